"""Observed samples of a set of records, arranged for the likelihood.

What samples at rest say about white measurement noise and a correlated part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.special import expit

from lcopa_bayes.core.arrays import Flags, Index, Matrix, Vector
from lcopa_bayes.data.drive import moved_with_drive
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.requirements import drifts
from lcopa_bayes.inference.noise import WhiteAR1

_ROUNDED = 1e-4
"""Deviation from whole sampling periods that rounded time stamps explain [sampling periods]."""
BEFORE_DRIVE = "samples before the drive acts"
_FEWEST = 8
"""Fewer samples before the drive moves, or changes of it, do not show whether a record begins at rest [-]."""
"""Source of an offset."""


@final
@dataclass(frozen=True, eq=False)
class Observed:
    """Samples of one response axis in one record."""

    index: Index
    """Position of each sample among the record's sample times."""
    values: Vector
    """[response unit]."""
    gaps: Vector
    """Time since the previous sample, in sampling periods; 1 for the first."""

    def first(self, count: int) -> Observed:
        """The first samples."""
        return Observed(self.index[:count], self.values[:count], self.gaps[:count])

    def every(self, step: int) -> Observed:
        """One sample of so many, the first included."""
        since = np.cumsum(self.gaps)[::step]
        return Observed(self.index[::step], self.values[::step], np.diff(since, prepend=since[:1] - 1.0))

    @cached_property
    def chosen(self) -> Index | slice:
        """`index`, as a slice where it is one: taking a slice copies nothing."""
        if not self.index.size:
            return self.index
        first, last = int(self.index[0]), int(self.index[-1]) + 1
        return slice(first, last) if last - first == self.index.size else self.index


@final
@dataclass(frozen=True, eq=False)
class Samples:
    """All samples of one record."""

    record: Record
    times: Vector
    """Times at which any axis was sampled [time unit]."""
    axes: tuple[Observed, ...]
    """One per response axis."""

    @classmethod
    def of(cls, record: Record, period: float) -> Samples:
        """Samples of a record; gaps are counted in `period` [time unit], and whole periods where they are as
        good as whole: time stamps are rounded."""
        taken = ~np.isnan(record.response)
        rows = np.flatnonzero(taken.any(axis=1))
        times = record.time[rows]
        axes = []
        for axis in range(record.response.shape[1]):
            index = np.flatnonzero(taken[rows, axis])
            at = times[index]
            gaps = np.concatenate(([1.0], np.diff(at) / period))[: at.size]
            gaps = np.where(np.abs(gaps - np.round(gaps)) < _ROUNDED, np.round(gaps), gaps)
            axes.append(Observed(index, record.response[rows[index], axis], gaps))
        return cls(record, times, tuple(axes))

    @cached_property
    def first_change(self) -> float:
        """Time of the first drive change, infinite when there is none [time unit]."""
        drive = self.record.drive
        moved = np.flatnonzero((drive != drive[0]).any(axis=1))
        return float(self.record.time[moved[0]]) if moved.size else np.inf

    def quiet(self, axis: int) -> Observed:
        """Samples of an axis taken before any drive change can have acted, that at the change included unless
        it has moved; as `resting`."""
        return self.resting(axis, int(np.count_nonzero(self._at_rest(axis))))

    def resting(self, axis: int, count: int) -> Observed:
        """The first samples of an axis, which nothing drives. Where no drive moves in the record they are
        taken about the line that they drift along, if they do: noise so smooth would hide every effect."""
        piece = self.axes[axis].first(count)
        if not self._drifting[axis]:
            return piece
        since = self.times[piece.index] - self.times[piece.index].mean()
        return replace(piece, values=piece.values - since * (since @ piece.values) / (since @ since))

    @cached_property
    def _drifting(self) -> tuple[bool, ...]:
        still = np.isinf(self.first_change)
        return tuple(still and drifts(self.times[one.index], one.values) for one in self.axes)

    def _at_rest(self, axis: int) -> Flags:
        times = self.times[self.axes[axis].index]
        moved = moved_with_drive(self.record, axis) != 0.0
        return times < self.first_change if moved else times <= self.first_change

    def level_samples(self, axis: int) -> tuple[Flags, str]:
        """Samples of an axis that give the offset of a record that was not fitted, and what they are."""
        quiet = self._at_rest(axis)
        if quiet.all():
            return (
                quiet,
                "all samples of the held-out record, whose drive does not change before the last of them",
            )
        if not quiet.any():
            return ~quiet, "all samples of the held-out record, none of which is before the drive acts"
        if np.count_nonzero(quiet) < _FEWEST and self._moving:
            return np.ones_like(quiet), "all samples of the held-out record, whose drive moves from the start"
        return quiet, BEFORE_DRIVE

    @property
    def _moving(self) -> bool:
        """Whether the drive changes again and again, first before it has held for twice its usual time.

        Then it may have moved before the record too, unless an early row without a response states what the
        plant rested under.
        """
        drive, response = self.record.drive, self.record.response
        changes = self.record.time[1:][(np.diff(drive, axis=0) != 0).any(axis=1)]
        stated = bool(np.isnan(response[0]).all())
        still = self.first_change - self.record.time[0]
        return not stated and changes.size >= _FEWEST and bool(still < 2 * np.median(np.diff(changes)))

    def matrix(self) -> Matrix:
        """Responses at `times`, (samples, axes), NaN where missing [response unit]."""
        out = np.full((self.times.size, len(self.axes)), np.nan)
        for axis, observed in enumerate(self.axes):
            out[observed.index, axis] = observed.values
        return out


