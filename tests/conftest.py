"""Fixtures of all tests."""

import os

import numpy as np
import pytest


def pytest_configure() -> None:
    """Workers of pytest-xdist inherit one thread each: with more they wait for each other."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20260710)
