"""The page of a comparison, drawn from `compare.json` and the candidates' tables alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import hypot
from pathlib import Path
from typing import Any

import pandas as pd
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from lcopa_bayes.comparison.compare import folder_name
from lcopa_bayes.core.errors import refuse_if
from lcopa_bayes.report.page import Verdict, write_graded
from lcopa_bayes.report.section import (
    NONE,
    Drawing,
    Section,
    Table,
    figures,
    interval,
    percent,
    to_spread,
    with_error,
)
from lcopa_bayes.report.theme import (
    CYCLE,
    NOISE,
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


def write_comparison(folder: Path) -> Path:
    """`compare.html` with scores, orders, fits and residuals; returns its path.

    InputError when the folder holds no comparison or it cannot be used.
    """

    def sections(values: Mapping[str, Any]) -> list[Section]:
        texts = [part(values) for part in (_priors, _predicted, _orders, _warnings)]
        return [_scores(values), _averaged(values), _figures(values, _curves(folder, values)), *texts]

    return write_graded(folder, "compare", "comparison", sections, box=_verdict)


def _verdict(results: Mapping[str, Any]) -> Verdict:
    """Grade of the preferred candidate."""
    own = next((row for row in results["models"] if row["name"] == results["preferred"]), None)
    grade, reason = (own["grade"], own["grade_reason"]) if own else ("unusable", results["why"])
    return Verdict(str(grade), f"{results['why']} {results['fractional']['sentence']}", str(reason))


def _curves(folder: Path, results: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Curves of every candidate that has any; InputError when a table cannot be read."""
    out, problems = {}, []
    for row in results["models"]:
        path = folder / "candidates" / folder_name(str(row["name"])) / "tables" / "curves.csv"
        try:
            out[str(row["name"])] = pd.read_csv(path, dtype={"record": str, "axis": str, "unit": str})
        except (OSError, ValueError) as error:
            problems.append(f"{path}: cannot be read ({error}); run `compare` again with --resume")
    refuse_if(problems)
    return out


