"""One pool for the stages of a search."""

import os
import sys

import numpy as np
import pytest

from lcopa_bayes.core import crew as module
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.progress import Progress


def scaled(shared, one):
    """A product and who made it."""
    return shared * one, os.getpid()


def divided(shared, one):
    return shared / one


def ended(shared, one):
    os._exit(1)


def test_stages_that_share_different_values_have_one_pool(monkeypatch):
    opened, plain = list[int](), module.workers
    monkeypatch.setattr(
        module, "workers", lambda *given, jobs: opened.append(jobs) or plain(*given, jobs=jobs)
    )
    with Crew(2) as crew:
        first = list(crew.sharing(np.arange(3.0)).each(scaled, [1, 2, 3]))
        second = list(crew.sharing(10).each(scaled, [1, 2]))
        assert list(crew.map(abs, [-1, 2])) == [1, 2]
    assert opened == [2]
    assert [value.tolist() for value, _ in first] == [[0, 1, 2], [0, 2, 4], [0, 3, 6]]
    assert [value for value, _ in second] == [10, 20]
    who = {pid for _, pid in (*first, *second)}
    assert os.getpid() not in who
    assert len(who) <= 2


@pytest.mark.parametrize("crew", [ALONE, Crew(2, after=1e9)])
def test_no_process_is_started_before_it_pays(crew, monkeypatch):
    monkeypatch.setattr(module, "workers", None)  # no call of it would end
    assert list(crew.sharing(2).each(scaled, [3])) == [(6, os.getpid())]


def test_what_no_other_process_can_import_is_done_here(monkeypatch):
    """Of a stage only the tasks that need it, by their input or what they share."""
    own = type("Own", (int,), {"__module__": "__main__"})
    monkeypatch.setattr(sys.modules["__main__"], "Own", own, raising=False)
    here = os.getpid()
    with Crew(2) as crew:
        made = list(crew.sharing(2).each(scaled, [1, own(2), np.float64(3.0)]))
        shared = list(crew.sharing(own(2)).each(scaled, [1]))
        local = list(crew.sharing(type("Local", (int,), {})(2)).each(scaled, [1]))
    assert [value for value, _ in made] == [2, 4, 6]
    assert [pid == here for _, pid in made] == [False, True, False]
    assert shared == local == [(2, here)]


def test_processes_that_rest_have_ended_and_others_work_later():
    with Crew(2) as crew:
        crew.rest()  # nothing to end yet
        ((_, first),) = crew.sharing(2).each(scaled, [1])
        crew.rest()
        with pytest.raises(ProcessLookupError):
            os.kill(first, 0)
        ((value, later),) = crew.sharing(2).each(scaled, [1])
    assert value == 2
    assert later not in (first, os.getpid())


def test_errors_are_those_of_the_task():
    with pytest.raises(ZeroDivisionError), Crew(2) as crew:
        list(crew.sharing(1).each(divided, [1, 0]))
    with pytest.raises(InputError, match="a worker process ended"), Crew(2) as crew:
        list(crew.sharing(1).each(ended, [1]))


def test_a_bar_counts_tasks_and_names_the_stage(capsys):
    with Progress(total=0, unit="task", desc="begun") as bar, Crew(1, bar=bar) as crew:
        assert [value for value, _ in crew.sharing(10).each(scaled, [1, 2])] == [10, 20]
        crew.stage("going on")
        assert bar.n == 2
    assert "going on: 2 tasks" in capsys.readouterr().err
    ALONE.stage("nothing to be seen")
    assert capsys.readouterr().err == ""
