"""Pairs of parameters: marginals, and contours that hold given shares of the draws of each pair.

All panels are drawn in one pair of axes: axes of their own would cost five times as long.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np
from contourpy import contour_generator
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Drawing, Section
from lcopa_bayes.report.theme import BAND, INK, locator_of, plain, svg_of

_IN_CORNER = 10
"""Parameters on one corner plot."""
_KINDS = ("time", "order", "delay", "gain")
"""Kinds of parameters that are shown first; of the rest, noise and offsets come last."""
_LAST = ("offset", "sigma", "rho", "nu")
_MIDDLE = 0.995
"""Share of the draws that each axis of the corner plot spans [-]."""
_LEVELS = (0.5, 0.9)
"""Shares of the draws that contours hold [-]."""
_QUANTILES = (0.05, 0.5, 0.95)
"""Quantiles that dashed lines mark [-]."""
_BINS, _SMOOTHING = 24, 1.0
"""Cells of an axis, and deviation of the smoothing [cells]."""
_GAP = 0.05
"""Distance of panels [panel]."""


def ranked(names: list[str]) -> list[str]:
    """Names by interest: times, orders, delays, gains, anything else, offsets, noise; ties in their order."""

    def rank(name: str) -> int:
        kind = name.split("_")[0]
        if kind in _KINDS:
            return _KINDS.index(kind)
        return len(_KINDS) + (1 + _LAST.index(kind) if kind in _LAST else 0)

    return sorted(names, key=rank)


def pairs(run: SavedRun) -> Section:
    """Corner plot of the most interesting free parameters."""
    moving = [name for name in run.units if np.ptp(run.draws[name]) > 0]
    shown, left_out = ranked(moving)[:_IN_CORNER], ranked(moving)[_IN_CORNER:]
    if not shown:
        return Section("Pairs of parameters", ("No free parameter has draws that vary.",))
    caption = (
        "Contours, smoothed, hold about 50 and 90 % of the draws of a pair; dashed "
        f"lines mark the 5, 50 and 95 % quantiles; each axis spans {100 * _MIDDLE:g} % of the draws."
    )
    rest = f" Not shown for lack of space: {', '.join(left_out)}." if left_out else ""
    return Section("Pairs of parameters", drawings=(Drawing("corner", _corner(run, shown), caption + rest),))


@final
@dataclass(frozen=True, eq=False)
class _Scale:
    """A parameter's axis, from 0 at its lower end to 1 at its upper."""

    name: str
    unit: str
    draws: Vector
    log: bool

    @cached_property
    def ends(self) -> tuple[float, float]:
        """Lower and upper end."""
        low, high = np.quantile(self.draws, (0.5 - 0.5 * _MIDDLE, 0.5 + 0.5 * _MIDDLE))
        return float(low), float(high)

    def at(self, values: Vector) -> Vector:
        """Places of some values."""
        low, high = np.log(self.ends) if self.log else self.ends
        return np.asarray(((np.log(values) if self.log else values) - low) / (high - low))

    @cached_property
    def places(self) -> Vector:
        """Those of the draws."""
        return self.at(self.draws)

    def ticks(self, most: int) -> tuple[Vector, list[str]]:
        """Places of about `most` round numbers, and these as text."""
        low, high = self.ends
        values = np.asarray(locator_of(low, high, log=self.log, most=most).tick_values(low, high))
        values = values[(values >= low) & (values <= high)]
        return self.at(values), [f"{value:.6g}" for value in values]


def _corner(run: SavedRun, names: list[str]) -> str:
    size, log = len(names), [run.spans_decades(name) for name in names]
    scales = [
        _Scale(name, run.units[name], run.draws[name].ravel(), own)
        for name, own in zip(names, log, strict=True)
    ]
    side = min(9.6, max(3.4, 1.15 * size + 0.9))
    figure = Figure(figsize=(side, side))
    panel = figure.add_axes((0.95 / side, 0.95 / side, 0.99 - 0.95 / side, 0.99 - 0.95 / side))
    panel.set(xlim=(0.0, size), ylim=(0.0, size))
    panel.set_axis_off()
    panel.set_rasterization_zorder(0.5)
    thin: list[Matrix] = []  # lines of frames and ticks
    for row, vertical in enumerate(scales):
        base = float(size - 1 - row)
        for column, horizontal in enumerate(scales[: row + 1]):
            corner = np.array([column, base])
            thin += [corner + line for line in ([[0, 1 - _GAP], [0, 0]], [[0, 0], [1 - _GAP, 0]])]
            if column < row:
                _pair(panel, horizontal.places, vertical.places, corner)
            else:
                _marginal(panel, horizontal, corner)
    _ticks(panel, scales, thin)
    panel.add_collection(LineCollection(thin, colors=INK, linewidths=0.7), autolim=False)
    return svg_of(figure)


