"""Sums of first-order lags with a delay: what a path may be if it is no Kelvin element.

    y_i(t) = offset + sum_j sum_k w_ijk (1 - exp(-(t - L_ij) / T_ijk))  for a unit step of every drive j

Weights of either sign make sums and, by partial fractions, products of lags with zeros between them; a
diffusion or a distributed order is approached by a few. Weights and offsets enter linearly and are integrated
out under Gaussian noise (Golub and Pereyra 1973, SIAM J. Numer. Anal. 10, of least squares), so that a
response axis has the time constants and delays of its paths as its only coordinates.

Responses are tabulated once over time constants and delays, whitened, and reduced to the directions in which
they differ by more than the noise can hide; a likelihood then costs the same for a hundred samples as for ten
thousand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from scipy.linalg import orth, solve_triangular
from scipy.linalg.lapack import dpstrf
from scipy.sparse import csr_array

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.noise import GaussianNoise
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.forward import Dynamics

_PER_DECADE = 10
"""Tabulated time constants in a decade [-]: between them a response is interpolated to 1e-4."""
_SHORTEST, _LONGEST = 0.5, 3.0
"""Time constants between this share of a sampling period and this multiple of the span of the records [-]:
what is slower cannot be told from a drift."""
_INSTANT = 0.02
"""Shortest time constant that is tabulated, for lags that are part of a diffusion [sampling period]."""
WEIGHT = 3.0
"""Prior standard deviation of a weight, in ranges of response over ranges of drive [-]: partial fractions of
a product of lags have weights of a few ranges, of either sign."""
_VISIBLE = 1e-4
"""Squared part of a whitened response per unit weight that may be in no direction that is kept [-]."""
_ROUNDING = 1e-12
"""Share of itself by which a product of columns may be off [-]."""
_SAMPLES = 4_000
"""Most samples of a response axis: of more one in so many is used, which widens intervals."""
_VALUES = 4_000_000
"""Most values simulated at once."""


@final
@dataclass(frozen=True, eq=False)
class LagTable:
    """Responses of lags on one response axis, whitened and without what its offsets explain."""

    log_times: Vector
    """Natural logarithms of the tabulated time constants, equally spaced, (times,) [time unit]."""
    delays: Matrix
    """Tabulated delays of every path, equally spaced, (paths, delays) [time unit]."""
    responses: Array
    """Of lags, and perhaps of what the first component of a path is in place of one, in the directions that
    are kept, (1 or 2, paths, times, delays, directions) [per unit weight]."""
    target: Vector
    """The record, (directions,)."""
    remainder: float
    """Its squared part in no direction [-]."""
    size: int
    """Samples behind it [-]."""
    shortest: float
    """Natural logarithm of the shortest time constant of a component [time unit]."""

    @property
    def paths(self) -> int:
        """Number of paths."""
        return len(self.delays)

    def ends(self, lags: int) -> tuple[Vector, Vector]:
        """Smallest and largest coordinates of paths of so many lags: log times path by path, then delays."""
        count = self.paths * lags
        low = np.concatenate([np.full(count, self.shortest), self.delays[:, 0]])
        high = np.concatenate([np.full(count, self.log_times[-1]), self.delays[:, -1]])
        return low, high

    def parts(self, coordinates: Matrix) -> tuple[Array, Matrix]:
        """Log times (batch, paths, lags) and delays (batch, paths) of coordinates (batch, dimension)."""
        count = coordinates.shape[1] - self.paths
        return coordinates[:, :count].reshape(len(coordinates), self.paths, -1), coordinates[:, count:]

    def columns(self, coordinates: Matrix) -> Array:
        """Responses of every lag, (batch, paths * lags, directions): cubic between tabulated log times,
        linear between tabulated delays."""
        log_times, delays = self.parts(coordinates)
        at = (log_times - self.log_times[0]) / (self.log_times[1] - self.log_times[0])
        first = np.clip(np.floor(at).astype(int) - 1, 0, self.log_times.size - 4)
        along = (delays - self.delays[:, 0]) / (self.delays[:, 1] - self.delays[:, 0])
        before = np.clip(np.floor(along).astype(int), 0, self.delays.shape[1] - 2)[..., None]
        share = along[..., None] - before
        kinds, _, times, nodes = self.responses.shape[:4]
        kind = np.where(np.arange(log_times.shape[2]), 0, kinds - 1)
        place = nodes * (times * (self.paths * kind + np.arange(self.paths)[:, None]) + first) + before
        around = nodes * np.arange(4)[:, None] + np.arange(2)
        weights = np.stack(cubic(at - first), axis=-1)[..., None]
        weights = weights * np.stack([1 - share, share], axis=-1)[..., None, :]
        flat = self.responses.reshape(-1, self.target.size)
        taken, each = (place[..., None, None] + around).ravel(), np.arange(place.size + 1) * around.size
        by_node = csr_array((weights.ravel(), taken, each), shape=(place.size, len(flat)))
        out = by_node @ flat  # nothing is copied for a node
        return np.asarray(out).reshape(len(coordinates), -1, self.target.size)

    def conditional(self, coordinates: Matrix) -> Conditional:
        """Distribution of the weights at coordinates (batch, dimension)."""
        columns = self.columns(coordinates)
        precision = _precision(columns)
        root = np.asarray(np.linalg.cholesky(precision), dtype=float)
        bent = np.linalg.solve(root, (columns @ self.target)[..., None])[..., 0]
        return Conditional(root, bent, self.remainder + float(self.target @ self.target))

    def log_density(self, coordinates: Matrix) -> Vector:
        """Log of the likelihood without its constants, weights integrated out, (batch,); -inf outside."""
        low, high = self.ends((coordinates.shape[1] - self.paths) // self.paths)
        inside = np.flatnonzero(((coordinates >= low) & (coordinates <= high)).all(axis=1))
        out = np.full(len(coordinates), -np.inf)
        if inside.size:
            out[inside] = self.conditional(coordinates[inside]).log_marginal
        return out

    def residuals(self, coordinates: Matrix) -> Matrix:
        """What the most probable weights leave at coordinates (batch, dimension), and what their prior adds
        to the cost, (batch, directions + weights)."""
        columns = self.columns(coordinates)
        precision = _precision(columns)
        weights = np.linalg.solve(precision, (columns @ self.target)[..., None])
        left = self.target - (columns.swapaxes(1, 2) @ weights)[..., 0]
        return np.concatenate([left, weights[..., 0] / WEIGHT], axis=1)


@final
@dataclass(frozen=True, eq=False)
class Conditional:
    """Normal distributions of the weights, each given its time constants and delays."""

    root: Array
    """Of the precision, lower triangular (batch, weights, weights)."""
    bent: Matrix
    """``root^-1 X'y``, (batch, weights)."""
    square: float
    """``y'y``."""

    @property
    def log_marginal(self) -> Vector:
        """Weights integrated out, (batch,) [nat]."""
        half = np.log(np.diagonal(self.root, axis1=1, axis2=2)).sum(axis=1)
        explained = np.einsum("bw,bw->b", self.bent, self.bent)
        return np.asarray(0.5 * (explained - self.square) - half - self.bent.shape[1] * np.log(WEIGHT))

    def draw(self, rng: np.random.Generator) -> Matrix:
        """One draw of the weights for each, (batch, weights)."""
        standard = self.bent + rng.standard_normal(self.bent.shape)
        return np.asarray(np.linalg.solve(self.root.swapaxes(1, 2), standard[..., None])[..., 0])


