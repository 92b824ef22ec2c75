"""Responses of a posterior near one optimum as quadratic functions of its coordinates.

What a response with effects costs is paid a few hundred times; sampling then asks the quadratics, and weights
by the model itself make up for what they miss (`sampling.weightedrun`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.simulation import Simulated

_WIDTH = 1.6
"""Standard deviation of the points a surrogate is fitted to, over that of the optimum's covariance [-]."""
_PER_TERM = 2.0
"""Such points per term of the quadratic [-]."""
_PORTION = 32
"""Points that one process simulates at once [-]: half as many take a third longer each."""
_TRIES = 40
"""Draws for each point inside the prior, at most [-]."""


@final
@dataclass(frozen=True, eq=False)
class Surrogate:
    """Quadratic responses of every fit record."""

    posterior: Posterior
    columns: tuple[int, ...]
    """Sampled coordinates that move the responses."""
    delays: tuple[int, ...]
    """Those of `columns` that are delays."""
    centre: Vector
    """(columns,)."""
    sd: Vector
    """Standard deviations at the optimum, (columns,)."""
    inverse: Matrix
    """From deviations to coordinates of unit variance, (columns, columns)."""
    bases: tuple[Array, ...]
    """Per record (terms, axes, samples) [response unit]."""
    scaled: tuple[Mapping[int, Matrix], ...]
    """Per record and linear parameter (terms, samples)."""

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        optimum: Optimum,
        rng: np.random.Generator,
        mapped: Callable[..., Iterable[Any]] = map,
    ) -> Surrogate | None:
        """About an optimum, by least squares over draws around it; None where too few have a response.

        `mapped` spreads the simulations over processes.
        """
        rows = posterior.table.rows
        columns = tuple(c for c, k in enumerate(posterior.sampled) if not rows[k].noise)
        centre = posterior.coordinates(optimum.values[None])[0]
        root = root_of(optimum.covariance[np.ix_(columns, columns)])
        late = tuple(p for p, c in enumerate(columns) if rows[posterior.sampled[c]].kind == "delay")
        sd = np.sqrt(np.diag(optimum.covariance)[list(columns)])
        terms = _features(np.zeros((1, len(columns))), np.zeros((1, len(columns))), late).shape[1]
        points = _points(posterior, centre, columns, _WIDTH * root, int(_PER_TERM * terms), rng)
        values = posterior.values(points)
        points = posterior.coordinates(values)
        portions = np.array_split(values, max(1, len(values) // _PORTION))
        parts = list(mapped(posterior.responses, portions))
        known = np.concatenate([np.asarray(part[0].bounded) for part in parts])
        if known.sum() < terms:
            return None
        inverse = np.linalg.inv(root).astype(float)
        apart = points[:, columns] - centre[list(columns)]
        features = _features(apart @ inverse.T, apart / sd, late)[known]
        solve = np.linalg.pinv(features)
        bases, scaled = [], []
        for r in range(len(posterior.samples)):
            whole = np.concatenate([part[r].base for part in parts], axis=1)[:, known]
            bases.append(np.einsum("tb,abn->tan", solve, whole, optimize=True))
            scaled.append(
                {
                    k: solve @ np.concatenate([part[r].columns[k] for part in parts])[known]
                    for k in parts[0][r].columns
                }
            )
        own = centre[list(columns)]
        return cls(posterior, columns, late, own, sd, inverse, tuple(bases), tuple(scaled))

    def __call__(self, values: Matrix) -> list[Simulated]:
        """Every record at canonical table values, (batch, rows)."""
        z = self.posterior.coordinates(values)[:, self.columns]
        z, where = np.unique(z, axis=0, return_inverse=True)  # differences move other parameters too
        apart = z - self.centre
        features = _features(apart @ self.inverse.T, apart / self.sd, self.delays)
        where, bounded = where.ravel(), np.ones(len(values), dtype=bool)
        out = []
        for base, scaled in zip(self.bases, self.scaled, strict=True):
            moved = np.stack([(features @ base[:, axis])[where] for axis in range(base.shape[1])])
            columns = {k: (features @ each)[where] for k, each in scaled.items()}
            out.append(Simulated(moved, columns, bounded))
        return out


def _features(u: Matrix, x: Matrix, delays: tuple[int, ...]) -> Matrix:
    """Terms in coordinates of unit variance, (batch, d), and in deviations over their own sd, (batch, d).

    A quadratic in the first, third and fourth powers of the second, and of every delay, in which an onset is
    steepest, the fifth to seventh power, and the square and cube times every coordinate: (batch, terms).
    """
    a, b = np.triu_indices(u.shape[1])
    steep = [part for k in delays for part in _steep(x[:, k, None], u)]
    return np.concatenate([np.ones((len(u), 1)), u, u[:, a] * u[:, b], x**3, x**4, *steep], axis=1)


def _steep(x: Matrix, u: Matrix) -> list[Matrix]:
    return [x ** np.arange(5, 8), x**2 * u, x**3 * u]


def _points(
    posterior: Posterior,
    centre: Vector,
    columns: tuple[int, ...],
    root: Matrix,
    count: int,
    rng: np.random.Generator,
) -> Matrix:
    """Sampled coordinates around an optimum inside the prior, the optimum first; fewer than `count` where the
    prior leaves hardly any room."""
    kept = [centre[None]]
    for _ in range(_TRIES):
        drawn = np.tile(centre, (count, 1))
        drawn[:, columns] += rng.standard_normal((count, len(columns))) @ root.T
        kept.append(drawn[posterior.log_prior(drawn) > -np.inf])
        if sum(map(len, kept)) >= count:
            break
    return np.concatenate(kept)[:count]
