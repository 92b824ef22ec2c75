"""Workers: independent tasks done in this process, in several of one thread each, or on a Dask cluster."""

from __future__ import annotations

import ctypes
import os
import pickle
import platform
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from functools import partial
from importlib import import_module
from importlib.metadata import version
from itertools import chain
from multiprocessing import forkserver, parent_process
from multiprocessing.context import BaseContext, SpawnContext, SpawnProcess
from threading import Thread
from typing import Any, Generic, TypeVar, final

from threadpoolctl import threadpool_limits

from lcopa_bayes.core.errors import InputError

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")
_MMAP_THRESHOLD, _TRIM_THRESHOLD = (-3, 32 << 20), (-1, 256 << 20)
"""Options of the allocator of the GNU C library with their values: arrays below 32 MB, the most it takes,
come from the heap, and up to 256 MB at its end are kept when they are freed [byte]."""
CONNECT = 5.0
"""Time a Dask scheduler has to answer [s]."""
_SCRIPT = b"__main__"
"""Where the main script keeps what it defines, which no worker imports."""
_ALIKE = "install the same versions on every worker"
_ADVICE = "what was finished is stored; go on with --resume"


@final
class Workers(Generic[S]):
    """What does tasks `task(shared, one)`; the results do not depend on who it is."""

    def __init__(self, submit: Callable[..., Any], as_finished: Callable[..., Iterator[Any]]) -> None:
        """By what gives a task and its input to a worker, a future, and what gives futures as they finish."""
        self._submit, self._as_finished = submit, as_finished

    def each(self, task: Callable[[S, T], R], inputs: Sequence[T]) -> Iterator[R]:
        """Results in the order of the inputs."""
        futures = [self._submit(task, one) for one in inputs]
        return (future.result() for future in futures)

    def finished(
        self,
        task: Callable[[S, T], R],
        inputs: Sequence[T],
        failed: Callable[[T, BaseException], R] | None = None,
    ) -> Iterator[R]:
        """Results in the order in which they are finished. Where a task ends in an error, on a cluster also
        where it is lost with its worker, `failed` gives its result; without it the error is raised."""
        futures = {self._submit(task, one): one for one in inputs}
        for future in self._as_finished(futures):
            try:
                result = future.result()
            except (BrokenProcessPool, CancelledError):
                raise
            except Exception as error:
                if failed is None:
                    raise
                result = failed(futures[future], error)
            yield result

    def map(self, function: Callable[[T], R], inputs: Sequence[T]) -> Iterator[R]:
        """Results of a function that needs nothing shared, in the order of the inputs."""
        return self.each(partial(_alone, function), inputs)


@final
class _Later:
    """A task of this process, done when its result is asked for."""

    def __init__(self, task: Callable[[S, T], Any], shared: S, one: T) -> None:
        self.result = partial(task, shared, one)


@final
class _Tasks:
    """Tasks as they are sent to workers: pickled once for all inputs, with what they have cached."""

    _task: object = None
    _sent: tuple[int, bytes | None] = (0, None)

    def sent(self, task: object) -> tuple[int, bytes | None]:
        """Number of a task, by which a worker knows the one it did last, and its pickle, as `packed`."""
        if task is not self._task:
            self._task, self._sent = task, (self._sent[0] + 1, packed(task))
        return self._sent


@contextmanager
def workers(shared: S, *, jobs: int = 1, dask: str | None = None) -> Iterator[Workers[S]]:
    """Workers that share a value: `jobs` processes of one thread each, this one alone where `jobs` is 1, or
    those of the Dask cluster at the address `dask`. What no other process can read, such as an effect of a
    study's own file, is done by this one.

    Processes end with this one, however it ends, and do not run the main script again, so that a script needs
    no main guard. InputError when there is no such cluster, and when a worker or the cluster is lost.
    """
    keep_freed_memory()
    if dask is not None:
        with _cluster(shared, dask) as cluster:
            yield cluster
    elif jobs <= 1:
        with threadpool_limits(1):
            yield Workers(lambda task, one: _Later(task, shared, one), iter)
    else:
        sent, tasks = packed(shared), _Tasks()
        with _pool(jobs, sent) as pool, threadpool_limits(1):  # threads here would take the workers' cores

            def submit(task: Callable[[S, T], R], one: T) -> Any:
                number, work = tasks.sent(task)
                given = None if sent is None or work is None else packed(one)
                if work is None or given is None:
                    return _Later(task, shared, one)
                return pool.submit(_perform, number, work, given)

            yield Workers(submit, _as_finished)


@contextmanager
def meanwhile(
    task: Callable[[T], R], one: T, finished: Callable[[R], None], *, jobs: int = 1
) -> Iterator[None]:
    """Do a task in a process of its own while what is within runs, or before it where `jobs` is 1 or no other
    process can read the task; `finished` takes its result at once. An error of the task is raised at the
    end."""
    work, given = (None, None) if jobs <= 1 else (packed(partial(_alone, task)), packed(one))
    if work is None or given is None:
        finished(task(one))
        yield
        return
    with _pool(1, None) as pool:
        future = pool.submit(_perform, 1, work, given)
        future.add_done_callback(lambda done: None if done.exception() else finished(done.result()))
        yield
        future.result()


