"""Processes for a search of many stages: one pool for all of them, started once the search has taken long."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import cached_property, lru_cache, partial
from time import monotonic
from types import SimpleNamespace, TracebackType
from typing import Any, TypeVar, final

from lcopa_bayes.core.packing import Latest, packed
from lcopa_bayes.core.parallel import Workers, imported_ahead, workers
from lcopa_bayes.core.progress import Progress

S = TypeVar("S")
T = TypeVar("T")
R = TypeVar("R")
WORTHWHILE = 2.0
"""Time that searches take from which processes share them [s]."""


@final
class Crew:
    """`jobs` processes from `after` seconds on, this one alone before, and where `jobs` is 1; results do not
    depend on that. A context that ends the processes."""

    def __init__(self, jobs: int = 1, *, after: float = 0.0, bar: Progress | None = None) -> None:
        """No process takes part yet; what they need is imported meanwhile. A `bar` counts tasks."""
        self.jobs, self._due, self._stack = jobs, monotonic() + after, ExitStack()
        self._bar = bar
        if jobs > 1:
            imported_ahead()

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def stage(self, said: str) -> None:
        """Name what is being done from now on, or say what is known by now."""
        if self._bar is not None:
            self._bar.set_description(said)

    def sharing(self, shared: S) -> Workers[S]:
        """Workers of a stage whose tasks share a value. It is pickled once, with what it has cached.

        A task whose value or input another process cannot import, such as an effect of a study's own file,
        is done in this one.
        """
        common = lru_cache(1)(lambda: packed(shared))
        work = lru_cache(1)(lambda task: partial(_done, task, common()))  # one task, however many inputs

        def submit(task: Callable[[S, T], R], one: T) -> SimpleNamespace:
            result: Callable[[], R] = partial(task, shared, one)
            if self.jobs > 1 and monotonic() >= self._due and common() is not None:
                result = partial(next, self._pool.each(work(task), [one]))
            return SimpleNamespace(result=self._counted(result))

        return Workers(submit, iter)

    def map(self, function: Callable[[T], R], inputs: Sequence[T]) -> Iterator[R]:
        """Results of a function that needs nothing shared, in the order of the inputs."""
        return self.sharing(None).map(function, inputs)

    def _counted(self, result: Callable[[], R]) -> Callable[[], R]:
        """The same, counted when it is there."""
        if self._bar is None:
            return result
        bar = self._bar

        def counted() -> R:
            value = result()
            bar.update()
            return value

        return counted

    @cached_property
    def _pool(self) -> Workers[None]:
        return self._stack.enter_context(workers(None, jobs=self.jobs))

    def rest(self) -> None:
        """End the processes, for a while in which others work; the next task starts them again."""
        self._stack.close()
        vars(self).pop("_pool", None)


_unpacked = Latest(1)
"""Keeps what the tasks of a stage share, in a worker."""


def _done(task: Callable[[Any, T], R], sent: bytes | None, _: None, one: T) -> R:
    """A task in a worker, which keeps what tasks share for the next one."""
    assert sent is not None
    return task(_unpacked(sent), one)


ALONE = Crew()
"""This process."""
