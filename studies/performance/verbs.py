"""Time, plants simulated, share of the likelihood and memory of every verb, on studies from easy to hard.

Each verb runs by the command line in a process of its own, as a user runs it; wall and CPU time, that of its
workers included, are measured from outside. In one process (`jobs` 1) `probe.py` counts plants and the time
of each stage. Between runs a fixed piece of array work, the yardstick, is timed: CPU times divided by it can
be compared between machines, and between hours of one machine.
"""

from __future__ import annotations

import ctypes
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from comparison import Spread, ratio
from probe import SAMPLING

from lcopa_bayes.verbs.commandline import USAGES

HERE = Path(__file__).parent
STUDIES = HERE.parent
ROOT = STUDIES.parent
MEASURED = ("lcd_panel_p_from000_to153", "hair_dryer", "heating_system", "tclab_2x2")
"""Studies of measured records that are added where there are such records."""
CANDIDATES = ("fractional-1", "fractional-2", "first-order", "second-order")
REPLICAS = {True: "2", False: "20"}
"""Simulated studies of `calibrate`, in a quick run and in a full one."""
SAMPLES = 1000
"""Bench time of `design` [sampling periods]."""
WITHOUT_STUDY = ("optics", "claims")
APART = ("run", "fleet", "new", "explain")
"""Verbs that are not measured: `fit` with what a study adds to it or of many studies, and two that calculate
nothing."""
ON_FIT = ("report", "predict", "audit", "design")
"""Verbs that take the run folder of a fit."""


@dataclass(frozen=True)
class Source:
    """A study of the list, from easy to hard."""

    name: str
    folder: Path | None = None
    """Where it is; None for one that is simulated."""
    model: str = ""
    """Tables added to the study file of one that is simulated (TOML)."""

    @property
    def campaign(self) -> Path:
        return HERE / "campaigns" / f"{self.name}.toml"


SOURCES = (
    Source("one-term", STUDIES / "calibration" / "one-term"),
    Source("correlated", model="[model]\nterms = 2\n"),
    Source("two-axes", model="[model]\nterms = 1\n"),
    Source("paper-step-x", STUDIES / "paper-step-x"),
    Source("paper-step", STUDIES / "paper-step"),
    Source("rich", model="[model]\nterms = { direct = 3, cross = 2 }\nshare = 'paper'\n"),
)


def sources() -> tuple[Source, ...]:
    """The six, and those of measured records where there are any."""
    place = Path(os.environ.get("LCOPA_BAYES_DATA", ROOT.parent / "shared")) / "records"
    there = [Source(name, place / name) for name in MEASURED if (place / name / "study.toml").is_file()]
    return SOURCES + tuple(there)


@dataclass(frozen=True)
class Cell:
    """A verb on a study; without one for verbs that have none."""

    verb: str
    source: Source | None

    @property
    def place(self) -> tuple[str, str]:
        return self.verb, "" if self.source is None else self.source.name


def cells(sources: Sequence[Source]) -> list[Cell]:
    """Every verb on every study in an order in which each has what it needs: first all that is simulated, all
    verbs of the easiest study, the fits of all, and then the rest from easy to hard."""
    simulated = [Cell("simulate", each) for each in sources if each.folder is None]
    rest = (
        "check",
        "look",
        "report",
        "predict",
        "loop",
        "identify",
        "audit",
        "design",
        "calibrate",
        "compare",
    )
    first, *harder = sources
    easy = [Cell(verb, first) for verb in ("fit", *rest)]
    alone = [Cell(verb, None) for verb in WITHOUT_STUDY]
    fits = [Cell("fit", each) for each in harder]
    return simulated + easy + alone + fits + [Cell(verb, each) for each in harder for verb in rest]


def wanted(cell: Cell, verbs: Sequence[str], studies: Sequence[str]) -> bool:
    """Whether a cell is among those asked for; what makes a study is."""
    verb, study = cell.place
    of_study = not studies or study in studies
    return of_study and (not verbs or verb in verbs or verb == "simulate")