@contextmanager
def _pool(jobs: int, shared: bytes | None) -> Iterator[ProcessPoolExecutor]:
    """Processes of one thread each that share a pickled value; InputError when one is lost."""
    imported_ahead()
    pool = ProcessPoolExecutor(jobs, mp_context=_CONTEXT, initializer=_take_up, initargs=(shared,))
    try:
        yield pool
    except BrokenProcessPool:
        raise InputError(
            f"a worker process ended, perhaps for want of memory, or because it was given what the main "
            f"script itself defines, which belongs in a module; {_ADVICE}"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def packed(value: object) -> bytes | None:
    """A pickle; None where another process could not read it."""
    try:
        out = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return None if _SCRIPT in out else out


def unpacked(sent: bytes) -> Any:
    """What `packed` was given, in a process of its own; nothing else is read so."""
    return pickle.loads(sent)


def _as_finished(futures: Iterable[Any]) -> Iterator[Any]:
    """Tasks of this process while workers do theirs, then these as they finish."""
    own = [one for one in futures if isinstance(one, _Later)]
    return chain(own, as_completed(one for one in futures if not isinstance(one, _Later)))


def keep_freed_memory() -> None:
    """Keep memory that arrays leave for the next ones.

    By default the allocator of the GNU C library hands the temporaries of a batch back to the operating
    system and takes them anew as page faults, 3.7 million in a fit of a thousand samples: a quarter of its
    time. With another library this does nothing.
    """
    if sys.platform == "linux":
        mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
        if mallopt is not None:
            for option, value in (_MMAP_THRESHOLD, _TRIM_THRESHOLD):
                mallopt(option, value)


def cores() -> int:
    """Processors available to this process, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def _cluster(shared: S, address: str) -> Iterator[Workers[S]]:
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
            # sent once; a worker that needs it takes it from another
            held = client.submit(_same, shared, pure=False)
            yield Workers(
                lambda task, one: client.submit(_on_cluster, task, held, one, pure=False),
                partial(distributed.as_completed, loop=client.loop),
            )
    except distributed.client.FutureCancelledError as error:
        raise InputError(f"--dask {address}: the scheduler was lost ({error}); {_ADVICE}") from None


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


def _on_cluster(task: Callable[[S, T], R], shared: S, one: T) -> R:
    """A task on a worker of a cluster. It gives no work to the cluster itself, so that xarray takes no lock
    of the scheduler for a file in memory, which that has no name for."""
    with import_module("dask").config.set(scheduler="synchronous"):
        return task(shared, one)


def _alone(function: Callable[[T], R], shared: object, one: T) -> R:
    """A function of the input alone as a task."""
    return function(one)


def _same(shared: S) -> S:
    return shared


@contextmanager
def _main_hidden() -> Iterator[None]:
    """Within it a process that is started does not import the main script: one without a main guard would run
    in it anew."""
    main = vars(sys.modules["__main__"])
    seen: dict[str, Any] = {key: main.pop(key) for key in ("__spec__", "__file__") if key in main}
    main["__spec__"] = None
    try:
        yield
    finally:
        main.update(seen)


@final
class _Spawned(SpawnProcess):
    """A process of its own."""

    def start(self) -> None:
        """Start it."""
        with _main_hidden():
            super().start()


@final
class _SpawnContext(SpawnContext):
    """Starts workers as processes of their own."""

    Process = _Spawned


if sys.platform == "linux":  # elsewhere system libraries do not outlast a fork
    from multiprocessing.context import ForkServerContext, ForkServerProcess

    @final
    class _Forked(ForkServerProcess):
        """A process forked from one that has imported what it needs."""

        def start(self) -> None:
            """Start it; BrokenProcessPool where the process it is forked from has ended."""
            with _main_hidden():
                try:
                    super().start()
                except (EOFError, ConnectionError) as error:
                    raise BrokenProcessPool(str(error)) from error

    @final
    class _ForkContext(ForkServerContext):
        """Starts workers as forks of one process, which imports the package once for all of them."""

        Process = _Forked

    _CONTEXT: BaseContext = _ForkContext()
else:
    _CONTEXT = _SpawnContext()


def imported_ahead(*modules: str) -> None:
    """Let another process import these modules from now on, for workers that are started later to begin with,
    by default those of the package that are imported here.

    Where workers are processes of their own, as on other systems than Linux, this does nothing.
    """
    if sys.platform == "linux":
        package = __name__.partition(".")[0]
        loaded = [name for name in sys.modules if name.startswith(f"{package}.")]
        forkserver.set_forkserver_preload(list(modules) or loaded)
        # an interrupt ends it without a word, even while it imports
        blocked = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            forkserver.ensure_running()
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


_shared: Any = None
"""What the tasks of this worker process share; set once when it starts."""


def _take_up(shared: bytes | None) -> None:
    global _shared
    import numpy  # noqa: F401 - its threads can only be limited once they are there
    import scipy.linalg  # noqa: F401

    keep_freed_memory()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # an interrupt ends a worker without a word
    if sys.platform == "linux":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    threadpool_limits(1)
    _shared = None if shared is None else unpacked(shared)
    Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this worker when the process that started it has ended."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


_latest: tuple[int, Any] = (0, None)  # number of the task that this worker did last, and the task


def _perform(number: int, work: bytes, given: bytes) -> Any:
    global _latest
    if _latest[0] != number:
        _latest = number, unpacked(work)
    return _latest[1](_shared, unpacked(given))
