"""Evidence of the draws: contraction, correlated parameters and the best-determined functions."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import Estimate, attributes, plain
from lcopa_bayes.core.units import per
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.results.sensitivity import Sensitivity
from lcopa_bayes.results.stepcurves import StepCurves, step_curves
from lcopa_bayes.results.steps import step_metrics
from lcopa_bayes.sampling.draws import Draws

FACTOR = 2.0
"""Upper over lower end of a gain, a time constant or a noise scale [-]: a controller that suits one end has
used up its customary gain margin, 6 dB, at the other, and a corner frequency is not known to an octave."""
ORDER = 0.5
"""Width of an order [-]: it turns the phase by 45 degrees, a customary phase margin, and does not distinguish
a half from a whole order."""
CORRELATION = 0.5
"""Width of a noise correlation [-]: half of all it may be."""
LEVEL = 0.5
"""Width of an offset over the range of the response [-]."""


@final
@dataclass(frozen=True)
class Tolerance:
    """Largest interval of an identified parameter."""

    width: float
    """Difference of its ends that is narrow enough, in the parameter's unit; 0 where their ratio counts."""
    ratio: float
    """Ratio of its ends that is narrow enough [-]; 1 where their difference counts."""
    unit: str

    @classmethod
    def of(cls, row: Parameter, scales: Scales) -> Tolerance:
        """Of a parameter of a plant or its noise; a delay may also be known to one sampling period only."""
        if row.kind == "order":
            return cls(ORDER, 1.0, row.unit)
        if row.kind == "rho":
            return cls(CORRELATION, 1.0, row.unit)
        if row.kind == "offset":
            return cls(LEVEL * float(scales.amplitude[row.place.first]), 1.0, row.unit)
        return cls(scales.period if row.kind == "delay" else 0.0, FACTOR, row.unit)

    def exceeded(self, lower: float, upper: float) -> str:
        """What is too wide about an interval, a clause; empty where it is narrow enough."""
        if upper - lower <= self.width:
            return ""
        if self.ratio == 1.0:
            unit = "" if self.unit == "-" else f" {self.unit}"
            return f"wider than {self.width:.3g}{unit}"
        if lower < 0 < upper:
            return "which leaves its sign open"
        smaller, larger = sorted((abs(lower), abs(upper)))
        if larger <= self.ratio * smaller:
            return ""
        if smaller == 0:
            return "which reaches to zero"
        return f"whose ends are a factor of {larger / smaller:.2g} apart"


_PRIOR_DRAWS = 4000
_COMPANION = 0.6
"""Rank correlation from which two parameters move together [-]."""
_STRAYING = 1000.0
"""A width relative to the median beyond this has no information [-]."""


@final
@dataclass(frozen=True, eq=False)
class Belief:
    """Posterior of one parameter beside its prior."""

    parameter: str
    contraction: float
    """``1 - var(posterior) / var(prior)`` on the sampled scale [-]: the share of the prior variance that the
    data remove."""
    companions: tuple[str, ...]
    """Parameters whose draws are rank-correlated with this one's, strongest first."""
    correlations: tuple[float, ...]
    """Spearman's rank correlations with them [-]."""
    modes: int
    """Separate modes of the marginal."""
    sensitivity: Sensitivity | None
    estimate: Estimate

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {
                "parameter": self.parameter,
                "contraction": self.contraction,
                "companions": dict(zip(self.companions, self.correlations, strict=True)),
                "modes": self.modes,
                "power_scaling": None if self.sensitivity is None else self.sensitivity.diagnosis,
            }
        )


