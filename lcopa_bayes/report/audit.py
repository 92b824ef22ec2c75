"""The page of an audit, drawn from `audit.json` and the draws of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.page import write_graded
from lcopa_bayes.report.savedrun import SavedRun, load_run
from lcopa_bayes.report.section import NONE, Drawing, Section, Table, ends, figures, paged, percent, sentence
from lcopa_bayes.report.theme import BAND, CYCLE, HELD_OUT, INK, blank, grid, label, log_ticks, plain, svg_of

_PER_FIGURE = 12
_TOP = 6.0
"""Largest fall that is drawn [nat]."""
_AT_90 = 2.706
"""Fall at the ends of a 90 % interval [nat]."""
_PAIRS = 6
_DOTS = 1500


def write_audit(folder: Path) -> Path:
    """`audit.html` with verdicts, profiles, spectrum and pairs; returns its path.

    InputError when the folder holds no audit or it cannot be used.
    """

    def sections(values: Mapping[str, Any]) -> list[Section]:
        run = load_run(folder)
        texts = [part(values) for part in (_verdicts, _next, _symmetries, _functions, _delays)]
        return [*texts, _profiles(values, run), _spectrum(values), _pairs(values, run)]

    return write_graded(folder, "audit", "identifiability", sections)


def _verdicts(results: Mapping[str, Any]) -> Section:
    rows = results["parameters"]
    caption = (
        "The profile interval is that of the likelihood alone, within the support of the priors. Contraction "
        "is 1 - posterior over prior variance on the sampled scale; relative sd is the Cramer-Rao bound "
        "at the maximum, a dash where the Fisher matrix is singular or the parameter belongs to the noise. "
        "Verdicts hold given this model. Identified: the data bound both ends of the interval, within a "
        "factor of 2 (6 dB, an octave), an order within 0.5 (45 degrees of phase), a delay within one "
        "sampling period or a factor of 2, an offset within half the range of the response. Weakly "
        "identified: bounded, but not as narrowly. Unresolved: a resonance faster than the samples resolve."
    )
    verdicts = Table.of(
        rows,
        ("name", "code", "name"),
        ("unit", "text", "unit"),
        ("verdict", "text", "verdict"),
        ("profile, 90 %", "interval", lambda row: ends(row["profile"])),
        ("contraction", "number", lambda row: figures(row["contraction"], 2)),
        ("relative sd", "number", lambda row: figures(row["relative_sd"], 2)),
        caption=caption,
    )
    why = Table.of(
        rows,
        ("name", "code", "name"),
        ("why", "prose", "reason"),
        ("partners", "prose", lambda row: ", ".join(row["partners"]) or NONE),
        caption="Partners are parameters that can compensate a change of this parameter, the most exact "
        "first.",
    )
    contrary = Table.of(
        [row for row in rows if row["disagreements"]],
        ("name", "code", "name"),
        ("verdict", "text", "verdict"),
        ("contrary evidence and limits", "prose", lambda row: "; ".join(row["disagreements"])),
        caption="Where the four methods disagree; the verdict is that of the symmetries and the profile.",
    )
    return Section("Verdicts", tables=(verdicts, why, *((contrary,) if contrary.rows else ())))


def _next(results: Mapping[str, Any]) -> Section:
    advice = results["next_measurement"]
    limits = results["limitations"]
    if advice is None and limits:
        text = tuple(
            f"{sentence(limit['reason'])} Remedy: {limit['remedy'] or 'see the report'}." for limit in limits
        )
        return Section(
            "What to measure next",
            (
                "Given this model every parameter is identified, but the checks of the model fail: "
                "correct the model first, then repeat the audit.",
                *text,
            ),
        )
    if advice is None:
        return Section(
            "What to measure next",
            ("Given this model every parameter is identified: its parameters need no further record.",),
        )
    text = (sentence(advice["reason"]),)
    if not advice["parameters"]:
        return Section("What to measure next", text)
    caption = (
        "Parameters that are not identified, and their relative sd after a further record of "
        f"{advice['time']:g} {advice['time_unit']}, each with its best drive: median Cramer-Rao bounds over "
        "draws of the posterior; above 1 a parameter is still not determined. The verb design tries other "
        "times and confirms the result by simulation."
    )
    table = Table.of(
        advice["parameters"],
        ("name", "code", "name"),
        ("best drive", "text", lambda row: row["drive"] or NONE),
        ("relative sd", "number", lambda row: _expected(row, "")),
        ("after a plain step", "number", lambda row: _expected(row, "_step")),
        ("why no drive", "prose", lambda row: row["reason"] or NONE),
        caption=caption,
    )
    return Section("What to measure next", text, tables=(table,))


def _expected(row: Mapping[str, Any], which: str) -> str:
    """Expected relative standard deviation after the best drive or after the plain step."""
    expected = row.get(f"expected_relative_sd{which}")
    return NONE if expected is None else figures(expected["value"], 2)


def _symmetries(results: Mapping[str, Any]) -> Section:
    text, printed = [], results["printed_form"]
    sentences = [f"{symmetry['kind']}: {symmetry['sentence']}." for symmetry in results["symmetries"]]
    text += sentences or [
        "The model has no symmetry with these drives: each parameter has an effect of its own."
    ]
    if not results["structure"]["certain"]:
        text.append(
            "The rank of the sensitivities changes with the tolerance: what is a symmetry and what is "
            "merely too weak to compute cannot be distinguished, and no parameter is called structurally "
            "unidentifiable."
        )
    if printed is not None:
        text.append(
            f"In the printed parametrisation (Ta et al. 2026, Eqs. 16, 21, 28) only {printed['rank']} of "
            f"{printed['parameters']} numbers act: "
            + "; ".join(symmetry["sentence"] for symmetry in printed["symmetries"])
            + "."
        )
    if results["radial"] is not None:
        moved, fall = results["radial"]["moved"], results["radial"]["fall"]
        text.append(
            f"Radial test: at {figures(results['radial']['reached'], 2)} prior standard deviations from the "
            f"maximum, twice the log likelihood is lower by {figures(fall, 2)}; parameters that moved: "
            f"{', '.join(moved) or 'none'}."
        )
    return Section("Symmetries", tuple(text))


def _functions(results: Mapping[str, Any]) -> Section:
    table = Table.of(
        results["functions"],
        ("function", "code", "name"),
        ("unit", "text", "unit"),
        ("median", "number", "value"),
        ("90 % interval", "interval", ends),
        ("width / median", "number", lambda row: percent(row["relative_width"])),
        ("verdict", "text", "verdict"),
        ("grade", "grade", "grade"),
        caption="Functions of the parameters, the most precise first; equal-tailed credible intervals.",
    )
    return Section("Best-determined functions", tables=(table,))


def _delays(results: Mapping[str, Any]) -> Section:
    delays = results["delays"]
    text = (sentence(str(delays["sentence"])),)
    rows: Sequence[Mapping[str, Any]] = delays["separations"]
    if not rows:
        return Section("Delays of the paths", text)
    unit = delays["paths"][0]["unit"]
    table = Table.of(
        rows,
        ("pair", "code", lambda row: " / ".join(row["pair"])),
        (
            f"smallest resolved difference [{unit}]",
            "number",
            lambda row: figures(row["smallest_difference"], 2),
        ),
        caption="Smallest difference whose 90 % interval excludes 0, linearised; a dash: none.",
    )
    return Section("Delays of the paths", text, tables=(table,))


def _profiles(results: Mapping[str, Any], run: SavedRun) -> Section:
    rows = results["parameters"]
    caption = (
        "Line: fall of twice the log likelihood along the profile, its 90 % level dashed, an open side where "
        "the line stays below to the end. Filled: marginal posterior on the scale of the axis."
    )
    drawings = paged("profiles", rows, _PER_FIGURE, lambda part: _profile_page(part, run), caption)
    return Section("Profiles and marginals", drawings=drawings)


def _profile_page(rows: Sequence[Mapping[str, Any]], run: SavedRun) -> str:
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
            log_ticks(panel.xaxis, low, high)
        else:
            panel.set_xlim(low - margin * (high - low), high + margin * (high - low))
            panel.locator_params(axis="x", nbins=4)
        panel.set(ylim=(0.0, _TOP), xlabel=label(name, run.units[name]))
        panel.set_title(row["verdict"], fontsize=7.5)
    return svg_of(figure)


def _spectrum(results: Mapping[str, Any]) -> Section:
    rows = results["spectrum"]
    if not rows:
        return Section("Sloppy spectrum", ("Only noise parameters are free.",))
    figure = blank(0.9 + 0.24 * len(rows))
    panel = figure.subplots()
    floor = max(row["eigenvalue"] for row in rows) * 1e-16
    for place, row in enumerate(rows):
        value = max(row["eigenvalue"], floor)  # what is drawn; the table of numbers is in audit.json
        panel.plot([value], [place], "o", color=BAND if row["eigenvalue"] >= 1 else HELD_OUT, markersize=4)
        told_parts = ", ".join(f"{weight:+.2f} {name}" for name, weight in list(row["direction"].items())[:4])
        panel.annotate(
            plain(told_parts), (1.01, place), xycoords=("axes fraction", "data"), va="center", fontsize=7
        )
    panel.axvline(1.0, color=INK, linewidth=0.8, linestyle=":")
    panel.set_xscale("log")
    panel.invert_yaxis()
    panel.set_yticks(range(len(rows)), [str(place + 1) for place in range(len(rows))])
    panel.set(xlabel="precision of the data over that of the prior [-]", ylabel="direction")
    caption = (
        "Eigenvalues of the Fisher information at the maximum, in prior standard deviations; below 1 the "
        "prior is more informative than the data. Beside each, the parameters of its eigenvector."
    )
    return Section("Sloppy spectrum", drawings=(Drawing("sloppy_spectrum", svg_of(figure), caption),))


def _pairs(results: Mapping[str, Any], run: SavedRun) -> Section:
    pairs: dict[frozenset[str], tuple[str, str]] = {}
    for row in results["parameters"]:
        if row["verdict"] != "identified":
            for partner in row["partners"][:2]:
                pairs.setdefault(frozenset((row["name"], partner)), (row["name"], partner))
    shown = list(pairs.values())[:_PAIRS]
    if not shown:
        return Section("Degenerate pairs", ("No parameter has a partner that compensates it.",))
    figure, panels = grid(len(shown), columns=3, height=2.1)
    for panel, (a, b) in zip(panels, shown, strict=True):
        _pair(panel, run, a, b)
    omitted = len(pairs) - len(shown)
    caption = "Draws of parameters that are not identified against the parameters that compensate them." + (
        f" {omitted} more pairs are not drawn." if omitted else ""
    )
    return Section("Degenerate pairs", drawings=(Drawing("degenerate_pairs", svg_of(figure), caption),))


def _pair(panel: Axes, run: SavedRun, a: str, b: str) -> None:
    x, y = (run.draws[name].ravel() for name in (a, b))
    step = max(1, x.size // _DOTS)
    panel.plot(x[::step], y[::step], ".", color=CYCLE[0], markersize=1.5, alpha=0.5, rasterized=False)
    for name, axis, values, scale in (
        (a, panel.xaxis, x, panel.set_xscale),
        (b, panel.yaxis, y, panel.set_yscale),
    ):
        if run.spans_decades(name):
            scale("log")
            log_ticks(axis, float(values.min()), float(values.max()))
    panel.set(xlabel=label(a, run.units[a]), ylabel=label(b, run.units[b]))
