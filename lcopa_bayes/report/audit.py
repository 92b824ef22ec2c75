"""The page of an audit, drawn from `audit.json` and the draws of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from lcopa_bayes.plot.audit import pairs_figure, profiles_figure, spectrum_figure
from lcopa_bayes.plot.rundata import RunData, load_run
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.svg import Drawing, drawing, paged

_PER_FIGURE = 12
_PAIRS = 6


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Profiles, spectrum and pairs of an audit; InputError when a file of its fit cannot be used."""
    run = load_run(folder)
    caption = (
        "Line: fall of twice the log likelihood along the profile, its 90 % level dashed, an open side "
        "where the line stays below to the end. Filled: marginal posterior on the scale of the axis."
    )
    rows = sorted(values["parameters"], key=lambda row: row["verdict"] == "identified")
    profiles = paged(
        "profiles", rows, _PER_FIGURE, lambda part: profiles_figure(part, run), caption, "audit.json"
    )
    verdict = Verdict(str(values["grade"]), "", str(values["grade_reason"]))  # the answers say the rest
    return {
        "verdict": verdict,
        "profiles": profiles,
        "spectrum": _spectrum(values["spectrum"]),
        "pairs": _pairs(values, run),
    }


def _spectrum(rows: Sequence[Mapping[str, Any]]) -> tuple[Drawing, ...]:
    if not rows:
        return ()
    caption = (
        "Eigenvalues of the Fisher information at the maximum, in prior standard deviations; below 1 the "
        "prior is more informative than the data. Beside each, the parameters of its eigenvector."
    )
    return (drawing("sloppy_spectrum", spectrum_figure(rows), caption, data="audit.json"),)


def _pairs(results: Mapping[str, Any], run: RunData) -> tuple[Drawing, ...]:
    pairs: dict[frozenset[str], tuple[str, str]] = {}
    for row in results["parameters"]:
        if row["verdict"] != "identified":
            for partner in row["partners"][:2]:
                pairs.setdefault(frozenset((row["name"], partner)), (row["name"], partner))
    shown = list(pairs.values())[:_PAIRS]
    if not shown:
        return ()
    omitted = len(pairs) - len(shown)
    caption = "Draws of parameters that are not identified against the parameters that compensate them." + (
        f" {omitted} more pairs are not drawn." if omitted else ""
    )
    return (drawing("degenerate_pairs", pairs_figure(shown, run), caption, data="posterior.nc"),)
