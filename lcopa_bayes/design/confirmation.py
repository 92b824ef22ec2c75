"""Does a drive keep its promise: records of the virtual bench under it and under the plain step, refitted."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, final

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.bench.acquisition import Bench as VirtualBench
from lcopa_bayes.bench.acquisition import truth
from lcopa_bayes.bench.device import Device, TransferPath
from lcopa_bayes.design.design import Design
from lcopa_bayes.design.information import Bench
from lcopa_bayes.design.precision import Promise
from lcopa_bayes.estimate import LEVEL, plain
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.record import Record
from lcopa_bayes.settings import PriorSettings

REPLICAS = 16
"""Records simulated and fitted per drive."""
_RESAMPLED = 2000
"""Bootstrap samples behind the interval of a factor."""
_SAME = 1e-9
"""Orders closer than this are one term [-]."""
_AT_BOUND = 1e-3
"""Closer to an end of the search than this, on its coordinate, an estimate leans on it."""


@final
@dataclass(frozen=True, eq=False)
class Achieved:
    """Estimates from independent records of one drive."""

    drive: str
    errors: Matrix
    """Estimate minus truth relative to the size of the truth, in logarithms for time constants,
    (records, parameters) [-]."""
    expected: Vector
    """Cramer-Rao standard deviations at the truth, likewise relative, (parameters,) [-]."""
    at_bound: Matrix
    """Whether an estimate leans on the end of its search, (records, parameters) [-]."""

    @property
    def spread(self) -> Vector:
        """Standard deviations of the estimates, (parameters,) [-]."""
        return np.asarray(self.errors.std(axis=0, ddof=1))


@final
@dataclass(frozen=True, eq=False)
class Confirmation:
    """Expected against achieved precision of the winner and the plain step at one draw of the posterior."""

    names: tuple[str, ...]
    among: Flags
    """Parameters that the worst is sought among, (parameters,)."""
    truth: Vector
    """Values the records were simulated with, each in its unit, (parameters,)."""
    winner: Achieved
    step: Achieved
    factor: float
    """Worst achieved standard deviation after the step over that after the winner [-]."""
    lower: float
    """Lower end of its bootstrap interval at `LEVEL` [-]."""
    upper: float
    """Upper end [-]."""

    @property
    def expected(self) -> float:
        """The factor that the Cramer-Rao bounds promise at this truth [-]; perhaps infinite."""
        return float(self.step.expected[self.among].max() / self.winner.expected[self.among].max())

    @property
    def confirmed(self) -> bool:
        """Whether the winner is better by more than the scatter of the simulation."""
        return self.lower > 1.0

    @property
    def sentence(self) -> str:
        """What the simulation says."""
        count = self.winner.errors.shape[0]
        told = (
            f"{count} simulated records and fits each: the worst achieved standard deviation is {self.factor:.3g} "
            f"times ({100 * LEVEL:g} %: {self.lower:.3g} to {self.upper:.3g}) smaller than after the plain step"
        )
        promised = f"{self.expected:.3g} promised there" if isfinite(self.expected) else "the step promises none"
        held = int((self.step.at_bound[:, self.among] > 0).any(axis=1).sum())
        bound = (
            f"; {held} of {count} fits after the step lean on the end of a prior, so that its scatter is "
            "smaller than the data alone would leave it"
        ) * (held > 0)
        return f"{'confirmed' if self.confirmed else 'not confirmed'}: {told} ({promised}){bound}"

    def as_json(self) -> dict[str, Any]:
        """Plain values; infinite ones are None."""
        told: dict[str, Any] = plain(
            {
                "confirmed": self.confirmed,
                "sentence": self.sentence,
                "replicas": self.winner.errors.shape[0],
                "factor": {
                    "value": self.factor,
                    "unit": "-",
                    "lower": self.lower,
                    "upper": self.upper,
                    "level": LEVEL,
                    "interval": "bootstrap over records",
                    "expected": self.expected,
                },
                "parameters": [
                    {
                        "name": name,
                        "truth": self.truth[k],
                        "winner": _row(self.winner, k),
                        "step": _row(self.step, k),
                    }
                    for k, name in enumerate(self.names)
                ],
            }
        )
        return told


def _row(achieved: Achieved, k: int) -> dict[str, Any]:
    """Expected and achieved of one parameter, with the interval of a standard deviation of few estimates."""
    freedom, spread = achieved.errors.shape[0] - 1, float(achieved.spread[k])
    ends = [spread * np.sqrt(freedom / chi2.ppf(q, freedom)) for q in (0.5 + LEVEL / 2, 0.5 - LEVEL / 2)]
    return {
        "expected_relative_sd": float(achieved.expected[k]),
        "achieved_relative_sd": spread,
        "lower": ends[0],
        "upper": ends[1],
        "level": LEVEL,
        "interval": "chi-squared",
        "bias": float(achieved.errors[:, k].mean()),
        "at_bound": int(achieved.at_bound[:, k].sum()),
    }


def confirm(made: Design, *, replicas: int = REPLICAS) -> Confirmation | None:
    """Simulate and fit records of the winner and of the plain step; None when there is nothing to compare.

    The truth is the draw at which the winner's worst parameter is as precise as at the median draw. Fits are
    output-error least squares with the study's priors as support, started at the truth and at another draw
    of the posterior, the better one kept. `repeats` of the design are not simulated: both sides have one.
    """
    if not made.determined.any() or made.winner is made.step:
        return None
    worst = made.winner.relative[:, made.determined].max(axis=1)
    both = np.where(np.isfinite(worst), worst, np.inf)
    target = made.winner.worst(made.determined)
    chosen = int(np.argmin(np.abs(np.log(both / target))))
    values = made.draws[chosen]
    other = made.draws[(chosen + made.draws.shape[0] // 2) % made.draws.shape[0]]
    rng = np.random.default_rng([made.fit.run.plan.seed, 9])
    winner, step = (
        _achieved(made, promise, chosen, values, other, replicas, rng) for promise in (made.winner, made.step)
    )
    factor, low, high = _factor(winner.errors, step.errors, made.determined, rng)
    columns = [made.fit.draws.table.names.index(name) for name in made.names]
    return Confirmation(made.names, made.determined, values[columns], winner, step, factor, low, high)


def _factor(winner: Matrix, step: Matrix, among: Flags, rng: np.random.Generator) -> tuple[float, float, float]:
    """Ratio of the worst standard deviations with its bootstrap interval."""

    def worst(errors: Array) -> Array:
        return np.asarray(errors[..., among].std(axis=-2, ddof=1).max(axis=-1))

    drawn = [
        worst(errors[rng.integers(0, errors.shape[0], (_RESAMPLED, errors.shape[0]))])
        for errors in (step, winner)
    ]
    low, high = np.quantile(drawn[0] / drawn[1], (0.5 - LEVEL / 2, 0.5 + LEVEL / 2))
    return float(worst(step) / worst(winner)), float(low), float(high)


def _achieved(
    made: Design,
    promise: Promise,
    draw: int,
    values: Vector,
    other: Vector,
    replicas: int,
    rng: np.random.Generator,
) -> Achieved:
    """Errors of `replicas` fits after one drive."""
    study, period = made.fit.study, made.limits.period
    device = device_of(made.fit.problem, values)
    bench = VirtualBench(camera=period, exposure=study.model.exposure)
    command = promise.candidate.command
    clean = truth(device, bench, command, duration=promise.time, name="simulated")
    blocks = Bench(made.fit.problem, promise.time, period).blocks
    expected = np.sqrt(np.diagonal(promise.covariance[draw])) * np.sqrt(made.repeats)
    errors, bound = [], []
    for _ in range(replicas):
        problem = _refit(made, _noisy(made, clean, values, rng), blocks)
        found = _solve(problem, [_moved(made, problem, v) for v in (values, other)])
        errors.append(_errors(made, problem, found, values))
        bound.append(_leaning(made, problem, found))
    return Achieved(promise.candidate.name, np.array(errors), expected, np.array(bound))


def device_of(problem: Problem, values: Vector) -> Device:
    """The plant of table values as a device of the virtual bench; terms of equal orders are added up."""
    table, study = problem.posterior.table, problem.study
    gains = table.gains(values[None])[0]
    rows = []
    for i in range(len(table.layout.responses)):
        row = []
        for j in range(len(table.layout.drives)):
            e, d = table.layout.element_of[i][j], table.layout.delay_of[i][j]
            row.append(_path(table, values, float(gains[i, j]), e, float(values[table.at("delay", d)])))
        rows.append(tuple(row))
    offsets = [float(table.offset(values[None], i, 0)[0]) for i in range(len(table.layout.responses))]
    return Device(tuple(rows), study.drive_axes, study.response_axes, tuple(offsets), study.time_unit)


def _path(table: ParameterTable, values: Vector, gain: float, element: int, delay: float) -> TransferPath:
    etas: list[float] = []
    orders: list[float] = []
    for term in range(table.layout.elements[element].terms):
        order = float(values[table.at("order", element, term)])
        eta = float(values[table.at("time", element, term)]) ** order
        if orders and orders[-1] - order < _SAME:
            etas[-1] += eta
        else:
            etas.append(eta)
            orders.append(order)
    return TransferPath(gain, delay, tuple(etas), tuple(orders), 1.0)


def _noisy(made: Design, clean: Record, values: Vector, rng: np.random.Generator) -> Record:
    """The record with the study's noise at these values."""
    posterior, response = made.fit.problem.posterior, clean.response.copy()
    sampled = ~np.isnan(response[:, 0])
    gaps = np.ones(int(sampled.sum()))
    for axis in range(response.shape[1]):
        parameters = posterior.noise_parameters(values[None], axis)
        response[sampled, axis] += posterior.noise.draw(parameters, gaps, rng)[0]
    axes = (clean.drive_axes, clean.response_axes)
    return Record(clean.name, clean.time, clean.drive, response, *axes, clean.time_unit)


