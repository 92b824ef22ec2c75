"""The verb `design`: which drive, for how long, makes which parameters how precise.

What precision a drive promises: Cramer-Rao bounds at draws of the posterior.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import Estimate, quantile
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.experiments.candidates import PLAIN, Candidate, Limits, bench_times, candidates, limits_of
from lcopa_bayes.experiments.information import Bench
from lcopa_bayes.identifiability.contraction import prior_draws, prior_spread
from lcopa_bayes.identifiability.symmetries import DIFFERENCED, Structure, structure
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.model.forward import StepResponses
from lcopa_bayes.results.predictive import Predictive

_SINGULAR = 1e-13
"""Eigenvalues of the information between unit sensitivities below this are rounding [-]."""
_TOUCHED = 1e-6
"""Squared weight in a singular direction from which a parameter's variance is infinite [-]."""


@final
@dataclass(frozen=True, eq=False)
class Promise:
    """Cramer-Rao covariances of the plant's parameters after one drive of one length."""

    candidate: Candidate
    time: float
    """[time unit]."""
    covariance: Array
    """Relative to the size of each parameter, (draws, parameters, parameters) [-]; infinite on the diagonal
    and NaN beside it where the information is singular."""

    @property
    def relative(self) -> Matrix:
        """Standard deviation over the size of the value, (draws, parameters) [-]."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=1, axis2=2)))

    @property
    def expected(self) -> Vector:
        """Medians of `relative` over the draws, (parameters,) [-]; infinite when half the draws are."""
        return quantile(self.relative, 0.5)

    @property
    def excites(self) -> bool:
        """Whether at any draw any parameter is determined."""
        return bool(np.isfinite(self.relative).any())

    def worst(self, among: Flags) -> Vector:
        """Largest relative standard deviation among some parameters at every draw, (draws,) [-]."""
        return np.asarray(self.relative[:, among].max(axis=1))

    def typical(self, among: Flags) -> float:
        """Median over draws of ``det(covariance)^(1 / 2p)`` among p parameters [-]: the geometric mean of
        the standard deviations along its axes, smallest for the D-optimal drive; infinite when singular."""
        chosen = self.covariance[:, among][:, :, among]
        open_ = ~np.asarray(np.isfinite(chosen).all(axis=(1, 2)))
        bare = np.where(open_[:, None, None], np.eye(int(among.sum())), chosen)
        sign, logs = np.linalg.slogdet(bare)
        sizes = np.where(open_ | (sign <= 0), np.inf, np.exp(logs / (2 * among.sum())))
        return float(quantile(sizes, 0.5))


def ratios(over: Vector, under: Vector) -> Vector:
    """Quotients of standard deviations that may be infinite; 1 where both are."""
    both = np.isinf(over) & np.isinf(under)
    quotient = np.where(both, 1.0, over) / np.where(both, 1.0, under)
    return np.asarray(quotient)


def promises(
    bench: Bench,
    drives: Sequence[Candidate],
    draws: Matrix,
    *,
    repeats: int = 1,
    prior: Vector | None = None,
    jobs: int = 1,
) -> list[Promise]:
    """What each drive promises at draws (draws, rows) of table values, by `jobs` processes.

    `prior`, (parameters,): standard deviations on the sampled scale that count as information beforehand;
    None: the measurement alone.
    """
    with workers((bench, drives, repeats, prior), jobs=min(jobs, len(draws))) as crew:
        result = list(crew.each(_covariances, list(draws)))
    return [
        Promise(drive, bench.time, np.array(each))
        for drive, each in zip(drives, zip(*result, strict=True), strict=True)
    ]


def _covariances(
    shared: tuple[Bench, Sequence[Candidate], int, Vector | None], values: Vector
) -> list[Matrix]:
    """Covariance that each drive promises at table values (rows,), (parameters, parameters)."""
    (bench, drives, repeats, prior), result = shared, []
    known, sizes = StepResponses(), bench.sizes(values)
    for drive in drives:
        gram = repeats * bench.gram(values, drive.command, known) * np.outer(sizes, sizes)
        if prior is not None:  # of a logarithm it is relative already
            gram[np.diag_indices_from(gram)] += (np.where(bench.logarithmic, 1.0, sizes) / prior) ** 2
        result.append(cramer_rao(gram))
    return result


def cramer_rao(gram: Matrix) -> Matrix:
    """Covariance from Fisher information, (p, p): infinite variance where the information is singular.

    Singular is judged between sensitivities of unit length, so that it does not depend on units. Covariances
    with a parameter of infinite variance are NaN.
    """
    norms = np.sqrt(np.diag(gram))
    acting = norms > 0
    scale = np.where(acting, norms, 1.0)
    eigenvalues, vectors = np.linalg.eigh(gram / np.outer(scale, scale))
    blind = eigenvalues <= _SINGULAR * max(float(eigenvalues[-1]), 1e-300)
    kept = vectors[:, ~blind]
    covariance: Matrix = (kept / eigenvalues[~blind]) @ kept.T / np.outer(scale, scale)
    lost = ((vectors[:, blind] ** 2).sum(axis=1) > _TOUCHED) | ~acting
    covariance[lost] = np.nan
    covariance[:, lost] = np.nan
    covariance[lost, lost] = np.inf
    return covariance


def reached(times: Vector, spreads: Vector, wanted: float) -> tuple[float, bool] | None:
    """Bench time from which a spread is `wanted`, by straight lines between logarithms.

    Parameters: times increasing [time unit] and the spread at each, (times,) [-], perhaps infinite.
    Returns: the time and whether it is only an upper bound, because the shortest time tried (or the first
    at which the parameter is determined at all) is enough; None when no time tried is.
    """
    good = np.flatnonzero(spreads <= wanted)
    if good.size == 0:
        return None
    at = int(good[0])
    if at == 0 or not np.isfinite(spreads[at - 1]):
        return float(times[at]), True
    share = np.log(spreads[at - 1] / wanted) / np.log(spreads[at - 1] / spreads[at])
    return float(times[at - 1] * (times[at] / times[at - 1]) ** share), False


def within(drive: Candidate, limits: Limits) -> bool:
    """Whether a drive respects the limits, to rounding."""
    slack = 1e-9 * (limits.high - limits.low)
    levels = drive.command.values
    inside = (levels >= limits.low - slack) & (levels <= limits.high + slack)
    ticks = drive.command.times / limits.refresh
    return bool(inside.all() and np.allclose(ticks, np.round(ticks), atol=1e-6))


DRAWS, EFFECT_DRAWS = 24, 4
"""Draws of the posterior that are averaged over, and most of them with effects."""
WANTED = 0.1
"""Relative standard deviation that bench times are sought for [-]."""
LINEAR = 0.5
"""Relative standard deviation up to which a linear bound is believed [-]."""
_TOLERANCES = (1e-9, 3e-10, 1e-10)
"""Relative singular values below which a direction is blind [-]; under drives that change often the series
leave those of true symmetries at up to 1e-11."""
_PRIOR_POINTS = 12
"""Draws of the prior at which symmetries are looked for, besides those of the posterior."""


@final
@dataclass(frozen=True, eq=False)
class Design:
    """Promises of every drive at every bench time tried."""

    fit: Predictive
    limits: Limits
    repeats: int
    time: float
    """Bench time designed for [time unit]."""
    draws: Matrix
    """Table values averaged over, (draws, rows)."""
    names: tuple[str, ...]
    """Plant parameters."""
    tried: tuple[tuple[Promise, ...], ...]
    """Per bench time, increasing, one promise per drive, the plain step first."""
    structure: Structure

    @cached_property
    def here(self) -> tuple[Promise, ...]:
        """Promises at the bench time designed for."""
        return next(row for row in self.tried if row[0].time == self.time)

    @property
    def step(self) -> Promise:
        """The plain step of equal time."""
        return self.here[0]

    @cached_property
    def determined(self) -> Flags:
        """Whether some drive determines a parameter within the time designed for, (parameters,)."""
        best = np.min([one.expected for one in self.here], axis=0)
        blind = np.array([name in self.structure.blind for name in self.names])
        return np.asarray(np.isfinite(best) & ~blind)

    def factors(self, promise: Promise) -> Vector:
        """How many times smaller the worst relative standard deviation is than after the plain step of equal
        time, at every draw, (draws,) [-]; infinite where only the step leaves a parameter open."""
        return ratios(self.step.worst(self.determined), promise.worst(self.determined))

    @cached_property
    def winner(self) -> Promise:
        """Best for the worst parameter, against the plain step at the median draw; of equals the better on
        the whole. Draws are compared one by one because bounds differ by decades between them."""

        def key(one: Promise) -> tuple[float, float]:
            return -float(quantile(self.factors(one), 0.5)), one.typical(self.determined)

        return min(self.here, key=key)

    @cached_property
    def overall(self) -> Promise:
        """D-optimal: smallest volume of the region of confidence."""
        return min(self.here, key=lambda one: one.typical(self.determined))

    @property
    def worst(self) -> str:
        """The parameter the winner knows least at most draws."""
        places = np.argmax(np.where(self.determined, self.winner.relative, -np.inf), axis=1)
        return self.names[int(np.bincount(places).argmax())]

    @property
    def factor(self) -> Estimate:
        """`factors` of the winner: median and interval over the draws."""
        return self.over_draws("factor over the plain step", self.factors(self.winner))

    @property
    def linear(self) -> float:
        """Share of the draws at which the winner's worst bound is small enough to be believed [-]."""
        return float(np.mean(self.winner.worst(self.determined) <= LINEAR))

    def over_draws(self, name: str, column: Vector) -> Estimate:
        """What the draws of the posterior say of a number [-]."""
        return Estimate.of(name, "-", column, ess=float(column.size), grade=self.fit.draws.grade.level)

    def estimate(self, promise: Promise, name: str) -> Estimate:
        """Expected relative standard deviation of a parameter, with its spread over the draws."""
        return self.over_draws(name, promise.relative[:, self.names.index(name)])

    def best(self, name: str, row: tuple[Promise, ...]) -> Promise:
        """Best drive for one parameter at one bench time."""
        at = self.names.index(name)
        return min(row, key=lambda one: float(one.expected[at]))

    def time_needed(self, name: str) -> tuple[float, bool] | None:
        """Bench time for `WANTED` on a parameter by the best drive at each; see `reached`."""
        at = self.names.index(name)
        times = np.array([row[0].time for row in self.tried])
        spreads = np.array([self.best(name, row).expected[at] for row in self.tried])
        return None if name in self.structure.blind else reached(times, spreads, WANTED)

    def reason(self, name: str) -> str:
        """Why a parameter has no number, in words; empty when it has."""
        for symmetry in self.structure.symmetries:
            if name in symmetry.parameters:
                return f"structurally unidentifiable: before any noise, {symmetry.sentence}"
        if not self.determined[self.names.index(name)]:
            unit = self.fit.study.time_unit
            return f"at most draws of the posterior no drive tried determines it within {self.time:g} {unit}"
        return ""

    @cached_property
    def sentence(self) -> str:
        """The design in a sentence."""
        unit = self.fit.study.time_unit
        if not self.determined.any():
            return f"no drive tried determines any parameter within {self.time:g} {unit}"
        which = f"{self.winner.candidate.name} for {self.time:g} {unit}"
        if self.winner is self.step:
            return f"{which}: no drive tried is better for the worst parameter than the plain step"
        factor = self.factor.value
        gained = (
            f"{factor:.3g} times smaller than after the plain step of equal time"
            if np.isfinite(factor)
            else "bounded, where the plain step of equal time leaves a parameter open"
        )
        few = (
            f"; linear bounds can be believed at {100 * self.linear:.0f} % of the draws, elsewhere they say "
            "which drive is better but not how precise it will be"
        ) * (self.linear < 1)
        return f"{which}: the worst relative standard deviation (mostly {self.worst}) is {gained}{few}"


