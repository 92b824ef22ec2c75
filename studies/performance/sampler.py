"""Effective draws per CPU second of this package's sampler, of plain emcee and of dynesty, on one posterior.

    python studies/performance/sampler.py [--json FILE] [--quick] [--jobs N]

The posterior is that of studies/paper-step-x. Two kinds of effective sample size: the one a method tells of
its own draws, and the one its errors show, posterior variance over mean squared error about a reference. The
first believes a chain that never left one ridge; the second does not. The smallest over quantities counts.
"""

import argparse
import json
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import dynesty
import emcee
import numpy as np
from arviz_stats.base import array_stats
from comparison import Piece, compared, table

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.sampling.evidence import evidence
from lcopa_bayes.sampling.nested import NestedPlan, nested
from lcopa_bayes.sampling.sampler import SamplePlan, sample, sampled_qualities
from lcopa_bayes.sampling.unitcube import UnitCube

STUDY = Path(__file__).parents[1] / "paper-step-x"
SHARES = (("order_2", ">", 1.3), ("order_1", ">", 1.9), ("order_3", "<", 0.1))
OURS, TUNED, EMCEE, PLAIN = "this package", "dynesty as tuned here", "plain emcee", "plain dynesty"
TOLD = {
    OURS: "smallest arviz bulk or tail",
    TUNED: "strands of each run drawn again, blind to the spread of runs",
    EMCEE: "smallest arviz bulk or tail",
    PLAIN: "Kish, of the weights",
}
WALKERS, THIN = 32, 10
"""Of plain emcee; thinning only saves memory."""
LIVE, STOP = 500, 0.509
"""Plain dynesty: its default live points and end [nat]."""


@dataclass(frozen=True)
class Effort:
    """How long to run each method."""

    plan: SamplePlan
    nested: NestedPlan
    """Of one run alone."""
    ours: int = 1
    nested_runs: int = 2
    emcee: int = 2
    dynesty: int = 1
    cap: float = 12.0
    """Most CPU time of a run of plain dynesty, in runs of this package's sampler [-]."""
    live: int = LIVE


def names_of(posterior: Posterior) -> list[str]:
    rows = [posterior.table.rows[k] for k in posterior.sampled]
    shares = [f"share of {name} {sign} {at:g}" for name, sign, at in SHARES]
    return [f"mean of {'log ' if row.log_scale else ''}{row.name}" for row in rows] + shares


def quantities(posterior: Posterior, coordinates: Matrix) -> Matrix:
    """Per draw: coordinates in canonical order and sides of the valleys, (draws, quantities)."""
    values = posterior.values(coordinates)
    column = {name: values[:, k] for k, name in enumerate(posterior.table.names)}
    sides = [column[name] > at if sign == ">" else column[name] < at for name, sign, at in SHARES]
    return np.column_stack([posterior.coordinates(values), *(side.astype(float) for side in sides)])


def piece(
    x: Matrix, told: float, spent: tuple[float, float], weights: Vector | None = None, **more: Any
) -> Piece:
    mean = np.average(x, axis=0, weights=weights)
    return Piece(mean, np.average(x**2, axis=0, weights=weights), told, *spent, **more)


def ours(posterior: Posterior, seed: int, effort: Effort, budget: float) -> list[Piece]:
    clock = started()
    run = sample(posterior, replace(effort.plan, seed=seed))
    spent = clock()
    told = min(quality.ess for quality in sampled_qualities(posterior, run))
    kept, _ = run.kept()
    weighed, count = evidence(posterior, kept, told, seed), len(kept)
    return [
        piece(
            quantities(posterior, one.reshape(-1, posterior.dimension)),
            told / count,
            (spent[0] / count, spent[1] / count),
            log_evidence=weighed.value if weighed else np.nan,
        )
        for one in kept
    ]


def tuned(posterior: Posterior, seed: int, effort: Effort, budget: float) -> list[Piece]:
    clock = started()
    found = nested(posterior, replace(effort.nested, seed=seed))
    x = quantities(posterior, posterior.coordinates(found.values))
    told = float(np.nanmin(found.ess))
    return [piece(x, told, clock(), log_evidence=found.log_evidence)]


