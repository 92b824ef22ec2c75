"""Who does independent tasks."""

import inspect
import os
import platform
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from threadpoolctl import threadpool_info, threadpool_limits

import lcopa_bayes as lb
from lcopa_bayes.core import parallel
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.parallel import cores, meanwhile, on_one_thread, workers


def threads(size, seed):
    """A product, and the threads that such products may take here."""
    made = np.random.default_rng(seed).normal(size=(size, size))
    return float(np.trace(made @ made)), max(pool["num_threads"] for pool in threadpool_info())


def lost(shared, one):
    os.kill(os.getpid(), signal.SIGKILL)


def wrong(shared, one):
    raise ZeroDivisionError


def over(shared, one):
    return shared / one


@pytest.mark.parametrize("jobs", [1, 2])
def test_tasks_are_done_in_order_on_one_thread_each(jobs, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # what a worker would take by itself
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with workers(50, jobs=jobs) as crew:
        made = list(crew.each(threads, range(5)))
        any_order = list(crew.finished(threads, range(5)))
    assert [value for value, _ in made] == [threads(50, seed)[0] for seed in range(5)]
    assert {count for _, count in made} == {1}
    assert sorted(any_order) == sorted(made)


def test_a_lost_worker_is_reported_and_an_error_is_raised():
    with pytest.raises(InputError, match="a worker process ended"), workers(0, jobs=2) as crew:
        list(crew.each(lost, range(3)))
    for jobs in (1, 2):
        with pytest.raises(ZeroDivisionError), workers(0, jobs=jobs) as crew:
            list(crew.finished(wrong, range(3)))


@pytest.mark.parametrize("error", [EOFError("unexpected EOF"), ConnectionRefusedError(111, "refused")])
def test_workers_that_cannot_be_started_are_reported(monkeypatch, error):
    """The process they are forked from was killed just then."""

    def refuse(self):
        raise error

    monkeypatch.setattr(parallel.ForkServerProcess, "start", refuse)
    with pytest.raises(InputError, match="a worker process ended"), workers(0, jobs=2) as crew:
        list(crew.each(over, [1]))
    with pytest.raises(InputError, match="a worker process ended"), meanwhile(half, 1, print, jobs=2):
        pass


def faults(shared, one):
    """Pages taken anew while temporaries come and go."""
    begin = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(50):
        temporaries = [np.ones(500_000) for _ in range(8)]
        temporaries.clear()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - begin


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="of the GNU C library")
@pytest.mark.parametrize("jobs", [1, 2])
def test_memory_of_temporaries_is_kept(jobs):
    """Eight arrays of 4 MB have 7 800 pages: taken anew fifty times these would be 390 000."""
    with workers(None, jobs=jobs) as crew:
        assert max(crew.each(faults, range(2))) < 30_000


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_task_that_ends_in_an_error_has_the_result_it_is_given(jobs):
    with workers(6, jobs=jobs) as crew:
        done = crew.finished(over, [1, 0, 2, 0, 3], lambda one, error: (one, type(error)))
        assert sorted(map(str, done)) == ["(0, <class 'ZeroDivisionError'>)"] * 2 + ["2.0", "3.0", "6.0"]
    with pytest.raises(InputError, match="a worker process ended"), workers(0, jobs=2) as crew:
        list(crew.finished(lost, range(3), lambda one, error: one))


class Scaled:
    """A task that knows how often it was pickled, and how often it was read here."""

    read = 0

    def __init__(self, factor):
        self.factor, self.sent = factor, 0

    def __getstate__(self):
        self.sent += 1
        return {"factor": self.factor}

    def __setstate__(self, state):
        Scaled.read += 1
        self.factor = state["factor"]

    def __call__(self, one):
        return self.factor * one, os.getpid(), Scaled.read


def test_a_task_is_sent_once_for_all_its_inputs():
    """And one that takes its place is another, whoever did the first."""
    with workers(None, jobs=2) as crew:
        for number, factor in enumerate((2, 3, 2), start=1):
            task = Scaled(factor)
            done = list(crew.map(task, range(8)))
            assert [value for value, _, _ in done] == [factor * one for one in range(8)]
            assert task.sent == 1
            assert os.getpid() not in {process for _, process, _ in done}
            assert max(read for _, _, read in done) <= number


def half(one):
    return one / 2 if one else 1 / one


@pytest.mark.parametrize("jobs", [1, 2])
def test_what_is_done_meanwhile_gives_its_result_and_its_error(jobs):
    given = []
    with meanwhile(half, 8, given.append, jobs=jobs):
        pass
    assert given == [4.0]
    reached = []
    with pytest.raises(ZeroDivisionError), meanwhile(half, 0, given.append, jobs=jobs):
        reached.append(jobs)
    assert given == [4.0]
    assert reached == [2][: jobs - 1]  # alone the task comes first


def test_workers_are_processes_of_their_own_where_forks_are_not_safe(monkeypatch):
    monkeypatch.setattr(parallel, "_CONTEXT", parallel._SpawnContext())
    with workers(6, jobs=2) as crew:
        assert list(crew.each(over, [1, 2, 3])) == [6.0, 3.0, 2.0]


