"""How often a comparison prefers the model that made the record, over many simulated records.

    python studies/model-choice/choice.py [--replicas N] [--jobs N] [--out FOLDER] [--quick]

Truths take turns: one, two and three fractional terms, first and second order. They are drawn from the
priors below until the record determines them: by the audit's own curvature at the truth every free order
is known to a third of its distance from the nearest integer, which is 0.1 at least, and every time constant
to a third of itself. Records are made by the forward model itself, since the choice is in question here and
not the numerics, which the calibration studies hold against the bench. Candidates are both integer models and
fractional ones of up to one term more than the truth (two where it is integer): a further term is seldom
determined, and sampling it takes as long as all others. The simplest candidate that no other beats beyond
chance in log evidence is preferred, by the rule of `compare`.
Finished replicas are kept in the folder: a killed run goes on where it stopped.
"""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import beta

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.bench.device import Bench, Device, truth
from lcopa_bayes.calibration.replica import measured
from lcopa_bayes.comparison.averaging import by_evidence, simplest
from lcopa_bayes.comparison.candidates import candidates_of
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.study import Study
from lcopa_bayes.identifiability.curvature import curvature
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.evidence import evidence
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.sampler import sample

KINDS = ("fractional-1", "fractional-2", "fractional-3", "first-order", "second-order")
INTEGER = ("first-order", "second-order")
LARGEST = {"fractional-1": 2, "fractional-2": 3, "fractional-3": 3, "first-order": 2, "second-order": 2}
"""Terms of the largest fractional candidate by kind of truth [-]."""
SEED = 41
NOISE = 5e-4
"""Standard deviation of a sample, of a response about 1 high [-]."""
APART = 0.1
"""Least distance of an order from an integer [-]."""
KNOWN = 1 / 3
"""Largest standard deviation of a time constant relative to it, and of an order relative to its distance."""
MOST_TRIES = 200_000
PLAN = {"ensembles": 2, "walkers": 32, "target_ess": 100}


def template() -> Study:
    """Drive, sample times and priors of every replica: steps up and down, 120 samples of 40 ms."""
    axes = (Axis("u", "V"),), (Axis("y", "V"),)
    device = Device(((TransferPath(1.0, 1.0, (2.0,), (1.0,), 1.0),),), *axes, (0.0,))
    command = staircase([1.0, 0.0, -1.0, 1.0, 0.0], hold=8.0)
    record = truth(device, Bench(camera=1 / 3), command, duration=40.0, name="steps")
    priors = {
        "gain": {"dist": "norm", "loc": 1.0, "scale": 0.5},
        **{f"time_{k}": {"dist": "loguniform", "a": 0.3, "b": 30.0} for k in (1, 2, 3)},
        "delay": {"dist": "uniform", "loc": 0.0, "scale": 3.0},
        "sigma": {"dist": "loguniform", "a": NOISE / 10, "b": 10 * NOISE},
    }
    return Study(
        "model-choice",
        None,
        "ms",
        SEED,
        (record,),
        model={"terms": 3, "offset": "none", "blocks": 480, "exposure_ms": 1 / 3},
        priors=priors,
        noise={"kind": "white"},
    )


def problems() -> dict[str, Problem]:
    """Every candidate made ready on the template."""
    return {one.name: problem_of(one.study) for one in candidates_of(template(), pick=KINDS)}


def identified(problem: Problem, values: Vector) -> bool:
    """Whether the record determines a truth, and its orders from integers, by the audit's curvature."""
    table = problem.posterior.table
    orders = [k for k in table.of_kind("order") if table.rows[k].free]
    apart = [float(np.abs(values[k] - np.array([0.0, 1.0, 2.0])).min()) for k in orders]
    if apart and min(apart) < APART:
        return False
    found = curvature(Landscape(problem.posterior), values, np.ones(values.size))
    for name, sd in zip(found.names, found.sd, strict=True):
        limit = KNOWN if name.startswith("time") else np.inf
        if name.startswith("order"):
            limit = KNOWN * apart[[table.names[k] for k in orders].index(name)]
        if not sd <= limit:
            return False
    return True


def drawn(problem: Problem, rng: np.random.Generator) -> tuple[Vector, int]:
    """A truth that the record determines, and how many draws it took."""
    table, tries = problem.posterior.table, 0
    sigma = table.names.index("sigma")
    while tries < MOST_TRIES:
        for values in table.draw(64, rng):
            tries += 1
            values[sigma] = NOISE
            if identified(problem, values):
                return values, tries
    raise RuntimeError(f"no truth of {tries} is determined by the record; lower the noise")


