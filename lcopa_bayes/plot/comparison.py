"""Candidates beside each other: log evidence, and their predictions of each record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from lcopa_bayes.plot.theme import (
    CYCLE,
    NOISE,
    blank,
    dots,
    draw_band,
    draw_line,
    headed,
    label,
    legend_above,
    plain,
)


def candidates_figure(
    results: Mapping[str, Any], parts: Mapping[str, pd.DataFrame], record: str, axis: str, *, held: bool
) -> Figure:
    """Medians and residuals of every candidate, by its curves of one axis of a record."""
    rows = [row for row in results["models"] if row["name"] in parts]
    figure = blank(4.3)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.3])
    some = parts[rows[0]["name"]]
    colour, unit = headed(top, record, axis, held_out=held), str(some["unit"].iloc[0])
    seen, time = some["observed"].to_numpy(), some["time"].to_numpy()
    draw_line(top, time, seen, ".", ms=dots(seen.size), mew=0, color=colour, label="observed", zorder=1)
    for row, own in zip(rows, CYCLE * len(rows), strict=False):
        _rival(
            top, below, parts[row["name"]], plain(row["name"]), own, row["name"] == results["preferred"], held
        )
    top.set_ylabel(label(axis, unit))
    below.axhline(0.0, color=NOISE, lw=0.7)
    below.set(ylabel=label("residual", unit), xlabel=label("time", results["time_unit"]))
    figure.align_ylabels()
    legend_above(figure, top, 5, markerscale=2)
    return figure


def _rival(
    top: Axes, below: Axes, part: pd.DataFrame, name: str, colour: str, preferred: bool, held: bool
) -> None:
    time, middle = part["time"].to_numpy(), part["middle"].to_numpy()
    residual = part["observed"].to_numpy() - middle
    if held or preferred:
        low, high = part["low"].to_numpy(), part["high"].to_numpy()
        draw_band(top, time, low, high, color=colour, alpha=0.12)
    draw_line(top, time, middle, color=colour, lw=1.6 if preferred else 1.0, label=name, zorder=2)
    draw_line(below, time, residual, color=colour, lw=0.9 if preferred else 0.6)


def evidence_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Log evidence of candidates, the rows of a comparison that have one, against the number of terms."""
    best = max(row["log_evidence"] for row in rows)
    figure = blank(2.6)
    panel = figure.subplots()
    beside: dict[int, int] = {}
    for row, colour in zip(rows, CYCLE * len(rows), strict=False):
        at = row["terms"] + 0.12 * beside.get(row["terms"], 0)
        beside[row["terms"]] = beside.get(row["terms"], 0) + 1
        panel.errorbar(
            [at],
            [row["log_evidence"] - best],
            [2 * row["log_evidence_sd"]],
            fmt="s" if row["integer"] else "o",
            color=colour,
            ms=5,
            capsize=3,
            label=plain(row["name"]),
        )
        for width in row["prior_widths"]:
            if width["log_evidence"] is not None:
                mark = "v" if width["factor"] < 1 else "^"
                panel.plot(
                    [at], [width["log_evidence"] - best], mark, mfc="none", mec=colour, ms=5, ls="none"
                )
    panel.set_yscale("symlog", linthresh=10)
    panel.axhline(0.0, color=NOISE, lw=0.7)
    panel.set(xlabel="viscous terms [-]", ylabel="log evidence less the best [nat]")
    terms = sorted(beside)
    panel.set_xticks(terms)
    panel.set_xlim(terms[0] - 0.5, terms[-1] + 0.5)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    return figure
