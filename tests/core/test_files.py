"""Files appear whole or not at all, and a folder that cannot be written to is reported at once."""

from __future__ import annotations

import errno
import os

import pytest

from lcopa_bayes.core import files
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import writable_folder, write_text, write_whole


def test_a_file_is_written_and_replaced(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "eins\n")
    write_text(path, "zwei ü\n")
    assert path.read_text(encoding="utf-8") == "zwei ü\n"
    assert os.listdir(tmp_path) == ["a.txt"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize(
    "failure", [OSError("odd"), ValueError("bad"), RuntimeError("bug"), KeyboardInterrupt()]
)
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def half(beside):
        assert beside.parent == tmp_path  # renaming across file systems would not be atomic
        assert beside.suffix == ".txt"
        beside.write_text("half of the n")
        assert path.read_text() == "old"
        raise failure

    with pytest.raises(InputError if isinstance(failure, OSError) else type(failure)):
        write_whole(path, half)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_failed_rename_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def refuse(*_):
        raise OSError("no")

    monkeypatch.setattr(files.os, "replace", refuse)
    with pytest.raises(InputError, match=r"a\.txt: cannot be written \(no\)"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_folder_is_made_with_its_parents_and_left_empty(tmp_path):
    folder = tmp_path / "a" / "b"
    assert writable_folder(folder) == folder == writable_folder(folder)
    assert os.listdir(folder) == []


def test_a_file_in_the_way_is_reported(tmp_path):
    (tmp_path / "a").write_text("")
    for folder in (tmp_path / "a", tmp_path / "a" / "b"):
        with pytest.raises(InputError, match="output folder cannot be written to") as caught:
            writable_folder(folder)
        assert str(folder) in caught.value.problems[0]
        assert "--out" in caught.value.problems[0]


def test_a_folder_without_permission_is_reported(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.tempfile, "NamedTemporaryFile", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        writable_folder(tmp_path)
    monkeypatch.setattr(files.Path, "mkdir", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        writable_folder(tmp_path / "new")


@pytest.mark.parametrize(
    ("failure", "reason", "remedy"),
    [
        (OSError(errno.ENOSPC, "any"), "No space left on device", "free some space"),
        (OSError(errno.EDQUOT, "any"), "quota exceeded", "free some of your quota"),
        (OSError(errno.EFBIG, "any"), "File too large", "ulimit -f"),
        (PermissionError(errno.EACCES, "any"), "Permission denied", "another folder with --out"),
        (OSError(errno.EROFS, "any"), "Read-only file system", "another folder with --out"),
        (OSError(errno.EIO, "any"), "Input/output error", "another folder with --out"),
        (OSError("odd"), "odd", "another folder with --out"),
    ],
)
@pytest.mark.parametrize("place", ["mkstemp", "write", "fsync", "replace"])
def test_what_the_system_refuses_is_reported_with_file_reason_and_remedy(
    tmp_path, monkeypatch, failure, reason, remedy, place
):
    path = tmp_path / "a.h5"
    path.write_text("old")

    def refuse(*_, **__):
        raise failure

    with monkeypatch.context() as patch:
        if place != "write":
            patch.setattr(files.tempfile if place == "mkstemp" else files.os, place, refuse)
        with pytest.raises(InputError) as caught:
            write_whole(path, refuse if place == "write" else lambda beside: beside.write_text("new"))
    (said,) = caught.value.problems
    assert said.startswith(f"{path}: cannot be written (")
    assert reason in said
    assert remedy in said
    assert (path.read_text(), os.listdir(tmp_path)) == ("old", ["a.h5"])


def test_a_folder_that_is_gone_is_reported(tmp_path):
    with pytest.raises(InputError, match="No such file or directory"):
        write_text(tmp_path / "gone" / "a.txt", "new")
