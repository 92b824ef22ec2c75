"""The report of the study in Markdown, of its results as `run.py` stores them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from comparison import Spread, table


def spread(value: Mapping[str, Any] | None) -> str | None:
    """Median with quartiles."""
    if value is None:
        return None
    return str(Spread(value["median"], *value["quartiles"], value["count"]))


def page(results: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> str:
    """The whole report; `before` are results of an earlier run, to compare verbs with."""
    parts = ["# Performance", *heading(results)]
    if "forward" in results:
        parts += forward(results["forward"])
    if "samplers" in results:
        parts += samplers(results["samplers"], results["settings"])
    if "verbs" in results:
        parts += verbs(results["verbs"])
        parts += changes(results["verbs"], (before or {}).get("verbs", {"rows": ()}))
    return "\n\n".join(parts) + "\n"


def heading(results: Mapping[str, Any]) -> list[str]:
    where = f"Measured on: {results['machine']} {results['software']}"
    kind = [
        "**A quick run**: one to five repeats, short samplings. It shows that the study runs and orders of "
        "magnitude, no more."
    ]
    reading = (
        "Times are CPU times of single-threaded processes unless another is named. Ratios are taken within a "
        "round, in which all methods take turns, and given as median (first to third quartile) over rounds. "
        "An empty cell is a number that was not obtained."
    )
    return [where, *(kind if results["quick"] else []), reading]


def forward(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [
        [
            row["method"],
            row["blocks"],
            row["reason"] or spread(row["cpu_s"]),
            None if row["reason"] else spread(row["ratio"]),
            None if row["reason"] else row["error"],
            None if row["reason"] else row["error_rms"],
            None if row["reason"] else row["memory_MB"],
        ]
        for row in rows
    ]
    head = ("method", "blocks", "CPU s", "ratio", "largest error", "rms error", "peak MB")
    said = (
        "Unit step response of the paper's element with three viscous terms over 25 ms, without delay. The "
        "ratio is to this package with 64 plants at once, per plant. Errors are shares of the steady "
        "response, against the inverse Laplace transform; block means are compared at the middles of blocks."
    )
    return ["## Forward response", said, table(head, lines), "![Time of a response](forward.svg)"]


def samplers(posteriors: Mapping[str, Any], settings: Mapping[str, str]) -> list[str]:
    out = [
        "## Samplers",
        "Effective draws are stated by the method itself (smallest bulk or tail of ArviZ for chains, Kish's "
        "or the library's own number for weights), or shown: posterior variance over the mean squared error "
        "of the estimates of several runs, of the quantity that errs most. Ratios are those of draws per CPU "
        "second of this package to the method's: above 1 this package is faster. Quartiles of shown ratios "
        "are over resampled runs.",
    ]
    for name, comparison in posteriors.items():
        out += [f"### {name}, {comparison['dimension']} sampled parameters", *sampled(comparison)]
    used = [f"- {method}: {text}." for method, text in settings.items()]
    return [*out, "Settings:", "\n".join(used), "![Effective draws per CPU second](samplers.svg)"]


def sampled(comparison: Mapping[str, Any]) -> list[str]:
    head = (
        *("method", "ended by itself", "CPU s", "evaluations", "draws stated", "evaluations per draw"),
        *("ratio, stated", "draws shown", "ratio, shown", "limited by"),
    )
    lines = [
        [
            row["method"],
            f"{row['finished']} of {row['runs']}",
            spread(row["cpu_s"]),
            spread(row["evaluations"]),
            spread(row["ess_stated"]),
            spread(row["evaluations_per_stated_draw"]),
            spread(row["ratio_stated"]),
            row.get("ess_shown"),
            spread(row["ratio_shown"]),
            row.get("ess_shown_by"),
        ]
        for row in comparison["methods"]
    ]
    lines += [[f"{method}: {why}"] + [None] * (len(head) - 1) for method, why in comparison["absent"].items()]
    shown = [row for row in comparison["methods"] if "ess_shown" in row]
    alone = [row["method"] for row in shown if row["judged_by_scatter_alone"]]
    judged = f"Judged against: {', '.join(comparison['references'])}, each without itself."
    if not shown:
        judged = "No method ran often enough to show its errors."
    if alone:
        judged += f" By scatter alone, for want of another: {', '.join(alone)}."
    return [table(head, lines), judged]


def verbs(result: Mapping[str, Any]) -> list[str]:
    head = (
        *("study", "verb", "wall s", "CPU s", "yardsticks", "of its fit", "peak MB", "plants simulated"),
        *("share of likelihood", "of sampling", "draws", "plants per draw", "grade"),
    )
    lines = []
    for row in sorted(result["rows"], key=lambda row: order(result, row)):
        study = row["study"] or "(none)"
        if row["outcome"] == "left out":
            continue
        if not row.get("runs"):
            why = row["message"] or row["outcome"]
            least = row.get("cpu_s_at_least")
            said = f"over {least:.3g}" if row["outcome"] == "stopped" and least is not None else why
            lines.append([study, row["verb"], None, said] + [None] * (len(head) - 4))
            continue
        lines.append(
            [
                study,
                row["verb"],
                spread(row["wall_s"]),
                spread(row["cpu_s"]),
                spread(row["yardsticks"]),
                spread(row.get("of_fit")),
                spread(row["peak_MB"]),
                row.get("plants"),
                row.get("likelihood_share"),
                row.get("likelihood_share_of_sampling"),
                row.get("smallest_ess"),
                row.get("plants_per_draw"),
                row.get("grade"),
            ]
        )
    said = (
        f"Every verb by the command line, with `--jobs {result['jobs']}`, from a fresh process to its page. "
        "The yardstick is a fixed piece of array work timed before and after each run; counted in it, times "
        "can be compared between machines. `report`, `predict`, `audit` and `design` begin with the finished "
        "fit. The likelihood is densities, their expansions and responses; its share is that of the whole "
        "verb, and of the time in which it samples."
    )
    parts = ["## Verbs", said, table(head, lines), left_out(result)]
    return [*filter(None, parts), "![CPU time of every verb](verbs.svg)", *stages(result)]


def left_out(result: Mapping[str, Any]) -> str:
    """What was not run, by the reason."""
    reasons: dict[str, list[str]] = {}
    for row in result["rows"]:
        if row["outcome"] == "left out":
            reasons.setdefault(row["message"], []).append(f"{row['verb']} {row['study']}".strip())
    return "\n\n".join(f"Left out, {why}: {', '.join(names)}." for why, names in reasons.items())


def order(result: Mapping[str, Any], row: Mapping[str, Any]) -> int:
    studies = result["studies"]
    return studies.index(row["study"]) if row["study"] in studies else len(studies)


def stages(result: Mapping[str, Any]) -> list[str]:
    """Where the time of fits goes."""
    fits = [row for row in result["rows"] if row["verb"] == "fit" and row.get("stages")]
    if not fits:
        return []
    names = list(dict.fromkeys(stage for row in fits for stage in row["stages"]))
    lines = [[name, *(sum(row["stages"].get(name, (0.0, 0.0))) for row in fits)] for name in names]
    said = "CPU seconds of a fit by stage, in the last run:"
    return [said, table(("stage", *(row["study"] for row in fits)), lines)]


def changes(result: Mapping[str, Any], before: Mapping[str, Any]) -> list[str]:
    """CPU time before over CPU time after, counted in yardsticks, of every verb that both runs finished."""
    earlier = {(row["study"], row["verb"]): row for row in before["rows"] if row.get("runs")}
    lines = []
    for row in result["rows"]:
        old = earlier.get((row["study"], row["verb"]))
        if old is None or not row.get("runs"):
            continue
        a, b = old["yardsticks"]["median"], row["yardsticks"]["median"]
        lines.append([row["study"] or "(none)", row["verb"], a, b, a / b])
    head = ("study", "verb", "before", "after", "before over after")
    beside = [
        [row["study"] or "(none)", row["verb"], spread(row["other_over_this"])]
        for row in result["rows"]
        if row.get("other_over_this")
    ]
    out = ["Before and after, CPU time counted in yardsticks:", table(head, lines)] if lines else []
    if beside:
        out += ["The other checkout over this one, in turn:", table(("study", "verb", "ratio"), beside)]
    return out
