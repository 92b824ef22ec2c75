"""The page of a comparison, drawn from `compare.json` and the candidates' tables alone."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.comparison.compare import folder_name
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.report.decimation import extremes
from lcopa_bayes.report.formatting import NONE, figures, interval, percent, to_spread
from lcopa_bayes.report.page import Verdict, write_page
from lcopa_bayes.report.section import Column, Drawing, Section, Table
from lcopa_bayes.report.theme import CYCLE, HELD_OUT, NOISE, SEEN, blank, label, look, plain, svg_of
from lcopa_bayes.results.bands import POINTWISE

_NEAR = 60.0
"""Log evidence below the best that is still shown [nat]."""


NAME = "compare.html"
"""Name of the page inside the run folder."""
_NEEDS = ("study", "models", "preferred", "why", "agreement", "fractional", "order_is_integer", "flags")


def write_comparison(folder: Path) -> Path:
    """`compare.html` with scores, orders, fits and residuals; returns its path.

    InputError when the folder holds no comparison or it cannot be used.
    """
    path = folder / "compare.json"
    try:
        told: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `compare` to write it") from None
    absent = [key for key in _NEEDS if key not in told]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `compare` again with --resume")
    if any("containment" not in row for row in told["models"]):
        raise InputError(f"{path}: written by an earlier version; run `compare` again")
    with look():
        scores, *rest = _tables(told)
        sections = [scores, *_figures(told, _curves(folder, told)), *rest]
    graded = {row["name"]: row for row in told["models"]}
    own = graded.get(told["preferred"])
    grade, reason = (own["grade"], own["grade_reason"]) if own else ("unusable", told["why"])
    verdict = Verdict(str(grade), f"{told['why']} {told['fractional']['sentence']}", str(reason))
    return write_page(folder, f"{told['study']}: comparison", sections, verdict, NAME)


def _curves(folder: Path, told: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Curves of every candidate that has any; InputError when a table cannot be read."""
    out, problems = {}, []
    for row in told["models"]:
        path = folder / "candidates" / folder_name(str(row["name"])) / "tables" / "curves.csv"
        try:
            out[str(row["name"])] = pd.read_csv(path, dtype={"record": str, "axis": str, "unit": str})
        except (OSError, ValueError) as error:
            problems.append(f"{path}: cannot be read ({error}); run `compare` again with --resume")
    if problems:
        raise InputError(problems)
    return out


def _tables(told: Mapping[str, Any]) -> list[Section]:
    """Everything of a comparison that is words and numbers."""
    return [_scores(told), _priors(told), _predicted(told), _orders(told), _heeded(told)]


def _scores(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("model", "code"), Column("what it is", "prose"), Column("parameters", "number")),
        *(Column("log evidence [nat]", "number"), Column("log Bayes factor", "number")),
        *(Column("probability", "number"), Column("grade", "grade")),
    )
    rows = tuple(
        (
            *(str(row["name"]), str(row["about"]), str(row["parameters"])),
            _with_error(row["log_evidence"], row["log_evidence_sd"]),
            _with_error(row["log_bayes_factor"], row["log_bayes_factor_sd"]),
            _with_error(row["probability"], row["probability_sd"], 3),
            str(row["grade"]),
        )
        for row in told["models"]
    )
    other_columns = (
        *(Column("model", "code"), Column("elpd [nat]", "number"), Column("less than best", "number")),
        *(Column("stacking weight", "number"), Column("max log likelihood", "number")),
        *(Column("AIC", "number"), Column("BIC", "number")),
    )
    others = tuple(
        (
            str(row["name"]),
            _with_error(row["elpd"], row["elpd_sd"], 1),
            _with_error(row["elpd_difference"], row["elpd_difference_sd"], 1),
            _plain(row["stacking"], 2),
            *(_plain(row[key], 1) for key in ("max_log_likelihood", "aic", "bic")),
        )
        for row in told["models"]
    )
    caption = (
        "± is a standard error: of the evidence by bridge sampling, of predictive densities by the spread "
        "over stretches of the records. The Bayes factor is against the best, the probability among these "
        "models alone, equally likely before. elpd is the log density of one forecast of what was left out, "
        "each sample predicted from those before it. AIC and BIC are from the maximum of the likelihood and "
        "know neither priors nor ridges."
    )
    text = [str(told["agreement"]["sentence"])]
    text += [f"{one['name']} is ranked nowhere: {one['reason']}." for one in told["unranked"]]
    text += [f"{one['name']}: {one['reason']}; the other scores stand." for one in told["evidence_undefined"]]
    text += [f"{row['name']} {note}." for row in told["models"] for note in row["notes"]]
    text += [
        f"{row['name']} contains {', '.join(names)} and is at least as likely as what it contains."
        for row in told["models"]
        if (names := [one["model"] for one in row["containment"]["contains"]]) and row["containment"]["met"]
    ]
    return Section("Scores", tuple(text), (), (Table(columns, rows), Table(other_columns, others, caption)))


