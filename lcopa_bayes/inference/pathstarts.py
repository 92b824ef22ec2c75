"""Starts of a plant of several paths: each path has the draw that follows the records best beside the others.

Where paths share no element, hardly a draw of the prior is likely in all of them at once. But their responses
add, and gains and offsets are linear: which draw of one path stands best beside those of the others is a
small problem of least squares. Paths take turns in it until none of them changes, a descent by coordinates
through as many combinations as draws to the power of paths.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self, final

import numpy as np
from scipy.linalg import orth
from scipy.sparse.csgraph import connected_components

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior, Units
from lcopa_bayes.model.layout import Layout, PathSlot

_DRAWS = 512
"""Draws of each path [-]."""
_CELLS = 5e6
"""Values of their responses that are held at once [-]."""
_TURNS = 12
"""Turns of every group of paths, at most [-]."""
_RIDGE = 1e-9
"""Of the squared response of a path, added to it so that one that does not respond has no gain [-]."""

Group = tuple[PathSlot, ...]
"""Paths that share an element or a delay with each other, and with no path beyond."""


def beside_each_other(posterior: Posterior, drawn: Matrix, starts: int) -> Matrix:
    """Table values, (at most `starts`, rows), in which groups of paths have draws of their own.

    From each of the first `starts` of `drawn`, (draws, rows), the groups begin to take turns. Of a plant of
    one group, or with a gain that is not linear, there are none.
    """
    table = posterior.table
    groups = _groups(table.layout)
    gains = {table.at("gain", path.response, path.drive) for path in table.layout.paths}
    count = min(_DRAWS, len(drawn), int(_CELLS / (len(table.layout.units) * posterior.size)))
    if len(groups) < 2 or not count or not gains <= set(posterior.linear):
        return drawn[:0]
    drawn = drawn[:count]
    units = posterior.responses(drawn)
    responses = range(len(table.layout.responses))
    axes = [_Axis.of(posterior, axis, units, count, groups) for axis in responses]
    ends = [_turned(axes, np.full(len(groups), k)) for k in range(min(starts, count))]
    chosen = np.unique(ends, axis=0)
    out = drawn[chosen[:, 0]]
    for group, own in zip(groups, chosen.T, strict=True):
        rows = _rows(table, group)
        out[:, rows] = drawn[own][:, rows]
    return np.asarray(table.canonical(out))


def _groups(layout: Layout) -> list[Group]:
    paths = layout.paths
    elements, delays = (
        np.array([by[path.response][path.drive] for path in paths])
        for by in (layout.element_of, layout.delay_of)
    )
    alike = (elements[:, None] == elements) | (delays[:, None] == delays)
    count, labels = connected_components(alike, directed=False)
    return [tuple(paths[k] for k in np.flatnonzero(labels == label)) for label in range(count)]


def _rows(table: ParameterTable, group: Group) -> list[int]:
    """Table positions of the elements and delays of its paths."""
    layout = table.layout
    elements = {layout.element_of[path.response][path.drive] for path in group}
    delays = {layout.delay_of[path.response][path.drive] for path in group}
    return [*(k for e in elements for k in table.terms[e].every), *(table.at("delay", d) for d in delays)]


def _turned(axes: Sequence[_Axis], chosen: Index) -> Index:
    """Draws of each group, (groups,), none of which can be replaced by a better one; from others."""
    last = -1
    for turn in range(_TURNS * chosen.size):
        group = turn % chosen.size
        best = int(np.sum([axis.gained(group, chosen) for axis in axes], axis=0).argmax())
        if best != chosen[group]:
            chosen, last = np.where(np.arange(chosen.size) == group, best, chosen), turn
        elif turn - last >= chosen.size:
            break
    return chosen


@final
@dataclass(frozen=True, eq=False)
class _Axis:
    """A response in all records over its standard deviation, less what offsets account for."""

    target: Vector
    """(samples,) [-]."""
    columns: Sequence[Array]
    """Those of the gains of each group, (draws, its paths to this response, samples)."""

    @classmethod
    def of(
        cls, posterior: Posterior, axis: int, units: Sequence[Units], draws: int, groups: Sequence[Group]
    ) -> Self:
        """From unit responses of every record at so many draws."""
        table = posterior.table
        observed = [one.axes[axis] for one in posterior.samples]

        def column(k: int, count: int) -> Matrix:
            parts = [posterior.column(k, axis, r, one, units[r]) for r, one in enumerate(observed)]
            shapes = [(count, one.values.size) for one in observed]
            wide = [np.broadcast_to(0.0 if p is None else p, at) for p, at in zip(parts, shapes, strict=True)]
            return np.concatenate(wide, axis=1)

        target = np.concatenate([one.values for one in observed])
        scale = float(target.std()) or 1.0
        levels = [k for k in table.of_kind("offset") if table.rows[k].response == axis]
        basis = orth(np.stack([np.zeros(target.size), *(column(k, 1)[0] for k in levels)], axis=1))
        columns = []
        for group in groups:
            own = [table.at("gain", axis, path.drive) for path in group if path.response == axis]
            each = [_beyond(column(k, draws), basis) for k in own]
            columns.append(np.stack(each, axis=1) if each else np.empty((draws, 0, target.size)))
        return cls(_beyond(target, basis) / scale, columns)

    def gained(self, group: int, chosen: Index) -> Vector:
        """What each draw of a group takes from the squared response beside the draws chosen of the others,
        (draws,) [-]."""
        others = [own[k] for own, k in zip(self.columns, chosen, strict=True)]
        others[group] = np.zeros((1, self.target.size))
        basis = orth(np.concatenate(others).T)
        own = _beyond(self.columns[group], basis)
        gram, moment = own @ np.swapaxes(own, 1, 2), own @ _beyond(self.target, basis)
        size = np.trace(gram, axis1=1, axis2=2)
        gram += (_RIDGE * size + np.finfo(float).tiny)[:, None, None] * np.eye(own.shape[1])
        gains = np.linalg.solve(gram, moment[..., None])[..., 0]
        return np.asarray((moment * gains).sum(axis=1))


def _beyond(columns: Array, basis: Matrix) -> Array:
    """What an orthonormal basis, (samples, k), does not span of columns, (..., samples)."""
    return np.asarray(columns - (columns @ basis) @ basis.T)
