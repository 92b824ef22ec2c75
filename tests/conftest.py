"""Fixtures of all tests."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

import numpy as np
import pytest

from lcopa_bayes.cli import keep_one_thread


def pytest_configure() -> None:
    """Workers of pytest-xdist inherit one thread each: with more they wait for each other."""
    keep_one_thread()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260710)


@contextmanager
def _undrawn() -> Iterator[None]:
    empty = '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1 1"></svg>'
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.report.svg.svg_of", lambda figure: empty)
        yield


@pytest.fixture(scope="session")
def undrawing() -> Callable[[], AbstractContextManager[None]]:
    """Within what it gives figures are empty, in this process; for fixtures of a module."""
    return _undrawn


@pytest.fixture
def undrawn() -> Iterator[None]:
    """Empty figures, for what a page says in words."""
    with _undrawn():
        yield
