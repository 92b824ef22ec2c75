"""One replica: a truth, records simulated from it, the inference a user runs, and where the truth ranks.

A study's records measured again on the virtual bench, at a given truth.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, NamedTuple, final, get_args

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.calibration.ranks import LEVELS, rank_of
from lcopa_bayes.calibration.truths import Truths
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import loss
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.results.discretisation import discretisation, resolved
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.results.stepcurves import StepCurves, curves_of, step_curves
from lcopa_bayes.sampling.draws import Draws, gather, weighted_draws
from lcopa_bayes.sampling.importance import Effort, ImportancePlan, importance
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.weightedrun import weighted_run

_FINER = 4
"""How many times narrower the blocks are on which effects are simulated [-]."""


def command_of(record: Record) -> Command:
    """The drive of a record: a value holds from its row to the next, and the plant rests before the first."""
    changed = np.flatnonzero((record.drive[1:] != record.drive[:-1]).any(axis=1)) + 1
    return Command(record.time[changed], record.drive[changed], record.drive[0])


def device_of(table: ParameterTable, truth: Vector, record: int, *, time_unit: str) -> Device:
    """The plant with the table values `truth`, (rows,), and the offsets it has on a fit record.

    Terms of equal orders are added up.
    """
    layout = table.layout
    paths = tuple(tuple(path.merged() for path in row) for row in table.paths(truth))
    offsets = tuple(float(table.offset(truth[None], i, record)[0]) for i in range(len(layout.responses)))
    return Device(paths, layout.drives, layout.responses, offsets, time_unit)


def exact_responses(problem: Problem, truth: Vector) -> list[Matrix]:
    """Responses of every fit record at its sample times without noise, (samples, axes) [response unit].

    Accuracy: that of `Device.response`; what the bench cannot do so accurately raises its error. With
    effects, which a device does not have, by the model on blocks four times narrower; UnstableError where
    there is no bounded response.
    """
    study, posterior = problem.study, problem.posterior
    if posterior.simulation is not None:
        return _simulated(problem.refined(_FINER), truth)
    return [
        device_of(posterior.table, truth, r, time_unit=study.time_unit).response(
            command_of(samples.record), samples.times, exposure=study.exposure
        )
        for r, samples in enumerate(posterior.samples)
    ]


def _simulated(problem: Problem, truth: Vector) -> list[Matrix]:
    posterior, values = problem.posterior, truth[None]
    out = []
    for r, one in enumerate(responses(posterior.table, posterior.model, values)):
        name = posterior.samples[r].record.name
        if not np.isfinite(one).all():
            raise UnstableError(problem.study.effects.use, name, "no bounded response at this truth")
        levels = [posterior.table.offset(values, axis, r)[0] for axis in range(one.shape[0])]
        out.append(one[:, 0].T + levels)
    return out


def measured(
    problem: Problem, truth: Vector, samples: Samples, exact: Matrix, rng: np.random.Generator
) -> Record:
    """A record with the `exact` responses at its sample times, (samples, axes), and noise of the study's
    noise model at the truth; drives, times and missing cells are its own."""
    posterior, record = problem.posterior, samples.record
    rows, response = np.searchsorted(record.time, samples.times), np.full(record.response.shape, np.nan)
    for axis, observed in enumerate(samples.axes):
        parameters = posterior.noise_parameters(truth[None], axis)
        noise = posterior.noise.draw(parameters, observed.gaps, rng)[0]
        response[rows[observed.index], axis] = exact[observed.index, axis] + noise
    return replace(record, response=response)


def model_gap(problem: Problem, truth: Vector, exact: Sequence[Matrix]) -> float:
    """Root sum of squares, over all samples, of forward model minus bench at the truth [noise scale].

    It bounds how many posterior standard deviations the discretisation of the model can shift anything.
    """
    posterior, values = problem.posterior, truth[None]
    modelled = responses(posterior.table, posterior.model, values)
    total = 0.0
    for r, (samples, clean) in enumerate(zip(posterior.samples, exact, strict=True)):
        for axis, observed in enumerate(samples.axes):
            offset = posterior.table.offset(values, axis, r)
            gap = modelled[r][axis][0][observed.index] + offset - clean[observed.index, axis]
            parameters = posterior.noise_parameters(values, axis)
            total += float(np.sum(posterior.noise.standard(gap[None], parameters, observed.gaps) ** 2))
    return float(np.sqrt(total))


RANKED = 99
"""Draws a truth is ranked among [-]; so few of a run's draws are nearly independent."""
_SHARES = (0.125, 0.25, 0.5, 1.0)
"""Where step responses are looked at: shares of the time between the longest delay and the span [-]."""
_LATEST = 0.999
"""Prior probability that a delay is shorter than what counts as the longest [-]."""
Engine = Literal["importance", "sampling"]
"""Importance sampling around the optima, with the ensembles where its weights are not good; or always the
ensembles."""
ENGINES: tuple[Engine, ...] = get_args(Engine)
_LOOK = ImportancePlan((Effort(3_000, 1_000, 6), Effort(8_000, 3_000, 6), Effort(8_000, 4_000, 6)), starts=3)
"""Work for importance sampling of a replica."""
_TRIES = 100
"""Truths drawn until one has bounded responses."""
_STREAM = 4
"""Marks the randomness of truth, noise and ranks apart from that of sampling."""