def sampling_period(records: Sequence[Record]) -> float:
    """Median time between samples over the records [time unit]; the unit in which noise correlates."""
    steps = [np.diff(record.sampled) for record in records]
    return float(np.median(np.concatenate(steps)))


FEWEST = 8
"""Independent deviations from rest below which nothing is derived from them [-]: with 8 a standard deviation
is known to a quarter."""
_LEVELS = 5
"""Different readings at rest below which their scatter is the resolution of the instrument [-]."""
_SHARES = expit(np.linspace(-6.0, 6.0, 25))
"""Shares of the correlated part in the variance that are tried [-]."""
_CORRELATIONS = 12
"""Correlations that are tried [-]."""
_DRAWS = 4000
_UPPER = 0.975
"""Probability that the correlated part is below its limit, at rest [-]."""
_CELLS = 2_000_000
"""Samples times parameter sets that are whitened at once [-]."""


@final
@dataclass(frozen=True)
class QuietNoise:
    """Noise of one response axis as its samples at rest give it."""

    samples: int
    """Samples less one level for each record [-]."""
    sigma: float
    """Posterior median of the white part's standard deviation [response unit]."""
    log_sd: float
    """Posterior standard deviation of its logarithm [-]."""
    correlated: float
    """97.5 % limit of the correlated part's standard deviation [response unit]."""


@final
@dataclass(frozen=True, eq=False)
class PlausibleNoise:
    """Posterior of `WhiteAR1` given pieces of it, over a grid of shares and correlations.

    Flat priors of the level of each piece, or of what else was fitted to them, and of the logarithm of the
    standard deviation, all integrated out in closed form.
    """

    shapes: Matrix
    """Parameters of unit variance, (grid, 3): standard deviation of the white and of the correlated part,
    correlation."""
    weights: Vector
    """Probability of each, (grid,) [-]."""
    squares: Vector
    """Squares of the whitened pieces about their levels under each, (grid,) [response unit^2]."""
    count: float
    """Samples less one for each level or coefficient that was fitted to them, one at least [-]."""

    @classmethod
    def of(cls, pieces: Sequence[Observed], shapes: Matrix, log_prior: Vector) -> PlausibleNoise:
        """From pieces of two samples or more; ValueError with none."""
        count = sum(piece.values.size - 1 for piece in pieces)
        if not count:
            raise ValueError("a noise scale needs a piece of two samples or more")
        level, squares = np.zeros(len(shapes)), np.zeros(len(shapes))
        for piece in pieces:
            portions = _portions(len(shapes), piece.values.size)
            parts = [_about_own_level(piece, shapes[portion]) for portion in portions]
            level += np.concatenate([one[0] for one in parts])
            squares += np.concatenate([one[1] for one in parts])
        return cls._weighed(shapes, level + log_prior, squares, count)

    @classmethod
    def of_residual(
        cls,
        pieces: Sequence[tuple[Observed, Matrix]],
        precision: Matrix,
        shapes: Matrix,
        log_prior: Vector,
    ) -> PlausibleNoise:
        """From residuals of a linear fit and the regressors of its coefficients, (n, k) each: the restricted
        likelihood (Patterson and Thompson 1971, Biometrika 58), which knows what a fit takes up of slow
        noise.

        `precision`, (k, k), is what is known of the coefficients besides, times the variance of the noise;
        each has to be determined by it or by the pieces.
        """
        k = len(precision)
        size = 1 / np.sqrt(np.diag(precision) + sum(np.square(own).sum(axis=0) for _, own in pieces))
        log_scale, products = np.zeros(len(shapes)), np.zeros((len(shapes), k + 1, k + 1))
        for piece, own in pieces:
            columns = np.vstack([piece.values, (own * size).T])
            for portion in _portions(len(shapes), columns.size):
                batch = np.broadcast_to(columns, (portion.size, *columns.shape))
                inner, scales = WhiteAR1().products(batch, shapes[portion], piece.gaps)
                products[portion] += inner
                log_scale[portion] += scales
        inner, onto = products[:, 1:, 1:], products[:, 1:, 0]
        known = inner + precision * np.outer(size, size)
        taken = np.einsum("bk,bk->b", onto, np.linalg.solve(known, onto[..., None])[..., 0])
        squares = products[:, 0, 0] - taken
        log_density = log_prior - log_scale - 0.5 * np.linalg.slogdet(known)[1]
        fitted = np.trace(np.linalg.solve(known, inner), axis1=1, axis2=2)
        count = sum(piece.values.size for piece, _ in pieces) - float(fitted.max())
        return cls._weighed(shapes, log_density, squares, max(1.0, count))

    @classmethod
    def white(cls, sd: float, count: int) -> PlausibleNoise:
        """White noise of a standard deviation [response unit] that so many samples know."""
        shape = np.array([[1.0, 0.0, 0.0]])
        return cls(shape, np.ones(1), np.array([count * sd**2]), float(count))

    @classmethod
    def _weighed(cls, shapes: Matrix, log_density: Vector, squares: Vector, count: float) -> PlausibleNoise:
        """With the scale integrated out."""
        weight = log_density - 0.5 * count * np.log(squares)
        weight = np.exp(weight - weight.max())
        return cls(shapes, weight / weight.sum(), squares, count)

    @property
    def estimate(self) -> Vector:
        """The parameters of largest probability, (3,)."""
        k = int(np.argmax(self.weights))
        scale = np.sqrt(self.squares[k : k + 1] / self.count)
        return np.asarray(self._scaled(self.shapes[k : k + 1], scale)[0])

    def draw(self, size: int, rng: np.random.Generator) -> Matrix:
        """Parameters, (size, 3)."""
        drawn = self.draw_shapes(size, rng)
        drawn[:, :2] *= np.sqrt(self.count / rng.chisquare(self.count, size))[:, None]
        return drawn

    def draw_shapes(self, size: int, rng: np.random.Generator) -> Matrix:
        """Parameters, the scale at its estimate beside each share and correlation, (size, 3)."""
        chosen = rng.choice(len(self.weights), size, p=self.weights)
        return self._scaled(self.shapes[chosen], np.sqrt(self.squares[chosen] / self.count))

    @staticmethod
    def _scaled(shapes: Matrix, scale: Vector) -> Matrix:
        return np.column_stack([scale * shapes[:, 0], scale * shapes[:, 1], shapes[:, 2]])


