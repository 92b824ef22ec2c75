"""The page of a design, drawn from `design.json` of its run folder alone."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.formatting import NONE, figures, interval
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import BAND, HELD_OUT, INK, grid, label, look, plain, svg_of

_SPREAD = "median over draws of the posterior, 90 % of them in brackets"

NAME = "design.html"
"""Name of the page inside the run folder."""
_NEEDS = (
    *("study", "verdict", "grade", "grade_reason", "time", "time_unit", "winner", "parameters", "table"),
    *("curve", "confirmed", "range", "repeats", "refresh", "draws", "structure", "template"),
)


def write_design(folder: Path) -> Path:
    """`design.html` with the table of drives, precision against bench time and its confirmation.

    InputError when the folder holds no design or it cannot be used.
    """
    path = folder / "design.json"
    try:
        results: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `design` to write it") from None
    absent = [key for key in _NEEDS if key not in results]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `design` again with --resume")
    with look():
        sections = _tables(results)
    verdict = Verdict(str(results["grade"]), str(results["verdict"]), str(results["grade_reason"]))
    return write_page(folder, f"{results['study']}: what to measure next", sections, verdict, NAME)


def _tables(results: Mapping[str, Any]) -> list[Section]:
    """Every part of the page."""
    return [_parameters(results), _curve(results), _drives(results), _confirmed(results)]


def _ranged(row: Mapping[str, Any] | None) -> str:
    """`value (lower to upper)` of an estimate."""
    if row is None:
        return NONE
    ends = (row["lower"], row["upper"])
    spread = None if None in ends else abs(ends[1] - ends[0]) / 3.29
    return f"{figures(row['value'], 2)} ({interval(*ends, spread)})"


def _parameters(results: Mapping[str, Any]) -> Section:
    time, unit = results["time"], results["time_unit"]
    text = [
        f"Relative standard deviations are Cramer-Rao bounds at {results['draws']} draws of the posterior "
        f"for {results['repeats']} record(s) of {time:g} {unit}. Far above 1 they mean that a parameter is "
        "not determined, not how large an error would be."
    ]
    text += [f"{row['name']}: {row['reason']}." for row in results["parameters"] if row["reason"]]
    columns = (
        *(Column("name", "code"), Column("best drive"), Column("relative sd", "interval")),
        *(Column("after the winner", "interval"), Column("after the step", "interval")),
        Column("bench time for 10 %"),
    )
    rows = tuple(
        (
            *(row["name"], row["best_drive"] or NONE, _ranged(row["relative_sd"])),
            *(_ranged(row["relative_sd_winner"]), _ranged(row["relative_sd_step"]), row["time_words"]),
        )
        for row in results["parameters"]
    )
    caption = f"Precision of every parameter with its best drive: {_SPREAD}."
    return Section("Gain of each parameter", tuple(text), (), (Table(columns, rows, caption),))


def _curve(results: Mapping[str, Any]) -> Section:
    curve = results["curve"]
    names = list(curve[0]["best"])
    if not names:
        return Section("Precision against bench time", ("There is no parameter to draw.",))
    figure, panels = grid(len(names), columns=3, height=1.7)
    times = np.array([row["time"] for row in curve], dtype=float)
    for panel, name in zip(panels, names, strict=True):
        for key, colour, told_as in (("step", HELD_OUT, "plain step"), ("best", BAND, "best drive")):
            spread = np.array([row[key][name] for row in curve], dtype=float)
            panel.plot(times, spread, color=colour, marker=".", markersize=4, label=told_as)
        panel.axhline(0.1, color=INK, linewidth=0.7, linestyle=":")
        panel.set_xscale("log")
        panel.set_yscale("log")
        panel.set_title(plain(name), fontsize=7.5, loc="left")
        panel.set_xlabel(label("bench time", results["time_unit"]))
        panel.set_ylabel("relative sd [-]")
    panels[0].legend()
    caption = (
        "Expected relative standard deviation (median over draws) after the best drive and after the plain "
        "step; dotted: 10 %. A gap: not determined at most draws."
    )
    return Section(
        "Precision against bench time", drawings=(Drawing("design_curve", svg_of(figure), caption),)
    )


def _drives(results: Mapping[str, Any]) -> Section:
    ranges = "; ".join(
        f"{row['axis']} from {figures(row['low'])} to {figures(row['high'])} {row['unit']}"
        for row in results["range"]
    )
    text = [
        f"Drives stay within {ranges} and change every {results['refresh']:g} {results['time_unit']} or less "
        "often."
    ]
    if results["winner"] is not None:
        text.append(
            f"Best for the worst parameter: {results['winner']['drive']} ({results['winner']['words']}); "
            f"D-optimal: {results['d_optimal']}. The winning drive is in "
            f"{results['template']}, its responses still empty."
        )
    columns = (
        *(Column("drive"), Column("what it does", "prose"), Column("worst relative sd", "interval")),
        *(Column("times better than the step", "number"), Column("geometric mean sd", "number")),
    )
    ordered = sorted(results["table"], key=lambda row: -(row["factor_over_step"] or 0.0))
    rows = tuple(
        (
            *(row["drive"], row["words"], _ranged(row["worst"]), figures(row["factor_over_step"], 3)),
            figures(row["typical"], 2),
        )
        for row in ordered
    )
    caption = (
        f"All drives of {results['time']:g} {results['time_unit']}: worst over the parameters, {_SPREAD}; "
        "the factor is the median of those at each draw; the geometric mean is along the axes of the "
        "confidence region."
    )
    return Section("Drives", tuple(text), (), (Table(columns, rows, caption),))


def _confirmed(results: Mapping[str, Any]) -> Section:
    trials = results["confirmed"]["trials"]
    if not trials:
        return Section("Confirmation", ("Nothing was simulated: no drive is better than the plain step.",))
    columns = (
        *(Column("name", "code"), Column("truth", "number")),
        *(Column("winner, expected", "number"), Column("winner, achieved", "interval")),
        *(Column("step, expected", "number"), Column("step, achieved", "interval")),
    )
    tables = []
    for trial in trials:
        rows = []
        for row in trial["parameters"]:
            cells = [row["name"], figures(row["truth"])]
            for which in (row["winner"], row["step"]):
                ends = interval(which["lower"], which["upper"], (which["upper"] - which["lower"]) / 3.29)
                told_sd = figures(which["achieved_relative_sd"], 2)
                cells += [figures(which["expected_relative_sd"], 2), f"{told_sd} ({ends})"]
            rows.append(tuple(cells))
        caption = (
            f"{trial['where'][0].upper()}{trial['where'][1:]}: relative standard deviation of least-squares "
            f"estimates from {trial['replicas']} records of the virtual bench, 90 % chi-squared interval."
        )
        tables.append(Table(columns, tuple(rows), caption))
    text = tuple(f"{trial['sentence'][0].upper()}{trial['sentence'][1:]}." for trial in trials)
    return Section("Confirmation", text, (), tuple(tables))
