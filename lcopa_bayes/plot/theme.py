"""How figures look.

Fewer points for the same picture: long curves are drawn through the extremes of short stretches.
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import log10
from typing import Any, final

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backend_bases import RendererBase
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogFormatter, LogLocator, MaxNLocator, NullFormatter, NullLocator

from lcopa_bayes.core.arrays import Index, Vector

INK = "#1a1a1a"
SEEN = "#1a1a1a"
"""Observations of records that were fitted."""
HELD_OUT = "#b3410b"
"""Observations of records that were held out."""
BAND = "#0072b2"
NOISE = "#8a8a8a"
STEADY = "#b3410b"
OUTSIDE = "#faf0e8"
"""Shade of what lies outside the fitted range."""
CYCLE = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#7a6a00", "#000000")
"""Okabe and Ito 2008, distinguishable with any colour vision; yellow darkened."""
WIDTH = 7.4
"""Width of a figure [in]."""
_DECADES = 200.0
"""Ratio of the ends of a logarithmic axis from which only powers of ten are marked [-]."""
_LOOK: Mapping[Any, Any] = {
    "svg.hashsalt": "lcopa-bayes",
    "svg.fonttype": "none",
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.facecolor": "none",
    "font.family": "DejaVu Sans",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.labelsize": 8.5,
    "xtick.labelsize": 7.5,
    "ytick.labelsize": 7.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": INK,
    "axes.linewidth": 0.7,
    "axes.formatter.useoffset": False,
    "lines.linewidth": 1.1,
    "lines.color": CYCLE[0],  # a colour by its place in the cycle is looked up for every tick
    "patch.facecolor": CYCLE[0],
    "figure.constrained_layout.w_pad": 0.07,
    "path.simplify": True,
    "savefig.dpi": 100,
    "figure.dpi": 100,
}
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@contextmanager
def look() -> Iterator[None]:
    """Inside, figures are drawn in the look of the report; outside nothing has changed."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_LOOK)
        yield


@final
class StyledFigure(Figure):
    """A figure that keeps this look whatever the settings of matplotlib are when it is shown or saved."""

    def draw(self, renderer: RendererBase) -> None:
        """Draw with round numbers on logarithmic axes."""
        for panel in self.axes:
            for axis in (panel.xaxis, panel.yaxis):
                if axis.get_scale() == "log" and isinstance(axis.get_major_formatter(), LogFormatter):
                    _log_ticks(axis)
        with look():
            super().draw(renderer)

    def _repr_png_(self) -> bytes:
        """The figure in a notebook."""
        out = io.BytesIO()
        self.savefig(out, format="png", dpi=100)
        return out.getvalue()


def blank(height: float, width: float = WIDTH) -> Figure:
    """An empty figure of a height and a width [in]."""
    return StyledFigure(figsize=(width, height), layout="constrained")


def grid(count: int, *, columns: int, height: float) -> tuple[Figure, Sequence[Axes]]:
    """A figure with `count` panels in `columns`, each row `height` [in] high."""
    rows = -(-count // columns)
    figure = blank(0.2 + rows * height)
    panels = figure.subplots(rows, min(columns, count), squeeze=False).ravel()
    for spare in panels[count:]:
        spare.remove()
    return figure, list(panels[:count])


def dots(count: int) -> float:
    """Diameter of the dots of so many samples [pt]: few are seen, many do not cover what they stand on."""
    return min(max(5.4 - 1.1 * log10(max(count, 1)), 1.6), 4.0)


def _log_ticks(axis: Axis) -> None:
    """Ticks of a logarithmic axis: round numbers when it spans few decades, else powers of ten."""
    low, high = axis.get_view_interval()
    few = high < _DECADES * low
    if few:
        wide = high > 5.0 * low
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)) if wide else MaxNLocator(4, steps=[1, 2, 5, 10]))
        axis.set_minor_locator(NullLocator())
    else:
        axis.set_major_locator(LogLocator(numticks=4))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}" if few else _power(value)))
    axis.set_minor_formatter(NullFormatter())


def _power(value: float) -> str:
    """A power of ten in characters: matplotlib's own formulas take as long to set as the rest of a figure."""
    return "10" + str(round(log10(value))).translate(_RAISED) if value > 0 else ""


def legend_above(figure: Figure, panel: Axes, columns: int, **style: Any) -> None:
    """The legend of a panel above the whole figure."""
    figure.legend(*panel.get_legend_handles_labels(), loc="outside upper center", ncols=columns, **style)


def headed(panel: Axes, record: str, axis: str, *, held_out: bool) -> str:
    """Title a panel with an axis of a record and its use, in the colour of that use, which is returned."""
    colour, use = (HELD_OUT, "held out") if held_out else (SEEN, "fit")
    panel.set_title(plain(f"{record}, {axis}: {use}"), color=colour)
    return colour


def plain(text: str) -> str:
    """`text` as matplotlib shows it unchanged."""
    return text.replace("$", r"\$")


def label(name: str, unit: str) -> str:
    """Axis label `name [unit]`."""
    return f"{plain(name)} [{plain(unit)}]"


MOST = 600
"""Points of a curve that are drawn; a figure is about 500 points wide."""


def extremes(*curves: Vector, most: int = MOST) -> Index:
    """Positions to draw, increasing: all of them up to `most`, else the least and greatest per stretch.

    The curves share their positions, as the two edges of a band do. Stretches hold equally many samples;
    the first, the last and every overall extreme are among the positions. NaN counts as missing. At most
    `most` + 2 positions are returned.
    """
    size = curves[0].size
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


def extremes_note(size: int) -> str:
    """A sentence for the caption when a record of `size` samples is longer than what is drawn."""
    if size <= MOST:
        return ""
    return f"Drawn through the extremes of short stretches: the record has {size} samples."
