"""Time of a design of experiments: a 10 s record at 10 kHz with all sensitivities of the paper's element.

    python studies/performance/design.py [--json FILE]

Per record length, on one core: the transfer function with its slopes (once per draw of the posterior), and
the Fisher information of one drive (once per drive), both for three viscous terms, a gain and a delay.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.experiments.candidates import candidates
from lcopa_bayes.experiments.information import Bench
from lcopa_bayes.experiments.limits import limits_of
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.model.literature import PAPER

STUDY = Path(__file__).parents[1] / "paper-step-x"
TIMES = (25.0, 250.0, 1000.0, 10_000.0)
ROUNDS = 5


def paper_values(problem: Problem) -> np.ndarray:
    path = PAPER.plant.xx
    told = {"gain": path.gain / path.stiffness, "delay": path.delay, "sigma": 1.8e-4}
    for term, (eta, order) in enumerate(zip(path.etas, path.orders, strict=True), start=1):
        told |= {f"time_{term}": (eta / path.stiffness) ** (1 / order), f"order_{term}": order}
    return np.array([told[name] for name in problem.posterior.table.names])


def measured(problem: Problem, duration: float) -> dict[str, float]:
    values, limits = paper_values(problem), limits_of(problem)
    bench = Bench(problem, duration, limits.period)
    drives = candidates(limits, duration, np.random.default_rng(1), unit="ms")
    drive = next(each for each in drives if each.name == "binary, every refresh")
    first, second = [], []
    for _ in range(ROUNDS):
        begin = time.perf_counter()
        elements = bench.elements(values)
        between = time.perf_counter()
        bench.gram(values, elements, drive.command)
        first.append(between - begin)
        second.append(time.perf_counter() - between)
    row = {"samples": bench.sample_times.size, "sensitivities": len(bench.names)}
    return row | {"element_s": min(first), "drive_s": min(second), "both_s": min(first) + min(second)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path)
    wanted = parser.parse_args().json
    problem = problem_of(load_study([STUDY], held_out=[]))
    with threadpool_limits(1):
        rows = [measured(problem, duration) for duration in TIMES]
    for row in rows:
        print(row)
    if wanted:
        wanted.write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main()
