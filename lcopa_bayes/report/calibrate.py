"""The page of a calibration, drawn from its `results.json` alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.formatting import figures, percent
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.theme import BAND, HELD_OUT, INK, NOISE, Drawing, blank, grid, paged, plain, svg_of

Draw: TypeAlias = Callable[[Axes, Mapping[str, Any], Mapping[str, Any]], None]
_PER_FIGURE = 18
"""Most quantities on one figure of ranks."""


def drawn(folder: Path, results: Mapping[str, Any]) -> Drawings:
    """Coverage, ranks and replicas of a calibration."""
    among, count = len(results["ranks"][0]["counts"]) - 1, results["replicas"]
    bound = f"with a probability of {percent(results['simultaneous'])}"
    coverage = (
        "Observed coverage with its simultaneous band against the stated level (dashed), over all replicas"
        + (" and over the reliable replicas." if results["reliable"] else "; none is graded reliable.")
    )
    ranks = (
        f"Ranks of the truth among {among} posterior draws, {count} replicas in "
        f"{results['rank_bins']['bins']} bins. Grey: where all bins of a histogram of uniform ranks "
        f"lie {bound} or more."
    )
    differences = (
        "Share of ranks below a value minus what uniform ranks have there, over all replicas. Grey: corridor "
        f"in which the whole curve of uniform ranks lies {bound}. The p-value is that of this test, each "
        "quantity on its own."
    )

    def pages(stem: str, draw: Draw, caption: str) -> tuple[Drawing, ...]:
        return paged(stem, results["ranks"], _PER_FIGURE, lambda part: _panels(part, results, draw), caption)

    return {
        "coverage": [Drawing("calibration_coverage", _dots(results), coverage)],
        "ranks": pages("calibration_ranks", _histogram, ranks),
        "differences": pages("calibration_ecdf", _difference, differences),
        "replicas": _replicas(results),
    }


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


def _panels(rows: Sequence[Mapping[str, Any]], results: Mapping[str, Any], draw: Draw) -> str:
    """One panel per quantity."""
    figure, panels = grid(len(rows), columns=3, height=1.35)
    for panel, row in zip(panels, rows, strict=True):
        draw(panel, row, results)
        panel.set_title(plain(row["parameter"]), fontsize=7.5)
    for panel in panels[-3:]:
        panel.set_xlabel("rank [-]")
    return svg_of(figure)


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


def _replicas(results: Mapping[str, Any]) -> dict[str, object]:
    """What is said of the replicas, by its name."""
    gap, seconds, counted = results["model_gap"], results["seconds"], results["grades"]
    engine, width = results["engine"], results["discretisation"]
    return {
        "replicas requested": results["asked"],
        **{f"graded {name}" if name != "failed" else "failed": n for name, n in counted.items()},
        "truths": _origin(results["truths"]),
        "draws by importance sampling": engine["importance"],
        "draws by ensembles": engine["sampling"],
        "Pareto k of importance weights, median": _number(engine["median_k"]),
        "Pareto k of importance weights, largest": _number(engine["largest_k"]),
        "seed": results["seed"],
        "processor time of a replica, median [s]": seconds["median"],
        "processor time of a replica, largest [s]": seconds["largest"],
        "processor time in all [s]": seconds["total"],
        "forward model from bench at the truth, median [noise sd]": gap["median"],
        "forward model from bench at the truth, 90 % quantile [noise sd]": gap["quantile_90"],
        "forward model from bench at the truth, largest [noise sd]": gap["largest"],
        "shift by the width of the blocks is negligible": f"{width['negligible']} replicas",
        "shift by the width of the blocks, median [posterior sd]": figures(width["median"], 2),
        "shift by the width of the blocks, largest [posterior sd]": figures(width["largest"], 2),
        **{name.replace("_", " "): value for name, value in results["sampler"].items()},
    }


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
