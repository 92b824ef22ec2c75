"""`calibrate`: whether the whole inference of a study covers what it states.

What replicas say together: coverage, uniformity of ranks, a grade and one sentence.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.calibration.calibrate import Calibration
from lcopa_bayes.calibration.calibrate import calibrate as calibrated
from lcopa_bayes.calibration.ranks import LEVELS, SIMULTANEOUS, Coverage, bin_limits, corridor, p_uniform
from lcopa_bayes.calibration.replica import ENGINES, RANKED, Engine, Outcome, Quantity
from lcopa_bayes.calibration.truths import Stated, Truths
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.files import csv_of
from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.results.discretisation import LARGEST
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.runfolder import opened, provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.results.structure import settled
from lcopa_bayes.sampling.importanceweights import LARGEST_K
from lcopa_bayes.verbs.sources import StudyLike, study_of

_BINS = (20, 10, 5)
"""Bins a rank histogram may have; they divide the `RANKED` + 1 rank values evenly [-]."""
_PER_BIN = 10
"""Replicas expected in a bin at least, if there are enough of them [-]."""
SMALL_P = 0.05
"""Below this overall p-value ranks are not uniform [-]."""
_MOST_OF_THEM = 0.9
"""Share of reliable replicas above which a calibration speaks of reliable runs [-]."""
_FEWEST = 50
"""With fewer replicas the bands are too wide to say much [-]."""
_COVERED = ("parameter", "step response")


def results(calibration: Calibration) -> dict[str, Any]:
    """Every number of a calibration as plain JSON values; only `seconds` differs from run to run."""
    replication = calibration.replication
    study, truths, plan = replication.problem.study, replication.truths, replication.plan
    reliable = [outcome for outcome in calibration.outcomes if outcome.grade == "reliable"]
    everything = over(calibration.outcomes, replication.quantities)
    grade, reason = graded(calibration, len(reliable))
    spent = np.array([outcome.seconds for outcome in calibration.outcomes])
    gaps = np.array([outcome.gap for outcome in calibration.outcomes])
    sampler = attributes(plan, "ensembles", "walkers") | {"most_steps": plan.steps}
    values = {
        "study": study.name,
        "verdict": verdict(everything, calibration),
        "grade": grade,
        "grade_reason": reason,
        "time_unit": study.time_unit,
        "seed": study.seed,
        "asked": calibration.asked,
        **everything,
        "reliable": over(reliable, replication.quantities) if reliable else None,
        "grades": grades(calibration),
        "not_reliable": [
            attributes(o, "replica", "seed", "grade", "reason")
            for o in calibration.outcomes
            if o.grade != "reliable"
        ],
        "failures": [asdict(f) for f in calibration.failures],
        "truths": {
            "from": _origin(truths),
            "folder": truths.folder or None,
            "grade": truths.grade or None,
            "stated": dict(truths.stated) or None,
        },
        "engine": engines(calibration),
        "model_gap": {
            "unit": "noise scale",
            "median": np.median(gaps),
            "quantile_90": np.quantile(gaps, 0.9),
            "largest": gaps.max(),
        },
        "discretisation": {
            "largest_negligible": LARGEST,
            "unit": "posterior sd",
            "negligible": sum(outcome.resolved for outcome in calibration.outcomes),
            "median": np.median([outcome.shift for outcome in calibration.outcomes]),
            "largest": max(outcome.shift for outcome in calibration.outcomes),
            "largest_refinement": max(outcome.refinement for outcome in calibration.outcomes),
        },
        "seconds": {"total": spent.sum(), "median": np.median(spent), "largest": spent.max()},
        "sampler": sampler | attributes(plan, "thin", "target_ess"),
    }
    return plain(values)


def over(outcomes: Sequence[Outcome], quantities: Sequence[Quantity]) -> dict[str, Any]:
    """Coverage and ranks over some replicas, with the bands of so many."""
    count, ranks = len(outcomes), np.array([outcome.ranks for outcome in outcomes])
    inside = np.array([outcome.inside for outcome in outcomes])  # (replicas, quantities, levels)
    covered = [k for k, quantity in enumerate(quantities) if quantity.kind in _COVERED]
    confidence = 1 - (1 - SIMULTANEOUS) / (len(covered) * len(LEVELS))  # Bonferroni
    rows = [
        Coverage(quantities[k].name, quantities[k].kind, level, int(inside[:, k, i].sum()), count, confidence)
        for k in covered
        for i, level in enumerate(LEVELS)
    ]
    counts = [np.bincount(column, minlength=RANKED + 1) for column in ranks.T]
    p_values = [p_uniform(column) for column in counts]
    bins = next((number for number in _BINS if count >= _PER_BIN * number), _BINS[-1])
    low, high = bin_limits(count, bins)
    lower, upper = corridor(count, RANKED + 1)
    return {
        "replicas": count,
        "coverage": [row.as_json() for row in rows],
        "simultaneous": SIMULTANEOUS,
        "p_value": min(1.0, len(p_values) * min(p_values)),
        "p_value_of": f"smallest of {len(p_values)} rank tests, times {len(p_values)} (Bonferroni)",
        "ranks": [
            {"parameter": q.name, "kind": q.kind, "unit": q.unit, "p_value": p, "counts": column}
            for q, p, column in zip(quantities, p_values, counts, strict=True)
        ],
        "rank_bins": {"bins": bins, "lower": low, "upper": high},
        "rank_corridor": {"lower": lower, "upper": upper},
    }


def _origin(truths: Truths) -> str:
    if truths.pool is not None:
        return "posterior"
    return "stated" if truths.fixed else "stated and prior" if truths.stated else "prior"


def engines(calibration: Calibration) -> dict[str, Any]:
    """Number of replicas that each engine gave the draws of, and the Pareto k of importance weights."""
    known = [outcome.pareto_k for outcome in calibration.outcomes if outcome.pareto_k is not None]
    return {
        "wanted": calibration.replication.engine,
        **{name: sum(outcome.engine == name for outcome in calibration.outcomes) for name in ENGINES},
        "largest_good_k": LARGEST_K,
        "median_k": np.median(known) if known else None,
        "largest_k": max(known, default=None),
    }


def grades(calibration: Calibration) -> dict[str, int]:
    """Number of replicas of each grade."""
    result = Counter(outcome.grade for outcome in calibration.outcomes)
    return {level: result[level] for level in ("reliable", "tentative", "unusable")} | {
        "failed": len(calibration.failures)
    }


def graded(calibration: Calibration, reliable: int) -> tuple[str, str]:
    """How far a calibration speaks of runs one would use, and why."""
    share, count = reliable / calibration.asked, len(calibration.outcomes)
    said = f"{reliable} of {calibration.asked} replicas are graded reliable"
    if share < 0.5:
        return "unusable", f"{said}; give the sampler of the study more steps"
    if calibration.failures:
        return "tentative", f"{said} and {len(calibration.failures)} failed"
    if share < _MOST_OF_THEM:
        return "tentative", f"{said}; give the sampler of the study more steps"
    if count < _FEWEST:
        return "tentative", f"{said}, but so few replicas leave wide bands; run {_FEWEST} or more"
    return "reliable", said


def verdict(values: dict[str, Any], calibration: Calibration) -> str:
    """One or two sentences: which intervals cover, whether ranks are uniform, what the truths were."""
    rows, count, p = values["coverage"], values["replicas"], values["p_value"]
    outside = [row for row in rows if not row["within"]]
    band = f"its Monte Carlo band (simultaneous {_percent(SIMULTANEOUS)}, {count} replicas)"
    if outside:
        said = ", ".join(
            f"{row['parameter']} at {_percent(row['level'])} ({_percent(row['observed'])}, band "
            f"{_percent(row['lower'])} to {_percent(row['upper'])})"
            for row in outside
        )
        parts = [f"Coverage is outside {band} for {said}."]
    else:
        parameters = len({row["parameter"] for row in rows if row["kind"] == "parameter"})
        levels = " and ".join(map(_percent, LEVELS))
        parts = [
            f"Coverage of {levels} intervals is within {band} for every one of {parameters} parameters "
            "and every step response."
        ]
    truths = calibration.replication.truths
    if truths.stated:
        parts.append(
            f"The truth was {'' if truths.fixed else 'in part '}stated, not drawn from the prior: coverage "
            "is then nominal as far as the priors are wide beside the posterior and the likelihood is smooth "
            "at the truth, and ranks need not be uniform."
        )
        return " ".join([*parts, *_failed(calibration)])
    uneven = [row["parameter"] for row in values["ranks"] if len(values["ranks"]) * row["p_value"] < SMALL_P]
    parts.append(
        f"Ranks are not uniform (overall p = {p:.2g}): {', '.join(uneven)}."
        if p < SMALL_P
        else f"Ranks are uniform as far as so many replicas show (overall p = {p:.2g})."
    )
    if truths.pool is not None:
        parts.append(
            "Truths came from an earlier posterior while every replica was inferred under the prior of the "
            "study: exact coverage is expected only where that prior is flat over the posterior."
        )
    return " ".join([*parts, *_failed(calibration)])


def _failed(calibration: Calibration) -> list[str]:
    if not calibration.failures:
        return []
    first = calibration.failures[0]
    return [
        f"{len(calibration.failures)} of {calibration.asked} replicas failed and are not counted, the first "
        f"being number {first.replica} (seed {first.seed}): {first.error}."
    ]


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %"


def tables(calibration: Calibration) -> dict[str, pd.DataFrame]:
    """Tables by file name: one row per replica, and one per replica and quantity."""
    quantities = calibration.replication.quantities
    return {
        "replicas": pd.DataFrame(
            [
                {
                    **attributes(o, "replica", "seed", "grade"),
                    "smallest_ess": o.ess,
                    "model_gap": o.gap,
                    "block_shift": o.shift,
                    **attributes(o, "resolved", "refinement", "engine", "pareto_k", "seconds"),
                }
                for o in calibration.outcomes
            ]
        ),
        "ranks": pd.DataFrame(
            [
                {"replica": o.replica, "name": q.name, "unit": q.unit, "truth": truth, "rank": rank}
                | {
                    f"inside_{level:.0%}".rstrip("%"): held
                    for level, held in zip(LEVELS, inside, strict=True)
                }
                for o in calibration.outcomes
                for q, truth, rank, inside in zip(quantities, o.truths, o.ranks, o.inside, strict=True)
            ]
        ),
    }


@final
@dataclass(frozen=True, eq=False)
class CalibrationResult(StoredResult):
    """Coverage and ranks of true values over simulated studies."""

    verb, file, beside = "calibrate", "results.json", ("tables/replicas.csv", "tables/ranks.csv")

    def summary(self) -> pd.DataFrame:
        """One row per quantity and level of its intervals: share of the truths inside, and the band [-] in
        which that share lies when the inference covers as stated."""
        return pd.DataFrame(self.values["coverage"])


@on_one_thread
def calibrate(
    study: StudyLike | Predictive,
    *,
    replicas: int = 100,
    around: Path | str | None = None,
    truth: Mapping[str, Stated] | None = None,
    engine: Engine = "importance",
    dask: str | None = None,
    jobs: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> CalibrationResult:
    """Draw truths, simulate the study's records from them, infer, and rank the truths (Talts et al. 2018).

    Parameters: `study`, or a fit of it; `replicas`, simulated studies; `around`, the run folder of a fit
    whose posterior truths are drawn from, in place of the prior; `truth`, values or ranges by parameter name
    [unit of the parameter]; `engine`, ``importance`` or ``sampling``; `dask`, address of a cluster that does
    the replicas; `jobs`, processes to use; `folder`, a run folder to write into, from which `resume` goes on;
    `quick`, a quarter of the steps; `quiet`, no progress bar.

    InputError for input that cannot be used, when a worker is lost, when not one replica could be done, and
    for a folder as `fit`.
    """
    wanted = settled(study_of(study), jobs=jobs)
    origin = plain(provenance(wanted, "calibrate"))
    with opened(folder, origin) as place:
        calibration = calibrated(
            wanted,
            replicas=replicas,
            around=None if around is None else Path(around),
            truth=truth,
            engine=engine,
            jobs=jobs,
            dask=dask,
            folder=place,
            resume=resume,
            quick=quick,
            quiet=quiet,
        )
        texts = {f"tables/{name}.csv": csv_of(table) for name, table in tables(calibration).items()}
        return CalibrationResult(results(calibration), origin, texts).kept(place)
