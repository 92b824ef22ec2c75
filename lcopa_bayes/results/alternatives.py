"""Numbers over structures: what the fitted plant and sums of lags leave open together.

A plant of Kelvin elements with its structure chosen is one family; the records may be followed as well by
others, whose steady values and delays are elsewhere though both leave the same residual. Sums of lags
(`inference.lagsum`) stand for these. Where Akaike's criterion leaves both any support, each counts one half,
whatever the evidence says: it rewards the family that needs fewer parameters, not the one that is true
(Burnham and Anderson 2002, Model Selection and Multimodel Inference, sect. 2.6). Bands of records are those
of the fitted plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL, Estimate, plain, quantile
from lcopa_bayes.core.wording import listed
from lcopa_bayes.inference.diffusion import KINDS, Kind
from lcopa_bayes.inference.noise import GaussianNoise
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.steps import Metric, metrics_of
from lcopa_bayes.results.sumsoflags import (
    Alternative,
    FittedPlant,
    lag_figures,
    lags_beside,
    sentence_of,
    weight_in,
    weights_of,
)
from lcopa_bayes.sampling.convergence import TENTATIVE_ESS, Limitation

_MOVED = 0.5
"""Shift of a median over its standard deviation from which a number counts as moved [-] ..."""
_WIDER = 1.5
"""... as from this width of its interval over that of the fitted plant [-]."""
_SHOWN = 4
"""Most numbers named in a sentence."""


@final
@dataclass(frozen=True, eq=False)
class Averaged:
    """One number over both plants."""

    estimate: Estimate
    plant: Vector
    """At draws of the fitted plant, (draws,) [unit]."""
    lags: Vector
    """At draws of the sums of lags, (draws,) [unit]."""
    weight: float
    """Of the sums of lags [-]."""

    @property
    def moved(self) -> bool:
        """Whether the number is elsewhere, or open farther, than the fitted plant by itself says."""
        low, middle, high = _ends_and_median(self.plant)
        here = self.estimate
        if not np.isfinite([low, high]).all():
            return False
        if not np.isfinite([here.lower, here.value, here.upper]).all():
            return True
        shifted = abs(here.value - middle) > _MOVED * (high - low) / (2 * HALF_WIDTH)
        return bool(shifted or here.upper - here.lower > _WIDER * (high - low))

    def as_json(self) -> dict[str, Any]:
        """Plain values: the estimate, its parts, and what each plant says by itself."""
        alone = {"plant": _ends_and_median(self.plant), "lags": _ends_and_median(self.lags)}
        noise, structure = parts_of_sd([self.plant, self.lags], np.array([1 - self.weight, self.weight]))
        return self.estimate.as_json() | alone | {"sd_noise": noise, "sd_structure": structure}


@final
@dataclass(frozen=True, eq=False)
class Alternatives:
    """Sums of lags beside a fitted plant, and the numbers that both have."""

    alternatives: tuple[Alternative, ...]
    """Of every response axis that has any."""
    numbers: tuple[Averaged, ...]
    """Figures of the step responses that the sums of lags have a part in."""

    @property
    def sentence(self) -> str:
        """Which plants the records leave in question."""
        return sentence_of(self.alternatives)

    def limitations(self, names: Mapping[str, tuple[str, ...]]) -> list[Limitation]:
        """What this says of the parameters of the fitted plant, by the figure each of them is: `names` has
        the parameters of every figure."""
        out = []
        for one in self.alternatives:
            if one.support == "lags":
                paths = listed([path.name for path in one.paths])
                out.append(
                    Limitation(
                        "tentative",
                        f"{one.said} follow {paths} better than the fitted plant "
                        f"(AIC lower by {one.advantage:.0f})",
                        "read figures of the step responses, which are of these lags, and let `compare` "
                        "weigh other structures",
                    )
                )
        moved = [one.estimate for one in self.numbers if one.weight == 0.5 and one.moved]
        moved = [one for one in moved if one.name in names]
        if moved:
            said = [f"{one.name} at {one.lower:.3g} to {one.upper:.3g} {one.unit}" for one in moved]
            concerned = dict.fromkeys(parameter for one in moved for parameter in names[one.name])
            out.append(
                Limitation(
                    "tentative",
                    f"sums of lags follow the records as well and leave {listed(said, _SHOWN)}",
                    "record until the response settles, and sample its onset",
                    tuple(concerned),
                )
            )
        return out

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {
                "sums_of_lags": [one.as_json() | {"ess": one.ess} for one in self.alternatives],
                "numbers": [one.as_json() for one in self.numbers],
                "sentence": self.sentence,
            }
        )


def alternatives_of(
    fitted: Fit, kinds: Sequence[Kind] = KINDS, *, single: bool = True
) -> tuple[Alternative, ...]:
    """Sums of lags of these kinds beside a fit, perhaps for `single` paths; none where its noise is not
    normal, its plant has effects, or `lags_beside` has none."""
    posterior, draws = fitted.problem.posterior, fitted.draws
    if posterior.simulation is not None or not isinstance(posterior.noise, GaussianNoise):
        return ()
    best = draws.flat[[int(draws.log_density.argmax())]]
    best = posterior.complete(posterior.coordinates(best), None)
    axes = range(len(posterior.table.layout.responses))
    noise = tuple(posterior.noise_parameters(best, axis)[0] for axis in axes)
    seed = fitted.run.plan.seed
    plant = FittedPlant(fitted.problem, best[0], noise, fitted.curves, seed)
    return lags_beside(plant, kinds, single=single)


def with_alternatives(fitted: Fit) -> Fit:
    """A fit with the figures of its step responses over both plants, and what follows for its grade."""
    found = alternatives_of(fitted)
    if not found:
        return fitted
    other = Alternatives(found, tuple(_numbers(fitted, found)))
    table = fitted.draws.table
    names = {}
    for one in table.layout.paths:
        slot = table.at("delay", table.layout.delay_of[one.response][one.drive])
        names[f"steady_state[{one.name}]"] = (table.names[table.at("gain", one.response, one.drive)],)
        names[f"delay[{one.name}]"] = (table.names[slot],)
    free = {name for row, name in zip(table.rows, table.names, strict=True) if row.free}
    own = {key: value for key, value in names.items() if set(value) <= free}
    by_name = {number.estimate.name: number.estimate for number in other.numbers}
    return replace(
        fitted,
        draws=fitted.draws.limited(other.limitations(own)),
        metrics=tuple(by_name.get(one.name, one) for one in fitted.metrics),
        alternatives=other,
    )


def parts_of_sd(values: Sequence[Vector], weights: Vector) -> tuple[float, float]:
    """Standard deviation within and between the components of a mixture, each given by equally probable
    values; NaN where a component with a weight is open. Their squares add up to the mixture's variance."""
    kept = [(one, weight) for one, weight in zip(values, weights, strict=True) if weight > 0]
    if not all(np.isfinite(one).all() for one, _ in kept):
        return np.nan, np.nan
    share = np.array([weight for _, weight in kept])
    means = np.array([one.mean() for one, _ in kept])
    within = float(share @ np.array([one.var() for one, _ in kept]))
    between = float(share @ (means - share @ means) ** 2)
    return float(np.sqrt(within)), float(np.sqrt(between))


