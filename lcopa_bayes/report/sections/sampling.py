"""What the draws rest on: evidence, a second method, settings, versions and inputs."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import (
    NONE,
    Cell,
    Kind,
    Section,
    Table,
    figures,
    interval,
    paged,
    percent,
    sentence,
    to_spread,
    with_error,
)
from lcopa_bayes.report.sections.parameters import density_axis, marginals
from lcopa_bayes.report.theme import BAND, HELD_OUT

_PER_FIGURE = 12
"""Parameters on one figure."""
_WIDE = 1.645 * 2
"""Width of a normal distribution's 90 % interval in standard deviations [-]."""
_WORDS = {
    "batches": "independent batches of draws",
    "draws": "draws of the proposal",
    "pareto_k": "Pareto k of the weights [-]",
    "weights_ess": "effective sample size of the weights [draws]",
    "steps": "steps taken",
    "most_steps": "steps allowed",
    "thin": "thinning [steps per draw]",
    "acceptance": "mean acceptance [-]",
    "smallest_ess": "smallest effective sample size [draws]",
    "largest_rhat": "largest R-hat [-]",
    "target_ess": "effective sample size wanted [draws]",
}


def evidence(run: SavedRun) -> Section:
    """The evidence of the model, and held-out errors of its integer-order rival where one was fitted."""
    results = run.results
    if results["log_evidence"] is None:
        said = "The error of an evidence needs several ensembles; with a single one none is given."
    else:
        method = (
            "the mean weight of the importance draws"
            if run.weighted
            else "by bridge sampling between the draws of each ensemble and a mixture fitted to the others"
        )
        said = (
            f"Log evidence {with_error(results['log_evidence'], results['log_evidence_sd'])} nat (standard "
            f"error; grade {results['log_evidence_grade']}), {method}. It compares models of the same "
            "records only, and depends on the width of their priors."
        )
    rival = results["rival"]
    if rival is None:
        return Section("Evidence", (said,))
    return Section("Evidence", (said, str(rival["sentence"])), tables=(_errors(results, rival),))


def _errors(results: Mapping[str, Any], rival: Mapping[str, Any]) -> Table:
    weighed = rival["log_evidence"]
    own_evidence = with_error(weighed, rival["log_evidence_sd"])
    caption = f"The rival's grade is {rival['grade']}: {rival['grade_reason']}." + (
        "" if weighed is None else f" Its log evidence is {own_evidence} nat."
    )
    pairs = [
        own | {"role": role, "rival": other}
        for key, role in (("fit_scores", "fit"), ("held_out", "held out"))
        for own, other in zip(results[key], rival[key], strict=True)
    ]
    return Table.of(
        pairs,
        ("record", "code", "record"),
        ("axis", "code", "axis"),
        ("role", "text", "role"),
        ("unit", "text", "unit"),
        ("free orders: RMSE", "number", "rmse"),
        ("in 90 % band", "number", lambda row: percent(row["coverage_90"])),
        ("integer orders: RMSE", "number", lambda row: figures(row["rival"]["rmse"])),
        ("in 90 % band", "number", lambda row: percent(row["rival"]["coverage_90"])),
        caption=caption,
    )


def cross_check(run: SavedRun) -> Section:
    """Verdict, marginals and evidences of both methods; a sentence where no second method was run."""
    check = run.results["cross_check"]
    if check is None:
        text = "Not run: `fit --cross-check` also samples by an independent method and compares the results."
        return Section("Second method", (text,))
    names = list(dict.fromkeys(run.tables["cross_check_density"]["name"]))
    caption = (
        "Marginals by both methods, over 99.8 % of their draws. Where the axis is logarithmic, densities are "
        "per natural logarithm of the parameter."
    )
    how = (
        "The ensembles and nested sampling share the posterior, but neither proposals nor tempering path. A "
        "p-value is the probability of a distance as large when both sample one posterior, adjusted for all "
        f"comparisons; below {figures(check['alarm'], 1)} every grade of this run is lowered."
    )
    return Section(
        "Second method",
        (sentence(str(check["sentence"])), how),
        paged("cross_check", names, _PER_FIGURE, lambda part: marginals(run, part, _panel), caption),
        (_both(check), _evidences(check)),
    )


