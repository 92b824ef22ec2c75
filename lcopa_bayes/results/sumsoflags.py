"""Sums of lags beside a fitted plant: what its paths may be if they are no Kelvin elements.

Each response axis has its own, held against the fitted plant by Akaike's criterion: other families follow the
records as well, and have other steady values and delays. Where sums of lags for all paths to an axis do not
follow it, because one of them rings, each path has its own beside the others as they are fitted: the samples
may lie anywhere along the slopes of what these add in their parameters.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.wording import listed
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.diffusion import KINDS, Kind
from lcopa_bayes.inference.lagsearch import LagSearch, likely
from lcopa_bayes.inference.lagsum import lag_problem, thinned
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import GaussianNoise
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.layout import Layout, PathSlot
from lcopa_bayes.results.stepcurves import StepCurves
from lcopa_bayes.results.steps import Metric, figures_of
from lcopa_bayes.sampling.lagdraws import LagDraws, LagMixture, lag_draws, lag_tasks

_SUPPORT = 10.0
"""Difference of Akaike's criterion beyond which the worse plant has no support [-]."""
_HOPELESS = 50.0
"""Difference beyond which no other kind is looked at: those in question differ by less [-]."""
_RISEN = 0.3
"""Share of its value at the end of the record that a response has reached before which its delay ends [-]."""
_STREAM = 17
"""Marks the randomness of these draws."""

_DIFFUSIONS = {"wall": "through a wall", "layer": "into a layer"}

Support = Literal["plant", "both", "lags"]


@final
@dataclass(frozen=True, eq=False)
class Alternative:
    """Sums of lags in place of the paths to one response axis."""

    paths: tuple[PathSlot, ...]
    """Those whose drive moves and whose gain is not known."""
    searches: tuple[LagSearch, ...]
    """Of each kind that follows the records about as well as the best, which is first."""
    advantage: float
    """Akaike's criterion of the fitted plant less that of the lags [-]."""
    square: float
    """Whitened residual of the fitted plant, squared [-]."""
    seed: int
    """Of the draws."""
    beside: tuple[PathSlot, ...] = ()
    """Paths to the same axis that stay as they are fitted."""
    drawn: LagMixture | None = None
    """Draws, where they are there already."""

    @property
    def search(self) -> LagSearch:
        """The best by BIC."""
        return self.searches[0]

    @property
    def support(self) -> Support:
        """Which of both the records leave in question."""
        if abs(self.advantage) <= _SUPPORT:
            return "both"
        return "lags" if self.advantage > 0 else "plant"

    @cached_property
    def draws(self) -> LagMixture:
        """Drawn where they are asked for, unless they are there."""
        return self.drawn or LagMixture.of(self.searches, self.seed)

    @property
    def ess(self) -> float | None:
        """Effective sample size of the draws [-]; None where the records give the lags no support."""
        return None if self.support == "plant" else self.draws.ess

    @property
    def said(self) -> str:
        """What they are."""
        best, most = self.search.best.lags, self.search.lags[-1]
        if self.search.kind == "lags":
            return f"sums of {best} to {most} lags"
        return f"diffusion {_DIFFUSIONS[self.search.kind]} and up to {most - 1} lag{'s' * (most > 2)}"

    def as_json(self) -> dict[str, Any]:
        """Plain values of the search."""
        best = self.search.best
        times = np.exp(best.coordinates[: -len(self.paths)]).reshape(len(self.paths), -1)
        return {
            "paths": [one.name for one in self.paths],
            "beside": [one.name for one in self.beside],
            "kind": self.search.kind,
            "said": self.said,
            "lags": best.lags,
            "times": [sorted(row) for row in times.tolist()],
            "aic_advantage": self.advantage,
            "support": self.support,
        }


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

    @cached_property
    def squares(self) -> Vector:
        """Whitened residual of each response axis, squared, at the samples that sums of lags follow [-]."""
        posterior, out = thinned(self.posterior), np.zeros(len(self.noise))
        assert isinstance(posterior.noise, GaussianNoise)
        units = posterior.responses(self.values[None])
        for r, samples in enumerate(posterior.samples):
            for axis, observed in enumerate(samples.axes):
                residual = posterior.residual(axis, r, observed, self.values[None], units[r])
                white = posterior.noise.standard(residual, self.noise[axis][None], observed.gaps)
                out[axis] += (white**2).sum()
        return out

    def square(self, axis: int) -> float:
        """That on one response axis [-]."""
        return float(self.squares[axis])

    def parameters(self, paths: Sequence[PathSlot]) -> int:
        """Free parameters that paths to one response axis use, others of the axis included [-]."""
        return len(_used(self.posterior.table, paths)) + (self.more[paths[0].response] if self.more else 0)


def lags_beside(
    plant: FittedPlant, kinds: Sequence[Kind] = KINDS, *, single: bool = True, crew: Crew = ALONE
) -> tuple[Alternative, ...]:
    """Sums of lags of these kinds beside a fitted plant: for each response axis that has any one for all of
    its paths, or, if `single`, where this has no support, one for each path that has; none where no drive
    moves or the records do not determine them. A `crew` searches several axes at once."""
    try:
        own = plant.posterior
        followed = own if plant.samples is None else replace(own, samples=plant.samples)
        problem = lag_problem(plant.problem.study, followed)
    except InputError:
        return ()
    axes = [paths for axis in range(len(plant.noise)) if (paths := _open(own, axis))]
    found = crew.sharing((plant, problem)).each(partial(_on_axis, kinds, single), axes)
    return tuple(one for on_axis in found for one in on_axis)