@dataclass(frozen=True)
class Measurement:
    """One run of a cell."""

    wall: float
    """[s]"""
    cpu: float
    """User and system time of the process and its workers [s]."""
    yardstick: float
    """CPU time of the yardstick around the run [s]."""
    outcome: str
    """``done``, ``refused``, ``failed`` or ``stopped`` when its time was up."""
    message: str = ""
    """What the verb said when it was refused or failed."""
    probe: Mapping[str, Any] = field(default_factory=dict)
    """What `probe` counted; empty where the run did not end."""
    results: Mapping[str, Any] = field(default_factory=dict)
    """Of a fit: grade, effective draws, method."""


@dataclass(frozen=True)
class Workshop:
    """A folder in which studies are made and results written, and how verbs are run."""

    folder: Path
    root: Path = ROOT
    """Checkout of the package that is measured."""
    jobs: int = 1
    quick: bool = False

    def study(self, source: Source) -> Path:
        return source.folder or self.folder / "studies" / source.name

    def run(self, source: Source) -> Path:
        """Run folder of a study's fit."""
        return self.folder / "runs" / source.name

    def arguments(self, cell: Cell) -> list[str]:
        """The command line of a cell."""
        verb, source = cell.verb, cell.source
        out: list[str] = [verb]
        if source is None:
            out += ["--out", str(self.folder / "runs" / verb)]
        elif verb == "simulate":
            out += [str(source.campaign), "--out", str(self.study(source)), "--overwrite"]
        elif verb in ON_FIT:
            out += [str(self.run(source))]
        else:
            other = self.run(source) if verb == "fit" else self.folder / "runs" / f"{source.name}-{verb}"
            out += [str(self.study(source)), "--out", str(other)]
        if verb == "predict" and source is not None:
            out += [str(self._drive(source)), "--out", str(self.run(source) / "predict")]
        if verb == "design" and source is not None:
            period = np.median(np.diff(self._last_record(source).iloc[:, 0]))
            out += ["--time", f"{SAMPLES * period:.9g}"]
        if verb == "compare":
            out += ["--pick", *CANDIDATES]
        if verb == "calibrate":
            out += ["--replicas", REPLICAS[self.quick]]
        known = [option for option, _ in USAGES[verb].options]
        if "--jobs" in known:
            out += ["--jobs", str(self.jobs)]
        if self.quick and "--quick" in known:
            out += ["--quick"]
        return [*out, "--json", "--quiet"]

    def _last_record(self, source: Source) -> pd.DataFrame:
        """The record that the study file names last."""
        study = self.study(source)
        text = (study / "study.toml").read_text(encoding="utf-8")
        return pd.read_csv(max(study.glob("*.csv"), key=lambda path: text.rfind(f'"{path.name}"')))

    def _drive(self, source: Source) -> Path:
        """A drive that nobody has measured, for `predict`: that of the last record, without its responses."""
        path, table = self.folder / f"{source.name}-drive.csv", self._last_record(source)
        table.filter(regex="^(time|drive)_").to_csv(path, index=False)
        return path

    def ready(self, cell: Cell) -> bool:
        """Whether what the cell needs has been made."""
        if cell.source is None or cell.verb == "simulate":
            return True
        if cell.verb in ON_FIT:
            return (self.run(cell.source) / "results.json").is_file()
        return (self.study(cell.source) / "study.toml").is_file()

    def measured(self, cell: Cell, limit: float, remaining: float) -> Measurement:
        """One run, stopped after `limit` seconds of CPU time and `remaining` seconds in all."""
        if cell.verb == "fit" and cell.source is not None:  # a fit that is stopped leaves nothing behind
            (self.run(cell.source) / "results.json").unlink(missing_ok=True)
        place = self.folder / "probe.json"
        place.unlink(missing_ok=True)
        probe = [str(HERE / "probe.py"), str(place), "counted" if self.jobs == 1 else "plain"]
        command = [sys.executable, *probe, *self.arguments(cell)]
        threads = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "OPENBLAS", "MKL")}
        environment = os.environ | threads | {"PYTHONPATH": str(self.root)}
        before = yardstick()
        spent, code, said, problem = observed(command, environment, self.root, limit, remaining)
        around = (before + yardstick()) / 2
        outcome = {0: "done", 2: "refused", None: "stopped"}.get(code, "failed")
        if outcome == "done" and cell.verb == "simulate" and cell.source is not None:
            with (self.study(cell.source) / "study.toml").open("a", encoding="utf-8") as file:
                file.write(cell.source.model)
        counts = json.loads(place.read_text()) if place.is_file() else {}
        results = fit_results(said) if cell.verb == "fit" and outcome == "done" else {}
        message = "" if outcome == "done" else (problem or said).strip().rpartition("\n")[2][:200]
        return Measurement(*spent, around, outcome, message, counts, results)


