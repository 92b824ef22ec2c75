"""Score sheet of the loop: hidden effects on the virtual bench and plants outside the family, judged by
thresholds frozen beforehand.

    python studies/undeclared-effects/score.py [--seed 1000] [--each 4] [--controls 60] [--outsiders 10]
        [--pairs 30] [--sampled 6] [--cells 12] [--foreign 64] [--jobs N]
        [--out reports/undeclared-effects] [--limit N]

Every campaign is a task of its own, kept in OUT/rows: a killed run goes on where it stopped. Seeds below 1000
were used in development and are refused unless --trial is given.
"""

import argparse
import json
import sys
import tomllib
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np
from campaigns import Task, play
from foreign import EFFECTS, KINDS
from scoresheet import bounds, matrix, plants, sheet, standing
from tqdm import tqdm

from lcopa_bayes.bench.undeclared import NAMED, OUTSIDE
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.effectsearch import acceptance, candidates, findings, rounds, trace, verdict
from lcopa_bayes.report.page import Verdict, write_page

HERE = Path(__file__).parent
FIRST_TEST_SEED = 1000
COLOURED = 0.6
"""Correlation of successive samples of coloured noise [-]."""
CELLS = tuple(product((0.0, 0.6, 0.9, 0.95), (40, 64, 176, 400)))
"""Correlation of successive samples and samples at rest of the further controls [-]."""


def tasks(options: argparse.Namespace) -> list[Task]:
    """All campaigns, each with a seed of its own drawn from the seed of the sheet."""
    made: list[tuple[str, tuple[str, ...], str, float]] = []
    made += [("clean", (), "rich", 0.0)] * options.controls
    made += [("coloured", (), "rich", COLOURED)] * options.controls
    made += [("named", (name,), "rich", 0.0) for name in NAMED for _ in range(options.each)]
    made += [("plain", (name,), "plain", 0.0) for name in NAMED for _ in range(-(-options.each // 4))]
    made += [("outside", (name,), "rich", 0.0) for name in OUTSIDE for _ in range(options.outsiders)]
    made += [
        ("heavy", (), "rich", rho) for k in range(options.controls) for rho in (0.0, COLOURED)[k % 2 :][:1]
    ]
    rng = np.random.default_rng([options.seed, 1])
    plant = sorted(NAMED)
    pairs = list(combinations(plant, 2))
    picked = rng.choice(len(pairs), size=min(options.pairs, len(pairs)), replace=False)
    made += [("pair", pairs[k], "rich", 0.0) for k in picked]
    sampled = set(rng.choice(len(made), size=min(options.sampled, len(made)), replace=False).tolist())
    first = options.seed * 100_000
    listed = [
        Task(kind, names, drives, rho, first + k, k in sampled)
        for k, (kind, names, drives, rho) in enumerate(made)
    ]
    further = [cell for cell in CELLS for _ in range(options.cells)]
    listed += [
        Task("control", (), "rich", rho, first + len(made) + k, quiet=quiet)
        for k, (rho, quiet) in enumerate(further)
    ]
    first += len(listed)
    for k in range(options.foreign):
        turn, hides = divmod(k + k // len(KINDS), 4)  # one of four, and of each kind in turn
        names = EFFECTS[turn % len(EFFECTS) :][:1] if hides == 3 else ()
        listed.append(Task("foreign", names, "foreign", 0.0, first + k, plant=KINDS[k % len(KINDS)]))
    return listed


def frozen() -> dict[str, Any]:
    """Thresholds and targets; ends the run when the package's are others."""
    frozen_values = tomllib.loads((HERE / "thresholds.toml").read_text(encoding="utf-8"))
    held = {
        "explained": verdict.EXPLAINED,
        "alone": verdict.ALONE,
        "firm": verdict.FIRM,
        "reached": verdict.REACHED,
        "single": acceptance.SINGLE,
        "clear": acceptance.CLEAR,
        "margin": verdict.MARGIN,
        "unseen": verdict.UNSEEN,
        "confirmed": findings.CONFIRMED,
        "least": trace.LEAST,
        "quantile": trace.QUANTILE,
        "seen": trace.SEEN,
        "near": candidates.NEAR,
        "most_effects": rounds.MOST,
    }
    wrong = [key for key in held if frozen_values["package"][key] != held[key]]
    if wrong:
        sys.exit(f"thresholds.toml and the package differ in {', '.join(wrong)}: thresholds are frozen")
    return frozen_values


def main() -> None:
    options = _options()
    frozen_values = frozen()
    if options.seed < FIRST_TEST_SEED and not options.trial:
        sys.exit(f"seeds below {FIRST_TEST_SEED} were used in development; give --trial to use one")
    listed = tasks(options)[:: options.every][: options.limit]
    folder = writable_folder(options.out / "rows")
    with workers(folder, jobs=options.jobs) as crew:
        rows = list(tqdm(crew.finished(play, listed), total=len(listed), disable=options.quiet))
    rows.sort(key=lambda row: (row["kind"], row["effects"], row["seed"]))
    lines = sheet(rows, frozen_values["targets"], frozen_values["package"]["seen"])
    lines = [line | {"standing": standing(line)} if line["trials"] else line for line in lines]
    values = {
        "seed": options.seed,
        "campaigns": len(rows),
        "cpu_seconds_each": float(np.median([row["cpu_seconds"] for row in rows])),
        "sheet": lines,
        "matrix": matrix(rows),
        "plants": plants(rows),
        "crashes": [
            [row[key] for key in ("kind", "effects", "seed", "crashed")] for row in rows if row["crashed"]
        ],
        "grades": [row["grade"] for row in rows if row.get("grade")],
        "thresholds": frozen_values,
        "command": " ".join(["python", "studies/undeclared-effects/score.py", *sys.argv[1:]]),
    }
    write_text(options.out / "results.json", json.dumps(values, indent=1) + "\n")
    title = "Undeclared effects: the score sheet"
    print(
        write_page(
            options.out,
            HERE / "scoresheet.html",
            title,
            values,
            {},
            verdict=_verdict(values),
            name="report.html",
        )
    )


def _verdict(values: dict[str, Any]) -> Verdict:
    missed, undecided = (
        [line["measure"] for line in values["sheet"] if line.get("standing") == one] for one in ("no", "open")
    )
    parts = [f"Not reached: {'; '.join(missed)}."] if missed else []
    parts += [f"Open, more campaigns decide: {'; '.join(undecided)}."] if undecided else []
    said = " ".join(parts) or "Every target is reached."
    grade = "tentative" if parts or bounds(0, values["campaigns"])[1] > 0.02 else "reliable"
    return Verdict(
        grade, said, "targets of the table below; thresholds were frozen before the seeds were drawn"
    )


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    numbers = {
        "seed": FIRST_TEST_SEED,
        "each": 4,
        "controls": 60,
        "outsiders": 10,
        "pairs": 30,
        "sampled": 6,
        "cells": 12,
        "foreign": 64,
    }
    for name, default in (numbers | {"jobs": 1, "limit": None, "every": 1}).items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--out", type=Path, default=Path("reports/undeclared-effects"))
    parser.add_argument("--trial", action="store_true", help="allow a seed that development may have used")
    parser.add_argument("--quiet", action="store_true")
    return parser.parse_args()


if __name__ == "__main__":
    main()