def _both(check: Mapping[str, Any]) -> Table:
    """Marginals of every parameter by both methods."""

    def spread(row: Mapping[str, Any]) -> float:
        return max(float(row[by]["upper"] - row[by]["lower"]) for by in ("run", "nested")) / _WIDE

    def of(by: str, title: str) -> tuple[tuple[str, Kind, Cell], ...]:
        return (
            (f"{title}: median", "number", lambda row: to_spread(row[by]["value"], spread(row))),
            (
                "90 % interval",
                "interval",
                lambda row: interval(row[by]["lower"], row[by]["upper"], spread(row)),
            ),
            ("ESS", "number", lambda row: f"{row[by]['ess']:.0f}"),
        )

    return Table.of(
        check["parameters"],
        ("name", "code", "name"),
        ("unit", "text", "unit"),
        *of("run", "ensembles"),
        *of("nested", "nested"),
        ("distance", "number", lambda row: f"{row['distance']:.3f}"),
        ("noticed from", "number", lambda row: f"{row['resolution']:.3f}" if row["resolution"] < 1 else NONE),
        ("p", "number", lambda row: figures(row["p"], 2)),
        caption="Intervals are equal-tailed credible. ESS is the effective sample size. Distance is the "
        "largest difference of the two cumulative probabilities; the next column is the distance from which "
        "it counts as a disagreement.",
    )


def _evidences(check: Mapping[str, Any]) -> Table:
    p = check["evidence_p"]
    each = ", ".join(f"{entry:.2f}" for entry in check["run_log_evidences"])
    caption = "± is the standard error. " + (
        "The ensembles of this run gave no evidence to compare."
        if p is None
        else f"Adjusted p-value of the difference: {figures(p, 2)}."
    )
    return Table.of(
        [
            {"method": "ensembles", "key": "run_log_evidence", "each": ""},
            {"method": "nested sampling", "key": "log_evidence", "each": each},
        ],
        ("method", "text", "method"),
        (
            "log evidence [nat]",
            "number",
            lambda row: with_error(check[row["key"]], check[f"{row['key']}_sd"], bare=False),
        ),
        ("each run", "prose", "each"),
        caption=caption,
    )


def _panel(panel: Axes, run: SavedRun, name: str) -> None:
    whole = run.tables["cross_check_density"]
    own = whole[whole["name"] == name]
    edges = np.append(own["left"].to_numpy(), own["right"].to_numpy()[-1])
    panel.stairs(own["ensembles"].to_numpy(), edges, fill=True, color=BAND, alpha=0.5, label="ensembles")
    panel.stairs(own["nested"].to_numpy(), edges, color=HELD_OUT, linewidth=1.1, label="nested sampling")
    density_axis(panel, float(edges[0]), float(edges[-1]), log=bool(own["log_scale"].any()))


def provenance(run: SavedRun) -> Section:
    """Sampler summary, command, seed, versions and hashes of the inputs."""
    own = run.provenance
    origin = {
        "command": shlex.join(str(word) for word in own["command"]),
        "seed": own["seed"],
        "python": own["python"],
        **own["versions"],
    }
    sampler = {
        _WORDS.get(key, key.replace("_", " ")): _cell(key, v) for key, v in run.results["sampler"].items()
    }
    return Section(
        "Sampler and provenance",
        tables=(
            Table.pairs("sampler", "value", "number", sampler),
            Table.pairs("origin", "value", "code", origin),
            Table.pairs("input", "SHA-256", "code", own["inputs_sha256"]),
        ),
    )


def _cell(key: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if key == "largest_rhat" else figures(value)
    return NONE if value is None else str(value)
