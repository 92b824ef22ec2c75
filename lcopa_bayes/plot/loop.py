"""What a model lacks: evidence of every effect, and residuals before and after."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.core.estimate import HALF_WIDTH
from lcopa_bayes.plot.theme import BAND, HELD_OUT, NOISE, SEEN, blank, dots, label, plain


def _residual(axes: Axes, curve: Mapping[str, Any], when: str, colour: str, unit: str) -> None:
    time = np.array(curve["time"], dtype=float)
    width = np.array(curve[f"half_width_{when}"], dtype=float)
    axes.fill_between(time, -width, width, color=NOISE, alpha=0.25, lw=0)
    axes.plot(time, curve[when], ".", ms=dots(time.size), mew=0, color=colour)
    axes.axhline(0.0, color=NOISE, lw=0.6)
    axes.set(title=plain(f"{curve['record']}, {curve['axis']}: {when}"), xlabel=label("time", unit))


def _scaled(panels: Sequence[Axes], along: str) -> None:
    """Both panels with their own scale, as a phone shows them one below the other."""
    for panel in panels:
        panel.set_ylabel(along)
        panel.tick_params(labelleft=True)


def before_after_figure(curve: Mapping[str, Any], time_unit: str) -> Figure:
    """A residual without and with the effects, each with its 90 % band."""
    figure = blank(1.9)
    panels = figure.subplots(1, 2, sharey=True)
    for panel, when in zip(panels, ("before", "after"), strict=True):
        _residual(panel, curve, when, HELD_OUT if curve["held_out"] else SEEN, time_unit)
    _scaled(panels, label("residual", curve["unit"]))
    return figure


def effects_figure(classes: Sequence[Mapping[str, Any]], threshold: float) -> Figure:
    """Log Bayes factors of effects beside the level that chance reaches."""
    figure = blank(0.6 + 0.2 * len(classes))
    panel = figure.subplots()
    values = np.array([one["log_bayes_factor"] for one in classes])
    places = np.arange(len(classes))
    panel.barh(places, values, color=[BAND if v > threshold else NOISE for v in values])
    panel.axvline(threshold, color=HELD_OUT, lw=1.0, ls="--")
    panel.set_yticks(places, [plain(one["name"]) for one in classes])
    panel.invert_yaxis()
    if max(map(abs, panel.get_xlim())) > 10:  # without a power of ten in view there are no round numbers
        panel.set_xscale("symlog", linthresh=10)
    panel.set_xlabel("log Bayes factor against nothing missing [nat]")
    return figure


def view_figure(before: Mapping[str, Any], after: Mapping[str, Any]) -> Figure:
    """A view of the residual without and with the effects, with 90 % intervals of pure noise."""
    figure = blank(1.9)
    panels = figure.subplots(1, 2, sharey=True)
    for panel, view, when in zip(panels, (before, after), ("before", "after"), strict=True):
        x, y, error = (np.array(view[key], dtype=float) for key in ("x", "y", "error"))
        level = 0.0 if "mean" in view["along"] or "correlation" in view["along"] else 1.0
        panel.axhline(level, color=NOISE, lw=0.7)
        panel.errorbar(x, y, yerr=HALF_WIDTH * error, fmt=".-", ms=3, lw=0.8, elinewidth=0.6, color=BAND)
        if view["name"] == "spectrum" and x.size:
            panel.set(xscale="log", yscale="log")
        panel.set(title=plain(f"{view['axis']}, {view['name']}: {when}"))
        across, _, names = str(view["across"]).partition(": ")
        panel.set_xlabel(plain(across))
        if names:  # of the places, each behind its number
            panel.set_xticks(x, [plain(name.split(" ", 1)[1]) for name in names.split(", ")], rotation=90)
    _scaled(panels, plain(str(before["along"])))
    return figure
