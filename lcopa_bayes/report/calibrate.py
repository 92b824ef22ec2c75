"""The page of a calibration, drawn from its `results.json` alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.page import write_graded
from lcopa_bayes.report.section import (
    NONE,
    Cell,
    Drawing,
    Kind,
    Section,
    Table,
    figures,
    percent,
    probability,
)
from lcopa_bayes.report.theme import BAND, HELD_OUT, INK, NOISE, blank, grid, plain, svg_of

_PER_FIGURE = 18
"""Most quantities on one figure of ranks."""
_MOST_ROWS = 40
"""Most replicas listed individually."""


def write_calibration(folder: Path) -> Path:
    """`report.html` with coverage, ranks and grades; returns its path. InputError when keys are missing."""
    parts = (_coverage, _ranks, _differences, _replicas)
    return write_graded(
        folder,
        "calibrate",
        "calibration",
        lambda values: [part(values) for part in parts],
        file="results.json",
        name="report.html",
    )


def _coverage(results: Mapping[str, Any]) -> Section:
    rows, reliable = results["coverage"], results["reliable"]
    others = {(row["parameter"], row["level"]): row for row in (reliable or {"coverage": ()})["coverage"]}
    table = Table.of(
        [row | {"reliable": others.get((row["parameter"], row["level"]))} for row in rows],
        ("quantity", "code", "parameter"),
        ("stated", "number", lambda row: percent(row["level"])),
        ("observed", "number", lambda row: _percent(row["observed"])),
        ("band", "number", lambda row: f"{_percent(row['lower'])} to {_percent(row['upper'])}"),
        ("p-value", "number", lambda row: figures(row["p_value"], 2)),
        ("within", "text", lambda row: "yes" if row["within"] else "NO"),
        (
            "observed in reliable replicas",
            "number",
            lambda row: _percent(row["reliable"]["observed"]) if row["reliable"] else NONE,
        ),
        caption=f"Share of replicas whose equal-tailed interval holds the truth, over {results['replicas']} "
        f"replicas. The band is {rows[0]['band']}'s at a confidence of {100 * rows[0]['confidence']:.2f} %: "
        f"if every interval covers as stated, all {len(rows)} rows are within theirs together with a "
        f"probability of {percent(results['simultaneous'])} or more. P-values are exact binomial, each row "
        "on its own.",
    )
    caption = (
        "Observed coverage with its simultaneous band against the stated level (dashed), over all replicas"
        + (" and over the reliable replicas." if reliable else "; none is graded reliable.")
    )
    return Section(
        "Coverage",
        ("A step response counts at several times after the step, each path by itself.",),
        (Drawing("calibration_coverage", _dots(results), caption),),
        (table,),
    )


def _percent(share: float) -> str:
    return f"{100 * share:.1f} %"


def _dots(results: Mapping[str, Any]) -> str:
    """One row per quantity, one panel per level."""
    names = list(dict.fromkeys(row["parameter"] for row in results["coverage"]))
    levels = sorted({row["level"] for row in results["coverage"]})
    figure = blank(0.9 + 0.27 * len(names))
    panels = figure.subplots(1, len(levels), sharey=True, squeeze=False)[0]
    groups = [(results, BAND, f"all {results['replicas']}")]
    if results["reliable"]:
        groups.append((results["reliable"], HELD_OUT, f"{results['reliable']['replicas']} reliable"))
    for panel, level in zip(panels, levels, strict=True):
        panel.axvline(level, color=NOISE, lw=0.9, ls=(0, (4, 3)))
        for number, (group, colour, name) in enumerate(groups):
            rows = [row for row in group["coverage"] if row["level"] == level]
            at = np.arange(len(rows)) + 0.24 * (number - (len(groups) - 1) / 2)
            seen = np.array([row["observed"] for row in rows])
            ends = np.array([[row["lower"], row["upper"]] for row in rows]).T
            panel.errorbar(seen, at, xerr=np.abs(ends - seen), fmt="o", ms=3, lw=1, color=colour, label=name)
        panel.set(title=f"{percent(level)} intervals", xlabel="coverage [-]")
    panels[0].set_yticks(range(len(names)), [plain(name) for name in names])
    panels[0].set_ylim(len(names) - 0.5, -0.5)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper right", ncols=2)
    return svg_of(figure)


def _ranks(results: Mapping[str, Any]) -> Section:
    bins, among = results["rank_bins"], len(results["ranks"][0]["counts"]) - 1
    caption = (
        f"Ranks of the truth among {among} posterior draws, {results['replicas']} replicas in {bins['bins']} "
        "bins. Grey: where all bins of a histogram of uniform ranks lie with a probability of "
        f"{percent(results['simultaneous'])} or more."
    )
    text = (
        "Ranks heaped in the middle mean intervals that are too wide, heaped at both ends too narrow, at "
        "one end biased. Of truths from the prior they are uniform if the whole procedure is exact; of a "
        "truth that is the same in every replica they need not be.",
        f"Overall {probability(results['p_value'])}: {results['p_value_of']}.",
    )
    return Section("Ranks", text, _pages(results, "calibration_ranks", caption, 1.35, _histogram))


def _differences(results: Mapping[str, Any]) -> Section:
    caption = (
        "Share of ranks below a value minus what uniform ranks have there, over all replicas. Grey: corridor "
        "in which the whole curve of uniform ranks lies with a probability of "
        f"{percent(results['simultaneous'])}. The p-value is that of this test, each quantity on its own."
    )
    return Section("ECDF differences", (), _pages(results, "calibration_ecdf", caption, 1.35, _difference))


def _pages(
    results: Mapping[str, Any],
    stem: str,
    caption: str,
    height: float,
    draw: Callable[[Axes, Mapping[str, Any], Mapping[str, Any]], None],
) -> tuple[Drawing, ...]:
    """Figures of up to `_PER_FIGURE` panels, one per quantity."""
    out = []
    pages = -(-len(results["ranks"]) // _PER_FIGURE)
    for number, part in enumerate(np.array_split(np.arange(len(results["ranks"])), pages), start=1):
        rows = [results["ranks"][k] for k in part]
        figure, panels = grid(len(rows), columns=3, height=height)
        for panel, row in zip(panels, rows, strict=True):
            draw(panel, row, results)
            panel.set_title(plain(row["parameter"]), fontsize=7.5)
        for panel in panels[-3:]:
            panel.set_xlabel("rank [-]")
        out.append(Drawing(f"{stem}_{number:02d}", svg_of(figure), caption))
    return tuple(out)


def _histogram(panel: Axes, row: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    counts, band = np.array(row["counts"]), results["rank_bins"]
    edges = np.linspace(0, counts.size, band["bins"] + 1)
    panel.axhspan(band["lower"], band["upper"], color=NOISE, alpha=0.3, lw=0)
    panel.axhline(results["replicas"] / band["bins"], color=NOISE, lw=0.8)
    panel.stairs(counts.reshape(band["bins"], -1).sum(axis=1), edges, fill=True, color=BAND, alpha=0.75)
    panel.set(xlim=(0, counts.size), ylabel="replicas")


def _difference(panel: Axes, row: Mapping[str, Any], results: Mapping[str, Any]) -> None:
    counts, corridor = np.array(row["counts"]), results["rank_corridor"]
    at = np.arange(1, counts.size)
    expected = at / counts.size
    lower, upper = (np.array(corridor[end]) / results["replicas"] - expected for end in ("lower", "upper"))
    panel.fill_between(at, lower, upper, color=NOISE, alpha=0.3, lw=0, step="post")
    panel.axhline(0.0, color=NOISE, lw=0.6)
    panel.step(at, np.cumsum(counts)[:-1] / results["replicas"] - expected, where="post", color=BAND)
    panel.set_xlim(0, counts.size)
    panel.text(
        0.98,
        0.96,
        f"p = {figures(row['p_value'], 2)}",
        ha="right",
        va="top",
        fontsize=7,
        color=INK,
        transform=panel.transAxes,
    )


def _replicas(results: Mapping[str, Any]) -> Section:
    gap, seconds, counted = results["model_gap"], results["seconds"], results["grades"]
    engine, width = results["engine"], results["discretisation"]
    rows = {
        "replicas requested": str(results["asked"]),
        **{f"graded {name}" if name != "failed" else "failed": n for name, n in counted.items()},
        "truths": _origin(results["truths"]),
        "draws by importance sampling": f"{engine['importance']}",
        "draws by ensembles": f"{engine['sampling']}",
        "Pareto k of importance weights, median": _number(engine["median_k"]),
        "Pareto k of importance weights, largest": _number(engine["largest_k"]),
        "seed": str(results["seed"]),
        "processor time of a replica, median [s]": figures(seconds["median"]),
        "processor time of a replica, largest [s]": figures(seconds["largest"]),
        "processor time in all [s]": figures(seconds["total"]),
        "forward model from bench at the truth, median [noise sd]": figures(gap["median"]),
        "forward model from bench at the truth, 90 % quantile [noise sd]": figures(gap["quantile_90"]),
        "forward model from bench at the truth, largest [noise sd]": figures(gap["largest"]),
        "shift by the width of the blocks is negligible": f"{width['negligible']} replicas",
        "shift by the width of the blocks, median [posterior sd]": figures(width["median"], 2),
        "shift by the width of the blocks, largest [posterior sd]": figures(width["largest"], 2),
        **{name.replace("_", " "): value for name, value in results["sampler"].items()},
    }
    lists = [Table.pairs("replicas", "value", "number", rows)]
    listed: tuple[tuple[str, str, tuple[tuple[str, Kind, Cell], ...]], ...] = (
        ("not_reliable", "replica", (("grade", "grade", "grade"), ("reason", "prose", "reason"))),
        ("failures", "failed replica", (("error", "prose", "error"),)),
    )
    for key, title, more in listed:
        if results[key]:
            rest = len(results[key]) - _MOST_ROWS
            lists.append(
                Table.of(
                    results[key][:_MOST_ROWS],
                    (title, "number", "replica"),
                    ("seed", "code", "seed"),
                    *more,
                    caption=f"And {rest} more in results.json." if rest > 0 else "",
                )
            )
    text = (
        "Only failed replicas are excluded from the numbers above. The distance of the forward "
        "model from the bench, root sum of squares over all samples, bounds by how many posterior standard "
        "deviations discretisation alone can shift a result. Draws come from importance sampling around the "
        f"optima where the Pareto k of the weights is at most {figures(engine['largest_good_k'])} and enough "
        "draws are effective, else from ensembles of walkers.",
    )
    return Section("Replicas", text, tables=tuple(lists))


def _origin(source: Mapping[str, Any]) -> str:
    """Where the true values come from."""
    stated = ", ".join(
        f"{name} = {value:g}"
        if isinstance(value, float | int)
        else f"{name} from {value[0]:g} to {value[1]:g}"
        for name, value in (source["stated"] or {}).items()
    )
    return {
        "prior": "drawn from the prior of the study",
        "posterior": f"drawn from the posterior in {source['folder']} (grade {source['grade']})",
        "stated": f"stated: {stated}",
        "stated and prior": f"stated: {stated}; the others drawn from the prior",
    }[source["from"]]


def _number(value: float | None) -> str:
    return "none" if value is None else figures(value, 2)
