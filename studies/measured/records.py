"""What `fit`, `loop` and `compare` say of every measured record: one table of all verbs, or of some of them.

    python studies/measured/records.py [--records FOLDER] [--only NAME ...] [--verbs VERB ...] [--jobs N]
        [--limit SECONDS] [--out FOLDER]

Every folder of records is fitted, looped and compared with the study file it comes with, the structure left
to the records where that file does not state it. Finished rows are kept in the folder: a killed run goes on
where it stopped, and a row that ended in an error, or not within the limit, says so.
"""

import argparse
import json
import os
import signal
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.verbs.compare import compare
from lcopa_bayes.verbs.fit import fit
from lcopa_bayes.verbs.loop import loop

RECORDS = Path(os.environ.get("LCOPA_BAYES_DATA", "../shared")) / "records"
VERBS = ("fit", "loop", "compare")
HEADS = {
    "fit": ("structure", "grade", "sums of lags", "held out, RMSE", "fit [CPU s]"),
    "loop": ("loop", "names", "held out / noise", "loop [CPU s]"),
    "compare": ("preferred", "fractional orders", "compare [CPU s]"),
}
"""Columns of each verb."""
ERRORS = (
    "Held-out errors are root mean squares, of the fit in the unit of the record, of the loop over the",
    "noise that it ends with, before and after.",
    "",
)
QUICK, BUDGET = ("silverbox", "cd_player_arm"), 300.0
"""Records of many samples, whose sampling ends after so long [s], and whose loop and candidates take fewer
steps."""


def measured(folder: Path) -> Study:
    """The study of a record, with a budget where it is one of many samples."""
    study = load_study(folder)
    seconds = BUDGET if folder.name in QUICK else study.sampler.seconds
    return replace(study, sampler=replace(study.sampler, seconds=seconds))


def fitted(folder: Path) -> dict[str, Any]:
    """What a fit says."""
    result = fit(measured(folder))
    assert isinstance(result, Fit)
    other = result.alternatives
    return {
        "structure": result.structure.chosen.name if result.structure else "stated",
        "grade": result.draws.grade.level,
        "limitations": [one.reason for one in result.draws.limitations],
        "sums_of_lags": [one.support for one in other.alternatives] if other else [],
        "ess": result.draws.ess,
        "held_out": [band.score() for band in result.bands if band.held_out],
    }


def looped(folder: Path) -> dict[str, Any]:
    """What the loop says."""
    result = loop(measured(folder), quick=folder.name in QUICK)
    values = result.to_json()
    sides = {
        side: {kind: values[side][f"{kind}_rmse_over_noise"] for kind in ("fit", "held_out")}
        for side in ("before", "after")
    }
    return {
        "verdict": values["verdict"],
        "confidence": values["confidence"],
        "effects": [one["name"] for one in values["effects"]],
        "unseen_by": values["unseen_by"],
        "held_out_rmse": [values[side]["held_out_rmse"] for side in ("before", "after")],
        **sides,
    }


def compared(folder: Path) -> dict[str, Any]:
    """What a comparison of the candidates of the study says."""
    values = compare(measured(folder), quick=folder.name in QUICK).values
    return {
        "preferred": values["preferred"],
        "why": values["why"],
        "fractional": values["fractional"],
        "candidates": [row["name"] for row in values["models"]],
    }


ACTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {"fit": fitted, "loop": looped, "compare": compared}


def perform(folder: str, verb: str, limit: int) -> dict[str, Any]:
    """One verb on one record, with its time; an InputError is its result, and so is `limit` [CPU s]."""
    began, cpu = time.perf_counter(), time.process_time()
    row: dict[str, Any] = {"record": Path(folder).name, "verb": verb}
    signal.signal(signal.SIGPROF, _too_long)
    signal.setitimer(signal.ITIMER_PROF, limit)  # other work on the machine ends nothing
    try:
        row |= ACTIONS[verb](Path(folder))
    except InputError as error:
        row["refused"] = str(error)
    except TimeoutError:
        row["refused"] = f"did not end in {limit} s"
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return row | {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}


