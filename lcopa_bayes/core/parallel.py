"""Workers: independent tasks done in this process, in several of one thread each, or on a Dask cluster."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from contextvars import ContextVar
from functools import partial, wraps
from itertools import chain
from multiprocessing import forkserver, parent_process
from multiprocessing.context import BaseContext, SpawnContext, SpawnProcess
from threading import Thread
from typing import Any, Generic, ParamSpec, TypeVar, final

from threadpoolctl import threadpool_limits

from lcopa_bayes.core.cluster import ADVICE, Cluster, connected
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.packing import packed, unpacked

S = TypeVar("S")
T = TypeVar("T")
P = ParamSpec("P")
R = TypeVar("R")
_MMAP_THRESHOLD, _TRIM_THRESHOLD = (-3, 32 << 20), (-1, 256 << 20)
"""Options of the allocator of the GNU C library with their values: arrays below 32 MB, the most it takes,
come from the heap, and up to 256 MB at its end are kept when they are freed [byte]."""
_CLUSTER: ContextVar[Cluster | None] = ContextVar("cluster", default=None)


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


def loss(error: BaseException) -> str:
    """Why a task has no result whose worker was lost, with the first sentence that a library has on it."""
    said = str(error).partition(". ")[0] or type(error).__name__
    return f"its worker was lost, perhaps for want of memory ({said})"


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
        """Number of a task, by which a worker knows the one it did last, and its bytes, as `packed`."""
        if task is not self._task:
            self._task, self._sent = task, (self._sent[0] + 1, packed(task))
        return self._sent


@contextmanager
def on_cluster(address: str | None) -> Iterator[int]:
    """Within it what several processes would do is done on the Dask cluster at an address; how many processes
    that is worth, at least 2. Nothing, and 1, without an address.

    InputError when there is no such cluster, and when the cluster, or a task with its worker, is lost.
    """
    if address is None:
        yield 1
        return
    with connected(address) as cluster:
        token = _CLUSTER.set(cluster)
        try:
            yield max(2, cluster.size)
        finally:
            _CLUSTER.reset(token)


def on_one_thread(function: Callable[P, R]) -> Callable[P, R]:
    """The function with one thread for the linear algebra of this process. Verbs are such functions, and
    workers begin so, so that what these call need not be.

    Matrices are small, and threads wait for each other: beside other work on the same cores half of the time
    of a fit of 120 samples.
    """

    @wraps(function)
    def limited(*args: P.args, **kwargs: P.kwargs) -> R:
        with threadpool_limits(1):
            return function(*args, **kwargs)

    return limited


@contextmanager
def workers(shared: S, *, jobs: int = 1, here: bool = False) -> Iterator[Workers[S]]:
    """Workers that share a value: `jobs` processes of one thread each, or those of the cluster inside of
    `on_cluster`, unless the tasks have to be done `here`, on this machine; this process alone where `jobs` is
    1. What no other process can read, such as an effect of a study's own file, is done by this one.

    Processes end with this one, however it ends, and do not run the main script again, so that a script needs
    no main guard. InputError when a worker is lost.
    """
    keep_freed_memory()
    cluster = None if here else _CLUSTER.get()
    with threadpool_limits(1):  # threads here would take the workers' cores
        if jobs <= 1:
            yield Workers(lambda task, one: _Later(task, shared, one), iter)
            return
        sent, tasks = packed(shared), _Tasks()

        def submit(give: Callable[[int, bytes, bytes], Any], task: Callable[[S, T], R], one: T) -> Any:
            number, work = tasks.sent(task)
            given = None if sent is None or work is None else packed(one)
            if work is None or given is None:
                return _Later(task, shared, one)
            return give(number, work, given)

        if cluster is not None:
            yield Workers(partial(submit, cluster.giving(sent)), partial(_as_finished, cluster.as_finished))
            return
        with _pool(jobs, sent) as pool:

            def give(number: int, work: bytes, given: bytes) -> Any:
                return pool.submit(_perform, number, work, given)

            yield Workers(partial(submit, give), partial(_as_finished, as_completed))


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
            f"script itself defines, which belongs in a module; {ADVICE}"
        ) from None
    finally:
        pool.shutdown(cancel_futures=True)


def _as_finished(theirs: Callable[[Sequence[Any]], Iterator[Any]], futures: Iterable[Any]) -> Iterator[Any]:
    """Tasks of this process while workers do theirs, then these as they finish."""
    own = [one for one in futures if isinstance(one, _Later)]
    return chain(own, theirs([one for one in futures if not isinstance(one, _Later)]))


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


def _alone(function: Callable[[T], R], shared: object, one: T) -> R:
    """A function of the input alone as a task."""
    return function(one)


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
    os.environ["OMP_NUM_THREADS"] = "1"  # of libraries that tasks load later
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
