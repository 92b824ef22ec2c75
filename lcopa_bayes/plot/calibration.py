"""Coverage and ranks of a calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.plot.theme import BAND, HELD_OUT, INK, NOISE, blank, grid, plain

Draw: TypeAlias = Callable[[Axes, Mapping[str, Any], Mapping[str, Any]], None]


def coverage_figure(results: Mapping[str, Any]) -> Figure:
    """Coverage of every quantity in rows, one panel per level."""
    names = list(dict.fromkeys(row["parameter"] for row in results["coverage"]))
    levels = sorted({row["level"] for row in results["coverage"]})
    figure = blank(0.9 + 0.27 * len(names))
    panels = figure.subplots(1, len(levels), sharey=True, squeeze=False)[0]
    groups = [(results, BAND, f"all {results['replicas']}")]
    if results["reliable"]:
        groups.append((results["reliable"], HELD_OUT, f"{results['reliable']['replicas']} reliable"))
    for panel, level in zip(panels, levels, strict=True):
        panel.axvline(level, color=NOISE, lw=0.9, ls=(0, (4, 3)))
        for number, (group, colour, name) in enumerate(groups):
            rows = [row for row in group["coverage"] if row["level"] == level]
            at = np.arange(len(rows)) + 0.24 * (number - (len(groups) - 1) / 2)
            seen = np.array([row["observed"] for row in rows])
            ends = np.array([[row["lower"], row["upper"]] for row in rows]).T
            panel.errorbar(seen, at, xerr=np.abs(ends - seen), fmt="o", ms=3, lw=1, color=colour, label=name)
        panel.set(title=f"{100 * level:.0f} % intervals", xlabel="coverage [-]")
    panels[0].set_yticks(range(len(names)), [plain(name) for name in names])
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return figure


def ranks_figure(rows: Sequence[Mapping[str, Any]], results: Mapping[str, Any], draw: Draw) -> Figure:
    """Ranks of the truth, one panel per quantity."""
    figure, panels = grid(len(rows), columns=3, height=1.35)
    for panel, row in zip(panels, rows, strict=True):
        draw(panel, row, results)
        panel.set_title(plain(row["parameter"]), fontsize=7.5)
    for panel in panels[-3:]:
        panel.set_xlabel("rank [-]")
    return figure


def draw_histogram(panel: Axes, row: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    """Histogram of ranks with its band."""
    counts, band = np.array(row["counts"]), results["rank_bins"]
    edges = np.linspace(0, counts.size, band["bins"] + 1)
    panel.axhspan(band["lower"], band["upper"], color=NOISE, alpha=0.3, lw=0)
    panel.axhline(results["replicas"] / band["bins"], color=NOISE, lw=0.8)
    panel.stairs(counts.reshape(band["bins"], -1).sum(axis=1), edges, fill=True, color=BAND, alpha=0.75)
    panel.set(xlim=(0, counts.size), ylabel="replicas")


def draw_difference(panel: Axes, row: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    """Cumulative ranks less those of uniform ranks, with their corridor."""
    counts, corridor = np.array(row["counts"]), results["rank_corridor"]
    at = np.arange(1, counts.size)
    expected = at / counts.size
    lower, upper = (np.array(corridor[end]) / results["replicas"] - expected for end in ("lower", "upper"))
    panel.fill_between(at, lower, upper, color=NOISE, alpha=0.3, lw=0, step="post")
    panel.axhline(0.0, color=NOISE, lw=0.6)
    panel.step(at, np.cumsum(counts)[:-1] / results["replicas"] - expected, where="post", color=BAND)
    panel.set_xlim(0, counts.size)
    panel.text(
        0.98,
        0.96,
        f"p = {row['p_value']:.2g}",
        ha="right",
        va="top",
        fontsize=7,
        color=INK,
        transform=panel.transAxes,
    )