def _marginal(panel: Axes, scale: _Scale, corner: Vector) -> None:
    """Histogram of a parameter with its quantiles, in the panel whose lower left end is at `corner`."""
    counts, edges = np.histogram(scale.places, bins=_BINS, range=(0.0, 1.0))
    room = 1 - _GAP
    heights = corner[1] + 0.95 * room * counts / max(1, counts.max())
    panel.stairs(heights, corner[0] + room * edges, baseline=corner[1], color=BAND, lw=0.9)
    marks = corner[0] + room * scale.at(np.quantile(scale.draws, _QUANTILES))
    panel.vlines(marks, corner[1], corner[1] + room, colors=BAND, linestyles="dashed", lw=0.8)


def _pair(panel: Axes, x: Vector, y: Vector, corner: Vector) -> None:
    """Contours of the density of a pair, and the draws beyond the outermost."""
    counts, *_ = np.histogram2d(x, y, bins=_BINS, range=((0.0, 1.0), (0.0, 1.0)))
    density, room = gaussian_filter(counts, _SMOOTHING), 1 - _GAP
    levels = levels_of(density, _LEVELS)
    centre = (np.arange(_BINS) + 0.5) / _BINS
    contours = contour_generator(corner[0] + room * centre, corner[1] + room * centre, density.T)
    lines = [np.asarray(line) for level in levels for line in contours.lines(level)]
    panel.add_collection(LineCollection(lines, colors=BAND, linewidths=0.9), autolim=False)
    inside = (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1)
    x, y = x[inside], y[inside]
    cell = [np.minimum((_BINS * one).astype(int), _BINS - 1) for one in (x, y)]
    far = density[cell[0], cell[1]] < levels[-1]
    at = corner[:, None] + room * np.stack([x[far], y[far]])
    panel.plot(*at, ".", ms=1.2, mew=0, color=BAND, alpha=0.25, zorder=0)


def levels_of(density: Matrix, shares: Sequence[float]) -> list[float]:
    """Densities above which cells hold given shares of the whole."""
    falling = np.sort(density, axis=None)[::-1]
    held = np.cumsum(falling) / falling.sum()
    return [float(falling[np.searchsorted(held, share)]) for share in shares]


def _ticks(panel: Axes, scales: list[_Scale], thin: list[Matrix]) -> None:
    """Ticks, their numbers and the labels of the outer panels."""
    size, small = len(scales), len(scales) > 5
    length, distance = 0.03, 0.62 * size / (panel.bbox.height / 100)
    text: dict[str, Any] = {"fontsize": 6.5 if small else 7.5, "rotation": 45.0}
    heading: dict[str, Any] = {"fontsize": 7.5 if small else 8.5}
    for k, scale in enumerate(scales):
        name = f"{plain(scale.name)}\n[{plain(scale.unit)}]"
        places, numbers = scale.ticks(3 if small else 4)
        row = size - 1 - k
        for place, number in zip((1 - _GAP) * places, numbers, strict=True):
            thin += [np.array([[k + place, y], [k + place, y - length]]) for y in range(row + 1)]
            panel.text(k + place, -1.5 * length, number, ha="right", va="top", rotation_mode="anchor", **text)
            thin += [np.array([[x, row + place], [x - length, row + place]]) for x in range(k)]
            if k:
                panel.text(-1.5 * length, row + place, number, ha="right", va="center", **text)
        panel.text(k + 0.5, -distance, name, ha="center", va="center", **heading)
        if k:
            panel.text(-distance, row + 0.5, name, ha="center", va="center", rotation=90, **heading)
