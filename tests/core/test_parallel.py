"""Who does independent tasks."""

import numpy as np
import pytest
from threadpoolctl import threadpool_info

from lcopa_bayes.core.parallel import crew


def threads(seed):
    """A product, and the threads that such products may take here."""
    made = np.random.default_rng(seed).normal(size=(50, 50))
    return float(np.trace(made @ made)), max(pool["num_threads"] for pool in threadpool_info())


@pytest.mark.parametrize("workers", [1, 2])
def test_tasks_are_done_in_order_on_one_thread_each(workers, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "2")  # what a worker would take by itself
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    with crew(workers) as mapped:
        made = list(mapped(threads, range(5)))
    assert [value for value, _ in made] == [threads(seed)[0] for seed in range(5)]
    assert {count for _, count in made} == {1}