def _refit(made: Design, record: Record, blocks: int) -> Problem:
    """The study with the new record in place of its own, and its own priors."""
    study, table = made.fit.study, made.fit.draws.table
    priors = {}
    for row in table.rows:
        if row.kind != "offset":
            prior = row.prior
            priors[row.name] = (
                PriorSettings(row.name, fixed=row.value)
                if prior is None
                else PriorSettings(row.name, dist=prior.dist, parameters=prior.parameters)
            )
    model = replace(study.model, blocks=blocks, orders="free", terms=_terms(table))
    return problem_of(replace(study, fit=(record,), held_out=(), model=model, priors=priors))


def _terms(table: ParameterTable) -> int | dict[str, int]:
    elements = table.layout.elements
    return elements[0].terms if len(elements) == 1 else {slot.name: slot.terms for slot in elements}


def _moved(made: Design, problem: Problem, values: Vector) -> Vector:
    """Table values of the refitted study from those of the study; offsets from its first record."""
    old, new = made.fit.draws.table, problem.posterior.table
    out = np.empty(len(new.rows))
    for k, row in enumerate(new.rows):
        if row.kind == "offset":
            out[k] = old.offset(values[None], row.place.first, 0)[0] if row.free else row.value
        else:
            out[k] = values[old.names.index(row.name)]
    return out


