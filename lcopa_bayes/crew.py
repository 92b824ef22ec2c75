"""Who runs ensembles: this process, or several of one thread each."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing import get_context
from typing import Any

from threadpoolctl import threadpool_limits


@contextmanager
def crew(workers: int) -> Iterator[Callable[..., list[Any]]]:
    """A map of a function over tasks, in order, by that many processes where there are several."""
    if workers <= 1:
        with threadpool_limits(1):
            yield lambda function, tasks: [function(task) for task in tasks]
        return
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=_ready) as pool:
        yield lambda function, tasks: list(pool.map(function, tasks))


def _ready() -> None:
    import numpy  # noqa: F401 - its threads can only be limited once they are there
    import scipy.linalg  # noqa: F401

    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an interrupt ends a worker without a word
    threadpool_limits(1)
