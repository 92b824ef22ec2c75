"""The page of a design, drawn from `design.json` of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.report.page import write_graded
from lcopa_bayes.report.section import NONE, Drawing, Section, Table, ends, figures
from lcopa_bayes.report.theme import BAND, HELD_OUT, INK, grid, label, plain, svg_of

_SPREAD = "median over draws of the posterior, 90 % of them in brackets"


def write_design(folder: Path) -> Path:
    """`design.html` with the table of drives, precision against bench time and its confirmation.

    InputError when the folder holds no design or it cannot be used.
    """
    parts = (_parameters, _curve, _drives, _confirmed)
    return write_graded(
        folder, "design", "what to measure next", lambda values: [part(values) for part in parts]
    )


def _ranged(row: Mapping[str, Any] | None) -> str:
    """`value (lower to upper)` of an estimate."""
    if row is None:
        return NONE
    return f"{figures(row['value'], 2)} ({ends(row)})"


def _parameters(results: Mapping[str, Any]) -> Section:
    time, unit = results["time"], results["time_unit"]
    text = [
        f"Relative standard deviations are Cramer-Rao bounds at {results['draws']} draws of the posterior "
        f"for {results['repeats']} record(s) of {time:g} {unit}. Far above 1 they mean that a parameter is "
        "not determined, not how large an error would be."
    ]
    text += [f"{row['name']}: {row['reason']}." for row in results["parameters"] if row["reason"]]
    table = Table.of(
        results["parameters"],
        ("name", "code", "name"),
        ("best drive", "text", lambda row: row["best_drive"] or NONE),
        ("relative sd", "interval", lambda row: _ranged(row["relative_sd"])),
        ("after the winner", "interval", lambda row: _ranged(row["relative_sd_winner"])),
        ("after the step", "interval", lambda row: _ranged(row["relative_sd_step"])),
        ("bench time for 10 %", "text", "time_words"),
        caption=f"Precision of every parameter with its best drive: {_SPREAD}.",
    )
    return Section("Gain of each parameter", tuple(text), tables=(table,))


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
        panel.set(xscale="log", yscale="log")
        panel.set_title(plain(name), fontsize=7.5)
        panel.set(xlabel=label("bench time", results["time_unit"]), ylabel="relative sd [-]")
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
    caption = (
        f"All drives of {results['time']:g} {results['time_unit']}: worst over the parameters, {_SPREAD}; "
        "the factor is the median of those at each draw; the geometric mean is along the axes of the "
        "confidence region."
    )
    table = Table.of(
        sorted(results["table"], key=lambda row: -(row["factor_over_step"] or 0.0)),
        ("drive", "text", "drive"),
        ("what it does", "prose", "words"),
        ("worst relative sd", "interval", lambda row: _ranged(row["worst"])),
        ("times better than the step", "number", "factor_over_step"),
        ("geometric mean sd", "number", lambda row: figures(row["typical"], 2)),
        caption=caption,
    )
    return Section("Drives", tuple(text), tables=(table,))


def _confirmed(results: Mapping[str, Any]) -> Section:
    trials = results["confirmed"]["trials"]
    if not trials:
        return Section("Confirmation", ("Nothing was simulated: no drive is better than the plain step.",))
    tables = tuple(
        Table.of(
            trial["parameters"],
            ("name", "code", "name"),
            ("truth", "number", "truth"),
            ("winner, expected", "number", lambda row: figures(row["winner"]["expected_relative_sd"], 2)),
            ("winner, achieved", "interval", lambda row: _achieved(row["winner"])),
            ("step, expected", "number", lambda row: figures(row["step"]["expected_relative_sd"], 2)),
            ("step, achieved", "interval", lambda row: _achieved(row["step"])),
            caption=f"{trial['where'][0].upper()}{trial['where'][1:]}: relative standard deviation of "
            f"least-squares estimates from {trial['replicas']} records of the virtual bench, 90 % "
            "chi-squared interval.",
        )
        for trial in trials
    )
    text = tuple(trial["sentence"] for trial in trials)
    return Section("Confirmation", text, tables=tables)


def _achieved(row: Mapping[str, Any]) -> str:
    return f"{figures(row['achieved_relative_sd'], 2)} ({ends(row)})"
