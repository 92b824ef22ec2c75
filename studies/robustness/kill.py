"""Kill runs at random moments, resume them, and hold the results against runs that were let end.

    python studies/robustness/kill.py [--kills N] [--seconds S] [--verbs VERB ...] [--seed N] [--jobs N]
        [--report FILE]

Each verb is started on a small study, the process, one it started, or all of them are killed (SIGKILL), and
the same command is given again, with --resume where the verb has it. After every kill nothing that was
started may go on for longer than `LEAST`, the resumed run must end well, hold every number of the
uninterrupted one, and leave no temporary file; a second run into the folder of one that is going on must be
refused in one sentence. Exit code 1 when anything of this fails. Reads the process table of Linux. The
committed summary is `reports/robustness/kills.md`.
"""

import argparse
import json
import os
import random
import shlex
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import xarray

from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.core.files import write_text
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_folder
from lcopa_bayes.model.path import TransferPath

SETTINGS = '[model]\nterms = 1\n[noise]\nkind = "white"\n[priors]\norder_1 = 0.8\ndelay = 0.7\n'
ENSEMBLES = "[sampler]\nensembles = 2\nwalkers = 16\nsteps = 400\nthin = 1\ntarget_ess = 100000\n"
COMMANDS = {
    "fit": ("fit", "devices/a", "--resume"),
    "run": ("run", "sampled", "--resume"),
    "audit": ("audit", "sampled", "--resume"),
    "compare": ("compare", "devices/a", "--quick", "--pick", "fractional-1", "first-order", "--resume"),
    "design": ("design", "devices/a", "--quick", "--resume"),
    "loop": ("loop", "devices/a", "--quick"),
    "fleet": ("fleet", "devices", "--quick", "--resume"),
    "calibrate": ("calibrate", "devices/a", "--quick", "--replicas", "6", "--resume"),
}
"""Command line of each verb; the last word is left out of the run that is killed where it is --resume."""
TARGETS = ("parent", "child", "both")
LEAST = 5.0
"""Time within which everything that a killed run started must have ended [s]."""
MOST = 600.0
"""Time that a run may take at most [s]."""
_OF_THE_RUN = ("seconds", "command", "look")
"""Keys and columns that may differ: times, command lines, and the first look, which a resumed run leaves
out."""
_HEADING = """# Killed runs

Each verb is started on a small study and killed (SIGKILL) at a random moment: the process, one that it
started, or all of them. Then the same command is given again, with `--resume` where the verb has it. *Equal
after*: that run ended well, every number it wrote is that of an uninterrupted run, nothing that the killed
run started went on for longer than 5 s, and no temporary file was left. *Second run*: what a run into the
folder of one that is going on was answered."""


def write_studies(folder: Path, devices: str = "abc", samples: int = 60) -> None:
    """A fleet, and a study that is sampled by ensembles."""
    bench = Bench(camera=12.0 / samples, noise_sd=0.02, noise_correlation=0.0)
    for number, name in enumerate((*devices, "sampled")):
        path = TransferPath.of_times(2.0 + 0.05 * number, 0.7, (1.5,), (0.8,))
        device = Device(((path,),), (Axis("u", "V"),), (Axis("y", "rad"),), (0.3,))
        rng = np.random.default_rng(number)
        record = simulate(device, bench, step(1.0, at=0.5), duration=12.0, name="step", rng=rng)
        place = folder / ("" if name == "sampled" else "devices") / name
        settings = SETTINGS + ENSEMBLES * (name == "sampled")
        write_folder(place, Study(name, seed=3, fit=record), settings=settings)


def start(verb: str, studies: Path, out: Path, *, jobs: int, resume: bool = False) -> subprocess.Popen[str]:
    """Start a verb in a process of its own."""
    name, source, *words = COMMANDS[verb]
    words = [word for word in words if resume or word != "--resume"]
    given = [name, str(studies / source), *words, "--jobs", str(jobs), "--out", str(out)]
    return subprocess.Popen(
        [sys.executable, "-m", "lcopa_bayes.cli", *given],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def descendants(process: int) -> list[int]:
    """Processes that a process started, and those that these started."""
    try:
        words = Path(f"/proc/{process}/task/{process}/children").read_text().split()
    except OSError:
        return []
    return [one for word in words for one in (int(word), *descendants(int(word)))]


def alive(process: int) -> bool:
    """Whether a process goes on."""
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition: Callable[[], bool], most: float) -> bool:
    """Whether a condition comes to hold within a time [s]."""
    until = time.monotonic() + most
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True


