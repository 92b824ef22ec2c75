"""Tasks on a Dask cluster: what it refuses, what survives a lost worker, and what stays here."""

import os
import signal
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from threading import Thread, Timer
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import lcopa_bayes as lb
from lcopa_bayes.core import cluster as module
from lcopa_bayes.core import parallel
from lcopa_bayes.core.crew import Crew
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.parallel import on_cluster, workers


@contextmanager
def cluster(count: int) -> Iterator[Any]:
    """A Dask cluster of processes."""
    distributed = pytest.importorskip("distributed")
    options = {"threads_per_worker": 1, "dashboard_address": ":0", "memory_limit": 0}
    with distributed.LocalCluster(n_workers=count, **options) as made:
        yield made


@contextmanager
def service(answer: bytes) -> Iterator[str]:
    """The address of something that is no scheduler and answers this to whoever calls."""
    held = []
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            while True:
                try:
                    held.append(server.accept()[0])
                except OSError:
                    return
                held[-1].sendall(answer)

        Thread(target=serve, daemon=True).start()
        yield f"tcp://127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)
        for one in held:
            one.close()


def slowly(shared, one):
    time.sleep(0.4)
    return shared * one


@pytest.mark.parametrize("answer", [b"", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"\0" * 8])
def test_an_address_where_no_scheduler_is_is_said_within_seconds(answer):
    pytest.importorskip("distributed")
    began = time.monotonic()
    with (
        service(answer) as address,
        pytest.raises(InputError, match=f"--dask {address}: no Dask scheduler answers there") as caught,
        on_cluster(address),
    ):
        pass
    assert len(caught.value.problems) == 1
    assert time.monotonic() - began < 15.0


def test_a_cluster_without_workers_is_said():
    with (
        cluster(0) as made,
        pytest.raises(InputError, match="the cluster has no worker; start some with `dask worker tcp:"),
        on_cluster(made.scheduler_address),
    ):
        pass


def test_a_worker_that_is_killed_changes_no_result():
    with cluster(2) as made, on_cluster(made.scheduler_address) as jobs, workers(3, jobs=jobs) as crew:
        pid = next(iter(made.workers.values())).pid
        Timer(0.6, os.kill, (pid, signal.SIGKILL)).start()
        assert list(crew.each(slowly, range(8))) == [3 * one for one in range(8)]
        assert pid not in [one.pid for one in made.workers.values()]


def test_workers_of_other_versions_are_refused(monkeypatch):
    here = os.getpid()

    def unlike() -> dict[str, str]:
        if os.getpid() != here:
            raise ModuleNotFoundError("No module named 'lcopa_bayes'")
        return {}

    known = module.version
    with cluster(1) as made:
        monkeypatch.setattr(module, "version", lambda name: "0.1" if name == "scipy" else known(name))
        refused = rf"the worker tcp:\S+ has scipy {known('scipy')}, here 0.1; install the same versions"
        with pytest.raises(InputError, match=refused), on_cluster(made.scheduler_address):
            pass
        monkeypatch.setattr(module, "_versions", unlike)
        refused = r"cannot take part \(No module named 'lcopa_bayes'\); install the same versions"
        with pytest.raises(InputError, match=refused), on_cluster(made.scheduler_address):
            pass


@pytest.fixture(scope="module")
def made() -> Iterator[Any]:
    with cluster(2) as one:
        yield one


def process(shared, one):
    return os.getpid()


def lost(shared, one):
    os.kill(os.getpid(), signal.SIGKILL)


def total(shared, one):
    """Of something large and the input, with how often a worker has unpacked the former."""
    return float(shared.sum()) + one, module._unpacked.kept.cache_info().misses


def of_itself(values, shared, one):
    return total(values, one)


def test_what_several_processes_would_do_is_done_by_its_workers(made):
    theirs = {one.pid for one in made.workers.values()}
    with on_cluster(made.scheduler_address) as jobs:
        assert jobs == 2
        with workers(None, jobs=jobs) as crew:
            assert set(crew.each(process, range(6))) <= theirs
            assert set(crew.finished(process, range(6))) <= theirs
        with workers(None, jobs=1) as alone:
            assert set(alone.each(process, range(2))) == {os.getpid()}
        with workers(None, jobs=jobs, here=True) as local:
            assert not set(local.each(process, range(4))) & {os.getpid(), *theirs}
    with workers(None, jobs=2) as after:
        assert not set(after.each(process, range(4))) & {os.getpid(), *theirs}


