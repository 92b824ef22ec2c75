"""Processes: how many this one may run, and independent tasks done in several of one thread each."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from threadpoolctl import threadpool_limits


@contextmanager
def crew(workers: int) -> Iterator[Callable[..., Iterable[Any]]]:
    """A map of a function over tasks, in order and as they are done, by that many processes where there are
    several."""
    if workers <= 1:
        with threadpool_limits(1):
            yield map
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_ready) as pool:
        yield pool.map


def _ready() -> None:
    import numpy  # noqa: F401 - its threads can only be limited once they are there
    import scipy.linalg  # noqa: F401

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an interrupt ends a worker without a word
    threadpool_limits(1)


def cores() -> int:
    """Processors available to this process, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
