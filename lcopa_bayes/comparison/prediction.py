"""Expected log predictive density of what was left out, and the road by which it was computed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, final

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]
from scipy.special import logsumexp

from lcopa_bayes.arrays import Array, Flags, Index, Matrix, Vector
from lcopa_bayes.comparison.carry import carried
from lcopa_bayes.comparison.parts import Part, parts_of, predicted, without
from lcopa_bayes.estimate import plain
from lcopa_bayes.fit import Fit
from lcopa_bayes.inference.data import Samples
from lcopa_bayes.inference.grade import TENTATIVE_RHAT, Level
from lcopa_bayes.inference.noise import AR1, Noise, White
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.plant.forward import ForwardModel
from lcopa_bayes.predict import offset_draws, responses

LARGEST_K = 0.7
"""Largest Pareto k of importance weights that are used [-] (Vehtari et al. 2024, JMLR 25)."""
_FEWEST = 100.0
"""Effective draws below which importance weights are not used [-]."""
_DRAWS = 600
"""Draws behind a predictive density."""

Road = Literal["exact", "importance weights", "refit"]


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
    """Of each sample given the known samples alone, (n,) [nat]."""
    error: float
    """Monte Carlo standard error of the sum, by the spread between parts of the draws [nat]."""
    road: Road
    pareto_k: float
    """Of the importance weights [-]; NaN where none were tried."""
    ess: float
    """Draws the densities are worth [-]."""
    rhat: float
    """Between the ensembles of a refit [-]; NaN on the other roads."""

    def grade(self, fitted: Level) -> Level:
        """That of the draws, lowered where a refit's populations disagree or are small."""
        agree = self.road != "refit" or (self.rhat <= TENTATIVE_RHAT and self.ess >= _FEWEST)
        return fitted if agree or fitted == "unusable" else "tentative"

    def as_json(self) -> dict[str, Any]:
        """Plain values, without the samples."""
        told: dict[str, Any] = plain(
            {
                "part": self.part.name,
                "kind": self.part.kind,
                "samples": self.time.size,
                "elpd": float(self.log_density.sum()),
                "monte_carlo_sd": self.error,
                "road": self.road,
                "pareto_k": self.pareto_k,
                "ess": self.ess,
                "rhat": self.rhat,
            }
        )
        return told


def predictions(fit: Fit, *, held_out_only: bool = False) -> tuple[Predicted, ...]:
    """Every part of a fitted study (`parts_of`), each sample given the known samples only.

    ``sum_i log p(y_i | known)``: each sample by itself, since the joint density of a long record is beyond
    importance sampling. Held-out records come from the draws as they are. What was fitted is taken away
    again by importance weights when their Pareto k is at most 0.7 and 100 draws or more stay effective, else
    by a refit (`carry`).
    """
    posterior, study = fit.problem.posterior, fit.study
    positions = _walkers(fit)
    out = []
    source = posterior
    for part in parts_of(posterior, [record.name for record in study.held_out]):
        if part.kind == "held-out record":
            samples, model = fit.problem.simulated(study.held_out)
            values = fit.draws.thinned(_DRAWS)
            out.append(
                _scored(fit, part, samples[part.record], _one(model, part.record), values, None, "exact")
            )
            continue
        if held_out_only:
            continue
        own, model = posterior.samples[part.record], _one(posterior.model, part.record)
        values = fit.draws.thinned(2 * _DRAWS)
        target = without(posterior, part)
        weights, k = _weights(posterior, target, values)
        if k <= LARGEST_K and float(np.exp(-logsumexp(2 * weights))) >= _FEWEST:
            out.append(_scored(fit, part, own, model, values, weights, "importance weights", k=k))
            continue
        seed = fit.run.plan.seed + 7_000 + len(out)
        found = carried(source, target, positions, seed, jump=False)
        if part.kind == "future of the record":  # the next part knows still less
            source, positions = target, found.coordinates[:, :, -1]
        rng = np.random.default_rng([seed, 5])
        flat = found.coordinates.reshape(-1, posterior.dimension)
        chosen = np.linspace(0, len(flat) - 1, min(_DRAWS, len(flat))).astype(int)
        values = target.complete(flat[chosen], rng)
        out.append(_scored(fit, part, own, model, values, None, "refit", k=k, ess=found.ess, rhat=found.rhat))
    return tuple(out)


def _one(model: ForwardModel, number: int) -> ForwardModel:
    return ForwardModel(model.layout, (model.experiments[number],))


def _walkers(fit: Fit) -> Array:
    """Walkers of every ensemble, at their last kept draw, (ensembles, walkers, dimension)."""
    return fit.run.kept()[0][:, :, -1]