def _priors(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("model", "code"), Column("width of the priors", "number")),
        *(Column("log evidence [nat]", "number"), Column("change", "number"), Column("road")),
        *(Column("ESS", "number"), Column("Pareto k", "number"), Column("priors changed", "prose")),
    )
    rows = []
    for row in told["models"]:
        for one in row["prior_widths"]:
            change = None if one["log_evidence"] is None else one["log_evidence"] - row["log_evidence"]
            rows.append(
                (
                    *(str(row["name"]), f"{one['factor']:g}"),
                    _with_error(one["log_evidence"], one["sd"]),
                    NONE if change is None else f"{change:+.2f}",
                    str(one["road"]),
                    f"{one['ess']:.0f}",
                    figures(one["pareto_k"], 2),
                    ", ".join(one["parameters"]) or "none",
                )
            )
    text = (
        "An evidence moves with the width of the priors. Here gains, times and delays have priors half and "
        "twice as wide; orders keep theirs, which are the ends of their domain. Importance weights use the "
        "draws that are there; a refit moves them to the new posterior and bridges anew; undefined are "
        "narrower priors that exclude what the data show: with one of these no win is claimed."
    )
    tables = (Table(columns, tuple(rows)),) if rows else ()
    return Section("The prior's part", (text,), (), tables)


def _predicted(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("model", "code"), Column("predicted", "code"), Column("how")),
        *(Column("samples", "number"), Column("log density [nat]", "number"), Column("if fitted", "number")),
        *(Column("road"), Column("Pareto k", "number"), Column("ESS", "number"), Column("grade", "grade")),
        Column("level from", "prose"),
    )
    rows = tuple(
        (
            *(str(row["name"]), str(one["part"]), str(one["kind"]), str(one["samples"])),
            _with_error(one["elpd"], one["monte_carlo_sd"], 1),
            *(_plain(one["in_sample"], 1), str(one["road"]), figures(one["pareto_k"], 2)),
            *(f"{one['ess']:.0f}", str(one["grade"]), "; ".join(one["level_from"])),
        )
        for row in told["models"]
        for one in row["predictions"]
    )
    held = tuple(
        (
            *(str(row["name"]), str(one["record"]), str(one["axis"]), use, figures(one["rmse"])),
            *(str(one["unit"]), percent(one["coverage_90"]), percent(one["coverage_50"])),
        )
        for row in told["models"]
        for key, use in (("fit_scores", "fit"), ("held_out", "held out"))
        for one in row[key]
    )
    errors = (
        *(Column("model", "code"), Column("record", "code"), Column("axis", "code"), Column("use")),
        *(Column("RMSE", "number"), Column("unit"), Column("in pointwise 90 % band", "number")),
        Column("in pointwise 50 % band", "number"),
    )
    text = (
        "Whole records are predicted from the others, and the future of a record from its past where it is "
        "the only one; single points are never left out, since their neighbours tell them. The log density "
        "is that of one forecast: each sample given those before it. The noise, and the level where a model "
        "gives every record one of its own, follow the record; all else is known from the others. "
        "Samples at rest are known, the first one at least; all models predict the same samples. ± is the "
        "Monte Carlo error. 'if fitted' is the density of the same samples under draws that have seen them, "
        "which is larger; where it is not, the grade is lowered. Bands are pointwise: of every 100 samples "
        "90 are expected inside, not whole curves."
    )
    return Section("Prediction", (text,), (), (Table(columns, rows), Table(errors, held)))


def _orders(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("model", "code"), Column("order", "code"), Column("median", "number")),
        *(Column("90 % interval", "interval"), Column("nearest", "number")),
        *(
            Column("log Bayes factor", "number"),
            Column("density from", "prose"),
            Column("answer"),
            Column("grade", "grade"),
        ),
    )
    rows = []
    for one in told["order_is_integer"]:
        estimate, spread = one["estimate"], one["estimate"]["sd"]
        said = _with_error(one["log_bayes_factor"], one["log_sd"])
        rows.append(
            (
                *(str(one["model"]), str(one["parameter"]), to_spread(estimate["value"], spread)),
                interval(estimate["lower"], estimate["upper"], spread),
                *(str(one["nearest"]), said, str(one["road"]), str(one["answer"]), str(one["grade"])),
            )
        )
    text = (
        "The Savage-Dickey ratio: posterior over prior density at the nearest integer, as a logarithm "
        "[nat] with its Monte Carlo error. Two errors above log 3 the integer is favoured, two below log "
        "1/3 it is not. Where too few draws are at the integer its density is that of a normal tail. "
        "Intervals are equal-tailed credible.",
    )
    tables = (Table(columns, tuple(rows)),) if rows else ()
    return Section("Is this order an integer?", text, (), tables)


def _heeded(told: Mapping[str, Any]) -> Section:
    text = tuple(f"{one['model']}: {one['sentence']}." for one in told["flags"])
    return Section("What to heed", text or ("No candidate leaves anything but noise in the fitted records.",))


def _with_error(value: float | None, error: float | None, places: int = 2) -> str:
    """`value ± error`."""
    if value is None:
        return NONE
    return f"{value:.{places}f}" if error is None else f"{value:.{places}f} ± {error:.{places}f}"


def _plain(value: float | None, places: int) -> str:
    return NONE if value is None else f"{value:.{places}f}"


def _figures(told: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> list[Section]:
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
    bands = f"the {POINTWISE} 90 % band" + (
        "s with noise of all" if held else " with noise of the preferred one"
    )
    return f"Medians of the rivals, {bands}, and residuals below. RMSE: {', '.join(told)}."
