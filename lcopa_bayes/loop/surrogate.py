"""Cheap stand-in of the loop's log density, for proposals that its own evaluations then accept or reject."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.loop.density import LoopDensity

_REACH = 2.0
"""Way of a smooth column's nodes from the centre [Laplace sd]."""
_FAR = 4.0
"""The same for a delay [Laplace sd]."""
_NODES = 12
"""Nodes of a delay to either side [-]."""
_DROP = (0.25, 4.0)
"""Fall of the log density at a node, over that of a normal law: nodes elsewhere are moved [-]."""
_TRIES = 4


@final
@dataclass(frozen=True, eq=False)
class _Curve:
    """Whitened residual along one column as a polygon, in the reduced basis."""

    at: Vector
    """Places of the nodes, (nodes,) [column]."""
    nodes: Matrix
    """Residual less that at the centre, (nodes, basis) [-]."""

    def __call__(self, u: Vector) -> Matrix:
        """(batch,) -> (batch, basis); straight on beyond the ends."""
        left = np.clip(np.searchsorted(self.at, u) - 1, 0, self.at.size - 2)
        share = ((u - self.at[left]) / (self.at[left + 1] - self.at[left]))[:, None]
        return np.asarray((1.0 - share) * self.nodes[left] + share * self.nodes[left + 1])


@final
@dataclass(frozen=True, eq=False)
class Surrogate:
    r"""The density with a residual that is additive in the columns of the Laplace covariance's root.

    :math:`w(c + L u) \approx w(c) + \sum_j f_j(u_j)`: f_j through a few nodes, a parabola for smooth columns
    and a polygon for delays, whose slopes jump where a delayed change crosses an edge of the grid. Delays are
    the first coordinates of the triangular root, so that no other column moves them. Priors and what is
    integrated out are treated exactly. Residuals are held in an orthonormal basis of all nodes.
    """

    density: LoopDensity
    centre: Vector
    """(k,)."""
    root: Matrix
    """Columns L, (k, k)."""
    base: Vector
    """Residual at the centre, (basis,) [-]."""
    slopes: Matrix
    """Slope of every column's parabola, 0 for delays, (k, basis) [1 / column]."""
    curvatures: Matrix
    """Coefficients of its squares, (k, basis) [1 / column^2]."""
    curves: tuple[tuple[int, _Curve], ...]
    """Columns of delays."""
    columns: Matrix
    """`LoopDensity.columns` in the basis, (basis, linear)."""

    @classmethod
    def of(cls, density: LoopDensity) -> Surrogate:
        """About the optimum; takes about 30 evaluations per delay and 3 per other coordinate."""
        optimum, chosen = density.state.optimum, density.sampled
        centre = optimum.x[chosen]
        delays = _delays(density)
        root = _root(optimum.covariance[np.ix_(chosen, chosen)], delays)
        white = density.residual(centre)
        if white is None:
            raise FloatingPointError("the optimum has no bounded response")
        told: dict[int, tuple[Vector, Matrix]] = {}
        for j in range(centre.size):
            told[j] = _walked(density, centre, root[:, j], white, far=j < len(delays))
        basis, _ = np.linalg.qr(
            np.concatenate(
                [white[:, None], density.columns, *(nodes.T for _, nodes in told.values())], axis=1
            )
        )
        slopes, curvatures = np.zeros((2, centre.size, basis.shape[1]))
        curves: list[tuple[int, _Curve]] = []
        for j, (at, nodes) in told.items():
            short = nodes @ basis
            if at.size > 3:
                curves.append((j, _Curve(at, short)))
            elif at.size == 3:  # nodes at -a, 0 and b
                a, b = -at[0], at[2]
                slopes[j] = (a**2 * short[2] - b**2 * short[0]) / (a * b * (a + b))
                curvatures[j] = (a * short[2] + b * short[0]) / (a * b * (a + b))
            elif at.size == 2:
                slopes[j] = (short[1] - short[0]) / (at[1] - at[0])
        reduced = basis.T @ density.columns
        return cls(density, centre, root, basis.T @ white, slopes, curvatures, tuple(curves), reduced)

    def __call__(self, z: Matrix) -> Vector:
        """Log density up to a constant, (batch, k) -> (batch,); -inf outside the priors."""
        u: Matrix = np.linalg.solve(self.root, (z - self.centre).T).T.astype(float)
        white = self.base + u @ self.slopes + u**2 @ self.curvatures
        for j, curve in self.curves:
            white += curve(u[:, j])
        inner: Array = white @ self.columns - self.density.pull
        power = np.einsum("br,br->b", white, white) - np.einsum(
            "bm,bm->b", inner @ self.density.inverse, inner
        )
        return np.asarray(self.density.log_priors(z) + self.density.log_likelihood(power))


