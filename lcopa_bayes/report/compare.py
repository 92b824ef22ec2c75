"""The page of a comparison, drawn from `compare.json` and the candidates' tables alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from lcopa_bayes.comparison.compare import folder_name
from lcopa_bayes.core.units import measured
from lcopa_bayes.plot.comparison import candidates_figure, evidence_figure
from lcopa_bayes.plot.rundata import read_tables
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.page import Drawings, Verdict
from lcopa_bayes.report.svg import Drawing, drawing
from lcopa_bayes.results.bands import POINTWISE


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Scores, fits and residuals of a comparison; InputError when a table of it cannot be used."""
    shown = [*_evidence(values), *_records(values, _curves(folder, values))]
    return {"verdict": _verdict(values), "candidates": shown}


def _verdict(results: Mapping[str, Any]) -> Verdict:
    """Grade of the preferred candidate."""
    own = next((row for row in results["models"] if row["name"] == results["preferred"]), None)
    if own is None:
        return Verdict("unusable", results["why"], "")
    said = f"{results['why']} {results['fractional']['sentence']}"
    return Verdict(str(own["grade"]), said, str(own["grade_reason"]))


def _curves(folder: Path, results: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Curves of every candidate that has any; InputError when a table cannot be read."""
    tables, names = folder / "candidates", [str(row["name"]) for row in results["models"]]
    paths = {name: tables / folder_name(name) / "tables" / "curves.csv" for name in names}
    return read_tables(paths, "compare")


def _evidence(results: Mapping[str, Any]) -> list[Drawing]:
    """Log evidence of every model, against the number of its terms."""
    rows = [row for row in results["models"] if row["usable"] and row["log_evidence"] is not None]
    if len(rows) < 2:
        return []
    caption = (
        "Log evidence against the number of terms: circles free orders, squares integer orders, bars two "
        "standard errors; open triangles the same under priors half (down) and twice (up) as wide. Linear "
        "within 10 nat of the best, logarithmic beyond."
    )
    return [drawing("compare_evidence", evidence_figure(rows), caption, data="compare.json")]


def _records(results: Mapping[str, Any], curves: Mapping[str, pd.DataFrame]) -> list[Drawing]:
    """Every axis of every record with the medians of all models, their residuals, and held-out bands: first
    where the bands of the preferred candidate, else of the first, hold the fewest samples."""
    rows = [row for row in results["models"] if row["name"] in curves]
    if not rows:
        return []
    first = curves[rows[0]["name"]]
    shown = first[["record", "axis", "held_out"]].drop_duplicates().itertuples(index=False, name=None)
    best = next((row for row in rows if row["name"] == results["preferred"]), rows[0])
    scores = (*best["fit_scores"], *best["held_out"])
    held_by = {(one["record"], one["axis"]): one["coverage_90"] for one in scores}
    drawings = []
    worst_first = sorted(shown, key=lambda one: held_by.get(one[:2], 1.0))
    for number, (record, axis, held) in enumerate(worst_first, start=1):
        parts = {
            row["name"]: entry[(entry["record"] == record) & (entry["axis"] == axis)]
            for row in rows
            for entry in [curves[row["name"]]]
        }
        drawings.append(
            drawing(
                f"compare_{number:02d}_{record}_{axis}",
                candidates_figure(results, parts, str(record), str(axis), held=bool(held)),
                _caption(rows, str(record), str(axis), held=bool(held)),
                "held out" * bool(held),
                f"candidates/{folder_name(str(results['preferred'] or rows[0]['name']))}/tables/curves.csv",
            )
        )
    return drawings


def _caption(rows: Sequence[Mapping[str, Any]], record: str, axis: str, *, held: bool) -> str:
    key = "held_out" if held else "fit_scores"
    errors = []
    for row in rows:
        for entry in row[key]:
            if (entry["record"], entry["axis"]) == (record, axis):
                errors.append(f"{row['name']} {measured(figures(entry['rmse']), entry['unit'])}")
    bands = f"the {POINTWISE} 90 % band" + (
        "s with noise of all" if held else " with noise of the preferred candidate"
    )
    return f"Medians of the candidates, {bands}, and residuals below. RMSE: {', '.join(errors)}."
