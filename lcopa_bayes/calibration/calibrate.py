"""The verb `calibrate`: many replicas of a study's whole inference, finished, stored and gathered."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from lcopa_bayes.calibration.replica import ENGINES, Engine, Failure, Outcome, Replication
from lcopa_bayes.calibration.store import Store
from lcopa_bayes.calibration.truths import Stated, Truths, truths_around, truths_stated
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.core.rules import whole, word_of
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.fit import plan_of

MOST = 99_999
"""Replicas a store has room for."""
ENOUGH = 400
"""Effective draws of a replica: a rank among so many is exact to 0.05, far below the scatter of ranks."""


@dataclass(frozen=True, eq=False)
class Calibration:
    """Replicas of a study, in the order of their numbers."""

    replication: Replication
    outcomes: tuple[Outcome, ...]
    failures: tuple[Failure, ...]

    @property
    def asked(self) -> int:
        """Replicas asked for."""
        return len(self.outcomes) + len(self.failures)


def calibrate(
    study: Study,
    *,
    replicas: int,
    around: Path | None = None,
    truth: Mapping[str, Stated] | None = None,
    engine: Engine = "importance",
    jobs: int = 1,
    dask: str | None = None,
    folder: Path | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> Calibration:
    """Draw truths, simulate the study's records from them, infer, and rank the truths (Talts et al. 2018).

    Truths come from the study's prior, or from the posterior in the run folder `around`; parameters named in
    `truth` have that value in every replica, or are drawn evenly from that range, each in its unit. Every
    replica is inferred with the study's model and priors; priors derived from its records stay as they are,
    unless all of a truth is stated: then they are derived from the replica's own. Draws come from importance
    sampling around the optima (`inference.importance`) and, where its weights are not good or `engine` says
    so, from the study's sampler, for at most `ENOUGH` effective draws. Replica k depends on the study, its
    seed and k alone: neither on `jobs` processes nor on the cluster at the address `dask`, nor on
    interruptions. With `folder`, finished replicas are stored in its `replicas/`, and `resume` goes on from
    them. InputError for input that cannot be used, when a worker is lost, and when not one replica could be
    done.
    """
    both = ["`around` and `truth` both say where truths come from; give one"] if around and truth else []
    refuse_if(
        [*whole(1, MOST).problems("replicas", replicas), *word_of(*ENGINES).problems("engine", engine), *both]
    )
    problem = problem_of(study)
    table = problem.posterior.table
    if around is not None:
        truths = truths_around(around, table)
    else:
        truths = truths_stated(truth, table) if truth else Truths(table)
    plan = plan_of(problem, quick=quick)
    plan = replace(plan, target_ess=min(plan.target_ess, ENOUGH))
    replication = Replication(problem, plan, truths, engine)
    with workers(replication, jobs=min(jobs, replicas), dask=dask) as crew:
        store = Store.within(folder, replication) if folder is not None else None
        done = store.load(replicas) if store and resume else {}
        if store and not resume:
            store.clear()
        failures: list[Failure] = []
        grades = Counter(outcome.grade for outcome in done.values())
        missing = [number for number in range(replicas) if number not in done]
        with Progress(
            total=replicas, initial=len(done), unit="replica", quiet=quiet, desc="calibrating"
        ) as bar:
            for outcome in crew.finished(_attempt, missing, replication.lost) if missing else ():
                if isinstance(outcome, Failure):
                    failures.append(outcome)
                else:
                    done[outcome.replica] = outcome
                    if store:
                        store.save(outcome)
                grades["failed" if isinstance(outcome, Failure) else outcome.grade] += 1
                bar.set_postfix({grade: f"{count}" for grade, count in sorted(grades.items())})
                bar.update()
    failures.sort(key=lambda failure: failure.replica)
    if not done:
        raise InputError(
            f"{study.name}: not one of {replicas} replicas could be done; the first, number "
            f"{failures[0].replica} with seed {failures[0].seed}, ended in {failures[0].error}"
        )
    return Calibration(replication, tuple(done[number] for number in sorted(done)), tuple(failures))


def _attempt(replication: Replication, number: int) -> Outcome | Failure:
    return replication.attempt(number)
