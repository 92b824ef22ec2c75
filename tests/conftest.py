"""Fixtures of all tests."""

import numpy as np
import pytest

from lcopa_bayes.cli import keep_one_thread


def pytest_configure() -> None:
    """Workers of pytest-xdist inherit one thread each: with more they wait for each other."""
    keep_one_thread()


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260710)
