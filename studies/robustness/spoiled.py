"""Give a verb small campaigns of every shape, as they are and spoiled, and say what came of them.

    python studies/robustness/spoiled.py [--verb VERB] [--campaigns N] [--seed S] [--limit SECONDS]
        [--jobs N] [--out FOLDER]

Plants, shapes, clocks and hidden effects are those of `studies/undeclared-effects/foreign.py`; records are
thinned to six samples or more, spoiled in one of `SPOILINGS`, and given in other units. Every campaign goes
into a run folder of its own, four of five with the structure as stated. A campaign crashes where it ends in
anything but a result or a refusal in words, a warning included. Finished rows are kept in the folder: a
killed run goes on where it stopped. Exit code 1 after a crash.
"""

import argparse
import json
import shlex
import signal
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).parents[1] / "undeclared-effects"))

from foreign import EFFECTS, KINDS, campaign

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.verbs.fit import fit
from lcopa_bayes.verbs.look import look
from lcopa_bayes.verbs.loop import loop

SPOILINGS = (
    "as it is",
    "half of it missing",
    "coarse",
    "no noise",
    "constant",
    "spikes",
    "drive never moves",
    "drive moves once",
    "drive moves in the first row",
)
SIZES = (6, 12, 25, 50, 100)
"""Samples per record, about [-]."""
AS_STATED = 0.8
"""Share of campaigns whose structure is as stated [-]."""
DRAWING = 5.0
"""Time for the draws of a fit [s]."""
RESULTS = {
    "loop": ("clean", "explained", "partly explained", "disturbance", "unexplained"),
    "fit": ("reliable", "tentative", "unusable"),
    "look": ("seen",),
}
"""What a verb says of a campaign: its verdict, the grade of its draws, or that there is a first look."""
HEADING = """# Campaigns of every shape

Small campaigns of plants outside the family, with none to two hidden effects, as they are and spoiled,
through a verb into a run folder. *Refused*: ended with a sentence of what is wrong with the records."""


