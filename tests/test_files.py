"""Files appear whole or not at all, and a folder that cannot be written to is told at once."""

from __future__ import annotations

import os

import pytest

from lcopa_bayes import files
from lcopa_bayes.files import writable_folder, write_text, write_whole
from lcopa_bayes.problems import InputError


def test_a_file_is_written_and_replaced(tmp_path):
    path = tmp_path / "a.txt"
    write_text(path, "eins\n")
    write_text(path, "zwei ü\n")
    assert path.read_text(encoding="utf-8") == "zwei ü\n"
    assert os.listdir(tmp_path) == ["a.txt"]
    assert path.stat().st_mode & 0o777 == 0o644


@pytest.mark.parametrize("failure", [OSError("disk full"), ValueError("bad"), KeyboardInterrupt()])
def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def half(beside):
        assert beside.parent == tmp_path  # renaming across file systems would not be atomic
        assert beside.suffix == ".txt"
        beside.write_text("half of the n")
        assert path.read_text() == "old"
        raise failure

    with pytest.raises(type(failure)):
        write_whole(path, half)
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_failed_rename_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "a.txt"
    write_text(path, "old")

    def refuse(*_):
        raise OSError("no")

    monkeypatch.setattr(files.os, "replace", refuse)
    with pytest.raises(OSError, match="no"):
        write_text(path, "new")
    assert path.read_text() == "old"
    assert os.listdir(tmp_path) == ["a.txt"]


def test_a_folder_is_made_with_its_parents_and_left_empty(tmp_path):
    folder = tmp_path / "a" / "b"
    assert writable_folder(folder) == folder == writable_folder(folder)
    assert os.listdir(folder) == []


def test_a_file_in_the_way_is_told(tmp_path):
    (tmp_path / "a").write_text("")
    for folder in (tmp_path / "a", tmp_path / "a" / "b"):
        with pytest.raises(InputError, match="output folder cannot be written to") as caught:
            writable_folder(folder)
        assert str(folder) in caught.value.problems[0]
        assert "--out" in caught.value.problems[0]


def test_a_folder_without_permission_is_told(tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.tempfile, "NamedTemporaryFile", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        writable_folder(tmp_path)
    monkeypatch.setattr(files.Path, "mkdir", refuse)
    with pytest.raises(InputError, match="Permission denied"):
        writable_folder(tmp_path / "new")
