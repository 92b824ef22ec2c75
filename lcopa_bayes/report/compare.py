"""The page of a comparison, drawn from `compare.json` and the candidates' tables alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.comparison.compare import folder_name
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.savedrun import read_tables
from lcopa_bayes.report.theme import (
    CYCLE,
    NOISE,
    Drawing,
    blank,
    draw_band,
    draw_line,
    headed,
    label,
    legend_above,
    plain,
    svg_of,
)
from lcopa_bayes.results.bands import POINTWISE

_NEAR = 60.0
"""Log evidence below the best that is still shown [nat]."""


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Scores, fits and residuals of a comparison; InputError when a table of it cannot be used."""
    shown = [*_evidence(values), *_records(values, _curves(folder, values))]
    return {"verdict": _verdict(values), "candidates": shown}


def _verdict(results: Mapping[str, Any]) -> Verdict:
    """Grade of the preferred candidate."""
    own = next((row for row in results["models"] if row["name"] == results["preferred"]), None)
    grade, reason = (own["grade"], own["grade_reason"]) if own else ("unusable", results["why"])
    return Verdict(str(grade), f"{results['why']} {results['fractional']['sentence']}", str(reason))


def _curves(folder: Path, results: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Curves of every candidate that has any; InputError when a table cannot be read."""
    tables, names = folder / "candidates", [str(row["name"]) for row in results["models"]]
    paths = {name: tables / folder_name(name) / "tables" / "curves.csv" for name in names}
    return read_tables(paths, "compare")


def _evidence(results: Mapping[str, Any]) -> list[Drawing]:
    """Log evidence of every model, against the number of its terms."""
    rows = [row for row in results["models"] if row["usable"] and row["log_evidence"] is not None]
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
        for prior_width in row["prior_widths"]:
            if prior_width["log_evidence"] is not None:
                mark = "v" if prior_width["factor"] < 1 else "^"
                panel.plot(
                    [at], [prior_width["log_evidence"] - best], mark, mfc="none", mec=colour, ms=5, ls="none"
                )
    low = min(row["log_evidence"] - best for row in rows)
    panel.set_ylim(bottom=max(1.1 * low, -_NEAR) - 3)
    panel.axhline(0.0, color=NOISE, lw=0.7)
    panel.set(xlabel="viscous terms [-]", ylabel="log evidence less the best [nat]")
    panel.xaxis.set_major_locator(MaxNLocator(integer=True))
    panel.margins(x=0.15)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5))
    below = [row["name"] for row in rows if row["log_evidence"] - best < -_NEAR - 3]
    caption = (
        "Log evidence against the number of terms: circles free orders, squares integer orders, bars two "
        "standard errors; open triangles the same under priors half (down) and twice (up) as wide."
    )
    if below:
        caption += f" Below the figure: {', '.join(below)}."
    return [Drawing("compare_evidence", svg_of(figure), caption)]


def _records(results: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> list[Drawing]:
    """Every axis of every record with the medians of all models, their residuals, and held-out bands."""
    rows = [row for row in results["models"] if row["name"] in curves]
    if not rows:
        return []
    first = curves[rows[0]["name"]]
    series = first[["record", "axis", "held_out"]].drop_duplicates().sort_values("held_out", kind="stable")
    drawings = []
    for number, (record, axis, held) in enumerate(series.itertuples(index=False), start=1):
        parts = {
            row["name"]: entry[(entry["record"] == record) & (entry["axis"] == axis)]
            for row in rows
            for entry in [curves[row["name"]]]
        }
        drawings.append(
            Drawing(
                f"compare_{number:02d}_{record}_{axis}",
                _drawn(results, rows, parts, str(record), str(axis), held=bool(held)),
                _caption(rows, str(record), str(axis), held=bool(held)),
                mark="held out" if held else "",
            )
        )
    return drawings


def _drawn(
    results: Mapping[str, Any],
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
    colour, unit = headed(top, record, axis, held_out=held), str(some["unit"].iloc[0])
    seen, time = some["observed"].to_numpy(), some["time"].to_numpy()
    draw_line(top, time, seen, ".", ms=2.5, mew=0, color=colour, label="observed", zorder=1)
    for row, own in zip(rows, CYCLE * len(rows), strict=False):
        _rival(
            top, below, parts[row["name"]], plain(row["name"]), own, row["name"] == results["preferred"], held
        )
    top.set_ylabel(label(axis, unit))
    below.axhline(0.0, color=NOISE, lw=0.7)
    below.set(ylabel=label("residual", unit), xlabel=label("time", results["time_unit"]))
    figure.align_ylabels()
    legend_above(figure, top, 5, markerscale=2)
    return svg_of(figure)


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


def _caption(rows: Sequence[Mapping[str, Any]], record: str, axis: str, *, held: bool) -> str:
    key = "held_out" if held else "fit_scores"
    errors = []
    for row in rows:
        for entry in row[key]:
            if (entry["record"], entry["axis"]) == (record, axis):
                errors.append(f"{row['name']} {figures(entry['rmse'])} {entry['unit']}")
    bands = f"the {POINTWISE} 90 % band" + (
        "s with noise of all" if held else " with noise of the preferred candidate"
    )
    return f"Medians of the candidates, {bands}, and residuals below. RMSE: {', '.join(errors)}."
