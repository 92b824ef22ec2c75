"""Marginals and pairs of parameters, all panels on one pair of axes: dozens of their own take seconds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any, final

import numpy as np
from contourpy import contour_generator
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import BAND, INK, StyledFigure, log_locator, plain

IN_CORNER = 10
"""Most parameters on one corner plot."""
MIDDLE = 0.995
"""Share of the draws that each axis of the corner plot spans [-]."""
_LEVELS, _QUANTILES = (0.5, 0.9), (0.05, 0.5, 0.95)
"""Shares of the draws of a pair inside its contours, and quantiles that are marked [-]."""
_BINS, _SMOOTH = 24, 1.0
"""Bins of a side, and width of the smoothing of a pair's [bins]."""
_PITCH, _HIGHEST = 1.05, 0.91
"""Distance of panels, and height of the highest bin, over the side of a panel [-]."""
_LABELS, _ROOM = 0.47, 0.95
"""Distance of a label from its panels, and margin for both [in]."""


@final
@dataclass(frozen=True)
class _Side:
    """What a side of a panel spans, in the unit of its parameter."""

    low: float
    high: float
    log: bool

    def place(self, values: Vector) -> Vector:
        """Places along the side, 0 to 1 within it."""
        low, high, at = (np.log(x) if self.log else x for x in (self.low, self.high, values))
        return np.asarray((at - low) / (high - low))

    def ticks(self, most: int) -> tuple[Vector, list[str]]:
        """Round numbers within it, as places and words."""
        locator, word = (
            log_locator(self.low, self.high) if self.log else (MaxNLocator(most), "{:.10g}".format)
        )
        values = np.asarray(locator.tick_values(self.low, self.high))
        values = values[(values >= self.low) & (values <= self.high)]
        return self.place(values), [word(float(value)) for value in values]


def corner_figure(run: RunData, names: Sequence[str]) -> Figure:
    """Marginals of parameters, and of pairs contours of their smoothed histogram with the draws outside."""
    count = len(names)
    size = min(9.6, max(3.4, 1.15 * count + 0.9))
    figure, room = StyledFigure(figsize=(size, size)), _ROOM / size
    panel = figure.add_axes((room, room, 0.99 - room, 0.99 - room))
    ends = (0.0, _PITCH * (count - 1) + 1.0)
    panel.set(xlim=ends, ylim=ends)
    panel.spines[:].set_visible(False)
    left = _PITCH * np.arange(count)
    bottom = left[::-1]
    tails = ((1 - MIDDLE) / 2, (1 + MIDDLE) / 2)
    sides, places = [], []
    for name in names:
        draws = run.draws[name].ravel()
        low, high = (float(end) for end in np.quantile(draws, tails))
        sides.append(_Side(low, high, run.spans_decades(name)))
        places.append(sides[-1].place(draws))
    solid, dashed, outside = [], [], []
    for k, own in enumerate(places):
        corner = np.array([left[k], bottom[k]])
        bins, edges = np.histogram(own, bins=_BINS, range=(0, 1))
        heights = np.concatenate([[0], np.repeat(_HIGHEST * bins / bins.max(), 2), [0]])
        solid.append(corner + np.stack([np.repeat(edges, 2), heights], axis=1))
        dashed += [corner + np.array([[x, 0], [x, 1]]) for x in np.quantile(own, _QUANTILES)]
    for j, i in combinations(range(count), 2):
        corner = np.array([left[j], bottom[i]])
        lines, beyond = _pair(places[j], places[i])
        solid += [corner + line for line in lines]
        outside.append(corner + beyond)
    frames = [
        np.array([[left[j], bottom[i] + 1], [left[j], bottom[i]], [left[j] + 1, bottom[i]]])
        for i in range(count)
        for j in range(i + 1)
    ]
    panel.add_collection(LineCollection(frames, colors=INK, linewidths=0.7), autolim=False)
    panel.add_collection(LineCollection(solid, colors=BAND, linewidths=0.9), autolim=False)
    marks = LineCollection(dashed, colors=BAND, linewidths=0.8, linestyles="dashed")
    panel.add_collection(marks, autolim=False)
    if outside:
        points = np.concatenate(outside).T
        panel.plot(*points, "o", ms=1.2, mec="none", color=BAND, alpha=0.25, rasterized=True)
        panel.set(xlim=ends, ylim=ends)
    small = count > 5
    per_inch = ends[1] / ((0.99 - room) * size)
    style: dict[str, Any] = {"fontsize": 7.5 if small else 8.5, "ha": "center"}
    ticks = [side.ticks(3 if small else 4) for side in sides]
    for axis, starts, first in (
        (panel.xaxis, left, 0),
        (panel.yaxis, bottom, 1),
    ):  # a marginal has no ordinate
        at = [start + own for start, (own, _) in zip(starts[first:], ticks[first:], strict=True)]
        axis.set_ticks(np.concatenate([[], *at]), [word for _, words in ticks[first:] for word in words])
        axis.set_tick_params(labelrotation=45, labelsize=6.5 if small else 7.5, length=2)
    labels = [f"{plain(name)}\n[{plain(run.units[name])}]" for name in names]
    away = -_LABELS * per_inch
    for text, x in zip(labels, left + 0.5, strict=True):
        panel.text(x, away, text, va="top", **style)
    for text, y in zip(labels[1:], bottom[1:] + 0.5, strict=True):
        panel.text(away, y, text, va="bottom", rotation=90, rotation_mode="anchor", **style)
    return figure


def _pair(x: Vector, y: Vector) -> tuple[list[Matrix], Matrix]:
    """Contours of two parameters, each (points, 2), and the draws outside them, (draws, 2)."""
    inside = (x >= 0) & (x < 1) & (y >= 0) & (y < 1)
    x, y = x[inside], y[inside]
    bins = [[0, 1], [0, 1]]
    counts = np.histogram2d(x, y, bins=_BINS, range=bins)[0]
    density = np.asarray(gaussian_filter(counts, _SMOOTH), dtype=float)
    falling = np.sort(density, axis=None)[::-1]
    held = np.cumsum(falling) / falling.sum()
    levels = [float(falling[max(int((held <= share).sum()) - 1, 0)]) for share in _LEVELS]
    centres = (np.arange(-1, _BINS + 1) + 0.5) / _BINS
    drawn = contour_generator(centres, centres, np.pad(density, 1).T)
    lines = [np.asarray(line) for level in levels for line in drawn.lines(level)]
    rare = density[(x * _BINS).astype(int), (y * _BINS).astype(int)] < min(levels)
    return lines, np.stack([x[rare], y[rare]], axis=1)