def _numbers(fitted: Fit, found: Sequence[Alternative]) -> list[Averaged]:
    """Every figure of the step responses that sums of lags have a part in, over both plants."""
    table, unit = fitted.draws.table, fitted.study.time_unit
    weight_of = weights_of(table.layout, found)
    found = [one for one in found if one.support != "plant"]
    if not found:
        return []
    own = metrics_of(table, fitted.curves, time_unit=unit)
    other = {one.name: one for one in lag_figures(found, fitted.curves.time, unit)}
    ess = min(fitted.draws.ess, *(one.draws.ess for one in found))
    grade = fitted.draws.grade.level if ess >= TENTATIVE_ESS else "tentative"
    out = []
    for one in own:
        if one.name not in other:
            continue
        weight = weight_in(one.name, weight_of)
        if weight > 0:
            out.append(_averaged(one, other[one.name], weight, ess, grade))
    return out


def _averaged(plant: Metric, lags: Metric, weight: float, ess: float, grade: str) -> Averaged:
    count = min(plant.values.size, lags.values.size)
    ours, theirs = (
        one.values[np.linspace(0, one.values.size - 1, count).astype(int)] for one in (plant, lags)
    )
    pooled = theirs if weight == 1.0 else np.concatenate([ours, theirs])
    own = f"of the fitted plant {plant.note}" if plant.note else ""
    notes = (
        ("of sums of lags", lags.note) if weight == 1.0 else ("over the fitted plant and sums of lags", own)
    )
    joined = "; ".join(note for note in notes if note)
    here = Estimate.of(plant.name, plant.unit, pooled, ess=ess, grade=grade, note=joined)
    return Averaged(here, plant.values, lags.values, weight)


def _ends_and_median(values: Vector) -> tuple[float, float, float]:
    """Lower end of the interval, median and upper end."""
    tail = (1 - LEVEL) / 2
    lower, middle, upper = (float(quantile(values, at)) for at in (tail, 0.5, 1 - tail))
    return lower, middle, upper
