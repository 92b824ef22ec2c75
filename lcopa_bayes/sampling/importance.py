"""A posterior by importance sampling around its optima: much faster than ensembles, where it holds.

The proposal is a mixture of Student components in the chart of the posterior, one group per local optimum,
fitted to its own weighted draws in a few rounds (Cappé, Douc, Guillin, Marin and Robert 2008, Statistics and
Computing 18) and widened in part, so that its tails are heavier than the posterior's. Draws of a last, fixed
proposal carry the result. Their weights are smoothed by a generalised Pareto distribution, whose shape k
tells whether averages over them converge (Vehtari, Simpson, Gelman, Yao and Gabry 2024, JMLR 25).

What no draw of the proposal reaches, no weight can show: a mode that neither the starts of the optimisation
nor the tails of the proposal meet is missed. Tempered ensembles (`sampler`) are the method for posteriors
with several modes, and what a caller falls back to where `Importance.good` is false.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import Quality, between
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.evidence import Mapped, charted_density
from lcopa_bayes.sampling.importanceweights import effective, smoothed, usable_k
from lcopa_bayes.sampling.proposal import Seen, around, fitted, split, weighty

LEAST_EFFICIENCY = 0.4
"""Effective draws per draw of a good result [-]. A small k alone is not enough: a two-term posterior gave
k = 0.4 at an efficiency of 0.2 while a third of its mass had not been met."""
_MOST = 12
"""Components beyond which a further attempt takes more draws alone [-]."""
_LIGHT = 0.2
"""Pareto k at which the proposal is fitted no further, if it is efficient [-]."""
_BATCHES = 4
"""Independent parts of the draws, compared as ensembles are."""
_PER_BATCH = 500
"""Draws delivered per part."""
_CHUNK = 128
"""Draws completed at a time."""


@final
@dataclass(frozen=True)
class Effort:
    """How much work one attempt may spend."""

    draws: int
    """Draws of the last proposal."""
    learning: int
    """Draws of each round that fits the proposal."""
    rounds: int
    """Most such rounds."""


@final
@dataclass(frozen=True)
class ImportancePlan:
    """How much work importance sampling may spend."""

    efforts: tuple[Effort, ...] = (Effort(4_000, 1_000, 6), Effort(8_000, 3_000, 6))
    """Attempts, each going on from the one before with more components, until one is good."""
    starts: int = 6
    """Starts of the least-squares search."""
    wanted: float = 400.0
    """Effective draws of a good one."""


@final
@dataclass(frozen=True, eq=False)
class Importance:
    """Weighted draws of a posterior."""

    coordinates: Matrix
    """Sampled coordinates of every draw, exchangeable terms by decreasing order, (draws, dimension)."""
    log_density: Vector
    """Log posterior density, as `Posterior.log_density`, (draws,) [nat]; -inf where there is none."""
    log_weights: Vector
    """Normalised and Pareto-smoothed, (draws,) [nat]; -inf where the density is 0."""
    pareto_k: float
    """Shape of the weights' tail [-]; infinite where too few draws have any weight."""
    ess: float
    """Effective number of draws, ``1 / sum w^2`` [-]."""
    log_evidence: float
    """Log of the integral of prior times likelihood [nat]."""
    log_evidence_sd: float
    """Standard error [nat]."""
    modes: int
    """Optima the proposal started from."""
    evaluations: int
    """Evaluations of the density, those of the optimisation not counted."""
    raw: Vector
    """Log of density over proposal, (draws,) [nat]."""

    def good(self, wanted: float) -> bool:
        """Whether averages converge, the proposal is close to the posterior, and enough draws count."""
        count = self.log_weights.size
        return self.pareto_k <= usable_k(count) and self.ess >= max(wanted, LEAST_EFFICIENCY * count)

    def resampled(self, count: int, rng: np.random.Generator, *, part: slice = slice(None)) -> Index:
        """Positions of `count` draws with equal weights, in random order, by systematic resampling.

        Of a `part` of the draws: parts of the whole are independent of each other.
        """
        log_weights = self.log_weights[part]
        share = np.cumsum(np.exp(log_weights - log_weights.max()))
        at = (rng.random() + np.arange(count)) / count
        chosen = np.searchsorted(share / share[-1], at)
        return np.asarray(rng.permutation(np.arange(self.log_weights.size)[part][chosen]))


def first_look(
    posterior: Posterior,
    rng: np.random.Generator,
    plan: ImportancePlan = ImportancePlan(),
    mapped: Mapped = map,
) -> Importance | None:
    """Optima of a posterior from several starts, and importance sampling around them.

    None where no start led to an optimum of positive density.
    """
    optima = find_optima(posterior, rng, starts=plan.starts)
    return importance(posterior, optima, rng, plan, mapped) if optima else None


