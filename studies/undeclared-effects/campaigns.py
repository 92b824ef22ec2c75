"""One hidden-effect campaign: made on the virtual bench, looped, and judged against its truth."""

import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import foreign
import numpy as np
from devicetruth import place, side_figures, size_deviations, steady_truth, step_deviations
from threadpoolctl import threadpool_limits

from lcopa_bayes.bench.hiddeneffects import Hidden, MarchError
from lcopa_bayes.bench.undeclared import NOISE, Campaign, campaign, drawn
from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.files import write_text
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.findings import Side
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.scores import pooled_coverage
from lcopa_bayes.results.structure import with_least_terms

_ATTEMPTS = 20
FREEDOM = 4.0
"""Degrees of freedom of the noise of a heavy-tailed control [-]."""
TERMS = {"direct": 2, "cross": 1}
"""What the study of a campaign says of its model: the truth's, without any effect."""


def _student(noise: Matrix, chance: np.random.Generator) -> Matrix:
    """Normal noise made Student's t of the same standard deviation, with pi/4 of its correlations."""
    return noise * np.sqrt((FREEDOM - 2) / chance.chisquare(FREEDOM, noise.shape))


HEAVY = Hidden("outliers", {"inverse_nu": 1 / FREEDOM}, disturbance=True, noise=_student)
"""What the noise of a heavy-tailed control has, under the name that the catalogue has for it."""


@dataclass(frozen=True)
class Task:
    """What one campaign hides."""

    kind: str
    """clean, coloured, heavy, named, plain, outside, pair, control or foreign."""
    effects: tuple[str, ...]
    drives: str
    correlation: float
    seed: int
    sampled: bool = False
    """Whether the final posterior is drawn too."""
    quiet: int = 0
    """Samples at rest of each axis, over all fit records, and no repeat; 0: as recorded."""
    plant: str = ""
    """Kind of a foreign plant, whose study states nothing of its model; empty: the steerer of the bench."""

    @property
    def name(self) -> str:
        return "_".join([self.kind, *self.effects, str(self.seed)])


def study_of(made: Campaign, seed: int) -> Study:
    """The records alone, as a user has them."""
    return Study("hidden", None, "ms", seed, made.fit, made.held_out, ModelSettings(terms=TERMS))


def play(folder: Path, task: Task) -> dict[str, Any]:
    """Make, loop and judge; the row is kept in `folder`, and read back when it is there."""
    path = folder / f"{task.name}.json"
    if path.exists():
        return json.loads(path.read_text(encoding="utf-8"))
    with threadpool_limits(1):
        if task.plant:
            made = foreign.campaign(task.plant, task.effects, task.seed)
            study = with_least_terms(made.study(task.seed))  # as the verb does
        else:
            made = measured(task)
            study = study_of(made, task.seed)
        begun, cpu = time.perf_counter(), time.process_time()
        try:
            found = loop(study, sample=task.sampled, as_stated=not task.plant)
            row = asdict(task) | judged(found, made) | (foreign.scored if task.plant else scored)(found, made)
        except Exception as error:  # a crash is a result too, and must not end the others
            row = asdict(task) | {"crashed": f"{type(error).__name__}: {error}"}
    row |= {"seconds": time.perf_counter() - begun, "cpu_seconds": time.process_time() - cpu}
    text = json.dumps(row, indent=1)
    write_text(path, text)
    return json.loads(text)  # as it is read back when the sheet goes on


def measured(task: Task) -> Campaign:
    """The campaign of a task; sizes whose device runs away are drawn again, since nobody could measure it."""
    for attempt in range(_ATTEMPTS):
        rng = np.random.default_rng([task.seed, 77, *([attempt] if attempt else [])])
        try:
            hidden = [*drawn(task.effects, rng), *([HEAVY] if task.kind == "heavy" else [])]
            made = campaign(hidden, rng, drives=task.drives, correlation=task.correlation)
        except MarchError:
            continue
        return shortened(made, task.quiet) if task.quiet else made
    raise RuntimeError(f"{task.name}: no device of {_ATTEMPTS} has a bounded response")