def spoiled(record: Record, how: str, size: int, scales: tuple[float, float, float]) -> Record:
    """A record thinned to about `size` samples, in other units of time, drive and response."""
    rows = np.arange(0, record.time.size, max(1, record.time.size // size))
    time_scale, drive_scale, response_scale = scales
    drive, response = record.drive[rows] * drive_scale, record.response[rows] * response_scale
    rng = np.random.default_rng([rows.size, SPOILINGS.index(how)])
    seen = np.ma.masked_invalid(response)
    if how == "half of it missing":
        response[rng.random(response.shape) < 0.5] = np.nan
    elif how == "coarse":
        spread = float(seen.compressed().std()) if seen.count() else 0.0
        response = np.round(response / (spread or 1.0)) * spread
    elif how == "no noise":
        response = _followed(drive)[:, [0] * response.shape[1]] * response_scale
    elif how == "constant":
        response = np.where(seen.mask, np.nan, seen.mean(axis=0).filled(0.0))
    elif how == "spikes":
        response[rng.integers(len(response))] *= 1e3
    elif how == "drive never moves":
        drive[:] = drive[0]
    elif how == "drive moves once":
        drive[1:] = drive[-1]
    elif how == "drive moves in the first row":
        drive[0] += 1.0
    return replace(record, time=record.time[rows] * time_scale, drive=drive, response=response)


def _followed(drive: Matrix) -> Matrix:
    """A lag of three rows without noise."""
    out = drive.copy()
    for row in range(1, len(out)):
        out[row] = out[row - 1] + 0.3 * (drive[row - 1] - out[row - 1])
    return out


def study(seed: int) -> tuple[Study, dict[str, Any]]:
    """A campaign and what was done to it."""
    rng = np.random.default_rng([seed, 5])
    kind = str(rng.choice(KINDS))
    effects = [str(one) for one in rng.choice(EFFECTS, size=int(rng.integers(0, 3)), replace=False)]
    own = campaign(kind, effects, seed).study(seed)
    powers = [int(rng.integers(-end, end + 1)) if rng.random() < 0.4 else 0 for end in (6, 9, 9)]
    time_scale, drive_scale, response_scale = (10.0**power for power in powers)
    hows: list[str] = []

    def changed(records: tuple[Record, ...]) -> tuple[Record, ...]:
        out = []
        for one in records:
            hows.append(str(rng.choice(SPOILINGS, p=[0.36, *[0.08] * (len(SPOILINGS) - 1)])))
            size = int(rng.choice(SIZES))
            out.append(spoiled(one, hows[-1], size, (time_scale, drive_scale, response_scale)))
        return tuple(out)

    fit, held_out = changed(own.fit), changed(own.held_out)
    fit = fit[:1] if rng.random() < 0.3 else fit
    held_out = () if rng.random() < 0.4 else held_out
    stated = bool(rng.random() < AS_STATED)
    model = ModelSettings(terms=int(rng.integers(1, 3))) if stated else ModelSettings()
    shape = f"{len(own.response_axes)}x{len(own.drive_axes)}"
    said = {"plant": kind, "effects": effects, "shape": shape, "spoiled": hows, "stated": stated}
    return replace(own, fit=fit, held_out=held_out, model=model), said


def _looped(own: Study, folder: Path, *, stated: bool) -> str:
    result = loop(own, as_stated=stated, quick=True, folder=folder)
    result.summary()
    return str(result.values["verdict"])


def _fitted(own: Study, folder: Path, *, stated: bool) -> str:
    brief = replace(own, sampler=replace(own.sampler, seconds=DRAWING))
    result = fit(brief, quick=True, folder=folder, page=True)
    result.summary()
    return result.draws.grade.level


def _looked(own: Study, folder: Path, *, stated: bool) -> str:
    look(own, folder=folder).summary()
    return "seen"


VERBS: dict[str, Callable[..., str]] = {"loop": _looped, "fit": _fitted, "look": _looked}


def play(known: tuple[str, int], seed: int) -> dict[str, Any]:
    """What a verb gives of one campaign within a limit [CPU s]."""
    (verb, limit), began, row = known, time.process_time(), {"seed": seed}
    signal.signal(signal.SIGPROF, _too_long)
    try:
        with warnings.catch_warnings(), tempfile.TemporaryDirectory() as place:
            warnings.simplefilter("error")
            signal.setitimer(signal.ITIMER_PROF, limit)
            own, said = study(seed)
            row |= said
            row["outcome"] = VERBS[verb](own, Path(place) / "run", stated=row["stated"])
    except InputError as error:
        row |= {"outcome": "refused", "said": str(error)}
    except TimeoutError:
        row["outcome"] = "not in time"
    except Exception:
        row |= {"outcome": "crashed", "said": traceback.format_exc()}
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    return row | {"cpu_seconds": time.process_time() - began}


def _too_long(number: int, frame: object) -> NoReturn:
    raise TimeoutError


def page(rows: list[dict[str, Any]], command: str, verb: str, limit: int) -> str:
    """The summary in Markdown."""
    outcomes = [*RESULTS[verb], "refused", "not in time", "crashed"]
    lines = [HEADING, "", f"`{command}`: {len(rows)} campaigns, {limit} CPU s each at most.", ""]
    lines += [f"| responses x drives | {' | '.join(outcomes)} | median [CPU s] | longest [CPU s] |"]
    lines += [f"|---|{'---:|' * (len(outcomes) + 2)}"]
    shapes = sorted({row.get("shape", "none") for row in rows})
    for shape in [*shapes, "all"]:
        own = [row for row in rows if shape in (row.get("shape", "none"), "all")]
        counts = Counter(row["outcome"] for row in own)
        seconds = [row["cpu_seconds"] for row in own]
        cells = [str(counts[one]) for one in outcomes]
        lines.append(f"| {shape} | {' | '.join(cells)} | {np.median(seconds):.1f} | {np.max(seconds):.0f} |")
    crashed = [row for row in rows if row["outcome"] == "crashed"]
    lines += ["", *(f"Seed {row['seed']} crashed: `{row['said'].splitlines()[-1]}`" for row in crashed)]
    return "\n".join([*lines, ""])


def main() -> int:
    """Run the campaigns; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    numbers = {"campaigns": 1000, "seed": 500_000, "limit": 120, "jobs": 1}
    for name, default in numbers.items():
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--verb", choices=VERBS, default="loop")
    parser.add_argument("--out", type=Path, default=Path("reports/robustness/spoiled"))
    parser.add_argument("--quiet", action="store_true")
    given = parser.parse_args()
    folder = writable_folder(given.out / "rows")
    seeds = range(given.seed, given.seed + given.campaigns)
    kept = {seed: folder / f"{seed}.json" for seed in seeds}
    rows = [json.loads(file.read_text(encoding="utf-8")) for file in kept.values() if file.exists()]
    missing = [seed for seed, file in kept.items() if not file.exists()]
    with workers((given.verb, given.limit), jobs=given.jobs) as crew:
        for row in tqdm(crew.finished(play, missing), total=len(missing), disable=given.quiet):
            write_text(kept[row["seed"]], json.dumps(row) + "\n")
            rows.append(row)
    command = shlex.join(["python", "studies/robustness/spoiled.py", *sys.argv[1:]])
    text = page(sorted(rows, key=lambda row: row["seed"]), command, given.verb, given.limit)
    write_text(given.out / "report.md", text)
    print(text)
    return int(any(row["outcome"] == "crashed" for row in rows))


if __name__ == "__main__":
    sys.exit(main())