@final
@dataclass(frozen=True, eq=False)
class Known:
    """A function of the parameters, by the posterior and by the prior."""

    estimate: Estimate
    relative_width: float
    """Width of the interval over the size of the median [-]; infinite when a side is open."""
    prior_relative_width: float
    """The same of prior draws [-]."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        fields: dict[str, Any] = self.estimate.as_json() | plain(
            attributes(self, "relative_width", "prior_relative_width", "verdict")
        )
        return fields

    @property
    def verdict(self) -> str:
        """Whether the draws bound the function, on both sides, one or none, and how narrowly."""
        ends = [np.isfinite(self.estimate.lower), np.isfinite(self.estimate.upper)]
        if not any(ends):
            return "practically unidentifiable"
        if not all(ends):
            return "one-sided"
        if not self.relative_width < 0.5 * self.prior_relative_width:
            return "prior-dominated"
        wide = Tolerance(0.0, FACTOR, self.estimate.unit).exceeded(self.estimate.lower, self.estimate.upper)
        return "weakly identified" if wide else "identified"


def prior_draws(landscape: Landscape, rng: np.random.Generator) -> Matrix:
    """Canonical draws of the prior, (draws, rows)."""
    return landscape.posterior.table.draw(_PRIOR_DRAWS, rng)


def prior_spread(landscape: Landscape, prior: Matrix) -> Vector:
    """Standard deviations of prior draws on the sampled scale, (rows,); NaN for what is fixed."""
    out = np.full(prior.shape[1], np.nan)
    for k in landscape.free:
        out[k] = landscape.column(k, prior).std()
    return out


def beliefs(
    landscape: Landscape, draws: Draws, prior_sd: Vector, moved: tuple[Sensitivity, ...]
) -> tuple[Belief, ...]:
    """Of every free parameter, in table order."""
    flat, names = draws.flat, [landscape.posterior.table.names[k] for k in landscape.free]
    columns = np.stack([landscape.column(k, flat) for k in landscape.free], axis=1)
    spearman = pd.DataFrame(columns).corr("spearman").fillna(0.0).to_numpy()
    by_name = {sensitivity.parameter: sensitivity for sensitivity in moved}
    estimates = {estimate.name: estimate for estimate in draws.estimates()}
    modes = {mode.parameter: len(mode.boundaries) + 1 for mode in draws.modes}
    out = []
    for p, (k, name) in enumerate(zip(landscape.free, names, strict=True)):
        order = [q for q in np.argsort(-np.abs(spearman[p])) if q != p and abs(spearman[p, q]) >= _COMPANION]
        out.append(
            Belief(
                parameter=name,
                contraction=float(1 - columns[:, p].var() / prior_sd[k] ** 2),
                companions=tuple(names[q] for q in order),
                correlations=tuple(float(spearman[p, q]) for q in order),
                modes=modes.get(name, 1),
                sensitivity=by_name.get(name),
                estimate=estimates[name],
            )
        )
    return tuple(out)


def known_best(draws: Draws, prior: Matrix, span: float, *, time_unit: str) -> tuple[Known, ...]:
    """Step metrics and steepest slopes of every path, the most precise first.

    `prior`, (draws, rows): draws of the prior, of which with effects the plant alone counts; `span`: length
    of the record [time unit].
    """
    alone = draws.table.without_effects
    prior = prior[:, [draws.table.names.index(name) for name in alone.names]]
    before = replace(draws, table=alone, values=prior[None], log_density=np.zeros((1, prior.shape[0])))
    functions = [_functions(each, span, time_unit) for each in (draws, before)]
    known = [
        Known(after, _width(after), _width(first))
        for after, first in zip(functions[0], functions[1], strict=True)
    ]
    return tuple(sorted(known, key=lambda known: known.relative_width))


def _functions(draws: Draws, span: float, time_unit: str) -> list[Estimate]:
    curves = step_curves(draws, span)
    metrics = [m for m in step_metrics(draws, curves, time_unit=time_unit) if m.value != 0 or m.upper != 0]
    wanted = ("rise_10_90", "value_at_end", "steady_state")
    return [m for m in metrics if m.name.startswith(wanted)] + _slopes(draws, curves, time_unit)


def _slopes(draws: Draws, curves: StepCurves, time_unit: str) -> list[Estimate]:
    """Steepest slope of the step response of every path, over the thousandth part of the record."""
    layout, step, out = draws.table.layout, float(curves.time[0]), []
    for i, j, path, unit in layout.paths:
        curve = curves.normalised[curves.curve_of[i][j]]
        steepest = np.diff(curve, axis=1, prepend=0.0).max(axis=1) / step
        slope, name = curves.gains[:, i, j] * steepest, f"steepest_slope[{path}]"
        out.append(Estimate.of(name, per(unit, time_unit), slope, ess=draws.ess, grade=draws.grade.level))
    return out


def _width(estimate: Estimate) -> float:
    """Width of the interval over the size of the median."""
    if not (np.isfinite(estimate.lower) and np.isfinite(estimate.upper)):
        return np.inf
    size = abs(estimate.value)
    width = estimate.upper - estimate.lower
    return float(width / size) if width < _STRAYING * size else np.inf
