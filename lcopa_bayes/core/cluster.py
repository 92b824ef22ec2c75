"""A Dask cluster: whether it can take part, and how tasks get to its workers.

Tasks and what they share go as bytes that this package packs and unpacks. What many tasks need is held by the
cluster and sent to a worker once; the scheduler knows how it came there, so that no lost worker takes it
along.
"""

from __future__ import annotations

import platform
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from importlib.metadata import version
from typing import Any, final

from threadpoolctl import threadpool_limits

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.packing import Latest, unpacked

CONNECT = 5.0
"""Time a Dask scheduler has to answer [s]."""
ADVICE = "what was finished is stored; go on with --resume"
_ALIKE = "install the same versions on every worker"
_LARGE = 1 << 14
"""Size from which a task is held by the cluster and not sent with each of its inputs [byte]."""
_unpacked = Latest(2)
"""Keeps a task and what it shares, in a worker."""


@final
class Cluster:
    """A Dask cluster that answers."""

    def __init__(self, distributed: Any, client: Any) -> None:
        self._distributed, self._client = distributed, client

    @property
    def size(self) -> int:
        """Tasks that its workers do at once."""
        return sum(self._client.nthreads().values())

    def giving(self, shared: bytes | None) -> Callable[[int, bytes, bytes], Any]:
        """What gives a task with its number, packed, and its input to a worker, a future; tasks share a
        value."""
        common = None if shared is None else self._held(shared)
        latest: tuple[int, Any] = (0, None)

        def give(number: int, work: bytes, given: bytes) -> Any:
            nonlocal latest
            if latest[0] != number:
                latest = number, self._held(work) if len(work) > _LARGE else work
            return self._client.submit(_perform, latest[1], common, given, pure=False)

        return give

    def as_finished(self, futures: Sequence[Any]) -> Iterator[Any]:
        """Futures as they finish."""
        return iter(self._distributed.as_completed(futures, loop=self._client.loop))

    def _held(self, sent: bytes) -> Any:
        with warnings.catch_warnings():  # advises to scatter it, where it would be lost with its worker
            warnings.filterwarnings("ignore", "Sending large graph")
            return self._client.submit(_same, sent, pure=False)


@contextmanager
def connected(address: str) -> Iterator[Cluster]:
    """The cluster at an address. InputError where none answers there, its workers are unlike this process,
    and when it, or a task with its worker, is lost."""
    try:
        distributed = import_module("distributed")
    except ImportError:
        raise InputError("--dask needs the package distributed: pip install 'lcopa-bayes[dask]'") from None
    try:
        with ThreadPoolExecutor(1) as beside:  # a notebook has a loop of its own here
            beside.submit(_ask, distributed, address).result()
        client = distributed.Client(address, timeout=CONNECT, set_as_default=False)
    except Exception as error:  # whatever another service than a scheduler answers leads to
        raise InputError(
            f"--dask {address}: no Dask scheduler answers there ({str(error) or 'it says nothing'}); "
            "start one with `dask scheduler`, and give the address it prints, such as tcp://host:8786"
        ) from None
    try:
        with client:
            _refuse_unlike(client, address)
            yield Cluster(distributed, client)
    except distributed.client.FutureCancelledError as error:
        raise InputError(f"--dask {address}: the scheduler was lost ({error}); {ADVICE}") from None
    except distributed.scheduler.KilledWorker as error:
        raise InputError(
            f"--dask {address}: a task was lost with its workers, perhaps for want of memory ({error}); "
            f"{ADVICE}"
        ) from None


def _ask(distributed: Any, address: str) -> None:
    """Wait for the answer of a scheduler, for which a client would wait without end."""
    import asyncio  # loaded where a cluster is used

    async def identity() -> None:
        keys = distributed.Security().get_connection_args("client")
        scheduler = distributed.rpc(address, timeout=CONNECT, connection_args=keys)
        async with asyncio.timeout(CONNECT + 1), scheduler:
            await scheduler.identity(n_workers=0)

    asyncio.run(identity())


def _refuse_unlike(client: Any, address: str) -> None:
    """InputError where a cluster has no worker, or one whose versions would give other numbers or none."""
    try:
        client.wait_for_workers(1, timeout=CONNECT)
    except TimeoutError:
        raise InputError(
            f"--dask {address}: the cluster has no worker; start some with `dask worker {address}`"
        ) from None
    own = _versions()
    for worker, theirs in client.run(_versions, on_error="return").items():
        if isinstance(theirs, Exception):
            raise InputError(f"--dask {address}: the worker {worker} cannot take part ({theirs}); {_ALIKE}")
        unlike = [
            f"{name} {theirs.get(name)}, here {known}"
            for name, known in own.items()
            if theirs.get(name) != known
        ]
        if unlike:
            raise InputError(f"--dask {address}: the worker {worker} has {'; '.join(unlike)}; {_ALIKE}")


def _versions() -> dict[str, str]:
    """Versions on which numbers and what is sent depend."""
    major, minor, *_ = platform.python_version_tuple()
    packages = ("lcopa-bayes", "numpy", "scipy", "distributed")
    return {"Python": f"{major}.{minor}"} | {name: version(name) for name in packages}


def _perform(work: bytes, shared: bytes | None, given: bytes) -> Any:
    """A task on a worker. It gives no work to the cluster itself, so that xarray takes no lock of the
    scheduler for a file in memory, which that has no name for."""
    with import_module("dask").config.set(scheduler="synchronous"):
        task, common = _unpacked(work), None if shared is None else _unpacked(shared)
        with threadpool_limits(1):  # of what these have loaded too
            return task(common, unpacked(given))


def _same(sent: bytes) -> bytes:
    return sent