def replica(number: int, *, quick: bool) -> dict[str, Any]:
    """One truth, its record, and the evidence of every candidate. Depends on `number` and `quick` alone."""
    prepared, kind = problems(), KINDS[number % len(KINDS)]
    rng = np.random.default_rng([SEED, number])
    values, tries = drawn(prepared[kind], rng)
    posterior = prepared[kind].posterior
    clean = [part[:, 0].T for part in responses(posterior.table, posterior.model, values[None])]
    records = measured(prepared[kind], values, clean, rng)
    rows = []
    for name, one in prepared.items():
        if one.study.model.orders == "free" and one.study.model.terms > LARGEST[kind]:
            continue
        posterior = problem_of(replace(one.study, fit=records)).posterior
        plan = SamplePlan.of(posterior.dimension, seed=1000 * SEED + number, **PLAN)
        plan = replace(plan, steps=plan.steps // 4) if quick else plan
        run = sample(posterior, plan)
        draws = gather(posterior, run)
        weighed = evidence(posterior, run.kept()[0], draws.ess, plan.seed)
        assert weighed is not None
        rows.append(
            {
                "name": name,
                "log_evidence": weighed.value,
                "log_evidence_sd": weighed.sd,
                "grade": draws.grade.level,
                "usable": draws.grade.level != "unusable",
                "parameters": sum(row.free for row in posterior.table.rows),
            }
        )
    chosen = simplest([row for row in rows if row["usable"]], by_evidence, "log_evidence")
    names = prepared[kind].posterior.table.names
    return {
        "replica": number,
        "quick": quick,
        "kind": kind,
        "truth": dict(zip(names, values.tolist(), strict=True)),
        "tries": tries,
        "preferred": None if chosen is None else chosen["name"],
        "candidates": rows,
    }


def summary(found: list[dict[str, Any]]) -> dict[str, Any]:
    """Shares with 90 % intervals (Clopper and Pearson 1934), by kind of truth and in all."""
    rows = []
    for kind in KINDS:
        own = [one for one in found if one["kind"] == kind]
        chosen = [one["preferred"] for one in own]
        rows.append(
            {
                "kind": kind,
                "replicas": len(own),
                "preferred": sum(name == kind for name in chosen),
                "others": {str(name): chosen.count(name) for name in dict.fromkeys(chosen) if name != kind},
            }
        )
    right = sum(row["preferred"] for row in rows)
    whole = [one for one in found if one["kind"] in INTEGER]
    called = sum(one["preferred"] not in (*INTEGER, None) for one in whole)
    return {
        "replicas": len(found),
        "generating_model_preferred": _share(right, len(found)),
        "integer_called_fractional": _share(called, len(whole)),
        "kinds": rows,
        "noise": NOISE,
        "seed": SEED,
        "plan": PLAN,
        "largest_log_evidence_sd": max(
            (row["log_evidence_sd"] for one in found for row in one["candidates"]), default=None
        ),
        "unusable_candidates": sum(not row["usable"] for one in found for row in one["candidates"]),
    }


def _share(count: int, of: int) -> dict[str, Any]:
    low = 0.0 if count == 0 else float(beta.ppf(0.05, count, of - count + 1))
    high = 1.0 if count == of else float(beta.ppf(0.95, count + 1, of - count))
    return {
        "count": count,
        "of": of,
        "share": count / of if of else None,
        "lower": low,
        "upper": high,
        "level": 0.9,
    }


def _perform(quick: bool, number: int) -> dict[str, Any]:
    return replica(number, quick=quick)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--replicas", type=int, default=100)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("reports/model-choice"))
    parser.add_argument("--quick", action="store_true", help="a quarter of the steps")
    options = parser.parse_args()
    folder = writable_folder(writable_folder(options.out) / "replicas")
    done: dict[int, dict[str, Any]] = {}
    for number in range(options.replicas):
        path = folder / f"{number:05d}.json"
        result = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
        if result is not None and result["quick"] == options.quick:
            done[number] = result
    missing = [number for number in range(options.replicas) if number not in done]
    with workers(options.quick, jobs=options.jobs) as crew:
        for result in crew.finished(_perform, missing):
            done[result["replica"]] = result
            write_text(folder / f"{result['replica']:05d}.json", json.dumps(result, allow_nan=False) + "\n")
            right = sum(one["preferred"] == one["kind"] for one in done.values())
            print(f"{len(done)} of {options.replicas}: {right} right", flush=True)
    result = summary([done[number] for number in sorted(done)])
    write_text(options.out / "summary.json", json.dumps(result, indent=1, allow_nan=False) + "\n")
    share = result["generating_model_preferred"]
    print(
        f"generating model preferred in {share['count']} of {share['of']}, 90 % interval "
        f"{share['lower']:.3f} to {share['upper']:.3f}"
    )


if __name__ == "__main__":
    from choice import main as run  # workers do not run this script: what they do must be in a module

    run()