def page(rows: list[dict[str, Any]], verbs: Sequence[str]) -> str:
    """The table of some verbs in Markdown, one line per record."""
    heads = ["record", *(head for verb in verbs for head in HEADS[verb])]
    lines = ["# Measured records", "", *(() if verbs == ["compare"] else ERRORS)]
    lines += [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for name in dict.fromkeys(row["record"] for row in rows):
        own = {row["verb"]: row for row in rows if row["record"] == name}
        cells = [_cells(own.get(verb), *CELLS[verb]) for verb in verbs]
        lines.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join([*lines, ""])


def _cells(row: dict[str, Any] | None, width: int, said: Callable[[dict[str, Any]], list[str]]) -> str:
    """The cells of one verb, its seconds last; what it did not end in stands in the first."""
    if row is None or "refused" in row:
        return " | ".join(["not run" if row is None else row["refused"], *[""] * width])
    return " | ".join([*said(row), f"{row['cpu_seconds']:.0f}"])


def _of_fit(row: dict[str, Any]) -> list[str]:
    errors = [f"{one['axis']} {one['rmse']:.3g} {one['unit']}" for one in row["held_out"]]
    lists = (row["sums_of_lags"], errors)
    return [row["structure"], row["grade"], *(", ".join(one) or "-" for one in lists)]


def _of_loop(row: dict[str, Any]) -> list[str]:
    was, now = row["held_out_rmse"]
    pairs = [
        f"{name} {ratio * was[name] / now[name]:.2f} to {ratio:.2f}"
        for name, ratio in row["after"]["held_out"].items()
    ]
    said = f"{row['verdict']} ({row['confidence']})"
    return [said, *(", ".join(one) or "-" for one in (row["effects"], pairs))]


def _of_compare(row: dict[str, Any]) -> list[str]:
    orders = row["fractional"]
    if "integer" not in orders:
        return [row["preferred"] or "none", orders["verdict"]]
    against = f"{orders['log_bayes_factor']:+.1f} nat against {orders['integer']}"
    return [row["preferred"] or "none", f"{orders['verdict']}, {against}"]


CELLS = {"fit": (4, _of_fit), "loop": (3, _of_loop), "compare": (2, _of_compare)}
"""Cells of a verb before its seconds: how many, and what they say."""


def _too_long(*_: object) -> NoReturn:
    raise TimeoutError


def _perform(limit: int, task: tuple[str, str]) -> dict[str, Any]:
    return perform(*task, limit)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--records", type=Path, default=RECORDS)
    parser.add_argument("--only", nargs="*")
    parser.add_argument("--verbs", nargs="*", choices=VERBS, default=VERBS)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=int, default=1800)
    parser.add_argument("--out", type=Path, default=Path("reports/measured"))
    options = parser.parse_args()
    folders = sorted(path.parent for path in options.records.glob("*/study.toml"))
    folders = [path for path in folders if not options.only or path.name in options.only]
    kept = writable_folder(writable_folder(options.out) / "rows")
    tasks = [(str(folder), verb) for folder in folders for verb in options.verbs]
    done = {}
    for folder, verb in tasks:
        path = kept / f"{Path(folder).name}.{verb}.json"
        if path.exists():
            done[folder, verb] = json.loads(path.read_text(encoding="utf-8"))
    with workers(options.limit, jobs=options.jobs) as crew:
        for row in crew.finished(_perform, [task for task in tasks if task not in done]):
            folder = next(str(path) for path in folders if path.name == row["record"])
            done[folder, row["verb"]] = row
            text = json.dumps(row, indent=1, allow_nan=False)
            write_text(kept / f"{row['record']}.{row['verb']}.json", f"{text}\n")
            print(f"{row['record']} {row['verb']}: {row['cpu_seconds']:.0f} s", flush=True)
    rows = [done[task] for task in tasks if task in done]
    verbs = [verb for verb in VERBS if verb in options.verbs]
    name = "report" if len(verbs) == len(VERBS) else "-".join(verbs)
    write_text(options.out / f"{name}.md", page(rows, verbs))


if __name__ == "__main__":
    from records import main as run  # workers do not run this script: what they do must be in a module

    run()
