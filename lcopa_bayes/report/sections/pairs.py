"""The corner plot: how parameters go together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from typing import Any, final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.ndimage import gaussian_filter

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.theme import BAND, INK, log_locator, plain, svg_of

MIDDLE = 0.995
"""Share of the draws that each axis spans [-]."""
_PITCH = 1.06
"""Distance of panels in widths of one [-]."""
_BINS = 24
_QUANTILES, _CONTOURS = (0.05, 0.5, 0.95), (0.5, 0.9)


def corner(run: SavedRun, names: Sequence[str]) -> str:
    """Histograms of parameters, and contours of the draws of every pair, as SVG.

    All panels are unit squares in one system of axes: as axes of their own they took a third of the time of a
    page.
    """
    count = len(names)
    side = min(9.6, max(3.4, 1.15 * count + 0.9))
    room, small = 0.95 / side, count > 5
    figure = Figure(figsize=(side, side))
    panel = figure.add_axes((room, room, 0.99 - room, 0.99 - room))
    panel.set_axis_off()
    span = count * _PITCH - (_PITCH - 1)
    panel.set(xlim=(0, span), ylim=(0, span))
    scales = [_Scale.of(run.draws[name].ravel(), log=run.spans_decades(name)) for name in names]
    shares = [scale.share(run.draws[name].ravel()) for scale, name in zip(scales, names, strict=True)]
    frames: list[list[tuple[float, float]]] = []
    dashes: list[list[tuple[float, float]]] = []
    text: dict[str, Any] = {"clip_on": False, "color": INK}
    for column, row in combinations_with_replacement(range(count), 2):
        x, y = column * _PITCH, (count - 1 - row) * _PITCH
        frames.append([(x, y + 1), (x, y), (x + 1, y)])
        if row != column:
            _pair(panel, x, y, shares[column], shares[row])
            continue
        heights, edges = np.histogram(shares[row], bins=_BINS, range=(0, 1))
        panel.stairs(y + 0.95 * heights / heights.max(), x + edges, baseline=None, color=BAND, lw=0.9)
        dashes += [[(x + q, y), (x + q, y + 1)] for q in np.quantile(shares[row], _QUANTILES)]
    panel.add_collection(LineCollection(dashes, colors=BAND, linewidths=0.8, linestyles="dashed"))
    size: dict[str, Any] = {"fontsize": 6.5 if small else 7.5, "rotation": 45}
    off = 0.007 * span
    for k, (name, scale) in enumerate(zip(names, scales, strict=True)):
        x, y = k * _PITCH, (count - 1 - k) * _PITCH
        for share, tick in scale.ticks(4 if small else 5):
            frames.append([(x + share, 0), (x + share, -off)])
            panel.text(
                x + share, -1.5 * off, tick, ha="right", va="top", rotation_mode="anchor", **size, **text
            )
            if k:
                frames.append([(0, y + share), (-off, y + share)])
                panel.text(-1.5 * off, y + share, tick, ha="right", va="center", **size, **text)
        title = {"fontsize": 7.5 if small else 8.5, "ha": "center", **text}
        shown, edge = f"{plain(name)}\n[{plain(run.units[name])}]", -0.95 * room / (0.99 - room) * span
        panel.text(x + 0.5, edge, shown, va="bottom", **title)
        if k:
            panel.text(edge, y + 0.5, shown, va="top", rotation=90, rotation_mode="anchor", **title)
    panel.add_collection(LineCollection(frames, colors=INK, linewidths=0.7, clip_on=False))
    return svg_of(figure)


def _pair(panel: Axes, x: float, y: float, across: Vector, up: Vector) -> None:
    """Draws of two parameters in the unit square at (x, y), their smoothed density as contours over them."""
    inside = (across >= 0) & (across <= 1) & (up >= 0) & (up <= 1)
    at = x + across[inside], y + up[inside]
    panel.plot(*at, ".", color=BAND, ms=1.2, alpha=0.25, rasterized=True, zorder=0)
    counts, edges, _ = np.histogram2d(up, across, bins=_BINS, range=((0, 1), (0, 1)))
    density = gaussian_filter(counts, 1.0)
    centres = (edges[1:] + edges[:-1]) / 2
    ranked = np.sort(density, axis=None)[::-1]
    held = np.cumsum(ranked) / ranked.sum()
    levels = np.unique([ranked[np.searchsorted(held, share)] for share in _CONTOURS])
    area = x + centres, y + centres, density
    panel.contourf(*area, levels=[levels[0], np.inf], colors="white", zorder=1)
    panel.contour(*area, levels=levels, colors=BAND, linewidths=0.9, zorder=2)


@final
@dataclass(frozen=True)
class _Scale:
    """Axis of a parameter."""

    low: float
    high: float
    log: bool

    @classmethod
    def of(cls, draws: Vector, *, log: bool) -> _Scale:
        """An axis that spans `MIDDLE` of the draws."""
        low, high = np.quantile(draws, (0.5 - MIDDLE / 2, 0.5 + MIDDLE / 2)).tolist()
        return cls(low, high, log)

    def share(self, values: Vector) -> Vector:
        """Positions from 0 at the lower end to 1 at the upper."""
        if self.log:
            return np.asarray(np.log(values / self.low) / np.log(self.high / self.low))
        return np.asarray((values - self.low) / (self.high - self.low))

    def ticks(self, most: int) -> list[tuple[float, str]]:
        """Position and text of up to so many round values, or somewhat more."""
        locator = log_locator(self.low, self.high) if self.log else MaxNLocator(most, steps=[1, 2, 5, 10])
        values = np.asarray(locator.tick_values(self.low, self.high))
        values = values[(values >= self.low) & (values <= self.high)]
        return list(zip(self.share(values).tolist(), (f"{value:.6g}" for value in values), strict=True))
