"""The verb `compare`: candidates fitted side by side, scored and decided.

Cards of all candidates joined: probabilities, weights, differences, and the decision.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.comparison.averaging import Gain, averaged, by_prediction, stretches, total_sd
from lcopa_bayes.comparison.candidatefit import REJECTED, Contender, contender
from lcopa_bayes.comparison.candidates import Candidate
from lcopa_bayes.comparison.containment import Check
from lcopa_bayes.comparison.decision import decided
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import writable_folder
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of

_ROUNDS = 2_000
_SETTLED = 1e-10
_SIMULATED = 4_000

_KEPT_APART = ("pointwise", "curves", "starts", "quantiles")
"""Entries of a card that stay in the folder of their candidate."""

Card = Mapping[str, Any]


def judged(cards: Sequence[Card], study: Study) -> dict[str, Any]:
    """The result of `compare` as plain values.

    Unusable candidates keep their card and the reason, but are ranked nowhere.
    """
    rows = [dict(card) for card in cards]
    _evidences(rows, study.seed)
    _predictions(rows)
    result = decided(rows)
    fractional = [row for row in rows if not row["integer"]]
    return plain(
        {
            "study": study.name,
            "time_unit": study.time_unit,
            "seed": study.seed,
            "fit": [record.name for record in study.fit],
            "held_out": [record.name for record in study.held_out],
            **result,
            "averaged": averaged(rows),
            "order_is_integer": [
                {"model": row["name"]} | dict(one) for row in fractional for one in row["order_is_integer"]
            ],
            "models": [{key: value for key, value in row.items() if key not in _KEPT_APART} for row in rows],
        }
    )


def _evidences(rows: Sequence[dict[str, Any]], seed: int) -> None:
    """Posterior probabilities, and Bayes factors against the most probable, into the rows."""
    ranked = [row for row in rows if row["usable"] and row["log_evidence"] is not None]
    for row in rows:
        row |= {"probability": None, "probability_sd": None, "log_bayes_factor": None}
        row |= {"log_bayes_factor_sd": None, "widths": []}
    if not ranked:
        return
    values = np.array([row["log_evidence"] for row in ranked])
    errors = np.array([row["log_evidence_sd"] for row in ranked])
    shares, spread = probabilities(values, errors, np.random.default_rng([seed, 9]))
    best = int(np.argmax(values))
    for k, row in enumerate(ranked):
        row["probability"], row["probability_sd"] = float(shares[k]), float(spread[k])
        row["log_bayes_factor"] = float(values[k] - values[best])
        row["log_bayes_factor_sd"] = float(np.hypot(errors[k], errors[best])) if k != best else 0.0


def _predictions(rows: Sequence[dict[str, Any]]) -> None:
    """Totals of log predictive densities, differences from the best, and stacking weights, into the rows."""
    for row in rows:
        row |= {"elpd": None, "elpd_sd": None, "elpd_difference": None, "elpd_difference_sd": None}
        row |= {"elpd_monte_carlo_sd": None, "stacking": None, "held_out_rmse": _rmse(row)}
    ranked = [row for row in rows if row["usable"] and row["pointwise"]["log_density"]]
    if not ranked:
        return
    columns: Matrix = np.array([row["pointwise"]["log_density"] for row in ranked]).T
    where = stretches(ranked[0]["pointwise"])
    sums = np.array([columns[where == block].sum(axis=0) for block in np.unique(where)])
    totals = columns.sum(axis=0)
    weights = stacking_weights(columns)
    for k, row in enumerate(ranked):
        row["elpd"], row["elpd_sd"] = float(totals[k]), total_sd(sums[:, k])
        own = [one["monte_carlo_sd"] for one in row["predictions"]]
        row["elpd_monte_carlo_sd"] = float(np.linalg.norm(own))
    best = ranked[int(np.argmax(totals))]
    for k, row in enumerate(ranked):
        gain = Gain(0.0, 0.0) if row is best else by_prediction(row, best)
        assert gain is not None
        row["elpd_difference"], row["elpd_difference_sd"] = gain.nats, gain.sd
        row["stacking"] = float(weights[k])


def _rmse(row: Card) -> dict[str, float]:
    """Held-out error of each response axis over all its records [response unit]."""
    pooled: dict[str, list[tuple[float, int]]] = {}
    for one in row["held_out"]:
        pooled.setdefault(one["axis"], []).append((one["rmse"] ** 2 * one["samples"], one["samples"]))
    return {
        axis: float(np.sqrt(sum(s for s, _ in parts) / sum(n for _, n in parts)))
        for axis, parts in pooled.items()
    }


def stacking_weights(log_density: Matrix) -> Vector:
    """Weights of the mixture of candidates that predicts best, (candidates,) [-].

    ``max_w sum_i log sum_k w_k p_k(y_i)`` (Yao et al. 2018, Bayesian Analysis 13), a concave problem, by
    expectation maximisation. `log_density` is (samples, candidates).
    """
    weights = np.full(log_density.shape[1], 1.0 / log_density.shape[1])
    before = -np.inf
    for _ in range(_ROUNDS):
        with np.errstate(divide="ignore"):
            joint = log_density + np.log(weights)
        total = logsumexp(joint, axis=1)
        weights = np.exp(joint - total[:, None]).mean(axis=0)
        if total.sum() - before < _SETTLED * abs(total.sum()):
            break
        before = float(total.sum())
    return np.asarray(weights / weights.sum())


def probabilities(log_evidence: Vector, sd: Vector, rng: np.random.Generator) -> tuple[Vector, Vector]:
    """Posterior probabilities of candidates that were equally likely before, and their Monte Carlo error.

    Both (candidates,) [-]; the error is the spread when log evidences err normally by `sd` [nat].
    """
    weights = np.exp(log_evidence - logsumexp(log_evidence))
    drawn = log_evidence + sd * rng.standard_normal((_SIMULATED, log_evidence.size))
    spread = np.exp(drawn - logsumexp(drawn, axis=1, keepdims=True)).std(axis=0)
    return np.asarray(weights), np.asarray(spread)


def compare(
    candidates: Sequence[Candidate],
    *,
    jobs: int = 1,
    folder: Path | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> dict[str, Any]:
    """Fit every candidate, score it, and say which is warranted; plain values as `compare.json` holds them.

    A candidate whose optima lie far below another's evidence is sampled around these alone
    (`candidatefit.REJECTED`). A candidate that contains another is held against it, and sampled again where
    it has missed a mode that the smaller one has found (`containment`).

    Candidates are fitted in `jobs` processes; what they give is the same, unless a budget of time ends one
    (`candidatefit.BUDGET`). With `folder` each has a folder of its own under `candidates/`, and `resume` goes
    on from what is there. InputError for fewer than two candidates, for candidates of different records, and
    when a candidate does not fit its records; then nothing is fitted.
    """
    problems = _problems(candidates)
    refuse_if(problems)
    place = None if folder is None else writable_folder(folder).resolve() / "candidates"
    tasks = []
    for one in candidates:
        own = None if place is None else writable_folder(place / folder_name(one.name))
        tasks.append(contender(one, own, quick=quick, resume=resume))
    cards: dict[str, Mapping[str, Any]] = {}
    with Progress(total=len(tasks), unit="candidate", quiet=quiet, desc="comparing") as bar:
        with workers(None, jobs=min(jobs, len(tasks))) as crew:
            levels = list(crew.each(_rough, tasks))
        for known in (True, False):  # with effects first: their evidence tells whom to sample how
            chosen = [k for k, level in enumerate(levels) if (level is None) == known]
            if not chosen:
                continue
            reached = [one["log_evidence"] for one in cards.values()]
            best = max([level for level in (*levels, *reached) if level is not None], default=-np.inf)
            for k in chosen:
                level = levels[k]
                behind = level is not None and level < best - REJECTED and tasks[k].candidate.fit is None
                tasks[k] = replace(tasks[k], rejected=behind)
            for values in _performed([tasks[k] for k in chosen], jobs):
                cards[str(values["name"])] = values
                bar.update()
        bar.set_description("holding against contained models")
        for wave in _by_size(tasks, cards):
            smaller = [task for task in tasks if _size(cards, task) < _size(cards, wave[0])]
            others = tuple((task.candidate, cards[task.candidate.name]) for task in smaller)
            checks = [Check(task, cards[task.candidate.name], others) for task in wave]
            for values in _performed(checks, jobs):
                cards[str(values["name"])] = values
    return judged([cards[one.name] for one in candidates], candidates[0].study)


def _size(cards: Mapping[str, Mapping[str, Any]], task: Contender) -> int:
    return int(cards[task.candidate.name]["parameters"])


def _by_size(tasks: Sequence[Contender], cards: Mapping[str, Mapping[str, Any]]) -> Iterator[list[Contender]]:
    """Candidates of equally many parameters together, the smallest first: what one has found, the richer
    ones are held against."""
    for size in sorted({_size(cards, task) for task in tasks}):
        yield [task for task in tasks if _size(cards, task) == size]


def folder_name(name: str) -> str:
    """Folder of a candidate."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name)