def contents(folder: Path) -> dict[str, Any]:
    """What a run folder holds, by file name, without what belongs to the run and not to its result."""
    held: dict[str, Any] = {}
    for path in sorted(one for one in folder.rglob("*") if one.is_file()):
        name = str(path.relative_to(folder))
        if path.name.startswith("look") or name == "chain.h5":
            continue
        if path.suffix == ".json":
            held[name] = _bare(json.loads(path.read_text()))
        elif path.suffix == ".nc":
            with xarray.open_datatree(path, engine="h5netcdf") as tree:
                held[name] = [
                    (group.path, key, one.to_numpy().tobytes())
                    for group in tree.subtree
                    for key, one in sorted(group.variables.items())
                    if key not in _OF_THE_RUN
                ]
        elif path.suffix in (".csv", ".parquet"):
            table = pd.read_csv(path) if path.suffix == ".csv" else pd.read_parquet(path)
            held[name] = table.drop(columns=[key for key in _OF_THE_RUN if key in table]).to_csv()
        else:  # pages print times
            held[name] = None if path.suffix == ".html" else path.read_bytes()
    return held


def _bare(values: Any) -> Any:
    if isinstance(values, dict):
        return {key: _bare(one) for key, one in values.items() if key not in _OF_THE_RUN}
    return [_bare(one) for one in values] if isinstance(values, list) else values


@dataclass(frozen=True)
class Kill:
    """One killed and resumed run."""

    verb: str
    target: str
    moment: float
    """After the start [s]."""
    problems: tuple[str, ...]
    ended: bool
    """Whether the run had ended before."""


def differences(got: dict[str, Any], wanted: dict[str, Any]) -> Iterator[str]:
    """Files in which two run folders differ."""
    for name in sorted(got.keys() | wanted.keys()):
        if name not in got or name not in wanted or got[name] != wanted[name]:
            yield f"differs: {name}"


def _works(process: int) -> bool:
    """Whether a process does work; that which only counts semaphores is Python's own."""
    try:
        return b"resource_tracker" not in Path(f"/proc/{process}/cmdline").read_bytes()
    except OSError:
        return False


def kill(process: subprocess.Popen[str], target: str, pick: random.Random) -> tuple[list[str], bool]:
    """Kill a run, one process that it started, or all; what is wrong then, and whether it had ended."""
    others = descendants(process.pid)
    if process.poll() is not None:
        process.communicate()
        return [], True
    working = [one for one in others if _works(one)]
    struck = {"parent": [process.pid], "both": [process.pid, *others]}
    for one in struck.get(target) or [pick.choice(working)] if working else [process.pid]:
        try:
            os.kill(one, signal.SIGKILL)
        except ProcessLookupError:
            continue
    try:
        said = process.communicate(timeout=MOST)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        said = process.communicate()[1]
        return ["hangs without a process that it started"], False
    problems = []
    killed = process.returncode == -signal.SIGKILL  # a child that was just starting says so
    if not killed and (process.returncode not in (0, 2) or "Traceback" in said):
        problems.append(f"exit code {process.returncode}: {said[-600:]}")
    wait_for(lambda: not any(map(alive, others)), LEAST)
    left = [one for one in others if alive(one)]
    for one in left:
        os.kill(one, signal.SIGKILL)
    return problems + [f"{len(left)} orphans"] * bool(left), False


def finish(verb: str, studies: Path, out: Path, *, jobs: int, resume: bool) -> list[str]:
    """Let a run end; what is wrong with how it did."""
    process = start(verb, studies, out, jobs=jobs, resume=resume)
    said = process.communicate(timeout=MOST)[1]
    problems = [f"exit code {process.returncode}: {said[-600:]}"] * bool(process.returncode)
    hidden = [one.name for one in out.rglob("*") if one.name.startswith((".", "tmp"))]
    return problems + [f"temporary files: {hidden}"] * bool(hidden)


def refused(verb: str, studies: Path, out: Path, *, jobs: int) -> list[str]:
    """What is wrong with how a second run into the folder of one that is going on is answered."""
    first = start(verb, studies, out, jobs=jobs)
    try:
        if not wait_for((out / ".lock").exists, MOST):
            return ["no lock"]
        os.kill(first.pid, signal.SIGSTOP)  # it goes on for as long as the second needs
        second = start(verb, studies, out, jobs=jobs, resume=True)
        said = second.communicate(timeout=MOST)[1]
    finally:
        os.kill(first.pid, signal.SIGCONT)
        problems = kill(first, "both", random.Random(0))[0]
    good = second.returncode == 2 and "another run is writing there" in said and said.count("error") == 1
    return problems + [f"second run: exit code {second.returncode}: {said[-600:]}"] * (not good)