def test_it_is_worth_two_processes_at_least():
    """Or one worker would leave the work to this process."""
    with cluster(1) as one, on_cluster(one.scheduler_address) as jobs:
        assert jobs == 2
    with on_cluster(None) as jobs:
        assert jobs == 1


@pytest.mark.parametrize("where", ["shared", "task"])
def test_what_tasks_share_is_unpacked_once(made, where):
    values = np.arange(100_000.0)
    with on_cluster(made.scheduler_address) as jobs:
        shared, task = (values, total) if where == "shared" else (None, partial(of_itself, values))
        with workers(shared, jobs=jobs) as crew:
            before = len(list(crew.each(task, range(2))))
            seen = list(crew.each(task, range(20)))
    assert before == 2
    assert [one for one, _ in seen] == [values.sum() + one for one in range(20)]
    most = max(count for _, count in seen)
    with on_cluster(made.scheduler_address) as jobs, workers(shared, jobs=jobs) as crew:
        again = max(count for _, count in crew.each(task, range(20)))
    assert again - most <= 4  # the task and what it shares, in another run of both workers


def test_a_search_of_many_stages_is_done_there(made):
    theirs = {one.pid for one in made.workers.values()}
    with on_cluster(made.scheduler_address) as jobs, Crew(jobs) as crew:
        assert set(crew.sharing(3).each(process, range(4))) <= theirs
        assert list(crew.sharing(3).each(times, range(4))) == [0, 3, 6, 9]
        assert list(crew.map(abs, [-1, 2])) == [1, 2]


def times(shared, one):
    return shared * one


def test_what_no_other_process_can_read_is_done_here(made):
    elsewhere = ModuleType("elsewhere")
    exec("class Own(int):\n    pass", elsewhere.__dict__)
    with on_cluster(made.scheduler_address) as jobs, workers(elsewhere.Own(3), jobs=jobs) as crew:
        assert list(crew.each(times, [1, 2])) == [3, 6]
        assert sorted(crew.finished(times, [1, 2])) == [3, 6]


def test_a_task_that_every_worker_is_lost_with_is_said():
    with (
        cluster(1) as one,
        pytest.raises(InputError, match="a task was lost with its workers, perhaps for want of memory"),
        on_cluster(one.scheduler_address) as jobs,
        workers(None, jobs=jobs) as crew,
    ):
        list(crew.each(lost, [0]))


def test_an_error_of_a_task_is_its_own(made):
    with (
        on_cluster(made.scheduler_address) as jobs,
        workers(0, jobs=jobs) as crew,
        pytest.raises(ZeroDivisionError),
    ):
        list(crew.each(divided, [1]))


def divided(shared, one):
    return one / shared


@pytest.mark.slow
@pytest.mark.parametrize("verb", ["fit", "compare", "audit", "loop"])
def test_a_verb_gives_the_same_numbers_there(made, verb, monkeypatch):
    """And its tasks are done there: none of a process of this machine."""
    records = {"fit": [stepped(1), stepped(2)], "held_out": [stepped(3)]}
    study = lb.Study("there", **records, model={"terms": 1}, noise={"kind": "white"})
    words = {"candidates": ["fractional-1", "first-order"]} if verb == "compare" else {}
    alone = getattr(lb, verb)(study, quick=True, **words)
    monkeypatch.setattr(parallel, "_perform", None)
    with on_cluster(made.scheduler_address) as jobs:
        there = getattr(lb, verb)(study, quick=True, jobs=jobs, **words)
    assert without_times(there.to_json()) == without_times(alone.to_json())


def stepped(seed: int) -> dict[str, np.ndarray]:
    """A record of a lag with a delay."""
    time = np.arange(-4.0, 16.0, 0.2)
    lag = 1 - np.exp(-np.maximum(time - 1.0, 0.0) / 2.0)
    noise = 0.02 * np.random.default_rng(seed).normal(size=time.size)
    return {"time_ms": time, "drive_u_V": 1.0 * (time >= 0), "response_y_rad": lag + noise}


def without_times(values: Any) -> Any:
    """Plain values without those that are times of the calculation, or of a folder."""
    if isinstance(values, dict):
        kept = {key: one for key, one in values.items() if key not in ("seconds", "folder", "provenance")}
        return {key: without_times(one) for key, one in kept.items()}
    return [without_times(one) for one in values] if isinstance(values, list) else values
