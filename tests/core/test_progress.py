"""Progress in a log: lines that name what is done, none where nothing changed or nothing is wanted."""

from __future__ import annotations

import pytest

from lcopa_bayes.core import progress
from lcopa_bayes.core.progress import Progress


@pytest.fixture
def at_once(monkeypatch):
    monkeypatch.setattr(progress, "_LINES", 0.0)


def lines(capsys) -> list[str]:
    return [line.strip("\r") for line in capsys.readouterr().err.split("\n") if line.strip()]


def test_lines_say_how_far_the_work_is(at_once, capsys):
    with Progress(total=4, unit="round", desc="from the prior") as bar:
        bar.update()
        bar.set_description("sampling")
        bar.set_postfix(ess="12")
        bar.update(3)
    said = lines(capsys)
    assert said[0].startswith("from the prior: 0/4 rounds")
    assert any(line.startswith("sampling: 1/4 rounds") and "ess=12" in line for line in said)
    assert said[-1].startswith("sampling: 4/4 rounds")
    assert len(said) == len(set(said))


def test_a_long_interval_keeps_a_log_short(capsys):
    for _ in Progress(range(500), total=500, unit="path", desc="identifying"):
        pass
    assert len(lines(capsys)) == 2  # the first and the last


def test_quiet_shows_nothing(at_once, capsys):
    with Progress(total=4, unit="round", desc="sampling", quiet=True) as bar:
        bar.set_description("other")
        bar.set_postfix(ess="12")
        bar.update(4)
    assert lines(capsys) == []


def test_work_of_unknown_length_is_counted(at_once, capsys):
    with Progress(total=0, unit="candidate", desc="searching") as bar:
        bar.update(7)
    assert lines(capsys)[-1].startswith("searching: 7 candidates")
