"""What `fit` and `loop` say of every measured record: one table.

    python studies/measured/records.py [--records FOLDER] [--only NAME ...] [--jobs N] [--limit SECONDS]
        [--out FOLDER]

Every folder of records is fitted and looped with the study file it comes with, the structure left to the
records where that file does not state it. Finished rows are kept in the folder: a killed run goes on where it
stopped, and a row that ended in an error, or not within the limit, says so.
"""

import argparse
import json
import os
import signal
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NoReturn

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.verbs.fit import fit
from lcopa_bayes.verbs.loop import loop

RECORDS = Path(os.environ.get("LCOPA_BAYES_DATA", "../shared")) / "records"
VERBS = ("fit", "loop")
HEADS = ("record", "structure", "grade", "sums of lags", "fit [CPU s]")
HEADS += ("loop", "names", "held out / noise", "loop [CPU s]")
QUICK = ("silverbox", "cd_player_arm")
"""Records of many samples, whose loop ends without draws."""


def fitted(folder: Path) -> dict[str, Any]:
    """What a fit says."""
    result = fit(folder)
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
    result = loop(folder, quick=folder.name in QUICK)
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


ACTIONS: dict[str, Callable[[Path], dict[str, Any]]] = {"fit": fitted, "loop": looped}


def perform(folder: str, verb: str, limit: int) -> dict[str, Any]:
    """One verb on one record, with its time; an InputError is its result, and so is `limit` [s]."""
    began, cpu = time.perf_counter(), time.process_time()
    row: dict[str, Any] = {"record": Path(folder).name, "verb": verb}
    signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(limit)
    try:
        row |= ACTIONS[verb](Path(folder))
    except InputError as error:
        row["refused"] = str(error)
    except TimeoutError:
        row["refused"] = f"did not end in {limit} s"
    finally:
        signal.alarm(0)
    return row | {"seconds": time.perf_counter() - began, "cpu_seconds": time.process_time() - cpu}


def page(rows: list[dict[str, Any]]) -> str:
    """The table in Markdown, one line per record."""
    lines = [
        "# Measured records",
        "",
        "Held-out errors are root mean squares over the noise of the fit, before and after the loop.",
        "",
        f"| {' | '.join(HEADS)} |",
        f"|{'---|' * len(HEADS)}",
    ]
    for name in dict.fromkeys(row["record"] for row in rows):
        own = {row["verb"]: row for row in rows if row["record"] == name}
        lines.append(f"| {name} | {_fit_cells(own.get('fit'))} | {_loop_cells(own.get('loop'))} |")
    return "\n".join([*lines, ""])


def _fit_cells(row: dict[str, Any] | None) -> str:
    if row is None or "refused" in row:
        return f"{'not run' if row is None else row['refused']} | | | "
    support = ", ".join(row["sums_of_lags"]) or "-"
    return f"{row['structure']} | {row['grade']} | {support} | {row['cpu_seconds']:.0f}"


def _loop_cells(row: dict[str, Any] | None) -> str:
    if row is None or "refused" in row:
        return f"{'not run' if row is None else row['refused']} | | | "
    pairs = [
        f"{name} {before:.2f} to {row['after']['held_out'][name]:.2f}"
        for name, before in row["before"]["held_out"].items()
    ]
    return (
        f"{row['verdict']} ({row['confidence']}) | {', '.join(row['effects']) or '-'} | "
        f"{', '.join(pairs) or '-'} | {row['cpu_seconds']:.0f}"
    )


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
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--limit", type=int, default=1800)
    parser.add_argument("--out", type=Path, default=Path("reports/measured"))
    options = parser.parse_args()
    folders = sorted(path.parent for path in options.records.glob("*/study.toml"))
    folders = [path for path in folders if not options.only or path.name in options.only]
    kept = writable_folder(writable_folder(options.out) / "rows")
    tasks = [(str(folder), verb) for folder in folders for verb in VERBS]
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
    write_text(options.out / "report.md", page(rows))


if __name__ == "__main__":
    from records import main as run  # workers do not run this script: what they do must be in a module

    run()
