"""The integer-order rival of a fit: the same study with every order held at its nearest integer."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from lcopa_bayes.core.units import measured
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.summary import scores


@final
@dataclass(frozen=True, eq=False)
class Rival:
    """A fitted rival beside the fit it rivals."""

    orders: Mapping[str, float]
    """Integer each free order was held at [-]."""
    fit: Fit
    against: Fit

    def as_json(self) -> dict[str, Any]:
        """Orders, grade, evidence and held-out scores of the rival, and what it is held against."""
        weighed = self.fit.evidence
        return {
            "orders": dict(self.orders),
            "grade": self.fit.draws.grade.level,
            "grade_reason": self.fit.draws.grade.reason,
            "log_evidence": weighed.value if weighed else None,
            "log_evidence_sd": weighed.sd if weighed else None,
            "held_out": scores(self.fit, held_out=True),
            "fit_scores": scores(self.fit, held_out=False),
            "sentence": self.sentence,
        }

    @property
    def sentence(self) -> str:
        """Held-out errors of both, with the rival's grade."""
        held = ", ".join(f"{name} = {order:g}" for name, order in self.orders.items())
        pairs = zip(self.fit.bands, self.against.bands, strict=True)
        said = ", ".join(
            f"{rival.record}/{rival.axis} RMSE {measured(rival.rmse, rival.unit)} "
            f"(free orders: {own.rmse:.3g}{'; offset from these samples' if rival.own_offset else ''})"
            for rival, own in pairs
            if rival.held_out
        )
        return f"With integer orders ({held}; grade {self.fit.draws.grade.level}), held out: {said}."


def integer_study(fitted: Fit) -> tuple[Study, dict[str, float]] | None:
    """The study with every free order fixed at the integer nearest to its median, 1 at least.

    None when no order is free. Rounding keeps decreasing orders from increasing.
    """
    table = fitted.draws.table
    free = [row.name for row in table.rows if row.kind == "order" and row.free]
    if not free:
        return None
    orders = {name: max(1.0, float(np.round(np.median(fitted.draws.column(name))))) for name in free}
    held = {name: PriorSettings(name, fixed=order) for name, order in orders.items()}
    return replace(fitted.study, priors=dict(fitted.study.priors) | held), orders


def integer_rival(fitted: Fit, *, jobs: int = 1, quick: bool = False, quiet: bool = True) -> Rival | None:
    """Fit the rival by the same procedure; None when no order is free or no record is held out."""
    rival = integer_study(fitted)
    if rival is None or not fitted.study.held_out:
        return None
    study, orders = rival
    return Rival(orders, fit(study, jobs=jobs, quick=quick, quiet=quiet), fitted)