def reference(verb: str, studies: Path, out: Path, *, jobs: int) -> tuple[dict[str, Any], float]:
    """What an uninterrupted run holds, and the time it took [s]."""
    began = time.monotonic()
    if problems := finish(verb, studies, out, jobs=jobs, resume=False):
        raise RuntimeError(f"{verb}: {problems}")
    return contents(out), time.monotonic() - began


def attempt(
    verb: str, studies: Path, out: Path, wanted: dict[str, Any], target: str, moment: float, jobs: int
) -> Kill:
    """Kill a run at a moment [s] and resume it."""
    process = start(verb, studies, out, jobs=jobs)
    time.sleep(moment)
    problems, ended = kill(process, target, random.Random(moment))
    problems += finish(verb, studies, out, jobs=jobs, resume=True)
    problems += differences(contents(out), wanted)
    return Kill(verb, target, moment, tuple(problems), ended)


def summary(kills: Sequence[Kill], second: Mapping[str, list[str]], known: Mapping[str, float]) -> str:
    """Table of what came of the kills, by verb, and every problem."""
    rows = [
        "| verb | takes [s] | killed (parent, child, both) | before half, after | equal after | orphans "
        "| temporary files | second run |",
        "|---|---:|---:|---:|---:|---:|---:|---|",
    ]
    for verb, seconds in known.items():
        own = [one for one in kills if one.verb == verb and not one.ended]
        struck = ", ".join(str(sum(one.target == target for one in own)) for target in TARGETS)
        early = sum(2 * one.moment < seconds for one in own)
        said = [problem for one in own for problem in one.problems]
        counts = [sum(word in problem for problem in said) for word in ("orphans", "temporary files")]
        equal = sum(not one.problems for one in own)
        answer = "not as it should be" if second[verb] else "refused"
        cells = [verb, f"{seconds:.1f}", f"{len(own)} ({struck})", f"{early}, {len(own) - early}", equal]
        rows.append(f"| {' | '.join(map(str, [*cells, *counts, answer]))} |")
    wrong = [f"- {one.verb}, {one.target} at {one.moment:.2f} s: {'; '.join(one.problems)}" for one in kills]
    wrong = [line for line, one in zip(wrong, kills, strict=True) if one.problems]
    wrong += [f"- {verb}, second run: {'; '.join(said)}" for verb, said in second.items() if said]
    late = sum(one.ended for one in kills)
    rows += ["", f"{late} more runs had ended before their kill, and were given again all the same."]
    return "\n".join([*rows, *(["", *wrong] if wrong else [])])


def main() -> int:
    """Kill as often as the command line asks for; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--kills", type=int, default=50, help="of each verb")
    parser.add_argument("--seconds", type=float, default=np.inf, help="begin no further round after these")
    parser.add_argument("--verbs", nargs="+", choices=COMMANDS, default=list(COMMANDS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--report", type=Path, help="file of the summary")
    given = parser.parse_args()
    began, pick, kills = time.monotonic(), random.Random(given.seed), list[Kill]()
    with tempfile.TemporaryDirectory() as place:
        studies = Path(place) / "studies"
        write_studies(studies)
        known = {verb: reference(verb, studies, Path(place) / verb, jobs=given.jobs) for verb in given.verbs}
        second = {}
        for verb in given.verbs:
            second[verb] = refused(verb, studies, Path(place) / f"{verb}-second", jobs=given.jobs)
            print(f"{verb}: a second run is {'; '.join(second[verb]) or 'refused'}", flush=True)
        for number in range(given.kills):
            if time.monotonic() - began > given.seconds:
                break
            for verb in given.verbs:
                wanted, seconds = known[verb]
                out, target = Path(place) / f"{verb}-{number}", pick.choice(TARGETS)
                one = attempt(verb, studies, out, wanted, target, pick.uniform(0.0, seconds), given.jobs)
                kills.append(one)
                if one.ended:  # the machine has become faster
                    known[verb] = wanted, one.moment
                said = "; ".join(one.problems) or ("ended before" if one.ended else "equal")
                print(f"{verb}, {target} at {one.moment:.2f} s of {seconds:.2f} s: {said}", flush=True)
    table = summary(kills, second, {verb: seconds for verb, (_, seconds) in known.items()})
    print(table)
    if given.report:
        command = shlex.join(["python", "studies/robustness/kill.py", *sys.argv[1:]])
        took = f"`{command}` took {(time.monotonic() - began) / 60:.0f} minutes"
        said = f"{_HEADING}\n\n{took}, of runs of {given.jobs} processes."
        write_text(given.report, f"{said}\n\n{table}\n")
    return int(any(second.values()) or any(one.problems for one in kills))


if __name__ == "__main__":
    sys.exit(main())