def importance(
    posterior: Posterior,
    optima: Sequence[Optimum],
    rng: np.random.Generator,
    plan: ImportancePlan = ImportancePlan(),
    mapped: Mapped = map,
) -> Importance:
    """Importance sampling around given optima, one or more; `mapped` spreads the density over processes.

    FloatingPointError where the density is NaN.
    """
    chart = Chart.of(posterior)
    chosen = weighty(optima)
    proposal = core = around(posterior, chart, chosen, rng)
    seen = Seen((), (), ())
    for effort in plan.efforts:
        if seen.proposals and len(core.means) < _MOST:
            core = split(core, rng)
        for _ in range(effort.rounds):
            y = proposal.draw(effort.learning, rng)
            seen = seen.joined(proposal, y, charted_density(posterior, chart, y, mapped))
            log_weights = seen.log_weights()
            if np.isneginf(log_weights).all():
                break
            own, k = tail_smoothed(seen.last_weights())
            core, proposal = fitted(core, np.concatenate(seen.points), log_weights)
            if k <= _LIGHT and effective(own) > LEAST_EFFICIENCY * effort.learning:
                break
        y = proposal.draw(effort.draws, rng)
        density = charted_density(posterior, chart, y, mapped)
        found = _weighed(posterior, chart, y, density, density - proposal.log_density(y))
        if found.good(plan.wanted):
            break
        seen = seen.joined(proposal, y, density)
    spent = sum(map(len, seen.points)) + (len(y) if found.good(plan.wanted) else 0)
    return replace(found, modes=len(chosen), evaluations=spent)


def _weighed(posterior: Posterior, chart: Chart, y: Matrix, charted: Vector, raw: Vector) -> Importance:
    """Charted draws of one proposal with their densities in the chart and their log weights."""
    z, exists = chart.uncharted(y)
    density = np.full(len(y), -np.inf)
    inside = exists & np.isfinite(charted)
    density[inside] = charted[inside] + chart.charted(z[inside])[1] - posterior.table.log_permutations
    log_weights, k = tail_smoothed(raw)
    if np.isneginf(raw).all():
        return Importance(z, density, log_weights, k, 0.0, -np.inf, np.inf, 0, 0, raw)
    mean = float(logsumexp(raw) - np.log(raw.size))
    error = float(np.std(np.exp(raw - mean)) / np.sqrt(raw.size))
    return Importance(z, density, log_weights, k, effective(log_weights), mean, error, 0, 0, raw)


def tail_smoothed(log_weights: Vector) -> tuple[Vector, float]:
    """Normalised log weights with a smoothed tail, and its Pareto k; log weights of -inf are allowed.

    k is infinite, and nothing is smoothed, where so few weights are positive that there is no tail to fit.
    """
    positive = np.count_nonzero(np.isfinite(log_weights))
    if positive <= max(3 * np.sqrt(log_weights.size) + 1, log_weights.size // 5):
        return log_weights - (logsumexp(log_weights) if positive else 0.0), np.inf
    return smoothed(log_weights)


def weighted_draws(
    posterior: Posterior, found: Importance, rng: np.random.Generator, *, target_ess: float
) -> Draws:
    """Draws of every parameter from weighted ones, linear parameters drawn exactly, with their grade.

    Parts of the weighted draws stand for the ensembles of a sampler: being independent, they let R-hat and
    scatter see a mean that hangs on a few draws. The effective sample size is that of the weights: it
    is known here, and need not be judged by four means.
    """
    count = found.log_weights.size
    parts = [slice(k * count // _BATCHES, (k + 1) * count // _BATCHES) for k in range(_BATCHES)]
    chosen = np.concatenate([found.resampled(_PER_BATCH, rng, part=part) for part in parts])
    chunks = np.array_split(found.coordinates[chosen], max(1, chosen.size // _CHUNK))
    values = np.concatenate([posterior.complete(chunk, rng) for chunk in chunks])
    values = values.reshape(_BATCHES, _PER_BATCH, -1)
    rows = posterior.table.rows
    measured = tuple(
        Quality(
            row.name,
            found.ess,
            found.ess,
            float(array_stats.rhat_nested(values[..., k], np.arange(_BATCHES))),  # type: ignore[no-untyped-call]
            scatter=between(values[:, None, :, k])[1],
        )
        for k, row in enumerate(rows)
        if row.free
    )
    density = found.log_density[chosen].reshape(_BATCHES, _PER_BATCH)
    return Draws(posterior.table, values, density, measured, target_ess)