def checked(
    problem: Problem,
    *,
    time: float | None = None,
    repeats: int = 1,
    amplitude: float | None = None,
    refresh: float | None = None,
) -> tuple[Limits, tuple[float, ...], float]:
    """Limits, bench times to try and the one to design for; InputError when a design cannot be made."""
    if repeats < 1:
        raise InputError(f"`repeats` must be one or more; got {repeats}")
    limits = limits_of(problem, amplitude=amplitude, refresh=refresh)
    times, chosen = bench_times(problem, limits, time)
    if not Bench(problem, times[0], limits.period).columns:
        raise InputError(
            f"{problem.study.name}: no parameter of the plant is free; there is nothing to design for"
        )
    return limits, times, chosen


def design(
    fit: Predictive,
    *,
    time: float | None = None,
    repeats: int = 1,
    amplitude: float | None = None,
    refresh: float | None = None,
    with_prior: bool = False,
    draws: int = DRAWS,
    ladder: bool = True,
    jobs: int = 1,
) -> Design:
    """Compare candidate drives for a fitted study at many bench times.

    `time` [time unit of the study] is what the winner is chosen for, by default 40 spans of the records;
    without `ladder` no other time is tried, nor with effects a longer one; `jobs`, processes to use. The
    measurement counts alone unless `with_prior`. InputError as `limits_of` and `bench_times`, for fewer than
    one repeat, and when no plant parameter is free.
    """
    problem, study = fit.problem.thrifty, fit.study
    limits, times, chosen = checked(problem, time=time, repeats=repeats, amplitude=amplitude, refresh=refresh)
    if problem.ranges is not None:  # every drive takes simulations
        times, draws = tuple(one for one in times if one <= chosen), min(draws, EFFECT_DRAWS)
    first = Bench(problem, times[0], limits.period)
    averaged = fit.draws.thinned(draws)
    landscape = Landscape(problem.posterior)
    rng = np.random.default_rng([fit.study.seed, 7])
    believed = prior_draws(landscape, rng)
    known = prior_spread(landscape, believed)[list(first.columns)] if with_prior else None
    tried = []
    for each in times if ladder else (chosen,):
        drives = candidates(limits, each, np.random.default_rng([study.seed, 8]), unit=study.time_unit)
        possible = [drive for drive in drives if within(drive, limits)]
        if not possible or possible[0].name != PLAIN:
            raise InputError(f"no candidate drive lies inside the amplitude limit at {each:g}")
        bench = Bench(problem, each, limits.period)
        tried.append(tuple(promises(bench, possible, averaged, repeats=repeats, prior=known, jobs=jobs)))
    points = averaged if problem.ranges is not None else np.concatenate([averaged, believed[:_PRIOR_POINTS]])
    result = _symmetries(first, limits, points)
    return Design(fit, limits, repeats, chosen, averaged, first.names, tuple(tried), result)


def _symmetries(bench: Bench, limits: Limits, points: Matrix) -> Structure:
    """What no drive can distinguish, from all candidates of the shortest bench time together."""
    unit = bench.problem.study.time_unit
    drives = candidates(limits, bench.time, np.random.default_rng(0), unit=unit)
    slopes, values = [], []
    for point in points:
        known, sizes = StepResponses(), bench.sizes(point)
        if not (sizes > 0).all():  # a size of zero has no relative change
            continue
        stacked = [s for drive in drives for s in bench.slopes(point, drive.command, known)]
        slopes.append((np.concatenate(stacked, axis=1) * sizes[:, None]).T)
        values.append(point[list(bench.columns)])
    if not slopes:
        return Structure((), 0, 0, True, np.empty(0))
    tolerances = _TOLERANCES if bench.problem.ranges is None else DIFFERENCED
    return structure(bench.names, slopes, values, tolerances=tolerances)
