"""What the records determine: profiles of the likelihood, spectrum of its curvature, pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.plot.rundata import RunData
from lcopa_bayes.plot.theme import BAND, CYCLE, HELD_OUT, INK, blank, grid, label, plain

_TOP = 6.0
"""Largest fall that is drawn [nat]."""
_AT_90 = 2.706
"""Fall at the ends of a 90 % interval [nat]."""
_DOTS = 1500


def profiles_figure(rows: Sequence[Mapping[str, Any]], run: RunData) -> Figure:
    """Profile likelihoods over marginals, by the rows of an audit."""
    figure, panels = grid(len(rows), columns=3, height=1.7)
    for panel, row in zip(panels, rows, strict=True):
        name, curve = row["name"], row["profile"]
        x, fall = np.array(curve["values"], dtype=float), np.array(curve["fall"], dtype=float)
        draws, log = run.draws[name].ravel(), run.is_log(name)
        if log:
            panel.set_xscale("log")
        inside = x[fall <= _TOP]
        low, high = min(inside.min(), draws.min()), max(inside.max(), draws.max())
        panel.plot(x, np.minimum(fall, 2 * _TOP), color=INK, marker=".", markersize=2.5, linewidth=1.0)
        panel.axhline(_AT_90, color=HELD_OUT, linewidth=0.8, linestyle="--")
        edges = np.geomspace(low, high, 41) if log else np.linspace(low, high, 41)
        counts, _ = np.histogram(draws, edges)
        panel.stairs(counts / max(counts.max(), 1) * 0.8 * _TOP, edges, fill=True, color=BAND, alpha=0.35)
        margin = 0.03
        if log:
            panel.set_xlim(low * (low / high) ** margin, high * (high / low) ** margin)
        else:
            panel.set_xlim(low - margin * (high - low), high + margin * (high - low))
            panel.locator_params(axis="x", nbins=4)
        panel.set(ylim=(0.0, _TOP), xlabel=label(name, run.units[name]))
        panel.set_title(row["verdict"], fontsize=7.5)
    return figure


def spectrum_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Eigenvalues of the Fisher information with the parameters of their directions."""
    figure = blank(0.9 + 0.24 * len(rows))
    panel = figure.subplots()
    floor = max(row["eigenvalue"] for row in rows) * 1e-16
    for place, row in enumerate(rows):
        value = max(row["eigenvalue"], floor)  # what is drawn; the table of numbers is in audit.json
        panel.plot([value], [place], "o", color=BAND if row["eigenvalue"] >= 1 else HELD_OUT, markersize=4)
        parts = ", ".join(
            f"{weight:+.2f}".replace("-", "\u2212") + f" {name}"
            for name, weight in list(row["direction"].items())[:4]
        )
        panel.annotate(
            plain(parts), (1.01, place), xycoords=("axes fraction", "data"), va="center", fontsize=7
        )
    panel.axvline(1.0, color=INK, linewidth=0.8, linestyle=":")
    panel.set_xscale("log")
    panel.invert_yaxis()
    panel.set_yticks(range(len(rows)), [str(place + 1) for place in range(len(rows))])
    panel.set(xlabel="precision of the data over that of the prior [-]", ylabel="direction")
    return figure


def pairs_figure(pairs: Sequence[tuple[str, str]], run: RunData) -> Figure:
    """Draws of pairs of parameters."""
    figure, panels = grid(len(pairs), columns=3, height=2.1)
    for panel, (a, b) in zip(panels, pairs, strict=True):
        _pair(panel, run, a, b)
    return figure


def _pair(panel: Axes, run: RunData, a: str, b: str) -> None:
    x, y = (run.draws[name].ravel() for name in (a, b))
    step = max(1, x.size // _DOTS)
    panel.plot(x[::step], y[::step], ".", color=CYCLE[0], markersize=1.5, alpha=0.5, rasterized=False)
    for name, scale in ((a, panel.set_xscale), (b, panel.set_yscale)):
        if run.spans_decades(name):
            scale("log")
    panel.set(xlabel=label(a, run.units[a]), ylabel=label(b, run.units[b]))