def _delays(density: LoopDensity) -> list[int]:
    """Sampled coordinates that are delays."""
    model = density.state.model
    rows, columns = model.base.posterior.table.rows, model.base.least.columns
    return [
        at
        for at, position in enumerate(density.sampled)
        if position < model.plant_size and rows[columns[position]].kind == "delay"
    ]


def _root(covariance: Matrix, first: list[int]) -> Matrix:
    """L with L L' the covariance; its leading columns are those of the coordinates `first`, which no later
    column moves."""
    order = [*first, *np.setdiff1d(np.arange(len(covariance)), first)]
    sd = np.sqrt(np.diag(covariance))
    even = (covariance / np.outer(sd, sd))[np.ix_(order, order)]
    out = np.empty_like(covariance)
    out[order] = sd[order, None] * np.linalg.cholesky(even + 1e-10 * np.eye(len(even)))
    return out


def _walked(
    density: LoopDensity, centre: Vector, column: Vector, white: Vector, *, far: bool
) -> tuple[Vector, Matrix]:
    """Nodes along a column, 0 among them, and the residual there less that at the centre."""
    here = _value(density, centre, white)
    at, nodes = [0.0], [np.zeros_like(white)]
    for sign in (-1.0, 1.0):
        end = _reach(density, centre, sign * column, here, _FAR if far else _REACH)
        for share in np.arange(1, _NODES + 1) / _NODES if far else (1.0,):
            found = density.residual(centre + sign * share * end * column) if end else None
            if found is not None:
                at.append(sign * share * end)
                nodes.append(found - white)
    order = np.argsort(at)
    return np.array(at)[order], np.array(nodes)[order]


def _reach(density: LoopDensity, centre: Vector, way: Vector, here: float, wanted: float) -> float:
    """How far to go so that the log density falls about as far as a normal one `wanted` sd away; 0 where the
    support ends at once."""
    low, high = (ends[density.sampled] for ends in density.state.model.bounds)
    with np.errstate(divide="ignore", invalid="ignore"):
        room = np.where(way > 0, (high - centre) / way, np.where(way < 0, (low - centre) / way, np.inf))
    most = float(room.min())
    end = min(wanted, most)
    for _ in range(_TRIES):
        if end <= 1e-3:
            return 0.0
        white = density.residual(centre + end * way)
        drop = np.inf if white is None else here - _value(density, centre + end * way, white)
        share = drop / (0.5 * wanted**2)
        if share > _DROP[1]:
            end *= max(0.25, 1 / np.sqrt(share))
        elif share < _DROP[0] and end < most:
            end = min(end * min(4.0, 1 / np.sqrt(max(share, 0.05))), most)
        else:
            return end
    return end


def _value(density: LoopDensity, z: Vector, white: Vector) -> float:
    """Log density where the residual is known."""
    inner = density.pulled(white)
    power = np.array(white @ white - inner @ density.inverse @ inner)
    return float(density.log_priors(z[None], ordered=False)[0] + density.log_likelihood(power))
