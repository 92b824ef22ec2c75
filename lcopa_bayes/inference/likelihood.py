"""The likelihood alone, maximised over all parameters but one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import final

import numpy as np
from scipy.linalg import solve_triangular
from scipy.optimize import least_squares, minimize

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.leastsquares import LeastSquares, apart
from lcopa_bayes.inference.posterior import Posterior

_TAIL = 1e-9
"""Prior mass beyond either end of a search where a prior has no end of its own [-]."""
_FAR = 100.0
"""Standard deviations of such a prior that are searched where it is not on a logarithmic scale [-]."""
_EDGE = 1e-6
"""Distance kept from the ends of a search, relative to its width [-]."""
_AT_END = 1e-3
"""Closer to an end than this share of the search counts as at its bound [-]."""
_STIFFNESS = 1e3
"""Weight of a residual row that keeps orders decreasing [-]: a force of 1 moves them by 1e-6."""
_EVALUATIONS = 60
_ROUNDS = 12
_NUDGE, _LEVEL = 1e-4, 0.03
"""Step of a difference and slope at which a maximum is reached, per standard deviation [-], [nat]."""
_GAINED = 1e-3
"""Rounds between plant and noise end when the noise, or a round, gains less: the plant that was fitted before
fits it still [nat]."""


@final
@dataclass(frozen=True, eq=False)
class Peak:
    """A maximum of the likelihood, perhaps with one parameter held."""

    values: Vector
    """Table values, (rows,); orders may increase by 1e-6 where terms merge."""
    log_likelihood: float
    """[nat]."""


@final
@dataclass(frozen=True, eq=False)
class Landscape:
    """Log likelihood of all free parameters, none integrated out; of the priors only the support counts.

    Coordinates are those on which a parameter is sampled: logarithms of time constants and noise scales,
    logits of correlations, plain values of the rest.
    """

    posterior: Posterior
    precision: Matrix | None = None
    """Of the free parameters in their coordinates, (free, free), with a surrogate, whose maxima are sought in
    all parameters at once; None without."""

    @classmethod
    def about(cls, posterior: Posterior, values: Matrix) -> Landscape:
        """With the precision of draws (draws, rows) where a surrogate stands for the posterior."""
        plain = cls(posterior)
        if posterior.surrogate is None:
            return plain
        columns = np.stack([plain.column(k, values) for k in plain.free])
        return replace(plain, precision=np.asarray(np.linalg.inv(np.cov(columns)), dtype=float))

    @cached_property
    def free(self) -> tuple[int, ...]:
        """Table positions of the free parameters."""
        return tuple(k for k, row in enumerate(self.posterior.table.rows) if row.free)

    @cached_property
    def least(self) -> LeastSquares:
        """Whitened residuals and their exact derivatives."""
        return LeastSquares(self.posterior)

    def coordinate(self, k: int, value: float) -> float:
        """Coordinate of one parameter's value."""
        return float(self.posterior.table.rows[k].coordinate(value))

    def value(self, k: int, coordinate: float) -> float:
        """Value of one parameter's coordinate."""
        return float(self.posterior.table.rows[k].value_at(coordinate))

    def column(self, k: int, values: Matrix) -> Vector:
        """Coordinates of one parameter of many table values, (batch,)."""
        return self.posterior.table.rows[k].coordinate(values[:, k])

    def search(self, k: int) -> tuple[float, float]:
        """Ends of the search of one free parameter in its coordinate: its domain, or for a prior without ends
        of its own 100 standard deviations, on logarithmic scales the decades with all but 2e-9 of its mass.
        """
        return self._searches[k]

    @cached_property
    def _searches(self) -> dict[int, tuple[float, float]]:
        return {k: self._search(k) for k in self.free}

    def _search(self, k: int) -> tuple[float, float]:
        row = self.posterior.table.rows[k]
        assert row.prior is not None
        low, high = row.domain
        tails = row.quantiles((_TAIL, 1 - _TAIL))
        if not (row.log_scale or row.logit_scale):
            mean, sd = row.prior.frozen.mean(), row.prior.sd
            tails = np.array([mean - _FAR * sd, mean + _FAR * sd]) if np.isfinite(sd) else tails
        closed = row.log_scale or row.logit_scale  # zero and one are infinitely far away
        if not np.isfinite(low) or (closed and low <= 0.0):
            low = max(low, float(tails[0]))
        if not np.isfinite(high) or (row.logit_scale and high >= 1.0):
            high = min(high, float(tails[1]))
        a, b = self.coordinate(k, low), self.coordinate(k, high)
        edge = _EDGE * (b - a)
        return a + edge, b - edge

    def log_likelihood(self, values: Matrix) -> Vector:
        """Of canonical table values (batch, rows), (batch,) [nat]."""
        return self.posterior.joint_log_likelihood(values)

    def maximise(self, start: Vector, *, held: int | None = None, most: int = _EVALUATIONS) -> Peak:
        """A local maximum from table values; the parameter `held` keeps the value it starts with.

        Plant and noise parameters are maximised in turn until nothing is gained.
        """
        if self.precision is not None:
            return self._jointly(start, held)
        noise_moves = any(k not in self.least.columns and k != held for k in self.free)
        values, best = start, -np.inf
        for _ in range(_ROUNDS if noise_moves and not self._one_scale else 1):
            both = [self._plant(values, held, most)]
            if noise_moves:
                both.append(self._noise(both[0], held))
            values, levels = both[-1], self.log_likelihood(self.posterior.table.canonical(np.array(both)))
            gained, best = min(levels[-1] - best, levels[-1] - levels[0]), max(best, float(levels[-1]))
            if gained < _GAINED:
                break
        return Peak(values, best)

    @cached_property
    def _one_scale(self) -> bool:
        """Whether noise is a scale of one response alone, which leaves the plant's maximum where it is."""
        return self.posterior.noise.names == ("sigma",) and len(self.posterior.table.layout.responses) == 1

    def exact(self, values: Matrix) -> Vector:
        """`log_likelihood` of the posterior itself where a surrogate stands for it, (batch,) [nat]."""
        plain = replace(self.posterior, surrogate=None)
        return plain.joint_log_likelihood(self.posterior.table.canonical(values))

    def _jointly(self, start: Vector, held: int | None) -> Peak:
        """A maximum near `start` under a surrogate, which costs little: Newton's steps in coordinates in
        which the likelihood falls alike in all directions."""
        assert self.precision is not None
        moving = [p for p, k in enumerate(self.free) if k != held]
        rows, columns = (
            [self.posterior.table.rows[self.free[p]] for p in moving],
            [self.free[p] for p in moving],
        )
        root = np.linalg.cholesky(self.precision[np.ix_(moving, moving)])
        begin = np.array([row.coordinate(start[k]) for row, k in zip(rows, columns, strict=True)])
        low, high = np.array([self.search(k) for k in columns]).T
        steps = np.concatenate([np.zeros((1, len(moving))), _NUDGE * np.eye(len(moving))])

        def at(t: Matrix) -> Matrix:
            x = np.clip(begin + solve_triangular(root.T, t.T).T, low, high)  # the search ends there
            values = np.tile(start, (len(t), 1))
            for k, row, column in zip(columns, rows, x.T, strict=True):
                values[:, k] = row.value_at(column)
            return self.posterior.table.canonical(values)

        def cost(t: Vector) -> tuple[float, Vector]:
            levels = -self.log_likelihood(at(t + steps))
            return float(levels[0]), (levels[1:] - levels[0]) / _NUDGE

        def curvature(t: Vector) -> Matrix:
            return np.eye(t.size)

        found = minimize(
            cost,
            np.zeros(len(moving)),
            jac=True,
            hess=curvature,
            method="trust-exact",
            options={"gtol": _LEVEL, "initial_trust_radius": 3.0, "maxiter": _ROUNDS},
        )
        return Peak(at(found.x[None])[0], -float(found.fun))

    def at_bound(self, values: Vector, *, but: int | None = None) -> tuple[str, ...]:
        """Names of the free parameters that stand at an end of their search."""
        out = []
        for k in self.free:
            low, high = self.search(k)
            x = self.coordinate(k, values[k]) if k != but else 0.5 * (low + high)
            if min(x - low, high - x) < _AT_END * (high - low):
                out.append(self.posterior.table.names[k])
        return tuple(out)

    def _plant(self, values: Vector, held: int | None, most: int) -> Vector:
        """Least squares in the plant's parameters at the noise parameters of `values`."""
        least, table = self.least, self.posterior.table
        moving = [p for p, k in enumerate(least.columns) if k != held]
        if not moving:
            return values
        ends = np.array([self.search(least.columns[p]) for p in moving]).T
        whole = least.coordinates(values)

        def both(x: Vector, *, slopes: bool = True) -> tuple[Vector, Matrix]:
            at = whole.copy()
            at[moving] = x
            return self.rows(at, values, moving, slopes=slopes)

        start = np.clip(whole[moving], *ends)  # a start only
        functions = apart(both, start)
        if self.posterior.simulation is not None:  # slopes cost most
            if not np.isfinite(both(start, slopes=False)[0]).all():
                return values
            functions = (lambda x: both(x, slopes=False)[0]), start, lambda x: both(x)[1]
        optimum = least_squares(
            *functions,
            bounds=(ends[0], ends[1]),
            x_scale="jac",
            max_nfev=most,
            ftol=1e-7,
            xtol=1e-7,
            gtol=1e-7,
        )
        whole[moving] = optimum.x
        raw = least.values(whole, values)
        # a held time or order stays that of its own term: merged terms must not change places
        own = held is not None and table.rows[held].kind in ("time", "order")
        return raw if own else np.asarray(table.canonical(raw[None])[0])

    def rows(
        self, x: Vector, template: Vector, moving: Sequence[int], *, slopes: bool = True
    ) -> tuple[Vector, Matrix]:
        """Whitened residual without priors, with rows that keep orders decreasing; without `slopes` the
        Jacobian is that of these rows alone."""
        least, table = self.least, self.posterior.table
        if slopes:
            residual, jacobian = least.residual(x, template)
        else:
            residual = least.misfit(x, template)
            jacobian = np.zeros((residual.size, len(least.columns)))
        residual, jacobian = residual[: self.posterior.size], jacobian[: self.posterior.size]
        if "nu" in self.posterior.noise.names:  # as in expectation maximisation of Student noise
            weight = np.sqrt(self._student_weights(residual, template))
            residual, jacobian = residual * weight, jacobian * weight[:, None]
        values = least.values(x, template)
        walls, steep = [], []
        for terms in table.terms:
            for upper, lower in pairwise(terms.orders):
                excess, row = values[lower] - values[upper], np.zeros(len(least.columns))
                for k, sign in ((upper, -1.0), (lower, 1.0)):
                    if excess > 0 and k in least.columns:
                        scale = values[k] if table.rows[k].log_scale else 1.0
                        row[least.columns.index(k)] = sign * _STIFFNESS * scale
                walls.append(_STIFFNESS * max(excess, 0.0))
                steep.append(row)
        if walls:
            residual = np.concatenate([residual, walls])
            jacobian = np.concatenate([jacobian, steep])
        return residual, jacobian[:, moving]

    def _student_weights(self, standard: Vector, values: Vector) -> Vector:
        """``(nu + 1) / (nu + z^2)`` of standardised residuals."""
        out, start, table = np.empty(standard.size), 0, self.posterior.table
        for samples in self.posterior.samples:
            for axis, observed in enumerate(samples.axes):
                part = slice(start, start + observed.values.size)
                nu = values[table.at("nu", axis)]
                out[part] = (nu + 1) / (nu + standard[part] ** 2)
                start = part.stop
        return out

    def _noise(self, values: Vector, held: int | None) -> Vector:
        """The noise parameters that maximise the likelihood of the residual of `values`."""
        table, out = self.posterior.table, values.copy()
        for axis, fit in enumerate(self.least.noise_fits(table.canonical(values[None])[0])):
            where = [table.at(name, axis) for name in self.posterior.noise.names]
            moving = [k for k in fit.free if where[k] != held]
            if moving:
                low, high = np.array([self.search(where[k]) for k in moving]).T
                out[where] = fit.likeliest(out[where], moving, (low, high))
        return out