def mixed_shapes(correlations: tuple[float, float]) -> tuple[Matrix, Vector]:
    """Grid of shares of the correlated part and of its correlation between two `correlations`, (grid, 3), and
    the logarithm of a prior that is uniform in both, (grid,)."""
    tried = np.linspace(*correlations, _CORRELATIONS)
    shares, rho = (grid.ravel() for grid in np.meshgrid(_SHARES, tried))
    shapes = np.column_stack([np.sqrt(1 - shares), np.sqrt(shares), rho])
    return shapes, np.log(shares * (1 - shares))


def quiet_noise(pieces: Sequence[Observed], correlations: tuple[float, float]) -> QuietNoise | None:
    """Posterior of `WhiteAR1` from samples at rest, the level of each piece unknown; None where too few.

    The share of the correlated part in the variance and its correlation between two `correlations` have
    uniform priors (`mixed_shapes`).
    """
    count = sum(piece.values.size - 1 for piece in pieces)
    readings = {value for piece in pieces for value in piece.values}
    if count < FEWEST or len(readings) < _LEVELS:
        return None
    drawn = PlausibleNoise.of(pieces, *mixed_shapes(correlations)).draw(_DRAWS, np.random.default_rng(0))
    sigma, sigma_ar = drawn[:, 0], drawn[:, 1]
    limit = float(np.quantile(sigma_ar, _UPPER))
    return QuietNoise(count, float(np.median(sigma)), float(np.log(sigma).std()), limit)


def _portions(shapes: int, samples: int) -> list[Index]:
    """Parameter sets whose whitened samples fit into memory at once."""
    count = max(1, shapes * samples // _CELLS)
    return [portion for portion in np.array_split(np.arange(shapes), count) if portion.size]


def _about_own_level(piece: Observed, parameters: Matrix) -> tuple[Vector, Vector]:
    """Log density of a piece under noise of unit variance, its level integrated out, without the sum of
    squares, and that sum, each (batch,)."""
    columns = np.stack([np.ones_like(piece.values), piece.values - piece.values.mean()])[None]
    white, scales = WhiteAR1().whiten(columns, parameters, piece.gaps)
    ones, misfit = white[:, 0], white[:, 1]
    strength = np.einsum("bn,bn->b", ones, ones)
    squares = np.einsum("bn,bn->b", misfit, misfit) - np.einsum("bn,bn->b", ones, misfit) ** 2 / strength
    return -scales - 0.5 * np.log(strength), squares
