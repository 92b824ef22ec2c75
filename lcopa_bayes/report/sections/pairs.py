"""Pairs of parameters: a corner plot of the most interesting ones."""

from __future__ import annotations

import corner
import numpy as np
from matplotlib.figure import Figure

from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.theme import BAND, Drawing, plain, svg_of

_IN_CORNER = 10
"""Parameters on one corner plot."""
_KINDS = ("time", "order", "delay", "gain")
"""Kinds of parameters that are shown first; of the rest, noise and offsets come last."""
_LAST = ("offset", "sigma", "rho", "nu")
_LABELS = 0.47
"""Distance of an axis label from its panel [in]."""
_MIDDLE = 0.995
"""Share of the draws that each axis of the corner plot spans [-]."""


def ranked(names: list[str]) -> list[str]:
    """Names by interest: times, orders, delays, gains, anything else, offsets, noise; ties in their order."""

    def rank(name: str) -> int:
        kind = name.split("_")[0]
        if kind in _KINDS:
            return _KINDS.index(kind)
        return len(_KINDS) + (1 + _LAST.index(kind) if kind in _LAST else 0)

    return sorted(names, key=rank)


def drawn(run: SavedRun) -> Drawings:
    """Corner plot of the most interesting free parameters that vary."""
    moving = ranked([name for name in run.units if np.ptp(run.draws[name]) > 0])
    shown, left_out = moving[:_IN_CORNER], moving[_IN_CORNER:]
    if not shown:
        return {"pairs": ()}
    caption = (
        "Contours, smoothed, hold about 50 and 90 % of the draws of a pair; dashed "
        f"lines mark the 5, 50 and 95 % quantiles; each axis spans {100 * _MIDDLE:g} % of the draws."
    )
    rest = f" Not shown for lack of space: {', '.join(left_out)}." if left_out else ""
    return {"pairs": [Drawing("corner", _corner(run, shown), caption + rest)]}


def _corner(run: SavedRun, names: list[str]) -> str:
    values = np.stack([run.draws[name].ravel() for name in names], axis=1)
    scales = ["log" if run.spans_decades(name) else "linear" for name in names]
    side = min(9.6, max(3.4, 1.15 * len(names) + 0.9))
    figure = Figure(figsize=(side, side))
    small = len(names) > 5
    corner.corner(
        values,
        fig=figure,
        range=[_MIDDLE] * len(names),
        axes_scale=scales,
        bins=24,
        smooth=1.0,
        levels=(0.5, 0.9),
        quantiles=(0.05, 0.5, 0.95),
        color=BAND,
        labels=[f"{plain(name)}\n[{plain(run.units[name])}]" for name in names],
        label_kwargs={"fontsize": 7.5 if small else 8.5},
        labelpad=max(0.05, _LABELS * len(names) / (side - 1.0) - 0.3),
        max_n_ticks=3 if small else 4,
        plot_density=False,
        data_kwargs={"ms": 1.2, "alpha": 0.25},
        hist_kwargs={"lw": 0.9},
        contour_kwargs={"linewidths": 0.9},
    )
    for k, panel in enumerate(figure.axes):
        row, column = divmod(k, len(names))
        if column < row or row == column == len(names) - 1:
            panel.tick_params(labelrotation=45)
        panel.tick_params(labelsize=6.5 if small else 7.5, length=2)
        for line in panel.lines:
            line.set_linewidth(0.8)
    figure.align_labels()
    room = 0.95 / side
    figure.subplots_adjust(left=room, bottom=room, right=0.99, top=0.99)
    return svg_of(figure)