def shortened(made: Campaign, quiet: int) -> Campaign:
    """The campaign less its repeat, with so many samples at rest of each axis in the fit records together."""
    repeated = made.fit[-1]
    fit = [one for one in made.fit if one is not repeated]
    rest = 0.8 * made.device.paths[0][0].delay  # what the loop takes for rest of a delay
    share, out = -(-quiet // len(fit)), []
    for one in fit:
        moved = one.time[np.flatnonzero((one.drive != one.drive[0]).any(axis=1))[0]]
        sampled = np.flatnonzero(~np.isnan(one.response).all(axis=1) & (one.time < moved + rest))
        response = np.array(one.response)
        response[sampled[: max(sampled.size - share, 0)]] = np.nan
        out.append(replace(one, response=response))
    return replace(made, fit=tuple(out))


def judged(found: Loop, made: Campaign | foreign.Foreign) -> dict[str, Any]:
    """What the loop said, beside the truth that only the judge sees."""
    trace = found.trace
    truth = [one.name for one in made.hidden]
    refits = [
        [[list(one.added), one.log_bayes_factor, one.left_out] for one in made_round.refits]
        for made_round in found.rounds
    ]
    return {
        "crashed": "",
        "truth": truth,
        "sizes": {one.name: dict(one.numbers) for one in made.hidden},
        "disturbance": all(one.disturbance for one in made.hidden) if made.hidden else False,
        "verdict": found.verdict.kind,
        "confidence": found.verdict.confidence,
        "sentence": found.verdict.sentence,
        "named": list(found.names),
        "groups": [*(list(group) for group in found.groups), *([["outliers"]] if found.outliers else [])],
        "alarmed": bool(trace and trace.alarmed),
        "threshold": trace.threshold if trace else None,
        "survival": {name: _survival(found, name) for name in truth},
        "leading": [[one.name, one.log_bayes_factor] for one in trace.traced[:6]] if trace else [],
        "of_truth": {name: _evidence(found, name) for name in truth},
        "refits": refits,
        "correlations": [one.law.share * one.law.rho for one in found.base.noise],
        "quiet_samples": [one.samples if one.known else 0 for one in found.base.noise],
        "base_failed": found.base.failed,
        "before": errors(found.before, made),
        "after": errors(found.after, made),
        "coverage_before": pooled_coverage(found.before.unseen),
        "coverage_after": pooled_coverage(found.after.unseen),
        "share_with_band": float(np.mean([score.banded for score in found.after.unseen])),
        "grade": found.grade.level if found.draws else None,
    }


def scored(found: Loop, made: Campaign) -> dict[str, Any]:
    """Places of gains, delays and figures of the device, and of the sizes of its effects [normal sd]."""
    return {
        "plant_before": deviations(found, made, found.before)
        | step_deviations(side_figures(found, found.before), found, made),
        "plant_alone": deviations(found, made, found.after)
        | step_deviations(found.figures, found, made, alone=True),
        "plant_after": deviations(found, made) | step_deviations(found.figures, found, made),
        "sizes_after": size_deviations(found, made),
    }


def errors(side: Side, made: Campaign | foreign.Foreign) -> dict[str, float]:
    """Root mean square errors over the noise [-], on held-out records against the response without noise or
    disturbances."""
    axes = [one.name for one in made.fit[0].response_axes]
    noise = dict(zip(axes, np.broadcast_to(getattr(made, "noise", NOISE), len(axes)), strict=True))
    fit = np.concatenate([(score.observed - score.predicted) / noise[score.axis] for score in side.fit])
    apart = []
    for score in side.unseen:
        record = next(one for one in made.held_out if one.name == score.record)
        rows = np.searchsorted(record.time, score.time)
        exact = made.truth[score.record][rows, axes.index(score.axis)]
        apart.append((score.predicted - exact) / noise[score.axis])
    both = np.concatenate(apart)
    return {
        "fit_over_noise": float(np.sqrt(np.mean(fit**2))),
        "held_out_truth_over_noise": float(np.sqrt(np.mean(both**2))),
    }


def deviations(found: Loop, made: Campaign, alone: Side | None = None) -> dict[str, float]:
    """Where the gains and the delay of the device lie among the values of a loop, by name [normal sd]; of one
    side `alone`, less its own, on the scale that they are sampled on [posterior sd]."""
    state, out, steady = (alone or found.after).state, {}, steady_truth(found, made)
    model, sd = state.model, np.sqrt(np.diag(state.covariance))
    for k in range(model.plant_size):
        row = model.posterior.table.rows[model.columns[k]]
        if row.kind not in ("gain", "delay"):
            continue
        truth = float(steady[row.place]) if row.kind == "gain" else made.device.paths[0][0].delay
        if alone is not None:
            out[row.name] = float((state.optimum.x[k] - row.coordinate(truth)) / sd[k])
        else:
            out[row.name] = place(found.number(k).values, truth)
    return out


def _survival(found: Loop, name: str) -> float | None:
    try:
        value = found.trace.of(name).survival if found.trace else np.nan
    except KeyError:
        return None
    return float(value) if np.isfinite(value) else None


def _evidence(found: Loop, name: str) -> float | None:
    try:
        return found.trace.of(name).log_bayes_factor if found.trace else None
    except KeyError:
        return None
