"""Killed runs: what resumes them gives the numbers of a run that was let end, and leaves nothing behind.

The short form of `studies/robustness/kill.py`, at moments when something is half done.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.paper.staticoptics import OpticsPlan
from lcopa_bayes.results.runfolder import LOCK, locked
from lcopa_bayes.verbs.papers import optics

sys.path.insert(0, str(Path(__file__).parents[2] / "studies" / "robustness"))
import kill

HOLDING = """
import sys, time
from pathlib import Path
from lcopa_bayes.results.runfolder import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(300)
"""
pytestmark = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads the process table")


@pytest.fixture(scope="module")
def studies(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("studies")
    kill.write_studies(folder, devices="ab", samples=40)
    return folder


def contents(studies: Path, out: Path, *words: str) -> dict:
    """Of a run that is let end, in this process alone: results do not depend on how many there are. Its
    figures are empty: they are drawn from what is compared."""
    verb, source, *given, _ = kill.COMMANDS["fleet"]
    command = [verb, str(studies / source), *given, "--jobs", "1", "--quiet", "--out", str(out), *words]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.report.svg.svg_of", lambda figure: "<svg></svg>")
        assert main(command) == 0
    assert [one.name for one in out.rglob("*") if one.name.startswith((".", "tmp"))] == []
    return kill.contents(out)


@pytest.fixture(scope="module")
def fleet(studies, tmp_path_factory) -> dict:
    return contents(studies, tmp_path_factory.mktemp("runs") / "fleet")


@pytest.mark.parametrize(
    "target", [pytest.param(one, marks=[pytest.mark.slow] * (one != "parent")) for one in kill.TARGETS]
)
def test_a_killed_fleet_goes_on_to_the_same_table(studies, fleet, tmp_path, target):
    """When the first device has begun and none has ended, or one has."""
    out = tmp_path / "fleet"
    process = kill.start("fleet", studies, out, jobs=2)
    assert kill.wait_for(lambda: any(out.rglob("device.json")), 60.0)
    problems, ended = kill.kill(process, target, random.Random(0))
    assert (problems, ended) == ([], False)
    assert list(kill.differences(contents(studies, out, "--resume"), fleet)) == []


def test_a_run_into_the_folder_of_another_is_refused(studies, tmp_path, capsys):
    out = tmp_path / "run"
    first = kill.start("run", studies, out, jobs=1)
    try:
        assert kill.wait_for((out / LOCK).exists, 60.0)
        os.kill(first.pid, signal.SIGSTOP)
        assert main(["run", str(studies / "sampled"), "--jobs", "1", "--out", str(out), "--resume"]) == 2
    finally:
        os.kill(first.pid, signal.SIGCONT)
        problems, _ = kill.kill(first, "both", random.Random(0))
    said = capsys.readouterr().err
    assert "another run is writing there" in said
    assert said.count("error") == 1
    assert problems == []


def test_what_a_killed_process_was_writing_is_removed_and_nothing_else(tmp_path):
    (tmp_path / "tables").mkdir()
    for name in (".part-a-x.csv", "tables/.part-b-y.csv", "tables/b.csv", ".own"):
        (tmp_path / name).write_text("half")
    with locked(tmp_path):
        assert (tmp_path / LOCK).read_text() == str(os.getpid())
    assert (tmp_path / ".part-a-x.csv").exists()  # no run was killed here: it may be another one's
    (tmp_path / LOCK).write_text("4194304")
    with locked(tmp_path):
        left = sorted(str(one.relative_to(tmp_path)) for one in tmp_path.rglob("*"))
        assert left == [LOCK, ".own", "tables", "tables/b.csv"]


def test_what_a_killed_worker_was_writing_is_removed(tmp_path):
    for ending, left in ((InputError("a worker process ended"), False), (None, True)):
        with suppress(InputError), locked(tmp_path):
            (tmp_path / ".part-x.csv").write_text("half")
            if ending is not None:
                raise ending
        assert (tmp_path / ".part-x.csv").exists() is left


@pytest.mark.usefixtures("undrawn")
def test_pages_are_not_written_while_another_run_writes(tmp_path):
    result = optics(OpticsPlan(targets_deg=(0.0,), voltages=(2.0,)))
    result.save(tmp_path)
    child = subprocess.Popen([sys.executable, "-c", HOLDING, str(tmp_path)], stdout=subprocess.PIPE)
    try:
        assert child.stdout.readline()
        with pytest.raises(InputError, match=f"another run is writing there .process {child.pid}."):
            result.report(tmp_path)
    finally:
        child.kill()
        child.communicate()
    assert result.report(tmp_path).exists()
    assert not (tmp_path / LOCK).exists()
