"""Fixtures of all tests."""

import os
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from matplotlib.figure import Figure

from lcopa_bayes.cli import keep_one_thread
from lcopa_bayes.core.parallel import cores


def pytest_configure() -> None:
    """Workers of pytest-xdist inherit one thread each: with more they wait for each other. Processes that
    tests start read the package compiled, which takes a fifth of their start where none may keep it."""
    keep_one_thread()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.dont_write_bytecode = False


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """One more than there are cores: a test that waits for a process or a disk leaves its core idle."""
    return cores() + 1


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260710)


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Empty figures, for what a page says in words."""
    empty = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"></svg>'
    monkeypatch.setattr("lcopa_bayes.report.svg.svg_of", lambda figure: empty)
    # half the time of the figures of a fit goes into the axes of this one
    monkeypatch.setattr("lcopa_bayes.report.draws.corner_figure", lambda run, names: Figure())


@pytest.fixture(scope="module")
def short_benches() -> Iterator[None]:
    """Designs try bench times of up to four spans of the records, not 400."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.experiments.candidates.SPANS", (1, 2, 4))
        yield