def _problems(candidates: Sequence[Candidate]) -> list[str]:
    problems: list[str] = []
    if len(candidates) < 2:
        problems.append(
            f"a comparison needs two candidates or more; got {len(candidates)}: name others under "
            "[compare] pick, [[candidates]] or --pick"
        )
    names = [one.name for one in candidates]
    folders = [folder_name(name) for name in names]
    problems += [
        f"candidates {', '.join(repr(n) for n, f in zip(names, folders, strict=True) if f == twice)} would "
        "share a folder; give them other names"
        for twice in sorted({f for f in folders if folders.count(f) > 1})
    ]
    for one in candidates[1:]:
        if not _same_data(candidates[0], one):
            problems.append(
                f"candidates {candidates[0].name!r} and {one.name!r} have different data; evidence and "
                "predictions compare models of the same records only"
            )
    for one in candidates if not problems else ():
        try:
            problem_of(one.study)
        except InputError as error:
            problems += [f"candidate {one.name!r}: {problem}" for problem in error.problems]
    return problems


def _same_data(one: Candidate, other: Candidate) -> bool:
    """Whether two candidates are fitted to and held against the same samples."""

    def held(candidate: Candidate) -> list[tuple[str, bytes, bytes, bytes]]:
        study = candidate.study
        return [
            (record.name, record.time.tobytes(), record.drive.tobytes(), record.response.tobytes())
            for record in (*study.fit, *study.held_out)
        ]

    return held(one) == held(other) and len(one.study.fit) == len(other.study.fit)


def _performed(tasks: Sequence[Contender | Check], jobs: int) -> Iterator[Mapping[str, Any]]:
    """Cards as they are finished, the largest model begun first."""
    ranked = sorted(tasks, key=lambda task: -problem_of(task.candidate.study).posterior.dimension)
    with workers(None, jobs=min(jobs, len(tasks))) as crew:
        yield from crew.finished(_perform, ranked)


def _rough(_: None, task: Contender) -> float | None:
    return task.rough


def _perform(_: None, task: Contender | Check) -> Mapping[str, Any]:
    return task()
