"""Whether stated Monte Carlo errors are true: fits of one study from many seeds, and how far they scatter.

    python studies/performance/scatter.py [STUDY ...] [--seeds N] [--jobs N] [--out FOLDER]

For every sampled parameter, at the 5, 50 and 95 % points of the draws of all seeds together: the share of a
seed's draws below each, whose error follows from the effective sample size that the fit states; the mean;
and the share of every mode, between the boundaries that the fit states. The root mean square of deviations
over stated errors is 1 where these are true. A fit that has been made is not made again.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from plots import COLOURS, save

import lcopa_bayes as lb
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.parallel import Workers, workers

STUDIES = Path(__file__).parents[1]
POINTS = (0.05, 0.5, 0.95)
LIMIT = 1.4
"""Ratio above which a stated error is wrong."""


def fitted(folder: Path, study: str, seed: int) -> Path:
    """Draws and stated errors of a fit, kept in the folder."""
    place = folder / f"{study}-{seed}.npz"
    if not place.exists():
        loaded = lb.load_study(STUDIES / study)
        fit = lb.fit(loaded.with_seed(seed), jobs=1)
        draws = fit.draws
        own = {one.name: one for one in draws.qualities}
        bulk, tail = (np.array([getattr(q, f"ess_{end}") for q in own.values()]) for end in ("bulk", "tail"))
        modes = {
            one.parameter: {
                "boundaries": list(one.boundaries),
                "shares": one.shares.mean(axis=0).tolist(),
                "errors": one.errors.mean(axis=0).tolist(),
            }
            for one in draws.modes
        }
        half = place.with_suffix(".half.npz")
        np.savez(
            half,
            names=np.array(list(own)),
            draws=np.stack([draws.column(name) for name in own], axis=1),
            bulk=bulk,
            tail=tail,
            about=np.array(json.dumps({"modes": modes, "grade": fit.draws.sampling_grade.level})),
        )
        half.rename(place)
    return place


def ratio(deviations: Vector, errors: Vector) -> float:
    """Root mean square of deviations from a mean of so many, over their stated errors [-]."""
    count = len(deviations)
    return float(np.sqrt((deviations**2 / errors**2).sum() / (count - 1)))


def scattered(fits: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Rows of quantity and ratio: `fits` have `names`, `draws` (draws, parameters), `bulk`, `tail` and
    `modes`, those of `fitted`."""
    rows: list[dict[str, Any]] = []
    for column, name in enumerate(fits[0]["names"]):
        own = [fit["draws"][:, column] for fit in fits]
        pooled = np.concatenate(own)
        for point in POINTS:
            at = np.quantile(pooled, point)
            below = np.array([(one <= at).mean() for one in own])
            worth = np.array([fit["bulk" if point == 0.5 else "tail"][column] for fit in fits])
            errors = np.sqrt(point * (1 - point) / worth)
            rows.append(
                {
                    "parameter": str(name),
                    "quantity": f"{100 * point:g} %",
                    "ratio": ratio(below - point, errors),
                }
            )
        means = np.array([one.mean() for one in own])
        errors = np.array(
            [one.std() / np.sqrt(fit["bulk"][column]) for one, fit in zip(own, fits, strict=True)]
        )
        rows.append(
            {"parameter": str(name), "quantity": "mean", "ratio": ratio(means - means.mean(), errors)}
        )
    counts = {
        name: [len(fit["modes"].get(name, {}).get("shares", [0])) for fit in fits]
        for name in fits[0]["names"]
    }
    for column, (name, count) in enumerate(counts.items()):
        usual, pooled = int(np.median(count)), np.concatenate([fit["draws"][:, column] for fit in fits])
        with_all = [fit["modes"][name] for fit, k in zip(fits, count, strict=True) if k == usual > 1]
        for mode in range(usual if len(with_all) > 2 else 0):
            shares = np.array([one["shares"][mode] for one in with_all])
            errors = np.array([one["errors"][mode] for one in with_all])
            ends = [np.array([-np.inf, *one["boundaries"], np.inf])[mode : mode + 2] for one in with_all]
            # a fit states the share between its own boundaries, which differ where a valley is wide
            there = np.array([((pooled > low) & (pooled <= high)).mean() for low, high in ends])
            row = {"parameter": str(name), "quantity": f"share of mode {mode + 1}", "fits": len(with_all)}
            rows.append(row | {"share": float(shares.mean()), "ratio": ratio(shares - there, errors)})
    return rows


