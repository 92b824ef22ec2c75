"""Forces on the direct paths of many plants at once, a row for every axis of every plant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Index, Matrix
from lcopa_bayes.model.effects.effect import ForceEffect, Motion, Scene

Forces: TypeAlias = Sequence[tuple[ForceEffect, Array]]
"""Forces with their coefficients: (coefficients,) of one plant, or (coefficients, plants times axes, 1), the
constants that differ likewise."""


@final
@dataclass(frozen=True, eq=False)
class ForcedRows:
    """What acts on every row."""

    forces: Forces
    scene: Scene
    """Its scales have a value per row."""
    f: Matrix
    """Gain times delayed drive, (rows, blocks) [response unit]."""
    step: float
    """Width of a block [time unit]."""

    def acting(self, rows: Index, f: Matrix, motion: Motion) -> Matrix:
        """The force that acts on some of the rows."""
        ranges = self.scene.ranges
        own = replace(self.scene, ranges=replace(ranges, response=ranges.response[rows]))
        for effect, psi in self.forces:
            one, mine = (effect, psi) if psi.ndim == 1 else (_of_rows(effect, rows), psi[:, rows])
            f = one.force(f, motion, own, mine)
        return f

    def deviation(
        self, level: Matrix, rows: Index, blocks: slice | Index, y: Matrix, one: Matrix, two: Matrix
    ) -> Matrix:
        """That force less the level (rows, 1), from y less the level and its values one and two blocks
        before."""
        last, before = y - one, one - two
        bend = (last - before) / self.step**2
        rate = last / self.step + 0.5 * self.step * bend
        motion = Motion(level[rows] + y, rate, bend)
        # whole rows would be copied for a few of their blocks
        f = self.f[rows, blocks] if isinstance(blocks, slice) else self.f[rows[:, None], blocks]
        return self.acting(rows, f, motion) - level[rows]


def _of_rows(effect: ForceEffect, rows: Index) -> ForceEffect:
    """The effect with those constants that differ from row to row taken of some rows."""
    constants = {
        name: value[rows] for name, value in effect.constants.items() if isinstance(value, np.ndarray)
    }
    return replace(effect, **constants) if constants else effect
