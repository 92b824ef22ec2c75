"""Numbers over structures: what the fitted plant, integer orders and sums of lags leave open together.

A plant of Kelvin elements with its structure chosen is one family; the records may be followed as well by
others, whose steady values and delays are elsewhere though both leave the same residual. Sums of lags
(`inference.lagsum`) stand for these, and the corner of the family itself where orders are integers has its
part by evidence (`inference.integerorders`). Where Akaike's criterion leaves plant and lags any support, each
counts one half, whatever the evidence says: it rewards the family that needs fewer parameters, not the one
that is true (Burnham and Anderson 2002, Model Selection and Multimodel Inference, sect. 2.6). Bands of
records are those of the fitted plant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.crew import WORTHWHILE, Crew
from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL, Estimate, plain, quantile
from lcopa_bayes.core.units import measured
from lcopa_bayes.core.wording import listed
from lcopa_bayes.inference.diffusion import KINDS, Kind
from lcopa_bayes.inference.noise import GaussianNoise
from lcopa_bayes.results.averages import parts_of_sd, pooled, pooled_parts
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.integerfit import IntegerFit
from lcopa_bayes.results.steps import Metric, metrics_of
from lcopa_bayes.results.sumsoflags import (
    Alternative,
    FittedPlant,
    held_against,
    lag_figures,
    lags_beside,
    sentence_of,
    weight_in,
    weights_of,
    with_draws,
)
from lcopa_bayes.sampling.convergence import TENTATIVE_ESS, Grade, Limitation

_MOVED = 0.5
"""Shift of a median over its standard deviation from which a number counts as moved [-] ..."""
_WIDER = 1.5
"""... as from this width of its interval over that of the fitted plant [-]."""
_SHOWN = 4
"""Most numbers named in a sentence."""


_SAID = {"plant": "the fitted plant", "integer": "integer orders", "lags": "sums of lags"}
"""What the parts of a number are."""


@final
@dataclass(frozen=True, eq=False)
class Averaged:
    """One number over several plants."""

    estimate: Estimate
    parts: Mapping[str, Vector]
    """At draws of the fitted plant and of what else it is over, by their keys in `_SAID`, (draws,) [unit]."""
    shares: Mapping[str, float]
    """Of the parts; they add up to 1 [-]."""

    @property
    def plant(self) -> Vector:
        """At draws of the fitted plant, (draws,) [unit]."""
        return self.parts["plant"]

    @property
    def open(self) -> bool:
        """Whether the fitted plant is one of several that it is over."""
        return 0.0 < self.shares["plant"] < 1.0

    @property
    def others(self) -> str:
        """What it is over beside the fitted plant."""
        return " and ".join(_SAID[one] for one in self.parts if one != "plant" and self.shares[one])

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
        alone = {one: _ends_and_median(self.parts[one]) if one in self.parts else None for one in _SAID}
        shares = np.array([self.shares[one] for one in self.parts])
        noise, structure = parts_of_sd(*pooled_parts(list(self.parts.values()), shares))
        parts = {"shares": dict(self.shares), "sd_noise": noise, "sd_structure": structure}
        return self.estimate.as_json() | alone | parts


@final
@dataclass(frozen=True, eq=False)
class Alternatives:
    """Sums of lags and integer orders beside a fitted plant, and the numbers that all have."""

    alternatives: tuple[Alternative, ...]
    """Of every response axis that has any."""
    numbers: tuple[Averaged, ...]
    """Figures of the step responses that others than the fitted plant have a part in."""
    integer: IntegerFit | None = None

    @property
    def sentence(self) -> str:
        """Which plants the records leave in question."""
        integer = [self.integer.sentence] if self.integer else []
        return " ".join([*integer, sentence_of(self.alternatives)]).strip()

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
        moved = [one for one in self.numbers if one.open and one.moved and one.estimate.name in names]
        for others in dict.fromkeys(one.others for one in moved):
            own = [one.estimate for one in moved if one.others == others]
            said = [f"{one.name} at {one.lower:.3g} to {measured(one.upper, one.unit)}" for one in own]
            concerned = dict.fromkeys(parameter for one in own for parameter in names[one.name])
            out.append(
                Limitation(
                    "tentative",
                    f"{others} follow the records as well and leave {listed(said, _SHOWN)}",
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
                "integer_orders": self.integer.as_json() if self.integer else None,
                "numbers": [one.as_json() for one in self.numbers],
                "sentence": self.sentence,
            }
        )


def alternatives_of(
    fitted: Fit, kinds: Sequence[Kind] = KINDS, *, single: bool = True
) -> tuple[Alternative, ...]:
    """Sums of lags of these kinds beside a fit, perhaps for `single` paths; none where its noise is not
    normal, its plant has effects, or `lags_beside` has none."""
    plant = _plant(fitted)
    return lags_beside(plant, kinds, single=single) if plant else ()


def _plant(fitted: Fit) -> FittedPlant | None:
    """At the best of its draws; None of one that sums of lags are not held against."""
    posterior = fitted.problem.posterior
    if posterior.simulation is not None or not isinstance(posterior.noise, GaussianNoise):
        return None
    best, axes = fitted.best, range(len(posterior.table.layout.responses))
    noise = tuple(posterior.noise_parameters(best[None], axis)[0] for axis in axes)
    return FittedPlant(fitted.problem, best, noise, fitted.curves, fitted.run.plan.seed)


def with_alternatives(fitted: Fit, integer: IntegerFit | None, *, jobs: int = 1) -> Fit:
    """A fit with the figures of its step responses over all plants, that with `integer` orders among them,
    and what follows for its grade."""
    own, other = _plant(fitted), _plant(integer.draws) if integer else None
    with Crew(jobs if own else 1, after=WORTHWHILE) as crew:
        found = lags_beside(own, crew=crew) if own else ()
        if own and other:
            found = held_against(found, own, replace(other, noise=own.noise))
        found = with_draws(found, crew)
    if not found and integer is None:
        return fitted
    over = Alternatives(found, tuple(_numbers(fitted, found, integer)), integer)
    table = fitted.draws.table
    names = {}
    for one in table.layout.paths:
        slot = table.at("delay", table.layout.delay_of[one.response][one.drive])
        names[f"steady_state[{one.name}]"] = (table.names[table.at("gain", one.response, one.drive)],)
        names[f"delay[{one.name}]"] = (table.names[slot],)
    free = {name for row, name in zip(table.rows, table.names, strict=True) if row.free}
    stated = {key: value for key, value in names.items() if set(value) <= free}
    by_name = {number.estimate.name: number.estimate for number in over.numbers}
    return replace(
        fitted,
        draws=fitted.draws.limited(over.limitations(stated)),
        metrics=tuple(by_name.get(one.name, one) for one in fitted.metrics),
        alternatives=over,
    )


def _numbers(fitted: Fit, found: Sequence[Alternative], integer: IntegerFit | None) -> list[Averaged]:
    """Every figure of the step responses that another plant has a part in, over all plants."""
    table, unit = fitted.draws.table, fitted.study.time_unit
    weight_of = weights_of(table.layout, found)
    found = [one for one in found if one.support != "plant"]
    values, ess = {"plant": metrics_of(table, fitted.curves, time_unit=unit)}, [fitted.draws.ess]
    if integer is not None:
        own = integer.draws
        values["integer"] = metrics_of(own.draws.table, own.curves, time_unit=unit)
        ess.append(own.draws.ess)
    if found:
        values["lags"] = lag_figures(found, fitted.curves.time, unit)
        ess += [one.draws.ess for one in found]
    few = [] if min(ess) >= TENTATIVE_ESS else [Grade("tentative", "")]
    grade = Grade.worst([fitted.draws.grade, *few]).level
    share = integer.weight if integer else 0.0
    named = {kind: {one.name: one for one in own} for kind, own in values.items()}
    out = []
    for name, one in named["plant"].items():
        lags = weight_in(name, weight_of) if name in named.get("lags", {}) else 0.0
        shares = {"plant": (1 - lags) * (1 - share), "integer": (1 - lags) * share, "lags": lags}
        parts = {kind: own[name] for kind, own in named.items() if kind == "plant" or shares[kind]}
        if len(parts) > 1:
            out.append(_averaged(one, parts, {kind: shares[kind] for kind in parts}, min(ess), grade))
    return out


def _averaged(
    plant: Metric, parts: Mapping[str, Metric], shares: Mapping[str, float], ess: float, grade: str
) -> Averaged:
    values = {kind: one.values for kind, one in parts.items()}
    *over, last = (_SAID[kind] for kind in parts if shares[kind])
    notes = [f"of {_SAID[kind]} {one.note}" for kind, one in parts.items() if shares[kind] and one.note]
    note = "; ".join([f"over {', '.join(over)} and {last}" if over else f"of {last}", *notes])
    shown = pooled(list(values.values()), np.array([shares[kind] for kind in parts]))
    return Averaged(
        Estimate.of(plant.name, plant.unit, shown, ess=ess, grade=grade, note=note), values, shares
    )


def _ends_and_median(values: Vector) -> tuple[float, float, float]:
    """Lower end of the interval, median and upper end."""
    tail = (1 - LEVEL) / 2
    lower, middle, upper = (float(quantile(values, at)) for at in (tail, 0.5, 1 - tail))
    return lower, middle, upper