_SUBREAPER = 36
"""Option of `prctl` that makes a process the parent of orphans among its descendants."""


def observed(
    command: Sequence[str], environment: Mapping[str, str], folder: Path, limit: float, remaining: float
) -> tuple[tuple[float, float], int | None, str, str]:
    """Wall and CPU seconds of a command with what it started, its exit code (None: it was stopped, after
    `limit` seconds of CPU time or `remaining` seconds), and what it wrote."""
    if sys.platform == "linux":  # what outlives the command becomes a child of this process, and is counted
        ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)
    before, others = resource.getrusage(resource.RUSAGE_CHILDREN), children()
    begin, most = time.perf_counter(), int(np.ceil(min(limit, 1e6)))
    with tempfile.TemporaryFile("w+") as out, tempfile.TemporaryFile("w+") as problems:
        process = subprocess.Popen(
            command,
            env=dict(environment),
            cwd=folder,
            stdout=out,
            stderr=problems,
            preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (most, most)),
        )
        stopped = False
        while True:
            ended, status = os.waitpid(process.pid, 0 if stopped else os.WNOHANG)
            if ended:
                break
            if time.perf_counter() - begin > remaining:
                process.terminate()  # its workers end with it
                stopped = True
            else:
                time.sleep(0.02)
        wall = time.perf_counter() - begin
        process.returncode = code = os.waitstatus_to_exitcode(status)
        for file in (out, problems):
            file.seek(0)
        while left := children() - others:
            os.waitpid(left.pop(), 0)
        used = resource.getrusage(resource.RUSAGE_CHILDREN)
        spent = wall, used.ru_utime + used.ru_stime - before.ru_utime - before.ru_stime
        stopped = stopped or code in (-signal.SIGXCPU, -signal.SIGKILL)
        return spent, None if stopped else code, out.read(), problems.read()


def children() -> set[int]:
    """Processes whose parent this one is, where the system lists them."""
    listed = Path(f"/proc/self/task/{os.getpid()}/children")
    return {int(one) for one in listed.read_text().split()} if listed.is_file() else set()


def fit_results(said: str) -> dict[str, Any]:
    """Grade, effective draws and method of what a fit printed."""
    values = json.loads(said)
    sampler = {key: values["sampler"][key] for key in ("smallest_ess", "target_ess", "method")}
    return {"grade": values["grade"], **sampler}


def yardstick() -> float:
    """CPU time of a fixed piece of the kind of work that a response is: transforms, exponentials, products
    [s]."""
    series = np.random.default_rng(0).normal(size=(64, 1024))
    begin = time.process_time()
    for _ in range(100):
        spectrum = np.fft.rfft(series)
        np.fft.irfft(spectrum * np.exp(-np.abs(spectrum) / 1e3))
        series @ series.T
    return time.process_time() - begin