def held_against(
    found: Sequence[Alternative], chosen: FittedPlant, other: FittedPlant
) -> tuple[Alternative, ...]:
    """Sums of lags beside a chosen plant, held against another one where that follows a response better by
    Akaike's criterion."""

    def worse(one: Alternative) -> float:
        """What the chosen plant lacks on a response."""
        paths, axis = (*one.paths, *one.beside), one.search.axis
        own, others = (plant.square(axis) + 2 * plant.parameters(paths) for plant in (chosen, other))
        return max(own - others, 0.0)

    return tuple(replace(one, advantage=one.advantage - worse(one)) for one in found)


def with_draws(found: Sequence[Alternative], crew: Crew = ALONE) -> tuple[Alternative, ...]:
    """The same with draws of those to which the records give any support; a `crew` draws all at once."""
    tasks = [lag_tasks(one.searches, one.seed) if one.support != "plant" else [] for one in found]
    each = crew.map(_drawn, [task for own in tasks for task in own])
    parts = [list(islice(each, len(own))) for own in tasks]
    return tuple(
        replace(one, drawn=LagMixture.joined(own, one.seed)) if own else one
        for one, own in zip(found, parts, strict=True)
    )


def _drawn(task: tuple[LagSearch, int, int, float]) -> LagDraws:
    return lag_draws(*task)


def sentence_of(found: Sequence[Alternative]) -> str:
    """Which plants the records leave in question."""
    figures = "figures of the step responses are"
    said = {
        "both": f"follow the records as well as the fitted plant does: {figures} over both",
        "lags": f"follow the records better than the fitted plant: {figures} theirs",
        "plant": "do not follow the records as well as the fitted plant does",
    }
    return " ".join(
        f"{one.said[0].upper()}{one.said[1:]}{_where(one) if len(found) > 1 or one.beside else ''} "
        f"{said[one.support]} (AIC {'lower' if one.advantage > 0 else 'higher'} by {abs(one.advantage):.1f})."
        for one in found
    )


def _where(one: Alternative) -> str:
    beside = ", beside the other paths as they are fitted," if one.beside else ""
    return f" for {listed([path.name for path in one.paths])}{beside}"


def weights_of(layout: Layout, found: Sequence[Alternative]) -> dict[str, float]:
    """Of the sums of lags beside a plant, by path [-]; 0 where a path has none, or the records do not support
    them."""
    weights = {"plant": 0.0, "both": 0.5, "lags": 1.0}
    none = dict.fromkeys((one.name for one in layout.paths), 0.0)
    return none | {path.name: weights[one.support] for one in found for path in one.paths}


def weight_in(name: str, weight_of: Mapping[str, float]) -> float:
    """Of the sums of lags in a figure: that of its path, of a crosstalk the least of the paths involved."""
    path = name.partition("[")[2].removesuffix("]")
    return weight_of[path] if path in weight_of else min(weight_of.values())


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


def _on_axis(
    kinds: Sequence[Kind], single: bool, beside: tuple[FittedPlant, Problem], paths: tuple[PathSlot, ...]
) -> list[Alternative]:
    """Those in place of all paths to one response axis, or of some of them, `beside` a plant whose records
    the problem states for lags."""
    plant, problem = beside
    every = _alternative(plant, problem, paths, (), kinds)
    each: list[Alternative] = []
    if single and every.support == "plant" and len(paths) > 1:
        others = [tuple(other for other in paths if other != one) for one in paths]
        each = [
            _alternative(plant, problem, (one,), rest, kinds) for one, rest in zip(paths, others, strict=True)
        ]
    return [one for one in each if one.support != "plant"] or [every]


def _alternative(
    plant: FittedPlant,
    problem: Problem,
    paths: tuple[PathSlot, ...],
    beside: tuple[PathSlot, ...],
    kinds: Sequence[Kind],
) -> Alternative:
    axis = paths[0].response
    square, noise = plant.square(axis), plant.noise[axis]
    open_to = _slopes(plant, problem, beside)
    ends = np.array([_ends(plant, one) for one in paths])
    seed = plant.seed * 1_000 + 100 * paths[0].drive + 10 * _STREAM + axis
    drives = [one.drive for one in paths]
    level = square + 2 * plant.parameters((*paths, *beside)) - 2 * len(_used(plant.posterior.table, beside))

    def advantage(search: LagSearch) -> float:
        return level - search.aic

    searches = LagSearch.over(problem, axis, drives, noise, ends, kinds, open_to)
    hopeless = advantage(searches[0]) < -_HOPELESS
    searches = searches[:1] if hopeless else likely(searches)
    return Alternative(paths, searches, advantage(searches[0]), square, seed, beside)


def _slopes(plant: FittedPlant, problem: Problem, beside: Sequence[PathSlot]) -> tuple[Matrix, ...]:
    """Slopes of what some paths to one response axis add in their parameters where they are fitted, record
    by record of a `lag_problem`, (parameters, samples). Their gains are among them: what they add lies along
    these."""
    if not beside:
        return ()
    table, axis = plant.posterior.table, beside[0].response
    gains = [table.at("gain", axis, one.drive) for one in beside]
    used, values = sorted(_used(table, beside)), plant.values.copy()
    values[[k for k in table.of_kind("gain") if k not in gains]] = 0.0
    posterior = replace(plant.posterior, samples=problem.posterior.samples)
    blocks = LeastSquares(posterior).plain_slopes(values[None])
    return tuple(slopes[:, used].T for at, _, slopes, _ in blocks if at == axis)


def _used(table: ParameterTable, paths: Sequence[PathSlot]) -> set[int]:
    """Table positions of the free parameters of a plant that the paths use."""
    used: set[int] = set()
    for one in paths:
        used.add(table.at("gain", one.response, one.drive))
        used.add(table.at("delay", table.layout.delay_of[one.response][one.drive]))
        used.update(table.terms[table.layout.element_of[one.response][one.drive]].every)
    return {k for k in used if table.rows[k].free}


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
