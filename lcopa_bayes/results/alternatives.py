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
from functools import cached_property
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL, Estimate, plain, quantile
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.lagsum import lag_problem, thinned
from lcopa_bayes.inference.noise import GaussianNoise
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.layout import Layout, PathSlot
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.steps import Metric, StepCurves, figures_of, metrics_of
from lcopa_bayes.results.summary import listed
from lcopa_bayes.sampling.convergence import TENTATIVE_ESS, Limitation
from lcopa_bayes.sampling.lagdraws import LagDraws, LagSearch, lag_draws

_SUPPORT = 10.0
"""Difference of Akaike's criterion beyond which the worse plant has no support [-]."""
_RISEN = 0.3
"""Share of its value at the end of the record that a response has reached before which its delay ends [-]."""
_MOVED = 0.5
"""Shift of a median over its standard deviation from which a number counts as moved [-] ..."""
_WIDER = 1.5
"""... as from this width of its interval over that of the fitted plant [-]."""
_SHOWN = 4
"""Most numbers named in a sentence."""
_STREAM = 17
"""Marks the randomness of these draws."""

Support = Literal["plant", "both", "lags"]


@final
@dataclass(frozen=True, eq=False)
class Alternative:
    """Sums of lags in place of the paths to one response axis."""

    paths: tuple[PathSlot, ...]
    """Those whose drive moves and whose gain is not known."""
    search: LagSearch
    advantage: float
    """Akaike's criterion of the fitted plant less that of the lags [-]."""
    square: float
    """Whitened residual of the fitted plant, squared [-]."""
    seed: int
    """Of the draws."""

    @property
    def support(self) -> Support:
        """Which of both the records leave in question."""
        if abs(self.advantage) <= _SUPPORT:
            return "both"
        return "lags" if self.advantage > 0 else "plant"

    @cached_property
    def draws(self) -> LagDraws:
        """Drawn where they are asked for."""
        return lag_draws(self.search, self.seed)

    @property
    def ess(self) -> float | None:
        """Effective sample size of the draws [-]; None where the records give the lags no support."""
        return None if self.support == "plant" else self.draws.ess

    def as_json(self) -> dict[str, Any]:
        """Plain values of the search."""
        best = self.search.best
        times = np.exp(best.coordinates[: -len(self.paths)]).reshape(len(self.paths), -1)
        return {
            "paths": [one.name for one in self.paths],
            "lags": best.lags,
            "times": [sorted(row) for row in times.tolist()],
            "aic_advantage": self.advantage,
            "support": self.support,
        }


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
    """One per response axis that has any."""
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
                        f"a sum of {one.search.best.lags} lags follows {paths} better than the fitted plant "
                        f"(AIC lower by {one.advantage:.0f})",
                        "read figures of the step responses, which are of the sum of lags, and let `compare` "
                        "weigh other structures",
                    )
                )
        moved = [one.estimate for one in self.numbers if one.weight == 0.5 and one.moved]
        moved = [one for one in moved if one.name in names]
        if moved:
            said = [f"{one.name} at {one.lower:.4g} to {one.upper:.4g} {one.unit}" for one in moved]
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


@final
@dataclass(frozen=True, eq=False)
class FittedPlant:
    """A plant at its optimum, which sums of lags are held against."""

    problem: Problem
    """Its posterior has no effects, and Gaussian noise."""
    values: Vector
    """Table values, (rows,)."""
    noise: tuple[Vector, ...]
    """Parameters of the noise of each response axis."""
    curves: StepCurves
    seed: int
    """Of draws of its rivals."""
    more: tuple[int, ...] = ()
    """Free parameters of each response axis beside those of the plant; by default none [-]."""
    samples: tuple[Samples, ...] | None = None
    """Those that its rivals follow, where they are not what the plant follows."""

    @property
    def posterior(self) -> Posterior:
        """Of its problem."""
        return self.problem.posterior


def alternatives_of(fitted: Fit) -> tuple[Alternative, ...]:
    """Sums of lags beside a fit; none where its noise is not normal, its plant has effects, or `lags_beside`
    has none."""
    posterior, draws = fitted.problem.posterior, fitted.draws
    if posterior.simulation is not None or not isinstance(posterior.noise, GaussianNoise):
        return ()
    best = draws.flat[[int(draws.log_density.argmax())]]
    best = posterior.complete(posterior.coordinates(best), None)
    axes = range(len(posterior.table.layout.responses))
    noise = tuple(posterior.noise_parameters(best, axis)[0] for axis in axes)
    seed = fitted.run.plan.seed
    return lags_beside(FittedPlant(fitted.problem, best[0], noise, fitted.curves, seed))


def lags_beside(plant: FittedPlant) -> tuple[Alternative, ...]:
    """Sums of lags beside a fitted plant, one for each response axis that has any; none where no drive moves
    or the records do not determine them."""
    try:
        own = plant.posterior
        followed = own if plant.samples is None else replace(own, samples=plant.samples)
        problem = lag_problem(plant.problem.study, followed)
    except InputError:
        return ()
    open_paths = [_open(plant.posterior, axis) for axis in range(len(plant.noise))]
    return tuple(_alternative(plant, problem, axis, paths) for axis, paths in enumerate(open_paths) if paths)


def sentence_of(found: Sequence[Alternative]) -> str:
    """Which plants the records leave in question."""
    figures = "figures of the step responses are"
    said = {
        "both": f"follow the records as well as the fitted plant does: {figures} over both",
        "lags": f"follow the records better than the fitted plant: {figures} theirs",
        "plant": "do not follow the records as well as the fitted plant does",
    }
    return " ".join(
        f"Sums of {one.search.best.lags} to {one.search.lags} lags"
        f"{f' for {listed([path.name for path in one.paths])}' if len(found) > 1 else ''} "
        f"{said[one.support]} (AIC {'lower' if one.advantage > 0 else 'higher'} by {abs(one.advantage):.1f})."
        for one in found
    )


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


