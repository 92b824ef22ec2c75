"""Devices of a fleet against their population, and the responses of the worst."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from lcopa_bayes.plot.theme import BAND, HELD_OUT, INK, NOISE, SEEN, blank, grid, label, plain

_COLUMNS = 4
"""Devices beside each other."""
_NAMED = 4
"""Most devices that are named in a panel."""


_MOST_LINES = 200
"""Devices beyond which their intervals are drawn as one band."""


def population_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Every device by itself and shrunk, in the order of its own median, one panel per parameter; behind them
    where 50 and 90 % of the next devices lie."""
    figure, panels = grid(len(rows), columns=2, height=2.4)
    for panel, row in zip(panels, rows, strict=True):
        devices = sorted(row["devices"], key=lambda one: float(one["own"]["value"]))
        at = np.arange(len(devices))
        following = row["next"]
        for tail, alpha in (("", 0.15), ("_50", 0.2)):
            panel.axhspan(
                following[f"lower{tail}"], following[f"upper{tail}"], color=NOISE, alpha=alpha, lw=0
            )
        panel.axhline(row["mean"]["value"], color=NOISE, lw=0.8)
        odd = np.array([one["p_odd"] > 0.5 for one in devices])
        for chosen, colour in ((~odd, BAND), (odd, HELD_OUT)):
            own = [one["own"] for one, wanted in zip(devices, chosen, strict=True) if wanted]
            low, high = ([one[end] for one in own] for end in ("lower", "upper"))
            if len(low) > _MOST_LINES:
                panel.fill_between(at[chosen], low, high, color=colour, alpha=0.5, lw=0)
            else:
                panel.vlines(at[chosen], low, high, color=colour, lw=0.9, alpha=0.7)
        shrunk = [one["shrunk"]["value"] for one in devices]
        panel.plot(at, shrunk, ".", ms=3, color=INK)
        for k in np.flatnonzero(odd)[:_NAMED]:
            side = "left" if k < len(devices) / 2 else "right"
            panel.annotate(
                f" {plain(devices[k]['device'])} ",
                (at[k], devices[k]["own"]["value"]),
                ha=side,
                va="center",
                fontsize=7,
                color=HELD_OUT,
            )
        panel.set(ylabel=label(row["name"], row["unit"]), xlabel="device, by value")
    return figure


def curves_figure(curves: Sequence[Mapping[str, Any]]) -> Figure:
    """Response with its 90 % band with noise, and residual below, one column of two panels per device.

    Where axes or units differ every device has its labels, else the first and the lowest panels.
    """
    alike = len({(one["axis"], one["unit"], one["time_unit"]) for one in curves}) == 1
    rows = -(-len(curves) // _COLUMNS)
    figure = blank(0.3 + 2.3 * rows)
    panels = figure.subplots(2 * rows, _COLUMNS, squeeze=False, height_ratios=[2, 1] * rows, sharex=False)
    for k in range(rows * _COLUMNS):
        row, column = divmod(k, _COLUMNS)
        above, below = panels[2 * row, column], panels[2 * row + 1, column]
        if k >= len(curves):
            above.remove()
            below.remove()
            continue
        one = curves[k]
        time = np.array(one["time"])
        above.fill_between(time, one["lower"], one["upper"], color=BAND, alpha=0.3, lw=0)
        above.plot(time, one["median"], color=BAND, lw=0.9)
        above.plot(time, one["observed"], ".", ms=1.2, color=SEEN)
        above.set_title(plain(one["device"]), fontsize=7.5)
        above.tick_params(labelbottom=False)
        below.axhline(0.0, color=NOISE, lw=0.6)
        below.plot(time, one["residual"], color=SEEN, lw=0.6)
        if column == 0 or not alike:
            above.set_ylabel(label(one["axis"], one["unit"]))
        if k + _COLUMNS >= len(curves) or not alike:
            below.set_xlabel(label("time", one["time_unit"]))
    return figure
