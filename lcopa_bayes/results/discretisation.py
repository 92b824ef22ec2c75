"""How far the width of the blocks moves a posterior, and narrower blocks where that is too far.

Two measures. Before sampling, at the best least-squares optimum: with W the whitening of the noise, J the
whitened Jacobian and d the change of the whitened response on narrower blocks, the optimum moves by
``(J' J + prior)^-1 J' d`` to first order. After sampling, at draws of the posterior, whatever its shape:
draws weighted by the ratio of the likelihoods on narrow and on used blocks have the mean that sampling on
narrow blocks would have had. Where responses cost much that has a control variate (Owen 2013, Monte Carlo
theory, methods and examples, 8.9): the same with responses that all change alike, at many draws of a
surrogate. A few draws on narrow blocks then say how they change, and what is not alike about it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias, final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.core.estimate import attributes
from lcopa_bayes.core.parallel import Workers, workers
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import Optimum, again, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.simulation import Simulated
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws

LARGEST = 0.1
"""Largest shift of a parameter by the width of the blocks that leaves a grade as it is [posterior sd]."""
UNUSABLE = 1.0
"""Shift at which numbers are not usable [posterior sd]."""
_NOTHING = 0.02
"""Shift that is not worth its digits [posterior sd]."""
FACTORS = (2, 4)
"""How many times narrower the blocks are on which shifts are measured."""
_REST = 16 / 15
"""Shift to blocks without width over that to blocks four times narrower, at second order; less at higher."""
FINEST = 16
"""Most by which blocks are narrowed [-]."""
_MOST_CELLS = 1 << 15
"""Blocks of all records together beyond which they are not narrowed: a fit takes as many times longer."""
_STARTS = 2
"""Starts of the search for the optimum."""
_DRAWS, _FEWER = 400, 128
"""Draws behind the measurement after sampling, and with effects, whose responses on narrow blocks cost more
than the sampling did; the error of the measurement says what they are worth."""
_PORTION = 32
"""Draws that one process takes at once [-]: of half as many each takes a seventh longer, on wide blocks a
third."""
_FIRST, _CLEAR = 32, 0.05
"""Draws that are looked at first, and shift with twice its error below which these are enough [posterior
sd]."""
_STAGES = (16, 32, 64, _FEWER)
"""Draws after which a measurement with a control variate may end."""
_CONTROLS = 500
"""Draws at which the control variate is evaluated."""
_PRECISE = 0.15 * LARGEST
"""Error, root mean square over parameters, with which such a measurement ends whatever the shifts [posterior
sd]. With 0.03 the grade of `studies/undeclared`, where one offset moves by 0.13, hung on the seed."""

Responses: TypeAlias = Callable[[Matrix], Sequence[Simulated]]
"""Every record at canonical table values, (batch, rows)."""


@final
@dataclass(frozen=True)
class Discretisation:
    """Shift of the posterior means by the width of the blocks."""

    parameter: str
    """The one that moves most."""
    shift: float
    """How far and to which side, on blocks without width [posterior sd]."""
    error: float
    """Standard error of `shift` from the number of draws [posterior sd]."""
    refinement: int
    """How many times narrower the blocks already are than the study sets."""

    blocks: int
    """Blocks of all fit records together [-]."""
    moved: tuple[str, ...] = ()
    """Every parameter that moves by more than is negligible."""

    @property
    def negligible(self) -> bool:
        """Whether no parameter moves by more than `LARGEST`, a small error of measurement aside: a large one,
        as of draws of which few have weight on narrow blocks, excuses nothing."""
        return bool(_negligible(self.shift, self.error))

    @property
    def sentence(self) -> str:
        """What was measured, a sentence without its full stop."""
        if abs(self.shift) + 2 * self.error < _NOTHING:
            return (
                f"The width of the {self.blocks} blocks moves no posterior mean by more than {_NOTHING:g} sd"
            )
        return (
            f"The width of the {self.blocks} blocks moves the posterior mean of {self.parameter} by "
            f"{abs(self.shift):.2f} ± {self.error:.2f} sd, that of every other parameter by less"
        )

    @property
    def limitations(self) -> tuple[Limitation, ...]:
        """None where the shift is negligible."""
        if self.negligible:
            return ()
        return (
            Limitation(
                "tentative" if abs(self.shift) < UNUSABLE else "unusable",
                f"the width of the blocks moves {self.parameter} by {abs(self.shift):.2g} posterior sd",
                "set [model] blocks to a larger number, or leave out the samples of the fastest onset",
                self.moved,
            ),
        )

    @classmethod
    def of_json(cls, values: Mapping[str, Any]) -> Discretisation:
        """From what `as_json` gave."""
        own = {key: values[key] for key in ("parameter", "refinement", "blocks")}
        moved = tuple(values["moved"])
        return cls(shift=values["shift_sd"], error=values["shift_error_sd"], moved=moved, **own)

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return {
            "parameter": self.parameter,
            "shift_sd": self.shift,
            "shift_error_sd": self.error,
            **attributes(self, "refinement", "blocks", "negligible"),
            "moved": list(self.moved),
        }


def resolved(problem: Problem, optima: Sequence[Optimum] | None = None) -> Problem:
    """The problem on blocks so narrow that the optimum moves by at most `LARGEST` sd on narrower ones.

    The same problem gives the same blocks; see `narrowed`. `optima` are its own, best first, where they are
    known already.
    """
    if optima is None:
        optima = optima_of(problem)
    if not optima:
        return problem
    best = optima[0].values
    return narrowed(problem, lambda each: optimum_shift(each, best))


def optima_of(
    problem: Problem, *, starts: int = _STARTS, near: Sequence[Vector] = (), jobs: int = 1
) -> tuple[Optimum, ...]:
    """Least-squares optima of a study, best first: what the first look, the width of the blocks and sampling
    begin with; `near` as `find_optima`. The same problem gives the same optima, whatever the number of
    processes, `jobs`."""
    rng = np.random.default_rng([problem.study.seed, 6])
    with workers(problem.posterior, jobs=jobs if problem.posterior.simulation is None else 1) as crew:
        return find_optima(problem.posterior, rng, starts=starts, near=near, crew=crew)


def resolved_optima(problem: Problem, optima: Sequence[Optimum]) -> tuple[Problem, tuple[Optimum, ...]]:
    """`resolved`, and the optima there; with effects until these ask for no narrower blocks: where the error
    of wide ones passes for noise, they seem narrow enough."""
    narrow = resolved(problem, optima)
    if narrow is problem:
        return problem, tuple(optima)
    found = again(narrow.posterior, optima, begun=True)
    return (narrow, found) if problem.ranges is None or not found else resolved_optima(narrow, found)


def narrowed(problem: Problem, shift: Callable[[Problem], float]) -> Problem:
    """The problem on blocks halved while the `shift` measured on them is larger than `LARGEST` sd.

    Not beyond `FINEST` or `_MOST_CELLS`, where the measurement after sampling gives the remaining shift.
    """
    while problem.refinement < FINEST and 2 * _cells(problem) <= _MOST_CELLS and shift(problem) > LARGEST:
        problem = problem.refined(2)
    return problem


def _cells(problem: Problem) -> int:
    """Blocks of all fit records together."""
    return sum(experiment.blocks for experiment in problem.posterior.model.experiments)


def optimum_shift(problem: Problem, values: Vector) -> float:
    """Largest shift of a free plant parameter at an optimum on narrower blocks [posterior sd].

    Parameters: values (rows,) of the table at the optimum. First order in the change of the response.
    """
    here = LeastSquares(problem.posterior)
    x = here.coordinates(values)
    residual, jacobian = here.residual(x, values)
    covariance = covariance_of(jacobian.T @ jacobian + np.diag(here.prior_precision))
    finer = [LeastSquares(problem.refined(factor).posterior) for factor in FACTORS]
    changes = [each.misfit(x, values) - residual for each in finer]  # slopes with effects cost most
    return largest_shift(covariance, jacobian, changes)


def largest_shift(covariance: Matrix, jacobian: Matrix, changes: Sequence[Vector]) -> float:
    """Largest shift of a parameter by changes of the whitened response on narrower blocks [posterior sd].

    Parameters: covariance (k, k) of the parameters at an optimum; jacobian (n, k) of the whitened response
    there; changes (n,) on blocks `FACTORS` times narrower.
    """
    sd = np.sqrt(np.diag(covariance))
    shifts = [np.abs(covariance @ (jacobian.T @ change)) / np.where(sd > 0, sd, np.inf) for change in changes]
    return float(np.max(shifts)) * _REST


def discretisation(
    problem: Problem, draws: Draws, *, surrogate: Responses | None = None, jobs: int = 1
) -> Discretisation:
    """Shift of the posterior mean of every free parameter on blocks four times narrower; with effects on
    `jobs` processes, and at fewer draws where a `surrogate` stands for the responses near them."""
    finer, used = problem.refined(FACTORS[-1]).posterior, problem.posterior
    rows = [k for k, row in enumerate(draws.table.rows) if row.free]
    with workers(None, jobs=1 if used.simulation is None else jobs) as crew:
        if surrogate is None:
            shifts, errors = _weighted(used, finer, draws, rows, crew)
        else:
            shifts, errors = _controlled(used, finer, draws, rows, crew, surrogate)
    worst = int(np.abs(shifts).argmax())
    names = [draws.table.names[k] for k in rows]
    return Discretisation(
        parameter=names[worst],
        shift=float(shifts[worst]),
        error=float(errors[worst]),
        refinement=problem.refinement,
        blocks=_cells(problem),
        moved=tuple(names[k] for k in np.flatnonzero(~_negligible(shifts, errors))),
    )


def _weighted(
    used: Posterior, finer: Posterior, draws: Draws, rows: Sequence[int], crew: Workers[None]
) -> tuple[Vector, Vector]:
    """Shifts of free parameters, table `rows`, and their standard errors, by weighted draws."""
    values = draws.thinned(_DRAWS if used.simulation is None else _FEWER)
    first = np.arange(len(values)) % max(1, len(values) // _FIRST) == 0
    values, change = np.concatenate([values[first], values[~first]]), np.empty(0)
    for end in dict.fromkeys((int(first.sum()), len(values))):
        portion = values[len(change) : end]
        parts = np.array_split(portion, max(1, len(portion) // _PORTION))
        there, here = (
            np.concatenate(list(crew.map(each.joint_log_likelihood, parts))) for each in (finer, used)
        )
        change = np.append(change, there - here)
        shifts, errors = _shifts(_scaled(values[:end, rows], values[:end, rows]), change)
        if (np.abs(shifts) + 2 * errors).max() < _CLEAR:
            break
    return shifts, errors


def _controlled(
    used: Posterior,
    finer: Posterior,
    draws: Draws,
    rows: Sequence[int],
    crew: Workers[None],
    surrogate: Responses,
) -> tuple[Vector, Vector]:
    """The same with a control variate; as many draws on narrow blocks as it takes until it is clear what is
    negligible, or the error is small beside that limit."""
    assert used.simulation is not None
    assert finer.simulation is not None
    values, many = draws.thinned(_FEWER), draws.thinned(_CONTROLS)
    values = values[_nested(len(values))]
    near = replace(used, surrogate=surrogate)
    level, every = near.joint_log_likelihood(many), draws.flat[:, rows]
    narrow, wide, change = list[Sequence[Simulated]](), list[Sequence[Simulated]](), np.empty(0)
    for end in (*(stage for stage in _STAGES if stage < len(values)), len(values)):
        portion = values[len(change) : end]
        parts = np.array_split(portion, max(2, len(portion) // _PORTION))  # for two processes at least
        there, here = (list(crew.map(each, parts)) for each in (finer.simulation, used.simulation))
        narrow, wide = [*narrow, *there], [*wide, *here]
        for part, after, before in zip(parts, there, here, strict=True):
            levels = (_given(used, units).joint_log_likelihood(part) for units in (after, before))
            change = np.append(change, np.subtract(*levels))
        moved = replace(used, surrogate=_Moved(surrogate, _mean_change(wide, narrow)))
        own, columns = values[:end], _scaled(values[:end, rows], every)
        alike = moved.joint_log_likelihood(own) - near.joint_log_likelihood(own)
        at_many = _shifts(_scaled(many[:, rows], every), moved.joint_log_likelihood(many) - level)
        unlike = _shifts(columns, change, alike)
        shifts, errors = at_many[0] + unlike[0], np.hypot(at_many[1], unlike[1])
        apart = np.abs(np.abs(shifts) - np.array([[LARGEST], [UNUSABLE]])).min(axis=0)
        if (apart > 2 * errors).all() or np.sqrt(np.mean(errors**2)) < _PRECISE:
            break
    return shifts, errors


@final
@dataclass(frozen=True)
class _Moved:
    """Responses that all change alike."""

    responses: Responses
    change: Sequence[Simulated]
    """Of every record, for a batch of one."""

    def __call__(self, values: Matrix) -> list[Simulated]:
        """Every record at canonical table values, (batch, rows)."""
        pairs = zip(self.responses(values), self.change, strict=True)
        return [
            Simulated(
                one.base + by.base,
                {k: column + by.columns[k] for k, column in one.columns.items()},
                one.bounded,
            )
            for one, by in pairs
        ]


def _given(posterior: Posterior, units: Sequence[Simulated]) -> Posterior:
    """A posterior whose responses are known, at the plants that they are of."""
    return replace(posterior, surrogate=lambda values: units)


def _mean_change(
    before: Sequence[Sequence[Simulated]], after: Sequence[Sequence[Simulated]]
) -> list[Simulated]:
    """Mean change of the responses of every record, for a batch of one, from several batches of plants; those
    that are not bounded do not count."""
    out = []
    for r in range(len(before[0])):
        pairs = [(one[r], other[r]) for one, other in zip(before, after, strict=True)]
        kept = np.concatenate([one.bounded & other.bounded for one, other in pairs])
        share = kept / max(1, int(kept.sum()))
        base = np.concatenate([other.base - one.base for one, other in pairs], axis=1)
        columns = {
            k: share @ np.concatenate([other.columns[k] - one.columns[k] for one, other in pairs])
            for k in pairs[0][0].columns
        }
        mean = np.einsum("b,abn->an", share, base)[:, None]
        out.append(Simulated(mean, {k: one[None] for k, one in columns.items()}, np.ones(1, dtype=bool)))
    return out


def _nested(count: int) -> Index:
    """Positions of draws in an order whose every beginning is spread over all of them."""
    place = np.arange(count) + _FEWER
    return np.argsort(-(place & -place), kind="stable")


def _scaled(columns: Matrix, every: Matrix) -> Matrix:
    """Parameters of some draws, less the mean of `every` draw and over their standard deviation."""
    sd = every.std(axis=0)
    return np.asarray((columns - every.mean(axis=0)) / np.where(sd > 0, sd, np.inf))


def _shifts(scaled: Matrix, change: Vector, than: Vector | None = None) -> tuple[Vector, Vector]:
    """Shifts of means of parameters and their standard errors, by draws (draws, parameters) and what narrower
    blocks change of their log likelihoods (draws,) [nat], over those by another change, by default none; both
    (parameters,) [posterior sd]."""
    apart = _weights(change) - (1.0 if than is None else _weights(than))
    terms = apart[:, None] * scaled
    return terms.mean(axis=0) * _REST, np.sqrt(np.mean(terms**2, axis=0) / len(terms))


def _weights(change: Vector) -> Vector:
    """Of draws by a change of their log likelihoods, (draws,), 1 on average [-]."""
    weights = np.exp(change - change.max())
    return np.asarray(weights / weights.mean())


def _negligible(shift: Vector | float, error: Vector | float) -> Flags:
    """Whether shifts are at most `LARGEST`, a small error of measurement aside [both in posterior sd]."""
    return np.asarray(np.abs(shift) - np.minimum(2 * error, LARGEST) <= LARGEST)
