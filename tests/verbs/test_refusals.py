"""What the system refuses, in one sentence wherever it refuses: nothing half written, no trace of a stack."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from small import record

from lcopa_bayes import cli
from lcopa_bayes.cli import main
from lcopa_bayes.core import files
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data import studyfile
from lcopa_bayes.data.record import save_record
from lcopa_bayes.data.studyfile import load_study

FULL, QUOTA, READ_ONLY, DENIED = (
    (errno.ENOSPC, "No space left on device"),
    (errno.EDQUOT, "Disk quota exceeded"),
    (errno.EROFS, "Read-only file system"),
    (errno.EACCES, "Permission denied"),
)
VERBS = (
    "check",
    "look",
    "fit",
    "run",
    "audit",
    "design",
    "compare",
    "loop",
    "calibrate",
    "identify",
    "fleet",
)


def refusing(number: int):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    return refuse


@pytest.fixture
def folder(tmp_path) -> Path:
    (tmp_path / "devices").mkdir()
    place = tmp_path / "devices" / "a"
    place.mkdir()
    save_record(record(camera=0.8), place / "step.csv")
    (place / "study.toml").write_text('[model]\nterms = 1\n[noise]\nkind = "white"\n')
    return tmp_path


@pytest.mark.parametrize(("number", "reason"), [FULL, QUOTA, READ_ONLY, DENIED])
@pytest.mark.parametrize("verb", VERBS)
def test_a_folder_that_takes_nothing_is_said_before_anything_is_computed(
    folder, monkeypatch, capsys, verb, number, reason
):
    monkeypatch.setattr(files.tempfile, "NamedTemporaryFile", refusing(number))
    source, out = folder / "devices" / ("" if verb == "fleet" else "a"), folder / "out"
    assert (
        main([verb, str(source), "--out", str(out), "--jobs", "1"][: 4 if verb in ("check", "look") else 6])
        == 2
    )
    said = capsys.readouterr().err
    assert (
        said.removeprefix(f"{verb}: loading\n")
        == f"error: {out}: the output folder cannot be written to ({reason}); choose another with --out\n"
    )
    assert not out.exists()


@pytest.mark.parametrize(("number", "reason"), [FULL, QUOTA])
def test_a_disk_that_is_full_elsewhere_is_one_sentence(folder, monkeypatch, capsys, number, reason):
    """Where temporary files are, which no option names."""
    monkeypatch.setattr(cli, "_outcome", refusing(number))
    monkeypatch.setattr(cli.tempfile, "mkstemp", refusing(number))
    assert main(["check", str(folder / "devices" / "a")]) == 1
    said = capsys.readouterr().err
    assert said.startswith(f"error: {reason}; free some ")
    assert said.endswith("and give the same command again; what was finished before is kept\n")
    assert said.count("\n") == 1


def test_an_unforeseen_error_is_reported_though_its_details_find_no_room(folder, monkeypatch, capsys):
    def broken(*_):
        raise ZeroDivisionError("by zero")

    monkeypatch.setattr(cli, "_outcome", broken)
    monkeypatch.setattr(cli.tempfile, "mkstemp", refusing(errno.ENOSPC))
    assert main(["check", str(folder), "--json"]) == 1
    said = json.loads(capsys.readouterr().out)["errors"]
    assert said == ["unforeseen ZeroDivisionError: by zero; what was finished before is kept"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_an_output_that_takes_nothing_is_one_sentence():
    with Path("/dev/full").open("w") as full:
        command = [sys.executable, "-m", "lcopa_bayes.cli", "explain", "R-hat"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, text=True, check=False)
    assert done.stderr == "error: the output cannot be written (No space left on device)\n"
    assert done.returncode == 2


def test_a_record_that_vanishes_while_it_is_read_is_said(folder, monkeypatch):
    path, load = folder / "devices" / "a" / "step.csv", studyfile.load_record

    def vanishing(*given):
        read = load(*given)
        path.unlink()
        return read

    monkeypatch.setattr(studyfile, "load_record", vanishing)
    with pytest.raises(InputError) as caught:
        load_study(folder / "devices" / "a")
    assert caught.value.problems == (f"{path}: cannot be read (No such file or directory)",)