def plain_emcee(posterior: Posterior, seed: int, effort: Effort, budget: float) -> list[Piece]:
    clock, dimension = started(), posterior.dimension
    sampler = emcee.EnsembleSampler(WALKERS, dimension, posterior.log_density, vectorize=True)
    sampler.random_state = np.random.RandomState(seed).get_state()
    state: Any = posterior.coordinates(posterior.table.draw(WALKERS, np.random.default_rng(seed)))
    while clock()[0] < budget:
        state = sampler.run_mcmc(state, 20, thin_by=THIN)
    spent = clock()
    chain = sampler.get_chain()
    kept = chain[len(chain) // 2 :].swapaxes(0, 1)
    values = posterior.values(kept.reshape(-1, dimension))[:, posterior.sampled]
    walks = values.reshape(WALKERS, -1, dimension)
    told = min(
        float(array_stats.ess(walks[..., k], method=method, prob=prob))
        for k in range(dimension)
        for method, prob in (("bulk", None), ("tail", (0.05, 0.95)))
    )
    return [piece(quantities(posterior, kept.reshape(-1, dimension)), told, spent)]


def plain_dynesty(posterior: Posterior, seed: int, effort: Effort, budget: float) -> list[Piece]:
    clock, cube = started(), UnitCube(posterior)
    sampler = dynesty.NestedSampler(
        lambda z: float(cube.log_likelihood(z[None])[0]),
        lambda point: cube.coordinates(point[None])[0],
        cube.dimension,
        nlive=effort.live,
        sample="rwalk",
        rstate=np.random.default_rng(seed),
    )
    finished = True
    for _ in sampler.sample(dlogz=STOP):
        if clock()[0] > effort.cap * budget:
            finished = False
            break
    sampler.add_final_live(print_progress=False)
    spent, found = clock(), sampler.results
    weights = np.exp(found.logwt - found.logwt.max())
    told = float(weights.sum() ** 2 / np.sum(weights**2))
    x = quantities(posterior, np.array(found.samples))
    return [piece(x, told, spent, weights, log_evidence=float(found.logz[-1]), finished=finished)]


METHODS: dict[str, Callable[[Posterior, int, Effort, float], list[Piece]]] = {
    OURS: ours,
    TUNED: tuned,
    EMCEE: plain_emcee,
    PLAIN: plain_dynesty,
}


def started() -> Callable[[], tuple[float, float]]:
    """A clock of CPU and wall seconds since now; each task is a process with one thread."""
    cpu, wall = time.process_time(), time.perf_counter()
    return lambda: (time.process_time() - cpu, time.perf_counter() - wall)


def performed(task: tuple[str, int, Effort, float]) -> tuple[str, list[Piece]]:
    method, seed, effort, budget = task
    posterior = problem_of(load_study(STUDY)).posterior
    posterior.log_density(posterior.coordinates(posterior.table.draw(4, np.random.default_rng(0))))
    return method, METHODS[method](posterior, seed, effort, budget)


def gathered(jobs: int, effort: Effort) -> dict[str, list[Piece]]:
    """Parts of every method; the rivals are given the CPU time of this package's sampler."""
    out: dict[str, list[Piece]] = {method: [] for method in METHODS}

    def collect(found: Iterable[tuple[str, list[Piece]]]) -> None:
        for method, pieces in found:
            out[method] += pieces
            spent = sum(one.cpu for one in pieces)
            print(f"{method}: {spent:.0f} CPU s, told {sum(one.told for one in pieces):.0f}", flush=True)

    def seeded(method: str, count: int, budget: float) -> list[tuple[str, int, Effort, float]]:
        return [(method, 1 + k, effort, budget) for k in range(count)]

    with workers(None, jobs=jobs) as crew:
        first = seeded(OURS, effort.ours, np.nan) + seeded(TUNED, effort.nested_runs, np.nan)
        collect(crew.map(performed, first))
        budget = sum(one.cpu for one in out[OURS]) / effort.ours
        collect(
            crew.map(performed, seeded(PLAIN, effort.dynesty, budget) + seeded(EMCEE, effort.emcee, budget))
        )
    return out


def words(told: dict[str, Any]) -> str:
    """The report for a reader."""
    quick = ["A quick run: the numbers mean nothing.", ""] if told["quick"] else []
    return "\n".join([*quick, table(told)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="report; its table goes beside it as Markdown")
    parser.add_argument(
        "--quick", action="store_true", help="a minute; shows that it runs, not what it finds"
    )
    parser.add_argument("--jobs", type=int, default=2)
    options = parser.parse_args()
    problem = problem_of(load_study(STUDY))
    posterior, plan = problem.posterior, plan_of(problem, quick=False)
    whole = NestedPlan.of(posterior.dimension, seed=0)
    effort = Effort(plan, replace(whole, runs=1))
    if options.quick:
        few = replace(plan, ensembles=2, walkers=18, steps=200)
        effort = Effort(few, NestedPlan(1, 30, 10, 0), ours=1, nested_runs=2, emcee=2, cap=0.5, live=50)
    found = gathered(options.jobs, effort)
    parts = {OURS: effort.plan.ensembles, TUNED: whole.runs, EMCEE: 1, PLAIN: 1}
    about = {
        "study": STUDY.name,
        "quick": options.quick,
        "ess_told_kind": TOLD,
        "effort": asdict(effort),
        "plain_emcee": {"walkers": WALKERS, "move": "stretch", "discarded": 0.5, "start": "prior"},
        "plain_dynesty": {"live": effort.live, "sample": "rwalk", "dlogz": STOP},
    }
    told = about | compared(names_of(posterior), found, parts)
    print(words(told))
    if options.json:
        options.json.write_text(json.dumps(told, indent=1) + "\n")
        options.json.with_suffix(".md").write_text(words(told) + "\n")


if __name__ == "__main__":
    from sampler import main as run  # workers do not run this script: what they do must be in a module

    run()
