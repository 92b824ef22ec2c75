"""The command line shares work out to processes; libraries of linear algebra keep to one thread."""

from __future__ import annotations

import os

import pytest

from lcopa_bayes.cli import main


@pytest.mark.parametrize(("given", "expected"), [(None, "1"), ("3", "3")], ids=["unset", "stated"])
def test_threads_are_one_unless_stated(
    given: str | None, expected: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        monkeypatch.setenv(name, "0")  # restored after the test
        monkeypatch.delenv(name)
        if given is not None:
            monkeypatch.setenv(name, given)
    assert main(["explain", "nat"]) == 0
    assert capsys.readouterr().out
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        assert os.environ[name] == expected
