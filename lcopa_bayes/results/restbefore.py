"""What the plant rested under before a record: was it the drive of the first row?

Before its first row a plant is taken to rest under the drive of that row. `data.requirements` refuses a
response that moves by a tenth of its range before a drive does; one that moves by less, and a record whose
drive moves at once, pass there. Another drive before a record adds ``(u - u_0) K (1 - step response)`` to the
response. Such drives are fitted to all records that do not state one, together with the parameters, by
Gauss-Newton steps under the noise of the optimum. Where a record has samples at rest, these have to agree.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.core.wording import listed
from lcopa_bayes.data.requirements import FEWEST
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import GaussianNoise
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.crosscheck import holm

MOVED = 0.5
"""Shift of a parameter by other drives before records from which they limit the numbers [posterior sd]."""
_RARE = 1e-3
"""p-value from which another drive explains the start of a record better, all records together [-]."""
_FLAT = 1e-9
"""Relative size of slopes below which a drive cannot be seen in a record [-]."""
_STARTS, _STREAM = 3, 19
"""Starts of the search for the optimum beside the first levels, and what marks their randomness [-]."""
_STEPS, _SETTLED, _FAR = 8, 0.01, 3.0
"""Gauss-Newton steps at most; size of one, over the largest drive, that ends them [-]; and largest difference
of a drive from that of the first row, over its range in the records, that is believed [-]."""


def rest_before(problem: Problem, values: Vector) -> Iterator[Limitation]:
    """A limitation by the record whose start another drive before it explains best, where these drives move
    a parameter; none of a plant with effects, or under noise that is not Gaussian.

    `values` (rows,) of the table are near the optimum.
    """
    posterior = problem.posterior
    unknown = [r for r, samples in enumerate(posterior.samples) if _unknown(samples)]
    if not unknown or posterior.simulation is not None or not isinstance(posterior.noise, GaussianNoise):
        return
    none = np.zeros((len(unknown), len(problem.study.drive_axes)))
    start = _Begun.at(problem, unknown, none, values)
    adjusted, found = holm(start.surprises(start.step, start.left, start.left_beyond(start.step))), start
    if min(adjusted) >= _RARE:
        return
    settled = start.settled()
    if settled is not None:
        there = holm(settled.surprises(settled.levels, start.left, settled.left))
        if min(there) < _RARE:
            adjusted, found = there, settled
    worst = int(np.argmin(adjusted))
    one, said = posterior.samples[unknown[worst]], f"explains its start better (p = {adjusted[worst]:.1g})"
    record = one.record
    if found is start:  # beside the wrong drive the optimum is another one
        yield _limitation(one, f"another drive before it {said}")
    elif (shift := start.shift(found)).max() > MOVED:
        drive = record.drive[0] + found.levels[worst] * _ranges(problem)
        pairs = zip(record.drive_axes, drive, strict=True)
        levels = listed([f"{axis.name} = {measured(value, axis.unit, '.4g')}" for axis, value in pairs])
        name = posterior.table.names[start.own.columns[int(shift.argmax())]]
        said = f"{levels} {said} and moves {name} by {shift.max():.1f} posterior sd"
        yield _limitation(one, said)


def _unknown(samples: Samples) -> bool:
    """Whether no early row says what the plant rested under. Where no drive changes, what moves may drift."""
    return not np.isnan(samples.record.response[0]).all() and bool(np.isfinite(samples.first_change))


def _resting(samples: Samples) -> list[int]:
    """Samples at rest of each axis [-]; zero where there are too few to show it."""
    counts = [samples.quiet(axis).values.size for axis in range(len(samples.axes))]
    return counts if max(counts) >= FEWEST else [0] * len(counts)


def _limitation(samples: Samples, said: str) -> Limitation:
    seen = "whose response moves before its drive does" if any(_resting(samples)) else "which moves at once"
    return Limitation(
        "tentative",
        "intervals hold only if the plant rested under the drive of the first row before "
        f"{samples.record.name}, {seen}: {said}",
        f"{samples.record.early_row}, or let `loop` fit a drive before all records",
    )


@final
@dataclass(frozen=True, eq=False)
class _Begun:
    """The optimum of a study in which some records begin after another drive than that of their first row."""

    problem: Problem
    records: Sequence[int]
    levels: Matrix
    """Those drives less that of the first row, over the range of the drive, (records, drives) [-]."""
    own: LeastSquares
    """Of these records."""
    values: Vector
    """Table values, (rows,)."""

    @property
    def samples(self) -> Sequence[Samples]:
        """Of all records."""
        return self.problem.posterior.samples

    @classmethod
    def at(
        cls, problem: Problem, records: Sequence[int], levels: Matrix, values: Vector, *, starts: int = 0
    ) -> _Begun:
        """The optimum that a descent from some values reaches; `starts`, further ones, which may find a
        better one."""
        own = _after(problem, records, levels)
        found = own.solve(values)[0]
        if starts:
            rng = np.random.default_rng([problem.study.seed, _STREAM])
            optima = find_optima(own.posterior, rng, starts=starts, near=[found])
            found = optima[0].values if optima else found
        return cls(problem, records, levels, own, found)

    def settled(self) -> _Begun | None:
        """The levels that explain the records best; None where they are too far away to be found."""
        found, starts = self, _STARTS  # beside wrong levels the optimum is often another one
        for _ in range(_STEPS):
            step = found.step
            levels = found.levels + step
            largest = np.abs(levels).max()
            if largest >= _FAR:
                return None
            found = _Begun.at(self.problem, self.records, levels, found.values, starts=starts)
            if (np.abs(step) < _SETTLED * largest).all():  # the noise there is that of another residual
                return _Begun.at(self.problem, self.records, levels, found.values, starts=1)
            starts = 0
        return None

    @cached_property
    def _linear(self) -> tuple[Matrix, Vector, Matrix]:
        """Covariance of the parameters; the residual beyond their slopes; and the slopes of the levels beyond
        these, (samples, records * drives)."""
        x = self.own.coordinates(self.values)
        residual, jacobian = self.own.residual(x, self.values)
        basis, triangle = np.linalg.qr(np.vstack([jacobian, np.diag(np.sqrt(self.own.prior_precision))]))
        left, columns = np.zeros(len(basis)), np.zeros((len(basis), *self.levels.shape))
        left[: residual.size] = residual
        ends = np.cumsum([0, *(sum(axis.values.size for axis in one.axes) for one in self.samples)])
        for drive, unit in enumerate(np.eye(self.levels.shape[1])):
            other = _after(self.problem, self.records, self.levels + unit)
            change = other.misfit(x, self.values) - residual  # of a record by its own level alone
            for k, r in enumerate(self.records):
                columns[ends[r] : ends[r + 1], k, drive] = change[ends[r] : ends[r + 1]]
        flat = columns.reshape(len(basis), -1)
        covariance = np.linalg.pinv(triangle.T @ triangle, hermitian=True)
        return covariance, left - basis @ (basis.T @ left), flat - basis @ (basis.T @ flat)

    @property
    def step(self) -> Matrix:
        """To the levels that explain the records best, (records, drives) [-]."""
        _, left, columns = self._linear
        step = np.linalg.lstsq(columns, -left, rcond=_FLAT)[0]
        return np.asarray(step.reshape(self.levels.shape))

    @property
    def left(self) -> Vector:
        """Residual beyond the slopes of the parameters, (samples and priors,) [noise sd]."""
        return self._linear[1]

    def left_beyond(self, step: Matrix) -> Vector:
        """The same after a step of the levels, (records, drives)."""
        return np.asarray(self.left + self._linear[2] @ step.ravel())

    def surprises(self, levels: Matrix, before: Vector, after: Vector) -> list[float]:
        """p-value of each record's first row as the drive before it, at fitted levels (Wald 1943, Trans. Am.
        Math. Soc. 54). Of a record with samples at rest that of these alone where it is larger, by the fall
        of their squares from a residual `before` the levels were fitted to one `after` it."""
        columns = self._linear[2]
        covariance = np.linalg.pinv(columns.T @ columns, rcond=_FLAT, hermitian=True)
        count, drives = levels.shape
        blocks = covariance.reshape(count, drives, count, drives)
        inverses = [np.linalg.pinv(blocks[k, :, k, :], hermitian=True) for k in range(count)]
        powers = [one @ inverse @ one for one, inverse in zip(levels, inverses, strict=True)]
        squares = before**2 - after**2
        for k, rows in enumerate(self._at_rest):
            if rows.size:
                powers[k] = min(powers[k], squares[rows].sum())
        return [float(chi2.sf(power, drives)) for power in powers]

    @property
    def _at_rest(self) -> list[Index]:
        """Positions of the samples at rest of each record in the residual."""
        out, begin = [], 0
        for r, one in enumerate(self.samples):
            rows = list[int]()
            for axis, count in zip(one.axes, _resting(one), strict=True):
                rows += range(begin, begin + count)
                begin += axis.values.size
            if r in self.records:
                out.append(np.array(rows, dtype=np.intp))
        return out

    def shift(self, other: _Begun) -> Vector:
        """How far each search coordinate moves to another optimum, (k,) [posterior sd]."""
        sd = np.sqrt(np.diag(self._linear[0]))
        apart = np.abs(self.own.coordinates(other.values) - self.own.coordinates(self.values))
        return np.asarray(np.divide(apart, sd, out=np.zeros_like(apart), where=sd > 0))


def _ranges(problem: Problem) -> Vector:
    """Of the drives in all records, (drives,) [drive unit]."""
    return np.asarray(np.ptp(np.concatenate([one.drive for one in problem.study.fit]), axis=0))


def _after(problem: Problem, records: Sequence[int], levels: Matrix) -> LeastSquares:
    """The least-squares problem with these records after other drives, by `levels` as in `_Begun`."""
    fitted = list(problem.study.fit)
    for r, change in zip(records, levels * _ranges(problem), strict=True):
        fitted[r] = fitted[r].begun(fitted[r].drive[0] + change)
    samples, model = problem.simulated(fitted)
    return LeastSquares(replace(problem.posterior, samples=samples, model=model))
