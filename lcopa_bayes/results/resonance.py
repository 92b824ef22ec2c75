"""Undamped resonances faster than the samples resolve: a periodic disturbance, not a plant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.model.transfer import denominator
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws

PEAK = 10.0
"""Response at a resonance over that at rest from which it is undamped [-]: that of one term is
``1 / (2 |cos(pi order / 4)|)``, 10 at an order of 1.936."""
SHARE = 0.05
"""Share of the draws with such a resonance from which it limits the numbers [-]: one tail of an interval."""
MOST = 0.5
"""Share from which the numbers describe a disturbance, not a plant [-]."""
_SPAN = 200.0
"""Highest over lowest frequency that is searched [-]."""
_STEP = 0.01
"""Relative step of the frequencies [-]: a peak of 10 is a tenth of its frequency wide."""
_DRAWS = 400


@dataclass(frozen=True)
class Resonance:
    """An undamped resonance of one element that the samples do not resolve."""

    name: str
    """Name of the element; empty when the plant has one."""
    parameters: tuple[str, ...]
    """Times and orders of the element, and the gains of its paths."""
    share: float
    """Share of the draws that have it [-]."""
    samples: float
    """Median of its period over the sampling period [-]."""

    def concerns(self, row: Parameter) -> bool:
        """Whether a parameter is one of the disturbance."""
        return row.name in self.parameters

    def sentence(self, period: float, time_unit: str) -> str:
        """What it is, without a full stop."""
        of = f"element {self.name}" if self.name else "the element"
        return (
            f"in {100 * self.share:.0f} % of the draws {of} has an order near 2 and a resonance of period "
            f"{self.samples * period:.3g} {time_unit}, {self.samples:.2g} sampling periods: a periodic "
            "disturbance faster than the sampling resolves, not a plant"
        )


def unresolved(draws: Draws, period: float) -> tuple[Resonance, ...]:
    """Resonances in at least `SHARE` of the draws whose phase turns by more than a radian between samples.

    For one term that is a time constant below the sampling `period` [time unit]. Such an oscillation has at
    most 6.3 samples a period and, without damping, adds to every sample what the drive did long before: with
    its phase free it follows any disturbance of that frequency.
    """
    dynamics = draws.table.dynamics(draws.thinned(_DRAWS))
    out = []
    layout, rows = draws.table.layout, draws.table.rows
    for number, slot in enumerate(layout.elements):
        peak, at = peaks(dynamics.times[number] / period, dynamics.orders[number])
        undamped = peak >= PEAK
        share = float(undamped.mean())
        if share >= SHARE:
            own = tuple(
                row.name
                for k, row in enumerate(rows)
                if k in draws.table.terms[number].every
                or (row.kind == "gain" and layout.element_of[row.place.first][row.place.second] == number)
            )
            out.append(Resonance(slot.name, own, share, float(2 * np.pi / np.median(at[undamped]))))
    return tuple(out)


def peaks(times: Matrix, orders: Matrix) -> tuple[Vector, Vector]:
    """Largest ``|1 / (sum (i w T)^order + 1)|`` at angular frequencies above one, (batch,) [-], and where, in
    the reciprocal of the unit of `times`, (batch, terms)."""
    frequency = np.exp(np.arange(0.0, np.log(_SPAN), _STEP))
    below = denominator(times, orders, frequency)
    at = np.argmin(np.abs(below), axis=1)
    return 1 / np.abs(below[np.arange(at.size), at]), frequency[at]


def resonances(draws: Draws, period: float, time_unit: str) -> Iterator[Limitation]:
    """Limitations of every number by resonances that the sampling `period` [time unit] does not resolve."""
    for one in unresolved(draws, period):
        yield Limitation(
            "unusable" if one.share >= MOST else "tentative",
            f"numbers describe a plant only if this does: {one.sentence(period, time_unit)}",
            "sample faster, keep the priors of the times above the sampling period, or let `loop` trace the "
            "disturbance",
        )