def _precision(columns: Array) -> Array:
    """Of the weights of columns (batch, weights, directions) given their prior, (batch, weights, weights);
    regular where lags are alike and noise is so small that their products round its part away."""
    products = columns @ columns.swapaxes(1, 2)
    diagonal = np.diagonal(products, axis1=1, axis2=2)
    own = _ROUNDING * diagonal + 1 / WEIGHT**2
    return np.asarray(products + own[..., None] * np.eye(columns.shape[1]))


def cubic(at: Array) -> tuple[Array, ...]:
    """Lagrange weights of nodes 0, 1, 2 and 3."""
    a, b, c = at - 1, at - 2, at - 3
    return -a * b * c / 6, at * b * c / 2, -at * a * c / 2, at * a * b / 6


def lag_problem(study: Study, fitted: Posterior | None = None) -> Problem:
    """The records of a study prepared for lags: one with a delay of its own for every path, offsets as in the
    study, samples and noise as in a `fitted` posterior of it, by default the study's; InputError as
    `problem_of`."""
    model = replace(study.model, terms=1, orders=(1.0,), share="none", delay="path")
    priors = {name: prior for name, prior in study.priors.items() if name.startswith("offset")}
    problem = problem_of(replace(study, model=model, priors=priors))
    own = fitted or problem.posterior
    posterior = replace(problem.posterior, samples=own.samples, noise=own.noise)
    return replace(problem, posterior=thinned(posterior))