def drawn(results: Mapping[str, Any], path: Path) -> None:
    """Ratios of every quantity, one panel a study, between the limits."""
    figure = Figure(figsize=(9.6, 4.6), layout="constrained")
    panels = figure.subplots(1, len(results), squeeze=False, sharex=True)[0]
    for panel, (study, result) in zip(panels, results.items(), strict=True):
        kinds = list(dict.fromkeys(row["quantity"].partition(" of ")[0] for row in result["rows"]))
        for height, kind in enumerate(reversed(kinds)):
            values = [row["ratio"] for row in result["rows"] if row["quantity"].partition(" of ")[0] == kind]
            spread = height + np.linspace(-0.25, 0.25, len(values))
            panel.plot(values, spread, "o", ms=4, alpha=0.7, color=COLOURS[0])
        panel.set_yticks(range(len(kinds)), reversed(kinds))
        panel.axvspan(1 / LIMIT, LIMIT, color="#e8eef4", zorder=0)
        panel.axvline(1.0, color="#1a1a1a", lw=0.8)
        panel.set(title=f"{study}, {result['fits']} seeds", xlabel="scatter over stated error [-]")
    save(figure, path)


def sentence(study: str, result: Mapping[str, Any]) -> str:
    """A study's ratios in words."""
    grades = ", ".join(f"{count} {grade}" for grade, count in result["grades"].items())
    return (
        f"{study}: {result['fits']} fits ({grades}). Of {len(result['rows'])} ratios the median is "
        f"{result['median']:.2f} and the largest {result['largest']:.2f}; {result['too_small']} stated "
        f"errors are too small by more than a factor {LIMIT:g}, {result['too_large']} too large."
    )


def report(results: Mapping[str, Any]) -> str:
    """The page."""
    said = "\n\n".join(sentence(study, result) for study, result in results.items())
    return (
        "# Stated Monte Carlo errors against the scatter over seeds\n\n"
        "The root mean square of the deviations of a quantity over seeds, divided by its stated error: 1 "
        "where stated errors are true, above 1 where they are too small. Made by "
        f"`studies/performance/scatter.py`.\n\n{said}\n\n![Scatter over stated error](scatter.svg)\n"
    )


def measured(study: str, folder: Path, seeds: Sequence[int], crew: Workers[None]) -> dict[str, Any]:
    """Rows of a study, and what its fits say of themselves."""
    fits = []
    for place in crew.map(partial(fitted, folder, study), seeds):
        with np.load(place, allow_pickle=False) as stored:
            about = json.loads(str(stored["about"]))
            fits.append({key: stored[key] for key in ("names", "draws", "bulk", "tail")} | about)
    rows = scattered(fits)
    grades = [fit["grade"] for fit in fits]
    return {
        "fits": len(fits),
        "grades": {grade: grades.count(grade) for grade in dict.fromkeys(grades)},
        "median": float(np.median([row["ratio"] for row in rows])),
        "largest": max(row["ratio"] for row in rows),
        "too_small": sum(row["ratio"] > LIMIT for row in rows),
        "too_large": sum(row["ratio"] < 1 / LIMIT for row in rows),
        "rows": rows,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="*", default=["paper-step-x", "paper-step"])
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--kept", type=Path, default=Path("runs/scatter"), help="folder of the fits")
    parser.add_argument("--out", type=Path, help="folder for scatter.md, .svg and .json")
    options = parser.parse_args()
    options.kept.mkdir(parents=True, exist_ok=True)
    with workers(None, jobs=options.jobs) as crew:
        seeds = range(1, options.seeds + 1)
        results = {study: measured(study, options.kept, seeds, crew) for study in options.studies}
    print(report(results))
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "scatter.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
        (options.out / "scatter.md").write_text(report(results), encoding="utf-8")
        drawn(results, options.out / "scatter.svg")


if __name__ == "__main__":
    import scatter  # workers import it by this name

    scatter.main()
