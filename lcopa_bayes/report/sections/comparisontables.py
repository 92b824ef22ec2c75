"""What a comparison found, as tables: scores, prior's part, predictions, integer orders, what to heed."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import NONE, figures, interval, percent, to_spread
from lcopa_bayes.report.section import Column, Section, Table


def sections(told: Mapping[str, Any]) -> list[Section]:
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