@final
class Quantity(NamedTuple):
    """What is ranked."""

    name: str
    kind: str
    """`parameter`, `step response`, or `log likelihood` (Modrák et al. 2025, Bayesian Analysis 20: it sees
    errors that leave every parameter's ranks uniform)."""
    unit: str


@final
@dataclass(frozen=True)
class Outcome:
    """What one replica gave; the tuples have one entry per quantity."""

    replica: int
    seed: int
    grade: str
    reason: str
    ess: float
    """Smallest effective sample size [draws]."""
    seconds: float
    """Processor time [s]."""
    gap: float
    """See `simulation.model_gap` [-]."""
    truths: tuple[float, ...]
    """True values, each in its quantity's unit."""
    ranks: tuple[int, ...]
    """0 to `RANKED`."""
    inside: tuple[tuple[bool, ...], ...]
    """Whether the central interval of each of `LEVELS` holds the truth."""
    engine: Engine
    """What gave the draws."""
    pareto_k: float | None
    """Of the importance weights [-]; None where none were tried or k is not finite."""
    refinement: int
    """How many times narrower the blocks became than the study asks [-]."""
    shift: float
    """Largest shift of a posterior mean by the width of the blocks, as the fit measures it [posterior sd]."""
    resolved: bool
    """Whether the fit takes that shift for negligible."""


@final
@dataclass(frozen=True)
class Failure:
    """A replica that could not be done."""

    replica: int
    seed: int
    error: str