def thinned(posterior: Posterior) -> Posterior:
    """A posterior of no more samples than lags are held against."""
    most = max(
        sum(samples.axes[axis].values.size for samples in posterior.samples)
        for axis in range(len(posterior.table.layout.responses))
    )
    step = -(-most // _SAMPLES)
    kept = [replace(one, axes=tuple(axis.every(step) for axis in one.axes)) for one in posterior.samples]
    return replace(posterior, samples=tuple(kept)) if step > 1 else posterior


def lag_table(
    problem: Problem,
    axis: int,
    drives: Sequence[int],
    noise: Vector,
    delays: Matrix,
    open_to: Sequence[Matrix] = (),
) -> LagTable:
    """Responses of one axis to some drives, of a `lag_problem` under Gaussian `noise` (parameters,).

    `delays` (paths, delays) [time unit] are those tabulated. A weight is in ranges of the response over
    ranges of the drive (`Scales`). The samples of every record may lie anywhere along what they are `open_to`
    (directions, samples), as along their offsets.
    """
    posterior, scales = problem.posterior, problem.scales
    assert isinstance(posterior.noise, GaussianNoise)
    first = np.log(_INSTANT * scales.period)
    last = np.log(_LONGEST * max(scales.span, scales.period))
    log_times = np.linspace(first, last, max(8, round(_PER_DECADE * (last - first) / np.log(10)) + 1))
    offsets = [k for k in posterior.table.of_kind("offset") if posterior.table.rows[k].response == axis]
    offsets = [k for k in offsets if posterior.table.rows[k].free]
    stacked = _columns(problem, axis, drives, np.exp(log_times), delays)
    count, white = delays.size * log_times.size, []
    values = np.array([[0.0 if row.free else row.value for row in posterior.table.rows]])
    values[:, [*posterior.table.of_kind("gain"), *offsets]] = 0.0
    for r, (samples, columns) in enumerate(zip(posterior.samples, stacked, strict=True)):
        observed = samples.axes[axis]
        none = np.zeros((0, 1, observed.values.size))  # offsets need no response
        acting = [posterior.column(k, axis, r, observed, none) for k in offsets]
        own = [np.zeros(observed.values.size) if column is None else column[0] for column in acting]
        target = posterior.residual(axis, r, observed, values, none)
        own = [*own, *(open_to[r] if open_to else ())]
        whole = np.concatenate([columns, np.reshape(own, (len(own), observed.values.size)), target])
        if observed.values.size:
            white.append(posterior.noise.whiten(whole[None], noise[None], observed.gaps)[0][0])
    joined = np.concatenate(white, axis=1)
    if len(joined) > count + 1:
        basis = orth(_unit_rows(joined[count:-1]).T)
        joined = joined - (joined @ basis) @ basis.T
    reduced, target = _reduced(joined[:count].reshape(len(drives), -1, joined.shape[1]), joined[-1])
    remainder = max(0.0, float(joined[-1] @ joined[-1] - target @ target))
    shape = (1, len(drives), log_times.size, delays.shape[1], -1)
    shortest = float(np.log(_SHORTEST * scales.period))
    return LagTable(log_times, delays, reduced.reshape(shape), target, remainder, joined.shape[1], shortest)


def _unit_rows(rows: Matrix) -> Matrix:
    """Rows of length 1, and those of length 0."""
    lengths = np.sqrt((rows**2).sum(axis=1, keepdims=True))
    return np.asarray(rows / np.where(lengths == 0.0, 1.0, lengths))


def _columns(
    problem: Problem, axis: int, drives: Sequence[int], times: Vector, delays: Matrix
) -> list[Matrix]:
    """Responses of one axis to each drive by every tabulated lag, its delay changing fastest, of every record
    (drives * times * delays, samples) [response unit per unit weight]."""
    posterior, scales = problem.posterior, problem.scales
    units = scales.amplitude[axis] / scales.excursion
    seen = [samples.axes[axis] for samples in posterior.samples]
    batch = times.size * delays.shape[1]
    out = [np.empty((len(drives), batch, observed.values.size)) for observed in seen]
    size = max(1, _VALUES // sum(samples.times.size for samples in posterior.samples))
    lags, orders = np.repeat(times, delays.shape[1])[:, None], np.ones((batch, 1))
    for drive, nodes, columns in zip(drives, delays, zip(*out, strict=True), strict=True):
        path = posterior.model.path(axis, drive)
        every = Dynamics((lags,), (orders,), np.tile(nodes, times.size)[:, None])
        for first in range(0, batch, size):
            portion = slice(first, first + size)
            read = path.unit_responses(every[portion])
            for own, observed, column, unit in zip(path.experiments, seen, columns, read, strict=True):
                column[portion] = units[drive] * (own.rest + unit[0][:, observed.chosen])
    return [one.reshape(len(drives) * batch, -1) for one in out]


def _reduced(columns: Array, target: Vector) -> tuple[Matrix, Vector]:
    """Columns (paths, columns, samples), all in one row, and target in the directions in which they differ by
    more than shows: those of a few columns, found of each path first and then of all."""
    apart = [own[_pivots(own)[0]] for own in columns]
    rows = np.concatenate(apart)
    chosen, factor = _pivots(rows)
    basis = solve_triangular(factor, rows[chosen], lower=True)
    return columns.reshape(-1, target.size) @ basis.T, basis @ target


def _pivots(rows: Matrix) -> tuple[Index, Matrix]:
    """Rows between which all others lie but for what does not show, and the lower triangular factor of their
    products: a Cholesky factorisation with pivoting that ends there (Harbrecht, Peters and Schneider 2012,
    Appl. Numer. Math. 62)."""
    factor, places, rank, _ = dpstrf(rows @ rows.T, tol=_VISIBLE, lower=1)
    return places[:rank] - 1, np.tril(factor[:rank, :rank])