def row_of(cell: Cell, runs: Sequence[Measurement], fits: Sequence[Measurement]) -> dict[str, Any]:
    """What repeated runs of a cell took; `fits` are those of the same study in the same rounds."""
    verb, study = cell.place
    done = [one for one in runs if one.outcome == "done"]
    last = runs[-1]
    row: dict[str, Any] = {"verb": verb, "study": study, "outcome": last.outcome, "message": last.message}
    row["runs"] = len(done)
    if not done:
        return row | {"cpu_s_at_least": max(one.cpu for one in runs)}
    row |= {
        "wall_s": Spread.of([one.wall for one in done]),
        "cpu_s": Spread.of([one.cpu for one in done]),
        "peak_MB": Spread.of([one.probe["peak_MB"] for one in done]),
        "yardsticks": Spread.of([one.cpu / one.yardstick for one in done]),
    }
    paired = [(a, b) for a, b in zip(runs, fits, strict=False) if a.outcome == b.outcome == "done"]
    if verb != "fit" and paired:
        row["of_fit"] = ratio([a.cpu for a, _ in paired], [b.cpu for _, b in paired])
    results, counts = done[-1].results, done[-1].probe
    row |= dict(results)
    if "plants" in counts:
        row |= {
            "plants": counts["plants"],
            "plants_with_slopes": counts["plants_with_slopes"],
            "likelihood_share": counts["likelihood_s"] / counts["process_s"],
            "likelihood_share_of_sampling": share_of_sampling(counts["stages"]),
            "stages": counts["stages"],
            "not_watched": counts["missing"],
        }
        if "smallest_ess" in results:
            row["plants_per_draw"] = counts["plants"] / results["smallest_ess"]
    return row


def share_of_sampling(stages: Mapping[str, Sequence[float]]) -> float | None:
    """Share of the likelihood in the time that sampling takes; None for a verb that does not sample."""
    sampling = np.array([stages[name] for name in SAMPLING if name in stages])
    return float(sampling[:, 1].sum() / sampling.sum()) if sampling.size else None


def measured(
    folder: Path,
    *,
    quick: bool,
    jobs: int = 1,
    seconds: float = np.inf,
    against: Path | None = None,
    only: tuple[Sequence[str], Sequence[str]] = ((), ()),
) -> dict[str, Any]:
    """A row per verb and study, and with `against`, another checkout of the package, ratios to it.

    `only` names verbs and studies that are wanted, all where there are none; what needs a fit needs it named.
    Checkouts take turns run by run, cells round by round. In a quick run, with one round and `seconds` for
    all of it, a cell that takes long is stopped and counts as at least what it took.
    """
    rounds, limit = (1, 40.0) if quick else (3, 3600.0)
    studies = SOURCES if quick and not only[1] else sources()
    todo = [cell for cell in cells(studies) if wanted(cell, *only)]
    shops = [Workshop(folder / "this", jobs=jobs, quick=quick)]
    if against is not None:
        shops.append(replace(shops[0], folder=folder / "other", root=against))
    end = time.perf_counter() + seconds
    runs: list[dict[tuple[str, str], list[Measurement]]] = [{} for _ in shops]
    left_out: dict[tuple[str, str], str] = {}
    for _ in range(rounds):
        for cell in todo:
            for shop, own in zip(shops, runs, strict=True):
                remaining = end - time.perf_counter()
                if not shop.ready(cell):
                    left_out[cell.place] = "its fit was not finished" if cell.verb in ON_FIT else "no study"
                elif remaining < 3.0:
                    left_out[cell.place] = "no time in a quick run"
                else:
                    one = shop.measured(cell, limit, remaining)
                    own.setdefault(cell.place, []).append(one)
                    print(f"{' '.join(cell.place)}: {one.cpu:.1f} CPU s, {one.outcome}", file=sys.stderr)
    rows = []
    for cell in todo:
        if cell.place not in runs[0]:
            verb, study = cell.place
            why = {"outcome": "left out", "message": left_out[cell.place], "runs": 0}
            rows.append({"verb": verb, "study": study} | why)
            continue
        fits = runs[0].get(("fit", cell.place[1]), [])
        row = row_of(cell, runs[0][cell.place], fits)
        if len(shops) > 1 and cell.place in runs[1]:
            pairs = [
                (a.cpu, b.cpu)
                for a, b in zip(runs[0][cell.place], runs[1][cell.place], strict=False)
                if a.outcome == b.outcome == "done"
            ]
            row["other_over_this"] = ratio([b for _, b in pairs], [a for a, _ in pairs])
        rows.append(row)
    return {"jobs": jobs, "rounds": rounds, "studies": [each.name for each in studies], "rows": rows}