def _solve(problem: Problem, starts: list[Vector]) -> Vector:
    """The best of the local solutions, all at the noise of the first start."""
    least = LeastSquares(problem.posterior)
    noise = [k for k, row in enumerate(problem.posterior.table.rows) if row.kind in ("sigma", "rho", "nu")]
    found = []
    for start in starts:
        at = start.copy()
        at[noise] = starts[0][noise]
        solved, _ = least.solve(at)
        residual, _ = least.residual(least.coordinates(solved), solved)
        found.append((float(residual @ residual), solved))
    return min(found, key=lambda each: each[0])[1]


def _errors(made: Design, problem: Problem, found: Vector, values: Vector) -> Vector:
    table, old = problem.posterior.table, made.fit.draws.table
    out = []
    for name in made.names:
        estimate, true = found[table.names.index(name)], values[old.names.index(name)]
        if old.rows[old.names.index(name)].kind == "time":
            out.append(np.log(estimate / true))
        else:
            out.append((estimate - true) / abs(true))
    return np.array(out)


def _leaning(made: Design, problem: Problem, found: Vector) -> Vector:
    """Whether each parameter stands at an end of its search, (parameters,)."""
    least, table = LeastSquares(problem.posterior), problem.posterior.table
    low, high = least.bounds
    at = least.coordinates(found)
    close = np.minimum(at - low, high - at) < _AT_BOUND
    leaning = {table.names[k]: bool(one) for k, one in zip(least.columns, close, strict=True)}
    return np.array([leaning[name] for name in made.names])