def _open(posterior: Posterior, axis: int) -> tuple[PathSlot, ...]:
    """Paths to a response axis whose drive moves while it is sampled and whose gain is free; none where
    another gain is known and not zero."""
    table, out = posterior.table, []
    for one in table.layout.paths:
        if one.response != axis:
            continue
        row = table.rows[table.at("gain", axis, one.drive)]
        if not row.free and row.value != 0.0:
            return ()
        moves = any(
            experiment.drives[one.drive].moves and samples.axes[axis].values.size
            for experiment, samples in zip(posterior.model.experiments, posterior.samples, strict=True)
        )
        if row.free and moves:
            out.append(one)
    return tuple(out)


def _alternative(plant: FittedPlant, problem: Problem, axis: int, paths: tuple[PathSlot, ...]) -> Alternative:
    posterior, noise = thinned(plant.posterior), plant.noise[axis]
    assert isinstance(posterior.noise, GaussianNoise)
    units, square = posterior.responses(plant.values[None]), 0.0
    for r, samples in enumerate(posterior.samples):
        observed = samples.axes[axis]
        residual = posterior.residual(axis, r, observed, plant.values[None], units[r])
        square += float((posterior.noise.standard(residual, noise[None], observed.gaps) ** 2).sum())
    ends = np.array([_ends(plant, one) for one in paths])
    seed = plant.seed * 1_000 + 10 * _STREAM + axis
    search = LagSearch.over(problem, axis, [one.drive for one in paths], noise, ends)
    parameters = _parameters(posterior.table, paths) + (plant.more[axis] if plant.more else 0)
    advantage = square + 2 * parameters - search.best.square - 2 * search.best.parameters
    return Alternative(paths, search, advantage, square, seed)


def _parameters(table: ParameterTable, paths: Sequence[PathSlot]) -> int:
    """Free parameters of a plant that the paths use [-]."""
    used: set[int] = set()
    for one in paths:
        used.add(table.at("gain", one.response, one.drive))
        used.add(table.at("delay", table.layout.delay_of[one.response][one.drive]))
        used.update(table.terms[table.layout.element_of[one.response][one.drive]].every)
    return sum(table.rows[k].free for k in used)


def _ends(plant: FittedPlant, path: PathSlot) -> tuple[float, float]:
    """Ends of the delays that are looked at: those of the prior, not after the response has visibly begun."""
    curves, table, period = plant.curves, plant.posterior.table, plant.problem.scales.period
    row = table.rows[table.at("delay", table.layout.delay_of[path.response][path.drive])]
    if not row.free:
        return row.value, row.value + 1e-6 * period
    low, high = (max(float(end), 0.0) for end in row.domain)
    curve = np.median(curves.normalised[curves.curve_of[path.response][path.drive]], axis=0)
    begun = float(curves.time[(curve >= _RISEN * curve[-1]).argmax()])
    return low, max(min(high, max(begun, low + 2 * period)), low + 1e-6 * period)


def weights_of(layout: Layout, found: Sequence[Alternative]) -> dict[str, float]:
    """Of the sums of lags beside a plant, by path [-]; 0 where a path has none, or the records do not support
    them."""
    weights = {"plant": 0.0, "both": 0.5, "lags": 1.0}
    none = dict.fromkeys((one.name for one in layout.paths), 0.0)
    return none | {path.name: weights[one.support] for one in found for path in one.paths}


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


def weight_in(name: str, weight_of: Mapping[str, float]) -> float:
    """Of the sums of lags in a figure: that of its path, of a crosstalk the least of the paths involved."""
    path = name.partition("[")[2].removesuffix("]")
    return weight_of[path] if path in weight_of else min(weight_of.values())


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


def lag_figures(found: Sequence[Alternative], time: Vector, time_unit: str) -> list[Metric]:
    """Figures of the responses of sums of lags to a unit step, at times from 0 on [`time_unit`]; of paths
    without any nothing."""
    layout = found[0].search.problem.posterior.table.layout
    count = min(len(one.draws.delays) for one in found)
    shape = (len(layout.responses), len(layout.drives))
    gains, delays = np.zeros((count, *shape)), np.zeros((count, len(layout.delays)))
    own = {}
    for one in found:
        for p, path in enumerate(one.paths):
            own[path.response, path.drive] = (one.draws, p)
            gains[:, path.response, path.drive] = one.draws.gains[:count, p]
            delays[:, layout.delay_of[path.response][path.drive]] = one.draws.delays[:count, p]

    def normalised(at: Vector) -> Array:
        out = np.zeros((shape[0] * shape[1], count, at.size))
        for (i, j), (lags, p) in own.items():
            steady = gains[:, i, j, None]
            out[i * shape[1] + j] = lags.response(p, at)[:count] / np.where(steady == 0.0, 1.0, steady)
        return out

    curve_of = tuple(tuple(i * shape[1] + j for j in range(shape[1])) for i in range(shape[0]))
    curves = StepCurves(time, normalised(time), gains, delays, curve_of, np.empty((count, 0)))
    without = [one.name for one in layout.paths if (one.response, one.drive) not in own]
    figures = figures_of(layout, curves, normalised, time_unit=time_unit)
    return [one for one in figures if not any(f"[{name}]" in one.name for name in without)]


def _ends_and_median(values: Vector) -> tuple[float, float, float]:
    """Lower end of the interval, median and upper end."""
    tail = (1 - LEVEL) / 2
    lower, middle, upper = (float(quantile(values, at)) for at in (tail, 0.5, 1 - tail))
    return lower, middle, upper