def _scores(results: Mapping[str, Any]) -> Section:
    models = results["models"]
    scores = Table.of(
        models,
        ("model", "code", "name"),
        ("what it is", "prose", "about"),
        ("parameters", "number", "parameters"),
        ("log evidence [nat]", "number", lambda row: _with_error(row, "log_evidence")),
        ("log Bayes factor", "number", lambda row: _with_error(row, "log_bayes_factor")),
        ("probability", "number", lambda row: _with_error(row, "probability", places=3)),
        ("grade", "grade", "grade"),
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
    others = Table.of(
        models,
        ("model", "code", "name"),
        ("elpd [nat]", "number", lambda row: _with_error(row, "elpd", places=1)),
        ("less than best", "number", lambda row: _with_error(row, "elpd_difference", places=1)),
        ("stacking weight", "number", lambda row: _with_error(row, "stacking", "")),
        ("max log likelihood", "number", lambda row: _with_error(row, "max_log_likelihood", "", places=1)),
        ("AIC", "number", lambda row: _with_error(row, "aic", "", places=1)),
        ("BIC", "number", lambda row: _with_error(row, "bic", "", places=1)),
        caption=caption,
    )
    return Section("Scores", tuple(text), tables=(scores, others))


def _averaged(results: Mapping[str, Any]) -> Section:
    """Numbers that every candidate has, and the part of their uncertainty that the choice of a model adds."""
    rows = results["averaged"]
    if not rows:
        return Section("Numbers over all models", ("Fewer than two usable candidates have an evidence.",))
    table = Table.of(
        rows,
        ("number", "code", "name"),
        ("median", "number", lambda row: to_spread(row["value"], _both(row))),
        ("unit", "text", "unit"),
        ("90 % interval", "interval", lambda row: interval(row["lower"], row["upper"], _both(row))),
        ("sd by noise", "number", lambda row: figures(row["sd_noise"], 2)),
        ("sd by structure", "number", lambda row: figures(row["sd_structure"], 2)),
        ("weights", "prose", _weights),
        ("grade", "grade", "grade"),
        caption="Equal-tailed credible intervals of the mixture of all models. Weights are posterior "
        "probabilities; a richer model that is not rejected and moves a number by more than half of its "
        "standard deviation (*) weighs as much as the most probable one, and its interval is held. Standard "
        "deviations are of draws within the models and of means between them; open where a number is not "
        "reached.",
    )
    return Section("Numbers over all models", (), tables=(table,))


def _both(row: Mapping[str, Any]) -> float | None:
    parts = row["sd_noise"], row["sd_structure"]
    return None if None in parts else float(hypot(*parts))


def _weights(row: Mapping[str, Any]) -> str:
    return ", ".join(
        f"{name}{'*' * (name in row['raised'])} {weight:.2f}" for name, weight in row["weights"].items()
    )


def _priors(results: Mapping[str, Any]) -> Section:
    table = Table.of(
        [
            width | {"model": row["name"], "change": _less(width["log_evidence"], row["log_evidence"])}
            for row in results["models"]
            for width in row["prior_widths"]
        ],
        ("model", "code", "model"),
        ("width of the priors", "number", lambda row: f"{row['factor']:g}"),
        ("log evidence [nat]", "number", lambda row: _with_error(row, "log_evidence", "sd")),
        ("change", "number", lambda row: NONE if row["change"] is None else f"{row['change']:+.2f}"),
        ("method", "text", "method"),
        ("ESS", "number", lambda row: f"{row['ess']:.0f}"),
        ("Pareto k", "number", lambda row: figures(row["pareto_k"], 2)),
        ("priors changed", "prose", lambda row: ", ".join(row["parameters"]) or "none"),
    )
    text = (
        "The evidence depends on the width of the priors. Here gains, times and delays have priors half and "
        "twice as wide; orders keep theirs, which are the ends of their domain. Importance weights use the "
        "existing draws; a refit moves them to the new posterior and repeats the bridge sampling; undefined "
        "marks narrower priors that exclude values the data support; no preference is stated where this "
        "occurs."
    )
    return Section("Influence of the prior", (text,), tables=(table,) if table.rows else ())


def _less(value: float | None, other: float) -> float | None:
    return None if value is None else value - other


def _predicted(results: Mapping[str, Any]) -> Section:
    predictions = Table.of(
        [part | {"model": row["name"]} for row in results["models"] for part in row["predictions"]],
        ("model", "code", "model"),
        ("predicted", "code", "part"),
        ("how", "text", "kind"),
        ("samples", "number", "samples"),
        ("log density [nat]", "number", lambda row: _with_error(row, "elpd", "monte_carlo_sd", places=1)),
        ("if fitted", "number", lambda row: _with_error(row, "in_sample", "", places=1)),
        ("method", "text", "method"),
        ("Pareto k", "number", lambda row: figures(row["pareto_k"], 2)),
        ("ESS", "number", lambda row: f"{row['ess']:.0f}"),
        ("grade", "grade", "grade"),
        ("level from", "prose", lambda row: "; ".join(row["level_from"])),
    )
    errors = Table.of(
        [
            entry | {"model": row["name"], "use": use}
            for row in results["models"]
            for key, use in (("fit_scores", "fit"), ("held_out", "held out"))
            for entry in row[key]
        ],
        ("model", "code", "model"),
        ("record", "code", "record"),
        ("axis", "code", "axis"),
        ("use", "text", "use"),
        ("RMSE", "number", "rmse"),
        ("unit", "text", "unit"),
        ("in pointwise 90 % band", "number", lambda row: percent(row["coverage_90"])),
        ("in pointwise 50 % band", "number", lambda row: percent(row["coverage_50"])),
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
    return Section("Prediction", (text,), tables=(predictions, errors))


def _orders(results: Mapping[str, Any]) -> Section:
    table = Table.of(
        [entry["estimate"] | entry for entry in results["order_is_integer"]],
        ("model", "code", "model"),
        ("order", "code", "parameter"),
        ("median", "number", lambda row: to_spread(row["value"], row["sd"])),
        ("90 % interval", "interval", lambda row: interval(row["lower"], row["upper"], row["sd"])),
        ("nearest", "number", lambda row: str(row["nearest"])),
        ("log Bayes factor", "number", lambda row: _with_error(row, "log_bayes_factor", "log_sd")),
        ("density from", "prose", "method"),
        ("answer", "text", "answer"),
        ("grade", "grade", "grade"),
    )
    text = (
        "The Savage-Dickey ratio: posterior over prior density at the nearest integer, as a logarithm "
        "[nat] with its Monte Carlo error. Two errors above log 3 the integer is favoured, two below log "
        "1/3 it is not. Where too few draws are at the integer its density is that of a normal tail. "
        "Intervals are equal-tailed credible.",
    )
    return Section("Is this order an integer?", text, tables=(table,) if table.rows else ())


def _warnings(results: Mapping[str, Any]) -> Section:
    text = tuple(f"{flag['model']}: {flag['sentence']}." for flag in results["flags"])
    return Section(
        "Warnings", text or ("The residuals of every candidate are compatible with its noise model.",)
    )


def _with_error(row: Mapping[str, Any], key: str, error: str | None = None, *, places: int = 2) -> str:
    """`value ± error` of a key and that of its error, by default the one with `_sd`."""
    return with_error(row[key], row.get(f"{key}_sd" if error is None else error), places)


def _figures(results: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> Section:
    """Figures of a comparison; `curves` by candidate."""
    drawings = [*_evidence(results), *_records(results, curves)]
    text = (
        "Each model in its own colour throughout; black dots are fitted samples, red dots samples "
        "that no model was fitted to.",
    )
    return Section("Candidates side by side", text, tuple(drawings))


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
