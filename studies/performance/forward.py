"""Time of the forward model per response, as ratios within one run.

    python studies/performance/forward.py [--json FILE]

Compares, on one core: the fast algebra in a batch of 64, the fast algebra one plant at a time, and the
dense matrices of the paper, for the paper's direct element under a step with a continuous delay.
"""

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.linalg import solve_triangular
from threadpoolctl import threadpool_limits

from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.blockpulses import integration_matrix
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.literature import PAPER

SPAN = 25.0
BATCH = 64


def dynamics(batch: int) -> Dynamics:
    path = PAPER.plant.xx
    times = [(eta / path.stiffness) ** (1 / order) for eta, order in zip(path.etas, path.orders, strict=True)]
    return Dynamics(
        (np.tile(times, (batch, 1)),), (np.tile(path.orders, (batch, 1)),), np.full((batch, 1), path.delay)
    )


def model(n: int) -> ForwardModel:
    layout = Layout.of([Axis("x", "rad")], [Axis("x", "rad")], ModelSettings(terms=3))
    mesh = Mesh.of_samples(SPAN / n * np.arange(1, n + 1), 0.0, blocks=n)
    assert mesh.grid.n - n <= 3, "the mesh has spare blocks only"
    drive = AxisDrive(np.zeros(1), np.ones(1))
    return ForwardModel(layout, (Experiment("step", mesh, (drive,), np.zeros(1)),))


def dense(n: int) -> np.ndarray:
    path, step = PAPER.plant.xx, SPAN / n
    top = path.orders[0]
    system = path.stiffness * integration_matrix(top, n, step) + sum(
        eta * integration_matrix(top - order, n, step)
        for eta, order in zip(path.etas, path.orders, strict=True)
    )
    means, _ = AxisDrive(np.zeros(1), np.ones(1)).block_means(step * np.arange(n + 1), np.array([path.delay]))
    return solve_triangular(system, integration_matrix(top, n, step) @ means[0], lower=True)


def fastest(work: Callable[[], object], seconds: float = 1.0) -> float:
    work()
    best, end = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < end:
        begin = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - begin)
    return best


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args().json
    rows = []
    with threadpool_limits(1):
        for n in (250, 512, 1024):
            forward, many, one = model(n), dynamics(BATCH), dynamics(1)
            batched = fastest(lambda f=forward, d=many: f.unit_responses(d)) / BATCH
            single = fastest(lambda f=forward, d=one: f.unit_responses(d))
            matrix = fastest(lambda n=n: dense(n)) if n <= 512 else np.nan
            rows.append(
                {
                    "blocks": n,
                    "batched_us": 1e6 * batched,
                    "single_over_batched": single / batched,
                    "dense_over_batched": matrix / batched if np.isfinite(matrix) else None,
                }
            )
            print(rows[-1])
    if wanted:
        wanted.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