SCRIPT = """
from time import sleep, time
from lcopa_bayes.core.parallel import workers
print("begun", flush=True)
with workers({length}, jobs=2) as crew:
    print(sum(crew.each({task}, [1, 2, 3])), flush=True)
"""
"""A script without a main guard."""


def test_a_script_without_a_main_guard_runs_once(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(SCRIPT.format(length=4, task="pow"))
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=60, check=False)
    assert done.stderr == ""
    assert done.stdout.split() == ["begun", str(4 + 16 + 64)]


def children(process: int) -> list[int]:
    listed = Path(f"/proc/{process}/task/{process}/children")
    return [int(word) for word in listed.read_text().split()]


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="reads the process table")
def test_workers_end_when_the_process_that_started_them_is_killed(tmp_path):
    """Nothing of a killed run goes on after two seconds: neither workers nor what they were forked from."""
    (tmp_path / "napping.py").write_text("import time\n\ndef nap(shared, one):\n    time.sleep(300)\n")
    script = tmp_path / "script.py"
    script.write_text("from napping import nap\n" + SCRIPT.format(length=0, task="nap"))
    parent = subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE)
    try:
        wait_for(lambda: len(working(parent.pid)) == 2)
        all_of_it = descendants(parent.pid)
        assert {*working(parent.pid)} <= {*all_of_it}
    finally:
        parent.kill()
        parent.communicate()
    wait_for(lambda: not any(alive(one) for one in all_of_it), most=2.0)


def descendants(process: int) -> list[int]:
    return [one for child in children(process) for one in (child, *descendants(child))]


def working(parent: int) -> list[int]:
    """Workers that have taken up their work: they have a thread that watches the parent."""
    return [one for one in descendants(parent) if len(list(Path(f"/proc/{one}/task").iterdir())) > 1]


def alive(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def wait_for(condition, most: float = 30.0) -> None:
    until = time.monotonic() + most
    while not condition():
        assert time.monotonic() < until, "it takes too long"
        time.sleep(0.05)


@pytest.mark.parametrize("where", ["shared", "input"])
def test_what_no_other_process_can_read_is_done_in_this_one(where):
    """Such as an effect of a study's own file, whose module only its path leads to."""
    module = ModuleType("elsewhere")
    exec("class Own(int):\n    pass", module.__dict__)
    three = module.Own(3)
    shared, inputs = (three, [1, 2]) if where == "shared" else (3, [module.Own(1), 2])
    with workers(shared, jobs=2) as crew:
        assert list(crew.each(added, inputs)) == [4, 5]
        assert sorted(crew.finished(added, inputs)) == [4, 5]


def added(shared: int, one: int) -> int:
    return int(shared) + int(one)


LATE = """
from threadpoolctl import threadpool_info
def loaded(shared, one):
    import sys
    late = "sklearn" not in sys.modules
    import sklearn.cluster
    return late, max(pool["num_threads"] for pool in threadpool_info() if pool["user_api"] == "openmp")
"""
LATER = """
from late import loaded
from lcopa_bayes.core.parallel import workers
with workers(None, jobs=2) as crew:
    for seen in crew.each(loaded, [1, 2]):
        print(*seen)
"""


@pytest.mark.skipif(cores() < 2, reason="on one core nothing takes more threads")
def test_what_a_worker_loads_later_has_one_thread_too(tmp_path):
    (tmp_path / "late.py").write_text(LATE)
    (tmp_path / "main.py").write_text(LATER)
    free = {key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")}
    ran = subprocess.run([sys.executable, "main.py"], cwd=tmp_path, env=free, capture_output=True, text=True)
    assert ran.stdout.splitlines() == ["True 1"] * 2, ran.stderr


def test_a_function_on_one_thread_leaves_the_others_theirs():
    with threadpool_limits(2):
        assert on_one_thread(threads)(3, seed=1)[1] == 1
        assert threads(3, 1)[1] == 2
        with pytest.raises(ZeroDivisionError):
            on_one_thread(over)(1, 0)
        assert threads(3, 1)[1] == 2
    assert on_one_thread(threads).__name__ == "threads"


VERBS = ("look", "fit", "loop", "compare", "calibrate", "design", "audit")


@pytest.mark.parametrize("verb", VERBS)
def test_a_verb_calculates_on_one_thread(verb, monkeypatch):
    """Whatever the calling process has: from Python nothing else limits it."""
    function, seen = getattr(lb, verb), []
    module = sys.modules[inspect.unwrap(function).__module__]

    def asked(*_, **__):
        seen.append(max(pool["num_threads"] for pool in threadpool_info()))
        raise ZeroDivisionError

    monkeypatch.setattr(module, {"compare": "several", "audit": "basis"}.get(verb, "study_of"), asked)
    with threadpool_limits(2), pytest.raises(ZeroDivisionError):
        function("a study")
    assert seen == [1]
