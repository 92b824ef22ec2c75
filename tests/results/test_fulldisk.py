"""A full disk: what was there stays, what went wrong is said, and the run can be taken up again.

A limit on the size of files, which needs no privileges, stands for the full disk: both make the system
refuse a write part of the way. It is set in a process of its own, as HDF5 would crash it if it failed.
"""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small import record, study

from lcopa_bayes.cli import main
from lcopa_bayes.core import files
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import save_record
from lcopa_bayes.data.studywriter import write_folder

resource = pytest.importorskip("resource", reason="needs limits on the size of files")

SCRIPT = """
import json, resource, sys
from pathlib import Path
import numpy as np
from small import record, study
from lcopa_bayes.core.files import write_whole
from lcopa_bayes.results.fit import fit
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.results.datatree import posterior_tree, save_tree
from lcopa_bayes.sampling.sampler import sample

def limit(size):
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))

def refused(act):
    try:
        act()
    except InputError as error:
        return list(error.problems)
    return []

folder = Path(sys.argv[1])
sampler = {"ensembles": 2, "walkers": 8, "steps": 60, "thin": 1, "target_ess": 100_000}
priors = {  # close about the truth, so that tempering is short
    "delay": 0.73,
    "order_1": 0.8,
    "time_1": ("uniform", {"loc": 1.3, "scale": 0.4}),
    "sigma": ("uniform", {"loc": 0.01, "scale": 0.02}),
}
task = study(record(camera=0.8), sampler=sampler, priors=priors)
reported = {}
path = folder / "chain.h5"
limit(int(sys.argv[2]))
reported["chain"] = refused(lambda: fit(task, folder=folder))
reported["left"] = sorted(p.name for p in folder.iterdir())
kept = path.read_bytes()
reported["again"] = refused(lambda: fit(task, folder=folder, resume=True))
reported["kept"] = path.read_bytes() == kept
limit(resource.RLIM_INFINITY)
resumed = fit(task, folder=folder, resume=True)
whole = sample(resumed.problem.posterior, resumed.run.plan)
pairs = zip(whole.ensembles, resumed.run.ensembles, strict=True)
reported["same"] = all(np.array_equal(one.chain, other.chain) for one, other in pairs)
reported["sizes"] = len(kept), path.stat().st_size

tree = posterior_tree(resumed, compact=True)

def save():
    write_whole(folder / "posterior.nc", lambda beside: save_tree(tree, beside))

save()
before = (folder / "posterior.nc").read_bytes()
reported["sizes"] += (len(before),)
reported["posterior"] = []
for size in (0, len(before) // 2, len(before) - 1):
    limit(size)
    reported["posterior"] += refused(save)
limit(resource.RLIM_INFINITY)
reported["intact"] = (folder / "posterior.nc").read_bytes() == before
reported["stray"] = sorted(p.name for p in folder.rglob(".*"))
save()
print(json.dumps(reported))
"""
LIMIT = 30_000
"""Room for a chain of one round, not of two [bytes]."""


@pytest.fixture(scope="module")
def reported(tmp_path_factory) -> dict:
    folder = tmp_path_factory.mktemp("full")
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(folder), str(LIMIT)],
        cwd=Path(__file__).parents[1],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr
    return json.loads(done.stdout) | {"folder": str(folder)}


def test_a_chain_that_no_longer_fits_keeps_the_rounds_before(reported):
    (said,) = reported["chain"]
    assert said.startswith(f"{reported['folder']}/chain.h5: cannot be written (File too large)")
    assert "--resume" in said
    assert reported["left"] == ["chain.h5"]
    assert len(reported["again"]) == 1
    assert reported["kept"]
    assert reported["sizes"][0] <= LIMIT < reported["sizes"][1]


def test_the_run_is_taken_up_to_the_same_draws(reported):
    assert reported["same"]


