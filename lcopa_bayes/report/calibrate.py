"""The page of a calibration, drawn from its `results.json` alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.plot.calibration import Draw, coverage_figure, draw_difference, draw_histogram, ranks_figure
from lcopa_bayes.report.formatting import figures, percent
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import Drawing, drawing, paged

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
        return paged(
            stem, results["ranks"], _PER_FIGURE, lambda part: ranks_figure(part, results, draw), caption
        )

    return {
        "coverage": [drawing("calibration_coverage", coverage_figure(results), coverage)],
        "ranks": pages("calibration_ranks", draw_histogram, ranks),
        "differences": pages("calibration_ecdf", draw_difference, differences),
        "replicas": _replicas(results),
    }


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
