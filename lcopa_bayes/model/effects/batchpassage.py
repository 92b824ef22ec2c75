"""Passage of one record through many plants at once, where their forces act point by point.

The same fixed points as `passage` and `balance`, by one accelerated iteration over all plants and axes. What
it does not bring to rest within its sweeps falls to the iteration of a single plant, which divides the
record.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeAlias, final

import numpy as np
from scipy import fft

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix
from lcopa_bayes.model.effects.balance import RUNAWAY, TOLERANCE
from lcopa_bayes.model.effects.effect import ForceEffect, Ranges, Scene
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.powerseries import Spectrum
from lcopa_bayes.model.transfer import transfer

Forces: TypeAlias = Sequence[tuple[ForceEffect, Array]]
"""Forces, each with its coefficients (coefficients, plants times axes, 1); constants likewise."""
_SWEEPS = 100
"""Most sweeps of the iteration [-]: a sweep of all plants costs what a plant by itself does."""
_DEPTH = 4
"""Earlier iterates that the acceleration combines (Anderson 1965, J. ACM 12)."""
_LEVELS = 60
"""Most steps towards the level at rest [-]."""


@final
@dataclass(frozen=True, eq=False)
class BatchPassage:
    """Many plants on the grid of one record, with forces on their direct paths."""

    model: ForwardModel
    record: int
    scene: Scene
    """Of any of the plants: forces see the scales and the grid alone."""
    gains: Array
    """(batch, responses, drives) [response unit per drive unit]."""
    dynamics: Dynamics

    @property
    def experiment(self) -> Experiment:
        """The record."""
        return self.model.experiments[self.record]

    @property
    def ranges(self) -> Ranges:
        """Scales of one plant."""
        return self.scene.ranges

    @cached_property
    def _spectra(self) -> dict[int, Spectrum]:
        """Of every element, (batch, points)."""
        grid = self.experiment.mesh.grid
        return {
            e: transfer(times, orders, self.experiment.circle, grid.step)
            for e, (times, orders) in enumerate(zip(self.dynamics.times, self.dynamics.orders, strict=True))
        }

    def _means(self, i: int) -> Matrix:
        """Block means of the delayed own drive of an axis, (batch, blocks) [drive unit]."""
        layout, j = self.model.layout, int(self.ranges.direct[i])
        late = self.dynamics.delays[:, layout.delay_of[i][j]]
        return self.experiment.drives[j].block_means(self.experiment.edges, late)[0]

    def change(self, forces: Forces) -> tuple[Array, Flags]:
        """What forces add to the deflection at the samples, (axes, batch, samples) [response unit], and for
        which plants it is known, (batch,)."""
        axes, batch, circle = self.ranges.axes, len(self.gains), self.experiment.circle
        own = np.arange(axes)
        gains = self.gains[:, own, self.ranges.direct]
        rest = gains * self.experiment.rest[self.ranges.direct]
        driven = np.stack([self._means(i) for i in range(axes)], axis=1)
        kernel = np.empty((batch, axes, circle.n))
        linear = np.empty_like(kernel)
        for i in range(axes):
            spectrum = self._spectra[self.model.layout.element_of[i][int(self.ranges.direct[i])]]
            kernel[:, i] = circle.coefficients(spectrum)
            moved = spectrum * circle.spectrum(driven[:, i])
            linear[:, i] = gains[:, i, None] * circle.coefficients(moved)
        rows = batch * axes
        scene = replace(
            self.scene, ranges=replace(self.ranges, response=np.tile(self.ranges.response, batch))
        )
        f0 = rest.reshape(rows, 1)
        f = f0 + (gains[..., None] * driven).reshape(rows, -1)
        balance = _Balanced(forces, scene, f, kernel.reshape(rows, -1), self.experiment.mesh.grid.step)
        level, solved = balance.level(f0)
        y, moving = balance.solve(level, solved)
        solved &= moving
        change = y.reshape(batch, axes, -1) - linear
        shift = (level - f0).reshape(batch, axes)
        read = self.experiment.mesh.reading(change.reshape(rows, -1)).reshape(batch, axes, -1)
        out = np.moveaxis(read + shift[..., None], 1, 0)
        known = solved.reshape(batch, axes).all(axis=1) & np.isfinite(out).all(axis=(0, 2))
        return out, np.asarray(known)


@final
@dataclass(frozen=True, eq=False)
class _Balanced:
    """``y = kernel * (force(level + y) - level)`` of every row, plants times axes."""

    forces: Forces
    scene: Scene
    f: Matrix
    """Gain times delayed drive, (rows, blocks) [response unit]."""
    kernel: Matrix
    """Impulse response in block means, (rows, blocks)."""
    step: float
    """Width of a block [time unit]."""

    def acting(self, rows: Index, f: Matrix, y: Matrix, rate: Matrix) -> Matrix:
        """The forces on some of the rows."""
        own = replace(
            self.scene, ranges=replace(self.scene.ranges, response=self.scene.ranges.response[rows])
        )
        for effect, psi in self.forces:
            f = _of_rows(effect, rows).force(f, y, rate, own, psi[:, rows])
        return f

    def level(self, f0: Matrix) -> tuple[Matrix, Flags]:
        """Level at which force and deflection balance at rest, (rows, 1), by secants; where one is known."""
        scale, y = self.scene.ranges.column, f0.copy()
        every = np.arange(len(y))
        still = np.zeros_like(y)
        step = 1e-6 * scale
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            ahead = self.acting(every, f0, y, still) - y
            for _ in range(_LEVELS):
                done = np.abs(ahead) <= TOLERANCE * scale
                if done.all():
                    break
                slope = (self.acting(every, f0, y + step, still) - (y + step) - ahead) / step
                y = np.where(done, y, y - ahead / slope)
                ahead = self.acting(every, f0, y, still) - y
        solved = (np.abs(ahead) <= TOLERANCE * scale) & (np.abs(y) < RUNAWAY * scale)
        return np.where(solved, y, 0.0), solved[:, 0]

    def solve(self, level: Matrix, possible: Flags) -> tuple[Matrix, Flags]:
        """Deviation from the level, (rows, blocks), and the rows that the iteration brought to rest."""
        n = self.kernel.shape[1]
        length = fft.next_fast_len(2 * n - 1, real=True)
        out, solved = np.zeros(self.kernel.shape), np.zeros(len(self.kernel), dtype=bool)
        rows = np.flatnonzero(possible)
        spectrum = fft.rfft(self.kernel[rows], length)
        y = np.zeros((rows.size, n))
        steps: list[Matrix] = []
        points: list[Matrix] = []
        for _ in range(_SWEEPS):
            if not rows.size:
                break
            scale = self.scene.ranges.column[rows]
            with np.errstate(over="ignore", invalid="ignore"):
                v = self._deviation(rows, level, y)
                target = fft.irfft(spectrum * fft.rfft(v, length), length)[:, :n]
                change = (target - y) / scale
                size = np.abs(change).max(axis=1)
            done = size < TOLERANCE
            out[rows[done]], solved[rows[done]] = target[done], True
            kept = ~done & (size < RUNAWAY)  # NaN is not kept
            steps.append(change)
            points.append(target / scale)
            del steps[: -_DEPTH - 1], points[: -_DEPTH - 1]
            if not kept.all():
                rows, spectrum, target, scale = rows[kept], spectrum[kept], target[kept], scale[kept]
                steps, points = [one[kept] for one in steps], [one[kept] for one in points]
            y = target if len(steps) == 1 else _mixed(steps, points) * scale
        return out, solved

    def _deviation(self, rows: Index, level: Matrix, y: Matrix) -> Matrix:
        """Force less the level, its argument the deviation from it."""
        joined = np.concatenate((np.zeros((len(y), 2)), y), axis=1)
        rate = (1.5 * y - 2.0 * joined[:, 1:-1] + 0.5 * joined[:, :-2]) / self.step
        return np.asarray(self.acting(rows, self.f[rows], level[rows] + y, rate) - level[rows])


def _mixed(steps: Sequence[Matrix], points: Sequence[Matrix]) -> Matrix:
    """The combination of iterates whose steps add up to least, row by row."""
    last = steps[-1]
    differences = np.stack([last - step for step in steps[:-1]], axis=1)
    gram = differences @ differences.swapaxes(1, 2)
    weights = np.linalg.pinv(gram, rcond=1e-14, hermitian=True) @ (differences @ last[..., None])
    apart = np.stack([points[-1] - point for point in points[:-1]], axis=1)
    return np.asarray(points[-1] - (weights.swapaxes(1, 2) @ apart)[:, 0])


def _of_rows(effect: ForceEffect, rows: Index) -> ForceEffect:
    """The effect with those constants that differ from row to row taken of some rows."""
    constants = {
        name: value[rows] for name, value in effect.constants.items() if isinstance(value, np.ndarray)
    }
    return replace(effect, **constants) if constants else effect
