"""Steady values that lie beyond the records, by a model that the records contradict.

A slow tail is what a plant bends first where something else is missing: of three lags in series, under a
clock of uncertain start, steady values came out at five times their truth, with narrow intervals and draws
that agree. What the responses reach by the end of a record is measured, whatever the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Self, final

from lcopa_bayes.core.estimate import quantile
from lcopa_bayes.effectsearch.openeffects import Weighed
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.results.steps import crosstalk_of

_MEASURED = ("delay", "value_at_end")
"""Figures of a step response that no steady value enters."""
_SHARE = 0.1
"""Share of a steady value that lies beyond the records from which it is an extrapolation [-]."""


@final
@dataclass(frozen=True)
class Extrapolated:
    """Paths whose steady value is an extrapolation."""

    shares: Mapping[str, float]
    """Of its steady value, what each path has not reached by the end of the longest record, by name [-]."""
    layout: Layout

    @classmethod
    def of(cls, figures: Sequence[Weighed], layout: Layout) -> Self:
        """By the figures of the response to a unit step over the longest record."""
        medians = {one.name: float(quantile(one.values, 0.5)) for one in figures}
        shares = {}
        for path in layout.paths:
            steady = medians.get(f"steady_state[{path.name}]", 0.0)
            if steady:
                shares[path.name] = 1.0 - medians[f"value_at_end[{path.name}]"] / steady
        return cls({name: share for name, share in shares.items() if share > _SHARE}, layout)

    def gain(self, response: int, drive: int) -> str:
        """Why the gain of a path says nothing of the plant, a sentence; empty where it does."""
        return self._said([self._path(response, drive)])

    def figure(self, name: str) -> str:
        """The same of a figure of a step response: of what it is measured by its steady value."""
        kind, _, place = name.removesuffix("]").partition("[")
        if kind in _MEASURED:
            return ""
        if kind != "crosstalk":
            return self._said([place])
        i, own, j = crosstalk_of(self.layout)[name]
        return self._said([self._path(i, j), self._path(own, j)])

    def _path(self, response: int, drive: int) -> str:
        return next(one.name for one in self.layout.paths if (one.response, one.drive) == (response, drive))

    def _said(self, paths: Sequence[str]) -> str:
        share = max((self.shares.get(path, 0.0) for path in paths), default=0.0)
        if not share:
            return ""
        return (
            f"By the model {100 * share:.0f} % of the steady value lies beyond the records, which hold "
            "something that this model does not explain: an extrapolation. What is measured is value_at_end."
        )
