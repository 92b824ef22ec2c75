"""Expected log predictive density of what was left out, and the method by which it was computed."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.comparison.sequentialdensity import (
    LevelFrom,
    Part,
    applies,
    known_before,
    level_of,
    linear_densities,
    log_densities,
    parts_of,
    predicted,
    without,
)
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.forward import ForwardModel
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.sampling.bridge import transferred
from lcopa_bayes.sampling.convergence import TENTATIVE_RHAT, Grade, Level
from lcopa_bayes.sampling.evidence import known_to
from lcopa_bayes.sampling.importanceweights import FEWEST_EFFECTIVE, effective, smoothed, usable_k
from lcopa_bayes.sampling.weighted import resampled

_DRAWS, _EFFECT_DRAWS = 600, 200
"""Draws behind a predictive density, and with effects, which take a simulation each."""
_BEYOND = 3.0
"""Standard errors by which a density of what was left out may exceed that of what was fitted [-]."""

Method = Literal["exact", "importance weights", "refit"]


@final
@dataclass(frozen=True, eq=False)
class Predicted:
    """Log predictive densities of the samples of one part, all axes."""

    part: Part
    axis: tuple[str, ...]
    """Of each sample."""
    time: Vector
    """(n,) [time unit]."""
    log_density: Vector
    """Of each sample given the known samples and those of its record before it, (n,) [nat]."""
    error: float
    """Monte Carlo standard error of the sum, by the spread between parts of the draws [nat]."""
    method: Method
    pareto_k: float
    """Of the importance weights [-]; NaN where none were tried."""
    ess: float
    """Draws the densities are worth [-]."""
    rhat: float
    """Between the ensembles of a refit [-]; NaN otherwise."""
    level_from: tuple[LevelFrom, ...]
    """Where the level of each axis comes from."""
    in_sample: float = np.nan
    """Sum of the densities of the same samples under draws that have seen them [nat]; NaN for what none
    has seen."""
    in_sample_error: float = np.nan
    """Its Monte Carlo standard error [nat]."""

    @property
    def plausible(self) -> bool:
        """Whether the density is no larger than where the samples themselves were fitted; else the draws
        do not represent the posterior without them."""
        if np.isnan(self.in_sample):
            return True
        excess = float(self.log_density.sum()) - self.in_sample
        return bool(excess <= _BEYOND * np.hypot(self.error, self.in_sample_error))

    def grade(self, fitted: Level) -> Level:
        """That of the draws, lowered where a refit's populations disagree or are small, where what was left
        out is predicted better than it was fitted, and where the Monte Carlo error is larger than an evidence
        may have."""
        known = known_to(self.error)
        agree = self.method != "refit" or (self.rhat <= TENTATIVE_RHAT and self.ess >= FEWEST_EFFECTIVE)
        own: Level = "reliable" if agree and self.plausible else "tentative"
        return Grade.worst([Grade(level, "") for level in (fitted, own, known)]).level

    def as_json(self) -> dict[str, Any]:
        """Plain values, without the samples."""
        return plain(
            {
                "part": self.part.name,
                "kind": self.part.kind,
                "samples": self.time.size,
                "elpd": float(self.log_density.sum()),
                "monte_carlo_sd": self.error,
                **attributes(self, "in_sample", "plausible", "method", "pareto_k", "ess", "rhat"),
                "level_from": list(dict.fromkeys(self.level_from)),
            }
        )


def predictions(fit: Fit, *, held_out_only: bool = False) -> tuple[Predicted, ...]:
    """Every part of a fitted study (`parts_of`), each sample given the known ones (`sequentialdensity`).

    ``sum_i log E[p(y_i | y_1 .. y_i-1, theta) | known]``, i over the samples of a part: the log density of
    one forecast of the record by the posterior of its shared parameters given what is known. Held-out
    records come from the draws as they are. What was fitted is taken away again by importance weights when
    their Pareto k is at most 0.7 and 100 draws or more stay effective, else by a refit (`bridge`).
    """
    posterior, study = fit.near, fit.study
    simulated = posterior.simulation is not None
    count = _EFFECT_DRAWS if simulated else _DRAWS
    tried = count if simulated and posterior.surrogate is None else _DRAWS
    positions = fit.run.kept()[0][:, :, -1]
    out: list[Predicted] = []
    source = posterior
    for part in parts_of(posterior, [record.name for record in study.held_out]):
        if part.kind == "held-out record":
            samples, model = fit.problem.simulated(study.held_out)
            scored = _Scored(fit, part, samples[part.record], model.only(part.record))
            out.append(scored(fit.draws.thinned(count), None, "exact", known=posterior))
            continue
        if held_out_only:
            continue
        scored = _Scored(fit, part, posterior.samples[part.record], posterior.model.only(part.record))
        seen = scored(fit.draws.thinned(count), None, "exact")
        values = fit.draws.thinned(2 * tried)
        target = without(posterior, part)
        weights, k = left_out_weights(posterior, target, values, fit.draws.ess / len(fit.draws.flat))
        rng = np.random.default_rng([fit.run.plan.seed, 5, len(out)])
        if k <= usable_k(len(values)) and effective(weights) >= FEWEST_EFFECTIVE:
            # gains and levels are drawn anew: those of the draws have seen what is to be predicted
            values = target.complete(posterior.coordinates(values), rng)
            worth = effective(weights)
            if simulated:  # each density takes a simulation
                values = values[resampled(weights, count, rng)]
            own = None if simulated else weights
            result = scored(values, own, "importance weights", k=k, ess=worth, known=target)
        else:
            seed = fit.run.plan.seed + 7_000 + len(out)
            moved = transferred(source, target, positions, seed, jump=False)
            if part.kind == "future of the record":  # the next part knows still less
                source, positions = target, moved.coordinates[:, :, -1]
            flat = moved.coordinates.reshape(-1, posterior.dimension)
            chosen = np.linspace(0, len(flat) - 1, min(count, len(flat))).astype(int)
            values = target.complete(flat[chosen], rng)
            result = scored(values, None, "refit", k=k, ess=moved.ess, rhat=moved.rhat, known=target)
        total = float(seen.log_density.sum())
        out.append(replace(result, in_sample=total, in_sample_error=seen.error))
    return tuple(out)


def left_out_weights(
    posterior: Posterior, target: Posterior, values: Matrix, r_eff: float = 1.0
) -> tuple[Vector, float]:
    """Normalised log weights (draws,) that turn draws of a posterior into draws of one that knows less,
    smoothed, and their Pareto k.

    Gains and levels that are integrated out do not count: the weights are those of the sampled coordinates.
    """
    return smoothed(target.log_likelihood(values) - posterior.log_likelihood(values), r_eff=r_eff)


@final
@dataclass(frozen=True, eq=False)
class _Scored:
    """Densities of the samples of a part under weighted draws."""

    fit: Fit
    part: Part
    samples: Samples
    model: ForwardModel

    def __call__(
        self,
        values: Matrix,
        log_weights: Vector | None,
        method: Method,
        *,
        k: float = np.nan,
        ess: float | None = None,
        rhat: float = np.nan,
        known: Posterior | None = None,
    ) -> Predicted:
        scored = [k for k, one in enumerate(self.samples.axes) if predicted(one, self.part).size]
        pieces = np.array_split(values, max(1, len(values) // 64))
        each = self._linear if known is not None and applies(known) else self._drawn
        parts = [each(piece, known) for piece in pieces]
        densities = [np.concatenate([part[axis] for part in parts]) for axis in scored]
        table, axes, times, sources = self.fit.draws.table, list[str](), list[Vector](), list[LevelFrom]()
        for axis in scored:
            observed = self.samples.axes[axis]
            last = int(np.count_nonzero(observed.index < self.part.until))
            index = observed.index[:last][known_before(self.samples, axis, self.part) :]
            sources.append(level_of(table, values, axis, self.part, self.samples).source)
            axes += [self.samples.record.response_axes[axis].name] * index.size
            times.append(self.samples.times[index])
        every = np.concatenate(densities, axis=1) if densities else np.empty((len(values), 0))
        level = np.full(len(values), -np.log(len(values))) if log_weights is None else log_weights
        return Predicted(
            part=self.part,
            axis=tuple(axes),
            time=np.concatenate(times) if times else np.empty(0),
            log_density=logsumexp(every + level[:, None], axis=0),
            error=_error(every, level),
            method=method,
            pareto_k=k,
            ess=min(effective(level), ess if ess is not None else self.fit.draws.ess),
            rhat=rhat,
            level_from=tuple(sources),
        )

    def _linear(self, values: Matrix, known: Posterior | None) -> list[Matrix]:
        """Densities (draws, predicted) of every axis, gains and levels integrated out."""
        assert known is not None
        first = [known_before(self.samples, axis, self.part) for axis in range(len(self.samples.axes))]
        return linear_densities(known, self.part, self.samples, self.model, values, first)

    def _drawn(self, values: Matrix, _: Posterior | None) -> list[Matrix]:
        """The same at the gains and levels of the draws."""
        table, noise = self.fit.draws.table, self.fit.problem.posterior.noise
        plant, out = responses(table, self.model, values)[0], []
        for axis, observed in enumerate(self.samples.axes):
            last = int(np.count_nonzero(observed.index < self.part.until))
            residual = observed.values[:last] - plant[axis][:, observed.index[:last]]
            parameters = values[:, [table.at(name, axis) for name in noise.names]]
            level = level_of(table, values, axis, self.part, self.samples).value
            first = known_before(self.samples, axis, self.part)
            out.append(log_densities(noise, residual, parameters, observed.gaps[:last], level, first))
        return out


def _error(every: Matrix, level: Vector) -> float:
    """Standard error of the sum of log means by its spread over groups of draws."""
    groups = 4
    if not every.shape[1]:
        return 0.0
    parts = np.array_split(np.arange(len(every)), groups)
    sums = [
        float((logsumexp(every[part] + level[part, None], axis=0) - logsumexp(level[part])).sum())
        for part in parts
    ]
    return float(np.std(sums, ddof=1) / np.sqrt(groups))