def test_a_posterior_that_does_not_fit_leaves_the_old_one(reported):
    assert len(reported["posterior"]) == 3
    for said in reported["posterior"]:
        assert said.startswith(f"{reported['folder']}/posterior.nc: cannot be written (File too large)")
    assert reported["intact"]
    assert reported["stray"] == []


def full(*_, **__):
    raise OSError(errno.ENOSPC, "No space left on device")


STUDY = """[records]
fit = ["a.csv"]
[model]
terms = 1
[noise]
kind = "white"
[priors]
delay = 0.73
order_1 = 0.8
[sampler]
target_ess = 50
"""


@pytest.fixture(scope="module")
def sampled(tmp_path_factory) -> list[str]:
    """The command of a run whose sampling is done, so that repeating it with --resume is quick."""
    folder = tmp_path_factory.mktemp("study")
    save_record(record(camera=0.8), folder / "a.csv")
    (folder / "study.toml").write_text(STUDY)
    command = ["fit", str(folder / "study.toml"), "--jobs", "1", "--quiet", "--out", str(folder / "out")]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.report.svg.svg_of", lambda figure: "<svg></svg>")
        assert main(command) == 0
    return [*command, "--resume"]


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    "at",
    [
        "results.json",
        *(
            pytest.param(one, marks=pytest.mark.slow)
            for one in ("posterior.nc", "report.html", "parameters.csv", "data_01_a_y.svg")
        ),
    ],
)
def test_whatever_file_fails_ends_with_exit_code_2(sampled, monkeypatch, capsys, at):
    out, replace = Path(sampled[-2]), os.replace
    (path,) = out.rglob(at)
    old = path.read_bytes()

    def replaced(source, target):
        return full() if Path(target).name == at else replace(source, target)

    monkeypatch.setattr(files.os, "replace", replaced)
    assert main(sampled) == 2
    said = capsys.readouterr().err
    assert f"{path}: cannot be written (No space left on device); free some space" in said
    assert "Traceback" not in said
    assert not list(out.rglob(".*"))
    assert path.read_bytes() == old


def test_the_first_save_of_a_run_promises_nothing(tmp_path, monkeypatch, capsys):
    """The chain that lies there is another run's; ensembles are stored before their first step."""
    save_record(record(camera=0.8), tmp_path / "a.csv")
    (tmp_path / "study.toml").write_text(f"{STUDY}ensembles = 2\nwalkers = 8\nsteps = 40\nthin = 1\n")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "chain.h5").write_bytes(b"of another run")
    monkeypatch.setattr(files.os, "fsync", full)
    command = ["fit", str(tmp_path / "study.toml"), "--out", str(tmp_path / "out"), "--jobs", "1", "--quiet"]
    assert main(command) == 2
    assert "--resume" not in capsys.readouterr().err
    assert (tmp_path / "out" / "chain.h5").read_bytes() == b"of another run"


@pytest.mark.parametrize("at", ["fsync", "replace"])
def test_a_campaign_that_does_not_fit_names_its_file_and_leaves_nothing(tmp_path, monkeypatch, at):
    monkeypatch.setattr(files.os, at, full)
    with pytest.raises(InputError) as caught:
        write_folder(tmp_path, study(record(camera=0.8)))
    assert str(tmp_path / "step.csv") + ": cannot be written (No space" in caught.value.problems[0]
    assert list(tmp_path.iterdir()) == []


def test_a_campaign_in_a_folder_that_cannot_be_made_is_reported(tmp_path, monkeypatch):
    monkeypatch.setattr(files.Path, "mkdir", full)
    with pytest.raises(InputError, match="cannot be written to"):
        write_folder(tmp_path / "new", study(record(camera=0.8)))


def test_figures_that_cannot_be_kept_are_reported(tmp_path):
    from lcopa_bayes.report import write_page

    (tmp_path / "figures").write_text("a file in the way")
    with pytest.raises(InputError, match="figures"):
        write_page(tmp_path, "claims.html", "it", {"verdict": "", "claims": []}, {"claims": []})
