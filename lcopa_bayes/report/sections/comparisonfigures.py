"""What a comparison found, as figures: evidence against terms, and the rivals on each record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.report.decimation import extremes
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.section import Drawing, Section
from lcopa_bayes.report.theme import CYCLE, HELD_OUT, NOISE, SEEN, blank, label, plain, svg_of
from lcopa_bayes.results.prediction import KIND

_NEAR = 60.0
"""Log evidence below the best that is still shown [nat]."""


def sections(told: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> list[Section]:
    """Figures of a comparison; `curves` by candidate."""
    drawings = [*_evidence(told), *_records(told, curves)]
    text = (
        "Each model in its own colour throughout; black dots are samples that were fitted, red ones samples "
        "no model has seen.",
    )
    return [Section("Rivals side by side", text, tuple(drawings))]


def _evidence(told: Mapping[str, Any]) -> list[Drawing]:
    """Log evidence of every model, against the number of its terms."""
    rows = [row for row in told["models"] if row["usable"] and row["log_evidence"] is not None]
    if len(rows) < 2:
        return []
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
        for one in row["prior_widths"]:
            if one["log_evidence"] is not None:
                mark = "v" if one["factor"] < 1 else "^"
                panel.plot([at], [one["log_evidence"] - best], mark, mfc="none", mec=colour, ms=5, ls="none")
    low = min(row["log_evidence"] - best for row in rows)
    panel.set_ylim(bottom=max(1.1 * low, -_NEAR) - 3)
    panel.axhline(0.0, color=NOISE, lw=0.7)
    panel.set_xlabel("viscous terms [-]")
    panel.set_ylabel("log evidence less the best [nat]")
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.margins(x=0.15)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    below = [row["name"] for row in rows if row["log_evidence"] - best < -_NEAR - 3]
    caption = (
        "Log evidence against the number of terms: circles free orders, squares integer ones, bars two "
        "standard errors; open triangles the same under priors half (down) and twice (up) as wide."
    )
    if below:
        caption += f" Below the figure: {', '.join(below)}."
    return [Drawing("compare_evidence", svg_of(figure), caption)]


def _records(told: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> list[Drawing]:
    """Every axis of every record with the medians of all models, their residuals, and held-out bands."""
    rows = [row for row in told["models"] if row["name"] in curves]
    if not rows:
        return []
    first = curves[rows[0]["name"]]
    series = first[["record", "axis", "held_out"]].drop_duplicates().sort_values("held_out", kind="stable")
    drawings = []
    for number, (record, axis, held) in enumerate(series.itertuples(index=False), start=1):
        parts = {
            row["name"]: one[(one["record"] == record) & (one["axis"] == axis)]
            for row in rows
            for one in [curves[row["name"]]]
        }
        drawings.append(
            Drawing(
                f"compare_{number:02d}_{record}_{axis}",
                _drawn(told, rows, parts, str(record), str(axis), held=bool(held)),
                _caption(rows, str(record), str(axis), held=bool(held)),
                mark="held out" if held else "",
            )
        )
    return drawings


def _drawn(
    told: Mapping[str, Any],
    rows: Sequence[Mapping[str, Any]],
    parts: Mapping[str, pd.DataFrame],
    record: str,
    axis: str,
    *,
    held: bool,
) -> str:
    figure = blank(4.3)
    top, below = figure.subplots(2, 1, sharex=True, height_ratios=[2.0, 1.3])
    some = parts[rows[0]["name"]]
    colour, unit = HELD_OUT if held else SEEN, str(some["unit"].iloc[0])
    seen, time = some["observed"].to_numpy(), some["time"].to_numpy()
    at = extremes(seen)
    top.plot(time[at], seen[at], ".", ms=2.5, mew=0, color=colour, label="observed", zorder=1)
    for row, own in zip(rows, CYCLE * len(rows), strict=False):
        _rival(
            top, below, parts[row["name"]], plain(row["name"]), own, row["name"] == told["preferred"], held
        )
    top.set_title(plain(f"{record}, {axis}: {'held out' if held else 'fit'}"), loc="left", color=colour)
    top.set_ylabel(label(axis, unit))
    below.axhline(0.0, color=NOISE, lw=0.7)
    below.set_ylabel(label("residual", unit))
    below.set_xlabel(label("time", told["time_unit"]))
    figure.align_ylabels()
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=5, markerscale=2)
    return svg_of(figure)


def _rival(
    top: Axes, below: Axes, part: pd.DataFrame, name: str, colour: str, preferred: bool, held: bool
) -> None:
    time, middle = part["time"].to_numpy(), part["middle"].to_numpy()
    left = part["observed"].to_numpy() - middle
    if held or preferred:
        low, high = part["low"].to_numpy(), part["high"].to_numpy()
        at = extremes(low, high)
        top.fill_between(time[at], low[at], high[at], color=colour, alpha=0.12, lw=0)
    at = extremes(middle)
    top.plot(time[at], middle[at], color=colour, lw=1.6 if preferred else 1.0, label=name, zorder=2)
    at = extremes(left)
    below.plot(time[at], left[at], color=colour, lw=0.9 if preferred else 0.6)


def _caption(rows: Sequence[Mapping[str, Any]], record: str, axis: str, *, held: bool) -> str:
    key = "held_out" if held else "fit_scores"
    told = []
    for row in rows:
        for one in row[key]:
            if (one["record"], one["axis"]) == (record, axis):
                told.append(f"{row['name']} {figures(one['rmse'])} {one['unit']}")
    bands = f"the {KIND} 90 % band" + ("s with noise of all" if held else " with noise of the preferred one")
    return f"Medians of the rivals, {bands}, and residuals below. RMSE: {', '.join(told)}."
