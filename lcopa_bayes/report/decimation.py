"""Fewer points for the same picture: long curves are drawn through the extremes of short stretches."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes

from lcopa_bayes.core.arrays import Index, Vector

MOST = 600
"""Points of a curve that are drawn; a figure is about 500 points wide."""


def extremes(*curves: Vector, most: int = MOST) -> Index:
    """Positions to draw, increasing: all of them up to `most`, else the least and greatest per stretch.

    The curves share their positions, as the two edges of a band do. Stretches hold equally many samples;
    the first, the last and every overall extreme are among the positions. NaN counts as missing. At most
    `most` + 2 positions are returned. ValueError when the curves differ in length or `most` is less than
    two per curve.
    """
    size = curves[0].size
    if any(curve.size != size for curve in curves) or most < 2 * len(curves):
        raise ValueError(f"need curves of one length and room for 2 points of each; got {most} points")
    if size <= most:
        return np.arange(size)
    stretches = most // (2 * len(curves))
    edges = np.linspace(0, size, stretches + 1).astype(int)[:-1]
    owner = np.repeat(np.arange(stretches), np.diff(np.append(edges, size)))
    picked = [np.array([0, size - 1])]
    for curve in curves:
        for values in (curve, -curve):
            filled = np.where(np.isnan(values), np.inf, values)
            order = np.lexsort((filled, owner))
            picked.append(order[edges])
    return np.unique(np.concatenate(picked))


def draw_line(panel: Axes, x: Vector, y: Vector, *args: Any, **style: Any) -> None:
    """`panel.plot` through the extremes of a curve (n,)."""
    at = extremes(y)
    panel.plot(x[at], y[at], *args, **style)


def draw_band(panel: Axes, x: Vector, low: Vector, high: Vector, **style: Any) -> None:
    """`panel.fill_between` through the extremes of both ends (n,), without an edge."""
    at = extremes(low, high)
    panel.fill_between(x[at], low[at], high[at], lw=0, **style)


def draw_bands(
    panel: Axes, x: Vector, rows: pd.DataFrame, bands: Sequence[tuple[str, str, str, str, float, str]]
) -> None:
    """Bands between columns of a table, each given by what the names of its columns begin with, the names of
    its ends, colour, opacity and label."""
    for column, low, high, colour, alpha, name in bands:
        lower, upper = (rows[f"{column}_{end}"].to_numpy() for end in (low, high))
        draw_band(panel, x, lower, upper, color=colour, alpha=alpha, label=name)


def said(size: int, *, most: int = MOST) -> str:
    """A sentence for the caption when a record of `size` samples is longer than what is drawn."""
    if size <= most:
        return ""
    return f"Drawn through the extremes of short stretches: the record has {size} samples."
