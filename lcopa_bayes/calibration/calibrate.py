"""The verb `calibrate`: many replicas of a study's whole inference, finished, stored and gathered.

Finished replicas on disk, one small file each, so that a killed calibration goes on where it stopped.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, final

from lcopa_bayes.calibration.replica import ENGINES, Engine, Failure, Outcome, Replication
from lcopa_bayes.calibration.truths import Stated, Truths, truths_around, truths_stated
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.parallel import on_cluster, workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.core.rules import whole, word_of
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.results.runfolder import fingerprint

_ADVICE = "leave out --resume to start anew, or choose another --out"


def store_fingerprint(replication: Replication) -> str:
    """Hash of everything an outcome depends on besides its number."""
    values = (
        fingerprint(replication.problem.study, replication.plan),
        replication.truths.digest,
        replication.engine,
        [list(quantity) for quantity in replication.quantities],
    )
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


@final
@dataclass(frozen=True)
class Store:
    """Folder of outcomes that share a fingerprint."""

    folder: Path
    fingerprint: str

    @classmethod
    def within(cls, folder: Path, replication: Replication) -> Store:
        """The store of a calibration whose results go to `folder`; InputError when it cannot be written."""
        return cls(writable_folder(writable_folder(folder) / "replicas"), store_fingerprint(replication))

    def save(self, outcome: Outcome) -> None:
        """Write an outcome whole or not at all; InputError when there is no room for it."""
        text = json.dumps({"fingerprint": self.fingerprint} | asdict(outcome), allow_nan=False)
        try:
            write_text(self._path(outcome.replica), text + "\n")
        except InputError as error:
            problems = [*error.problems, "what was stored before is intact; go on with --resume"]
            raise InputError(problems) from error

    def load(self, replicas: int) -> dict[int, Outcome]:
        """Outcomes stored of the first replicas; InputError when one is damaged or of another study."""
        paths = {number: self._path(number) for number in range(replicas)}
        return {number: self._outcome(path) for number, path in paths.items() if path.exists()}

    def clear(self) -> None:
        """Remove every outcome."""
        for path in self.folder.glob("[0-9]*.json"):
            path.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:05d}.json"

    def _outcome(self, path: Path) -> Outcome:
        try:
            values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            own = values.pop("fingerprint") == self.fingerprint
            if own:
                tuples = {"truths": tuple(values["truths"]), "ranks": tuple(values["ranks"])}
                return Outcome(**values | tuples | {"inside": tuple(tuple(row) for row in values["inside"])})
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(
                f"{path}: not a replica this program wrote, or damaged ({error}); {_ADVICE}"
            ) from None
        raise InputError(f"{path}: of other records, settings, truths or seed; {_ADVICE}")


MOST = 99_999
"""Replicas a store has room for."""
ENOUGH = 400
"""Effective draws of a replica: a rank among so many is exact to 0.05, far below the scatter of ranks."""


@final
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
    with on_cluster(dask) as many, workers(replication, jobs=many if dask else min(jobs, replicas)) as crew:
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
            for outcome in crew.finished(Replication.attempt, missing, replication.lost) if missing else ():
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