def _weights(posterior: Posterior, target: Posterior, values: Matrix) -> tuple[Vector, float]:
    """Smoothed log weights that take the left-out samples away, and their Pareto k."""
    removed = _log_likelihood(posterior, values) - _log_likelihood(target, values)
    log_weights, k = array_stats.psislw(-removed)  # type: ignore[no-untyped-call]
    return np.asarray(log_weights, dtype=float), float(k)


def _log_likelihood(posterior: Posterior, values: Matrix) -> Vector:
    total = np.zeros(len(values))
    for portion in np.array_split(np.arange(len(values)), max(1, len(values) // 64)):
        records = posterior.pointwise(values[portion])
        total[portion] = np.sum([axis.sum(axis=1) for record in records for axis in record], axis=0)
    return total


def _scored(
    fit: Fit,
    part: Part,
    samples: Samples,
    model: ForwardModel,
    values: Matrix,
    log_weights: Vector | None,
    road: Road,
    *,
    k: float = np.nan,
    ess: float | None = None,
    rhat: float = np.nan,
) -> Predicted:
    """Densities of the samples of a part under weighted draws."""
    table, noise = fit.draws.table, fit.problem.posterior.noise
    rng = np.random.default_rng([fit.run.plan.seed, 6, part.record, part.known])
    plant = np.concatenate(
        [responses(table, model, piece)[0] for piece in np.array_split(values, max(1, len(values) // 64))],
        axis=1,
    )
    axes: list[str] = []
    times: list[Vector] = []
    densities: list[Matrix] = []
    for axis, observed in enumerate(samples.axes):
        chosen = predicted(observed, part)
        if not chosen.size:
            continue
        response = plant[axis][:, observed.index]
        offset, _, used = offset_draws(
            table,
            values,
            axis,
            part.record,
            samples,
            response,
            noise,
            held_out=part.known == 0,
            rng=rng,
        )
        residual = observed.values - response - offset[:, None]
        if used:  # samples before the drive acts set the offset: no prediction
            begin = _quiet(samples, observed.index)
            chosen = chosen[~begin[chosen]]
        parameters = values[:, [table.at(name, axis) for name in noise.names]]
        densities.append(_densities(noise, residual, parameters, observed.gaps, chosen, part.known))
        axes += [samples.record.response_axes[axis].name] * chosen.size
        times.append(samples.times[observed.index[chosen]])
    every = np.concatenate(densities, axis=1) if densities else np.empty((len(values), 0))
    level = np.full(len(values), -np.log(len(values))) if log_weights is None else log_weights
    level = level - logsumexp(level)
    effective = float(np.exp(-logsumexp(2 * level)))
    return Predicted(
        part,
        tuple(axes),
        np.concatenate(times) if times else np.empty(0),
        logsumexp(every + level[:, None], axis=0),
        _error(every, level),
        road,
        k,
        min(effective, ess if ess is not None else fit.draws.ess),
        rhat,
    )


def _densities(
    noise: Noise, residual: Matrix, parameters: Matrix, gaps: Vector, chosen: Index, known: int
) -> Matrix:
    """Log density of each chosen sample given the last known one, (draws, chosen).

    Correlated noise remembers the last known sample over the gap; what is predicted tells nothing.
    """
    wanted = residual[:, chosen]
    if not isinstance(noise, AR1):
        return noise.pointwise(wanted, parameters, np.ones(wanted.shape[1]))
    sigma, rho = parameters[:, :1], parameters[:, 1:2]
    link = np.zeros_like(wanted)
    before = int(chosen[0]) - 1
    if known and before >= 0 and chosen.size:
        since = np.cumsum(gaps)[chosen] - np.cumsum(gaps)[before]
        link = rho**since
    middle = link * residual[:, [max(before, 0)]]
    scale = sigma * np.sqrt(1 - link**2)
    return White().pointwise((wanted - middle) / scale, np.ones((len(wanted), 1)), gaps[chosen]) - np.log(
        scale
    )


def _quiet(samples: Samples, index: Index) -> Flags:
    """Samples taken before any drive changes."""
    drive = samples.record.drive
    moved = np.flatnonzero((drive != drive[0]).any(axis=1))
    begin = samples.record.time[moved[0]] if moved.size else np.inf
    return np.asarray(samples.times[index] <= begin)


def _error(every: Matrix, level: Vector, groups: int = 4) -> float:
    """Standard error of the sum of log means by its spread over groups of draws."""
    if not every.shape[1]:
        return 0.0
    parts = np.array_split(np.arange(len(every)), groups)
    sums = [
        float((logsumexp(every[part] + level[part, None], axis=0) - logsumexp(level[part])).sum())
        for part in parts
    ]
    return float(np.std(sums, ddof=1) / np.sqrt(groups))
