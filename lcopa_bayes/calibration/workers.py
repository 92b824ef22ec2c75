"""Who does the replicas: this process, others on this machine, or a Dask cluster of the user's."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager
from importlib import import_module
from multiprocessing import get_context
from typing import Any, TypeAlias

from threadpoolctl import threadpool_limits

from lcopa_bayes.calibration.replica import Failure, Outcome, Replication
from lcopa_bayes.core.errors import InputError

Perform: TypeAlias = Callable[[Sequence[int]], Iterator[Outcome | Failure]]
"""Replicas of these numbers, in the order they are finished."""
CONNECT = 5.0
"""Time a scheduler has to answer [s]."""
_ADVICE = "what was finished is stored; go on with --resume"


def crew(replication: Replication, *, jobs: int, dask: str | None) -> AbstractContextManager[Perform]:
    """Replicas on the cluster at the address `dask`, or in `jobs` processes; what they give is the same.

    InputError when there is no such cluster, and when workers are lost.
    """
    return _cluster(replication, dask) if dask is not None else _here(replication, jobs)


@contextmanager
def _here(replication: Replication, jobs: int) -> Iterator[Perform]:
    """This process, or `jobs` others with one thread each."""
    if jobs <= 1:
        yield lambda numbers: map(replication.attempt, numbers)
        return
    pool = ProcessPoolExecutor(
        jobs, mp_context=get_context("spawn"), initializer=_take_up, initargs=(replication,)
    )

    def perform(numbers: Sequence[int]) -> Iterator[Outcome | Failure]:
        for future in as_completed([pool.submit(_perform, number) for number in numbers]):
            yield future.result()

    try:
        yield perform
    except BrokenProcessPool:
        raise InputError(f"a worker process ended, perhaps for want of memory; {_ADVICE}") from None
    finally:
        pool.shutdown(cancel_futures=True)


_replication: Replication | None = None
"""What a worker process does replicas of; set once when the process starts."""


def _take_up(replication: Replication) -> None:
    global _replication
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an interrupt ends a worker without a word
    threadpool_limits(1)
    _replication = replication


def _perform(number: int) -> Outcome | Failure:
    assert _replication is not None
    return _replication.attempt(number)


@contextmanager
def _cluster(replication: Replication, address: str) -> Iterator[Perform]:
    """The workers of the scheduler at an address."""
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise InputError("--dask needs the package distributed: pip install 'lcopa-bayes[dask]'") from None
    try:
        client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"--dask {address}: no Dask scheduler answers there ({error}); "
            "start one with `dask scheduler`, and give the address it prints, such as tcp://host:8786"
        ) from None

    def perform(numbers: Sequence[int]) -> Iterator[Outcome | Failure]:
        # sent once; a worker that needs it takes it from another
        shared = client.submit(_same, replication, pure=False)
        futures = {client.submit(_attempt, shared, number, pure=False): number for number in numbers}
        for future in distributed.as_completed(futures, loop=client.loop):
            yield _gathered(future, futures[future], replication)

    try:
        with client:
            yield perform
    except distributed.client.FutureCancelledError as error:
        raise InputError(f"--dask {address}: the scheduler was lost ({error}); {_ADVICE}") from None


def _same(replication: Replication) -> Replication:
    return replication


def _attempt(replication: Replication, number: int) -> Outcome | Failure:
    return replication.attempt(number)


def _gathered(future: Any, number: int, replication: Replication) -> Outcome | Failure:
    """What a worker sent back; what the cluster itself could not do is a failure of the replica."""
    if future.status == "error":
        error = future.exception()
        return Failure(number, replication.seed_of(number), f"{type(error).__name__}: {error}")
    outcome: Outcome | Failure = future.result()
    return outcome
