"""How often intervals hold the truth of the plant, for plants in and outside the fitted family.

    python studies/coverage/intervals.py [--campaigns N] [--first N] [--jobs N] [--out FOLDER]

Every campaign (`truths`) is fitted as a user would, with the structure left to the records, and the 90 %
intervals of four figures of every path are held against the true ones: those of the fitted plant alone, and
those that are reported, which are over the fitted plant, integer orders and sums of lags. Finished campaigns
are kept in the folder: a killed run goes on where it stopped.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta
from truths import KINDS, Campaign, campaign

from lcopa_bayes.core.estimate import LEVEL, Estimate
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.results.steps import step_metrics
from lcopa_bayes.verbs.fit import fit

FIGURES = ("steady_state", "delay", "value_at_end", "rise_10_90")
_TAIL = (1 - LEVEL) / 2


def play(number: int) -> dict[str, Any]:
    """Fit a campaign and hold its intervals against its truth."""
    kind = KINDS[number % len(KINDS)]
    made = campaign(kind, number // len(KINDS))
    began = time.process_time()
    fitted = fit(made.study)
    alone = step_metrics(fitted.draws, fitted.curves, time_unit=fitted.study.time_unit)
    support = [one.support for one in fitted.alternatives.alternatives] if fitted.alternatives else []
    return {
        "number": number,
        "kind": kind,
        "shape": [len(made.study.drive_axes), len(made.study.response_axes)],
        "structure": fitted.structure.chosen.name if fitted.structure else "",
        "grade": fitted.draws.grade.level,
        "support": support,
        "cpu_seconds": time.process_time() - began,
        "figures": _held(made, {one.name: one for one in alone}, {one.name: one for one in fitted.metrics}),
    }


def _held(made: Campaign, alone: dict[str, Estimate], reported: dict[str, Estimate]) -> list[dict[str, Any]]:
    rows = []
    for name, path in made.paths.items():
        for figure, true in path.figures.items():
            row: dict[str, Any] = {"path": name, "kind": path.kind, "figure": figure, "truth": _plain(true)}
            for label, estimates in (("alone", alone), ("reported", reported)):
                here = estimates[f"{figure}[{name}]"]
                row[label] = {
                    "lower": _plain(here.lower),
                    "upper": _plain(here.upper),
                    "holds": bool(here.lower <= true <= here.upper),
                    "grade": here.grade,
                }
            rows.append(row)
    return rows


def _plain(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares of intervals that hold the truth, by figure and by kind of plant, with 90 % intervals (Clopper
    and Pearson 1934), and how much wider the reported ones are."""
    rows = [row for one in found for row in one["figures"]]
    return {
        "campaigns": len(found),
        "level": LEVEL,
        "by_figure": [_line(figure, [row for row in rows if row["figure"] == figure]) for figure in FIGURES],
        "by_kind": [_line(kind, [row for row in rows if row["kind"] == kind]) for kind in KINDS],
        "median_cpu_seconds": float(np.median([one["cpu_seconds"] for one in found])),
        "support": {key: sum(key in one["support"] for one in found) for key in ("plant", "both", "lags")},
        "grades": {
            key: sum(one["grade"] == key for one in found) for key in ("reliable", "tentative", "unusable")
        },
    }


def _line(name: str, rows: list[dict[str, Any]]) -> dict[str, Any]:
    widths = [
        [row[label]["upper"] - row[label]["lower"] for label in ("alone", "reported")]
        for row in rows
        if None not in (row["alone"]["upper"], row["reported"]["upper"])
    ]
    ratio = [wide / narrow for narrow, wide in widths if narrow > 0]
    return {
        "name": name,
        "alone": _share([row["alone"]["holds"] for row in rows]),
        "reported": _share([row["reported"]["holds"] for row in rows]),
        "reported_reliable": _share(
            [row["reported"]["holds"] for row in rows if row["reported"]["grade"] == "reliable"]
        ),
        "median_width_ratio": float(np.median(ratio)) if ratio else None,
    }


def _share(holds: list[bool]) -> dict[str, Any]:
    count, of = sum(holds), len(holds)
    low = 0.0 if count == 0 else float(beta.ppf(_TAIL, count, of - count + 1))
    high = 1.0 if count == of else float(beta.ppf(1 - _TAIL, count + 1, of - count))
    return {"count": count, "of": of, "share": count / of if of else None, "lower": low, "upper": high}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--campaigns", type=int, default=96)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("reports/coverage"))
    options = parser.parse_args()
    folder = writable_folder(writable_folder(options.out) / "campaigns")
    wanted = range(options.first, options.first + options.campaigns)
    done = {}
    for number in wanted:
        path = folder / f"{number:05d}.json"
        if path.exists():
            done[number] = json.loads(path.read_text(encoding="utf-8"))
    missing = [number for number in wanted if number not in done]
    with workers(None, jobs=options.jobs) as crew:
        for result in crew.finished(_perform, missing):
            done[result["number"]] = result
            write_text(folder / f"{result['number']:05d}.json", json.dumps(result, allow_nan=False) + "\n")
            print(f"{len(done)} of {len(wanted)}: {_said(result)}", flush=True)
    result = summary([done[number] for number in sorted(done)])
    write_text(options.out / "summary.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    for row in (line for key in ("by_figure", "by_kind") for line in result[key] if line["reported"]["of"]):
        print(
            f"{row['name']:14} alone {row['alone']['share']:.2f}, reported {row['reported']['share']:.2f} "
            f"({row['reported']['lower']:.2f} to {row['reported']['upper']:.2f}) of {row['reported']['of']}"
        )


def _perform(_: None, number: int) -> dict[str, Any]:
    return play(number)


def _said(result: dict[str, Any]) -> str:
    held = {label: sum(row[label]["holds"] for row in result["figures"]) for label in ("alone", "reported")}
    return (
        f"{result['kind']}, {result['structure']}, {held['alone']} and {held['reported']} of "
        f"{len(result['figures'])}, {'/'.join(result['support'])}, {result['cpu_seconds']:.0f} s"
    )


if __name__ == "__main__":
    from intervals import main as run  # workers do not run this script: what they do must be in a module

    run()
