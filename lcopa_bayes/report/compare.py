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
        results: Mapping[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: cannot be read ({error}); run `compare` to write it") from None
    absent = [key for key in _NEEDS if key not in results]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `compare` again with --resume")
    if any("containment" not in row for row in results["models"]):
        raise InputError(f"{path}: written by an earlier version; run `compare` again")
    with look():
        scores, *rest = _tables(results)
        sections = [scores, *_figures(results, _curves(folder, results)), *rest]
    graded = {row["name"]: row for row in results["models"]}
    own = graded.get(results["preferred"])
    grade, reason = (own["grade"], own["grade_reason"]) if own else ("unusable", results["why"])
    verdict = Verdict(str(grade), f"{results['why']} {results['fractional']['sentence']}", str(reason))
    return write_page(folder, f"{results['study']}: comparison", sections, verdict, NAME)


def _curves(folder: Path, results: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Curves of every candidate that has any; InputError when a table cannot be read."""
    out, problems = {}, []
    for row in results["models"]:
        path = folder / "candidates" / folder_name(str(row["name"])) / "tables" / "curves.csv"
        try:
            out[str(row["name"])] = pd.read_csv(path, dtype={"record": str, "axis": str, "unit": str})
        except (OSError, ValueError) as error:
            problems.append(f"{path}: cannot be read ({error}); run `compare` again with --resume")
    if problems:
        raise InputError(problems)
    return out


def _tables(results: Mapping[str, Any]) -> list[Section]:
    """The sections of a comparison that hold text and tables."""
    return [_scores(results), _priors(results), _predicted(results), _orders(results), _warnings(results)]


def _scores(results: Mapping[str, Any]) -> Section:
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
        for row in results["models"]
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
        for row in results["models"]
    )
    caption = (
        "± is a standard error: of the evidence by bridge sampling, of predictive densities by the spread "
        "over parts of the records. The Bayes factor is against the best, the probability among these "
        "models alone, with equal prior probabilities. elpd is the log density of one forecast of held-out "
        "data, each sample predicted from those before it. AIC and BIC are from the maximum of the "
        "likelihood and take account of neither priors nor several modes."
    )
    text = [str(results["agreement"]["sentence"])]
    text += [f"{entry['name']} is not ranked: {entry['reason']}." for entry in results["unranked"]]
    text += [
        f"{item['name']}: {item['reason']}; its other scores remain valid."
        for item in results["evidence_undefined"]
    ]
    text += [f"{row['name']} {note}." for row in results["models"] for note in row["notes"]]
    text += [
        f"{row['name']} contains {', '.join(names)} and is at least as likely as what it contains."
        for row in results["models"]
        if (names := [contained["model"] for contained in row["containment"]["contains"]])
        and row["containment"]["met"]
    ]
    return Section("Scores", tuple(text), (), (Table(columns, rows), Table(other_columns, others, caption)))


def _priors(results: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("model", "code"), Column("width of the priors", "number")),
        *(Column("log evidence [nat]", "number"), Column("change", "number"), Column("method")),
        *(Column("ESS", "number"), Column("Pareto k", "number"), Column("priors changed", "prose")),
    )
    rows = []
    for row in results["models"]:
        for prior_width in row["prior_widths"]:
            change = (
                None
                if prior_width["log_evidence"] is None
                else prior_width["log_evidence"] - row["log_evidence"]
            )
            rows.append(
                (
                    *(str(row["name"]), f"{prior_width['factor']:g}"),
                    _with_error(prior_width["log_evidence"], prior_width["sd"]),
                    NONE if change is None else f"{change:+.2f}",
                    str(prior_width["method"]),
                    f"{prior_width['ess']:.0f}",
                    figures(prior_width["pareto_k"], 2),
                    ", ".join(prior_width["parameters"]) or "none",
                )
            )
    text = (
        "The evidence depends on the width of the priors. Here gains, times and delays have priors half and "
        "twice as wide; orders keep theirs, which are the ends of their domain. Importance weights use the "
        "existing draws; a refit moves them to the new posterior and repeats the bridge sampling; undefined "
        "marks narrower priors that exclude values the data support; no preference is stated where this "
        "occurs."
    )
    tables = (Table(columns, tuple(rows)),) if rows else ()
    return Section("Influence of the prior", (text,), (), tables)


def _predicted(results: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("model", "code"), Column("predicted", "code"), Column("how")),
        *(Column("samples", "number"), Column("log density [nat]", "number"), Column("if fitted", "number")),
        *(Column("method"), Column("Pareto k", "number"), Column("ESS", "number"), Column("grade", "grade")),
        Column("level from", "prose"),
    )
    rows = tuple(
        (
            *(str(row["name"]), str(prediction["part"]), str(prediction["kind"]), str(prediction["samples"])),
            _with_error(prediction["elpd"], prediction["monte_carlo_sd"], 1),
            *(
                _plain(prediction["in_sample"], 1),
                str(prediction["method"]),
                figures(prediction["pareto_k"], 2),
            ),
            *(f"{prediction['ess']:.0f}", str(prediction["grade"]), "; ".join(prediction["level_from"])),
        )
        for row in results["models"]
        for prediction in row["predictions"]
    )
    held = tuple(
        (
            *(str(row["name"]), str(entry["record"]), str(entry["axis"]), use, figures(entry["rmse"])),
            *(str(entry["unit"]), percent(entry["coverage_90"]), percent(entry["coverage_50"])),
        )
        for row in results["models"]
        for key, use in (("fit_scores", "fit"), ("held_out", "held out"))
        for entry in row[key]
    )
    errors = (
        *(Column("model", "code"), Column("record", "code"), Column("axis", "code"), Column("use")),
        *(Column("RMSE", "number"), Column("unit"), Column("in pointwise 90 % band", "number")),
        Column("in pointwise 50 % band", "number"),
    )
    text = (
        "Whole records are predicted from the others, and the future of a record from its past where it is "
        "the only one; single samples are never held out, since their neighbours determine them. The log "
        "density is that of one forecast: each sample given those before it. The noise, and the offset "
        "where a model has one per record, are those of the predicted record; all other parameters come "
        "from the other records. Samples at rest, at least the first, are given; all models predict the "
        "same samples. ± is the Monte Carlo error. 'if fitted' is the density of the same samples under "
        "draws of a fit that includes them, which is larger; where it is not, the grade is lowered. Bands "
        "are pointwise: of every 100 samples 90 are expected inside, not whole curves."
    )
    return Section("Prediction", (text,), (), (Table(columns, rows), Table(errors, held)))


def _orders(results: Mapping[str, Any]) -> Section:
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
    for entry in results["order_is_integer"]:
        estimate, spread = entry["estimate"], entry["estimate"]["sd"]
        said = _with_error(entry["log_bayes_factor"], entry["log_sd"])
        rows.append(
            (
                *(str(entry["model"]), str(entry["parameter"]), to_spread(estimate["value"], spread)),
                interval(estimate["lower"], estimate["upper"], spread),
                *(
                    str(entry["nearest"]),
                    said,
                    str(entry["method"]),
                    str(entry["answer"]),
                    str(entry["grade"]),
                ),
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


def _warnings(results: Mapping[str, Any]) -> Section:
    text = tuple(f"{flag['model']}: {flag['sentence']}." for flag in results["flags"])
    return Section(
        "Warnings", text or ("The residuals of every candidate are compatible with its noise model.",)
    )


def _with_error(value: float | None, error: float | None, places: int = 2) -> str:
    """`value ± error`."""
    if value is None:
        return NONE
    return f"{value:.{places}f}" if error is None else f"{value:.{places}f} ± {error:.{places}f}"


def _plain(value: float | None, places: int) -> str:
    return NONE if value is None else f"{value:.{places}f}"


def _figures(results: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> list[Section]:
    """Figures of a comparison; `curves` by candidate."""
    drawings = [*_evidence(results), *_records(results, curves)]
    text = (
        "Each model in its own colour throughout; black dots are fitted samples, red dots samples "
        "that no model was fitted to.",
    )
    return [Section("Candidates side by side", text, tuple(drawings))]


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
    panel.set_xlabel("viscous terms [-]")
    panel.set_ylabel("log evidence less the best [nat]")
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
    colour, unit = HELD_OUT if held else SEEN, str(some["unit"].iloc[0])
    seen, time = some["observed"].to_numpy(), some["time"].to_numpy()
    at = extremes(seen)
    top.plot(time[at], seen[at], ".", ms=2.5, mew=0, color=colour, label="observed", zorder=1)
    for row, own in zip(rows, CYCLE * len(rows), strict=False):
        _rival(
            top, below, parts[row["name"]], plain(row["name"]), own, row["name"] == results["preferred"], held
        )
    top.set_title(plain(f"{record}, {axis}: {'held out' if held else 'fit'}"), loc="left", color=colour)
    top.set_ylabel(label(axis, unit))
    below.axhline(0.0, color=NOISE, lw=0.7)
    below.set_ylabel(label("residual", unit))
    below.set_xlabel(label("time", results["time_unit"]))
    figure.align_ylabels()
    figure.legend(*top.get_legend_handles_labels(), loc="outside upper center", ncols=5, markerscale=2)
    return svg_of(figure)


def _rival(
    top: Axes, below: Axes, part: pd.DataFrame, name: str, colour: str, preferred: bool, held: bool
) -> None:
    time, middle = part["time"].to_numpy(), part["middle"].to_numpy()
    residual = part["observed"].to_numpy() - middle
    if held or preferred:
        low, high = part["low"].to_numpy(), part["high"].to_numpy()
        at = extremes(low, high)
        top.fill_between(time[at], low[at], high[at], color=colour, alpha=0.12, lw=0)
    at = extremes(middle)
    top.plot(time[at], middle[at], color=colour, lw=1.6 if preferred else 1.0, label=name, zorder=2)
    at = extremes(residual)
    below.plot(time[at], residual[at], color=colour, lw=0.9 if preferred else 0.6)


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