@final
@dataclass(frozen=True, eq=False)
class Replication:
    """How replicas of a study are made; replica k depends on the seed of `plan` and on k alone."""

    problem: Problem
    plan: SamplePlan
    truths: Truths
    engine: Engine = "importance"

    def seed_of(self, number: int) -> int:
        """Root of all randomness of a replica."""
        return int(np.random.SeedSequence(self.plan.seed, spawn_key=(number,)).generate_state(1)[0])

    @cached_property
    def step_times(self) -> Vector:
        """Times after a unit step at which every path has begun to answer [time unit]."""
        table, span = self.problem.posterior.table, self.problem.scales.span
        delays = [table.rows[k] for k in table.of_kind("delay")]
        latest = max(row.value if row.prior is None else float(row.quantiles([_LATEST])[0]) for row in delays)
        begin = min(float(latest), span / 2)
        return np.array([begin + share * (span - begin) for share in _SHARES])

    @cached_property
    def quantities(self) -> tuple[Quantity, ...]:
        """All that is ranked: free parameters, step responses, joint log likelihood."""
        table, study = self.problem.posterior.table, self.problem.study
        out = [Quantity(row.name, "parameter", row.unit) for row in table.rows if row.free]
        out += [
            Quantity(f"step_response[{path.name}] at {at:.3g} {study.time_unit}", "step response", path.unit)
            for path in table.layout.paths
            for at in self.step_times
        ]
        return (*out, Quantity("log_likelihood", "log likelihood", "nat"))

    def attempt(self, number: int) -> Outcome | Failure:
        """The replica, or what went wrong with it: the others go on, and it is reported with its seed."""
        try:
            return self(number)
        except Exception as error:
            return Failure(number, self.seed_of(number), f"{type(error).__name__}: {error}")

    def lost(self, number: int, error: BaseException) -> Failure:
        """A replica whose worker was lost."""
        return Failure(number, self.seed_of(number), loss(error))

    def __call__(self, number: int) -> Outcome:
        """Draw, simulate, infer, rank."""
        start, seed = time.thread_time(), self.seed_of(number)
        streams = np.random.SeedSequence([seed, _STREAM]).spawn(4)
        drawing, noise, ranking, looking = map(np.random.default_rng, streams)
        truth, exact = self._bounded(drawing)
        pairs = zip(self.problem.posterior.samples, exact, strict=True)
        records = tuple(measured(self.problem, truth, one, clean, noise) for one, clean in pairs)
        problem, draws, engine, pareto_k = self._inferred(self._measured_again(records), seed, looking)
        posterior = problem.posterior
        width = discretisation(problem, draws)
        draws = draws.limited(width.limitations)
        curves = step_curves(draws, self.problem.scales.span)
        at = [int(np.abs(curves.time - moment).argmin()) for moment in self.step_times]
        true = self._true(posterior, truth, curves.time[at])
        drawn = self._drawn(posterior, draws, curves, at, ranking)
        return Outcome(
            number,
            seed,
            draws.grade.level,
            draws.grade.reason,
            draws.ess,
            time.thread_time() - start,
            model_gap(problem, truth, exact),
            tuple(true),
            tuple(
                rank_of(value, ranking.choice(column, RANKED, replace=False), ranking)
                for value, column in zip(true, drawn, strict=True)
            ),
            tuple(
                tuple(holds(column, value, level) for level in LEVELS)
                for value, column in zip(true, drawn, strict=True)
            ),
            engine,
            pareto_k,
            problem.refinement,
            abs(width.shift),
            width.negligible,
        )

    def _bounded(self, rng: np.random.Generator) -> tuple[Vector, list[Matrix]]:
        """A truth, and the responses it gives the study's records without noise.

        Where effects leave no bounded response the likelihood of any record is 0, and no inference draws such
        parameters: a truth like that is drawn again. UnstableError when none of `_TRIES` is bounded.
        """
        for left in reversed(range(1 if self.truths.fixed else _TRIES)):
            truth = self.truths.draw(rng)
            try:
                return truth, exact_responses(self.problem, truth)
            except UnstableError:
                if not left:
                    raise
        raise AssertionError("a truth is drawn at least once")

    def _measured_again(self, records: tuple[Record, ...]) -> Problem:
        """The problem of a replica's records.

        Where truths are drawn only the samples change: table and priors stay those a truth comes from. A
        stated truth has no such prior, and default priors are derived from the new records, as a fit does.
        """
        study = replace(self.problem.study, fit=records, effects=self.problem.stated_effects)
        if self.truths.fixed:
            return problem_of(study)
        samples = tuple(Samples.of(record, self.problem.scales.period) for record in records)
        return replace(self.problem, study=study, posterior=replace(self.problem.posterior, samples=samples))

    def _inferred(
        self, problem: Problem, seed: int, rng: np.random.Generator
    ) -> tuple[Problem, Draws, Engine, float | None]:
        """The problem on narrow enough blocks, draws, what gave them, and the Pareto k of weights."""
        look = None
        if self.engine == "importance" and problem.posterior.simulation is not None:
            problem = resolved(problem)
            result = weighted_run(problem.posterior, replace(self.plan, seed=seed), quick=True)
            if result is not None and result[0].weighted is not None:
                return problem, result[1], "importance", result[0].weighted.pareto_k
        elif self.engine == "importance":
            optima = find_optima(problem.posterior, rng, starts=_LOOK.starts)
            problem = resolved(problem, optima)
            look = importance(problem.posterior, optima, rng, _LOOK) if optima else None
        else:
            problem = resolved(problem)
        posterior = problem.posterior
        if look is not None and look.good(self.plan.target_ess):
            draws = weighted_draws(posterior, look.weighted, rng, target_ess=self.plan.target_ess)
            return problem, draws, "importance", look.weighted.pareto_k
        draws = gather(posterior, sample(posterior, replace(self.plan, seed=seed)))
        tried = look.weighted.pareto_k if look is not None and np.isfinite(look.weighted.pareto_k) else None
        return problem, draws, "sampling", tried

    def _true(self, posterior: Posterior, truth: Vector, times: Vector) -> list[float]:
        """True value of each quantity; step responses by the bench, or by the model where the plant has
        effects, which no device of the bench has."""
        table = posterior.table
        if posterior.simulation is None:
            device = device_of(table, truth, 0, time_unit=self.problem.study.time_unit)
            steps = [step_response(path, times) for row in device.paths for path in row]
        else:
            curves = curves_of(table, truth[None], self.problem.scales.span)
            at = [int(np.abs(curves.time - moment).argmin()) for moment in times]
            steps = _heights(curves, at)
        parameters = [value for value, row in zip(truth, table.rows, strict=True) if row.free]
        likelihood = posterior.joint_log_likelihood(truth[None])
        return [float(value) for value in np.concatenate([parameters, *steps, likelihood])]

    def _drawn(
        self,
        posterior: Posterior,
        draws: Draws,
        curves: StepCurves,
        at: Sequence[int],
        rng: np.random.Generator,
    ) -> list[Vector]:
        """Draws of each quantity; step responses at the positions `at` of the curves."""
        table = draws.table
        parameters = [draws.flat[:, k] for k, row in enumerate(table.rows) if row.free]
        steps = _heights(curves, at)
        picked = draws.flat[rng.choice(draws.flat.shape[0], RANKED, replace=False)]
        return [*parameters, *steps, posterior.joint_log_likelihood(picked)]


def _heights(curves: StepCurves, at: Sequence[int]) -> list[Vector]:
    """Step responses of every path at positions of the curves, one array (draws,) each."""
    return [
        curves.gains[:, i, j] * curves.normalised[unit][:, k]
        for i, row in enumerate(curves.curve_of)
        for j, unit in enumerate(row)
        for k in at
    ]


def holds(draws: Vector, truth: float, level: float) -> bool:
    """Whether the equal-tailed interval of the draws holds the truth."""
    tail = (1 - level) / 2
    low, high = np.quantile(draws, [tail, 1 - tail])
    return bool(low <= truth <= high)
