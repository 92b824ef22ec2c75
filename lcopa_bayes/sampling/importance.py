"""A posterior by importance sampling around its optima: much faster than ensembles, where it holds.

The proposal is a mixture of Student components in the chart of the posterior, one group per local optimum,
fitted to its own weighted draws in a few rounds (Cappé, Douc, Guillin, Marin and Robert 2008, Statistics and
Computing 18) and widened in part, so that its tails are heavier than the posterior's. Draws of a last, fixed
proposal give the result. Their weights are smoothed by a generalised Pareto distribution, whose shape k
shows whether averages over them converge (Vehtari, Simpson, Gelman, Yao and Gabry 2024, JMLR 25).

No weight shows what no draw of the proposal reaches: a mode outside the starts of the optimisation and the
tails of the proposal is missed. Tempered ensembles (`sampler`) are the method for posteriors
with several modes, and what a caller falls back to where `Importance.good` is false.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Index, Matrix, Vector
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart, Mapped, charted_density
from lcopa_bayes.sampling.importanceweights import effective, usable_k
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.proposal import Blend, Product, Proposal, Seen, around, fitted, split, weighty
from lcopa_bayes.sampling.straightened import Straightened
from lcopa_bayes.sampling.weighted import Weighted, tail_smoothed

LEAST_EFFICIENCY = 0.4
"""Effective draws per draw of a good result [-]. A small k alone is not enough: a two-term posterior gave
k = 0.4 at an efficiency of 0.2 while a third of its mass was not covered."""
_MOST = 12
"""Components beyond which a further attempt takes more draws alone [-]."""
_JOINT = 0.3
"""Share of a proposal in which plant and noise are not apart [-]."""
_SURPLUS = 1.25
"""Effective draws for every centre, tail and share of a mode over those wanted [-]: resampling costs the
rest."""
_LONGER, _SPARE = 6.0, 1.1
"""How many times as many draws a good proposal that gave too few gives at most, and factor on the number that
is estimated to be lacking [-]."""
_PORTION = 250
"""Draws between two looks at the clock, of responses with effects [-]."""
_LIGHT, _HEAVY, _CLOSE = 0.4, 0.9, 0.3
"""Pareto k up to which a proposal gives more draws rather than being fitted further, if it is efficient, and
from which a third attempt has little hope; effective draws per draw at which one is that need not be close
to the posterior [-]."""


@final
@dataclass(frozen=True)
class Effort:
    """Limits on the work of one attempt."""

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
    """Attempts, each continuing the previous attempt with more components, until the draws are good."""
    starts: int = 6
    """Starts of the least-squares search."""
    wanted: float = 400.0
    """Effective draws of a good attempt."""
    efficient: bool = True
    """Whether a good attempt is close to the posterior."""
    straightened: bool = False
    """Whether the proposal follows a curve along the orders, that of other parameters given these."""
    promising: float = 0.0
    """Effective draws per draw of the last proposal that was learned from, below which no further attempt is
    made [-]; above 0 a third one is made only after one with a Pareto k below `_HEAVY`."""


@final
@dataclass(frozen=True, eq=False)
class Importance:
    """Weighted draws of a posterior around its optima."""

    weighted: Weighted
    proposal: Proposal
    """That they are drawn from, in the chart of the posterior."""
    modes: int
    """Optima the proposal started from."""
    evaluations: int
    """Evaluations of the density, those of the optimisation not counted."""

    def good(self, wanted: float, *, efficient: bool = True) -> bool:
        """Whether averages converge, the proposal is close to the posterior where it has to be `efficient`,
        and enough draws count."""
        own, least = self.weighted, LEAST_EFFICIENCY if efficient else 0.0
        if own.pareto_k > usable_k(own.count) or own.ess < max(wanted, least * own.count):
            return False
        return own.smallest_ess >= _SURPLUS * wanted


def importance(
    posterior: Posterior,
    optima: Sequence[Optimum],
    rng: np.random.Generator,
    plan: ImportancePlan = ImportancePlan(),
    mapped: Mapped = map,
    late: Callable[[], bool] = lambda: False,
    begin: Mixture | None = None,
    rough: Callable[[Matrix], Vector] | None = None,
) -> Importance | None:
    """Importance sampling around given optima, one or more, or from a proposal to `begin` with, in the chart;
    `mapped` spreads the density over processes. Once it is `late` no further attempt is made, and no further
    draws of responses with effects are simulated, but for a few of the last proposal. None where no optimum
    has a surrounding inside the prior. The proposal is fitted to a `rough` density of charted coordinates,
    where there is a cheaper one; its draws are weighted by the posterior itself.

    FloatingPointError where the density is NaN.
    """
    chart = Chart.of(posterior)
    chosen = weighty(optima)
    first, groups = begin or around(posterior, chart, chosen, rng), _apart(posterior)
    if first is None:
        return None
    cores = [first, *(first.marginal(own) for own in groups if len(groups) > 1)]
    proposal: Proposal = first
    exact = partial(charted_density, posterior, chart, mapped=mapped)
    rough = rough or exact
    dear = posterior.simulation is not None and posterior.surrogate is None
    portion = _PORTION if dear else None
    rows = [posterior.table.rows[k] for k in posterior.sampled]
    orders = np.flatnonzero([row.kind == "order" for row in rows])
    seen = Seen()
    for number, effort in enumerate(plan.efforts, start=1):
        if seen.proposals and len(cores[0].means) < _MOST:
            cores = [split(core, rng) for core in cores]
        worth = np.inf
        for _ in range(effort.rounds):
            y, density = _evaluated(proposal.draw(effort.learning, rng), rough, late, portion)
            seen = seen.joined(proposal, len(y), y, density)
            log_weights = seen.log_weights()
            if np.isneginf(log_weights).all():
                break
            own, k = tail_smoothed(seen.last_weights())
            worth = effective(own) / len(y)
            points = np.concatenate(seen.points)
            if plan.straightened:
                every = np.arange(posterior.dimension)
                fits = [
                    Straightened.fitted(
                        points[:, own], log_weights, np.flatnonzero(np.isin(own, orders)), rng
                    )
                    for own in (every, *groups)
                ]
                proposal = Blend(Product(groups, tuple(fits[1:])), fits[0], _JOINT)
            else:
                cores, proposal = _learned(cores, groups, points, log_weights)
            close = LEAST_EFFICIENCY if plan.efficient else _CLOSE
            if (k <= _LIGHT and worth > close) or late():
                break
        last = worth < plan.promising or late()
        y, density = np.empty((0, posterior.dimension)), np.empty(0)
        count = effort.learning if last else effort.draws
        while count:
            more, known = _evaluated(proposal.draw(count, rng), exact, late, portion)
            y, density = np.concatenate([y, more]), np.append(density, known)
            weighted = _weighted(posterior, chart, y, density, density - proposal.log_density(y))
            count = 0 if last else _lacking(weighted, plan, _LONGER * effort.draws)
        spent = sum(map(len, seen.points)) + len(y)
        result = Importance(weighted, proposal, len(chosen), spent)
        last |= number == 2 and plan.promising > 0 and weighted.pareto_k > _HEAVY
        if last or result.good(plan.wanted, efficient=plan.efficient):
            break
        seen = seen.joined(proposal, len(y), y, density)
    return result


def _evaluated(
    y: Matrix, density: Callable[[Matrix], Vector], late: Callable[[], bool], portion: int | None
) -> tuple[Matrix, Vector]:
    """Draws and their densities, all at once or portion by portion, none further once it is late."""
    size = portion or len(y)
    known = [density(y[:size])]
    for begin in range(size, len(y), size):
        if late():
            break
        known.append(density(y[begin : begin + size]))
    done = np.concatenate(known)
    return y[: done.size], done


def _lacking(weighted: Weighted, plan: ImportancePlan, most: float) -> int:
    """Further draws of a proposal that is good and has given too few: none where it would be `most`."""
    least = LEAST_EFFICIENCY if plan.efficient else 0.0
    if weighted.pareto_k > _LIGHT or weighted.ess < least * weighted.count:
        return 0
    needed = _SURPLUS * plan.wanted / weighted.smallest_ess
    return ceil(_SPARE * (needed - 1.0) * weighted.count) if 1.0 < needed < most / weighted.count else 0


def _learned(
    cores: Sequence[Mixture], groups: Sequence[Index], y: Matrix, log_weights: Vector
) -> tuple[list[Mixture], Proposal]:
    """Mixtures of all coordinates, and of each group where there are several, fitted further; and the
    proposal they make: groups hardly depend on each other, and jointly they need as many components as there
    are pairs."""
    joint, whole = fitted(cores[0], y, log_weights)
    pairs = [fitted(core, y[:, own], log_weights) for core, own in zip(cores[1:], groups, strict=False)]
    if not pairs:
        return [joint], whole
    product = Product(tuple(groups), tuple(proposal for _, proposal in pairs))
    return [joint, *(core for core, _ in pairs)], Blend(product, whole, _JOINT)


def _apart(posterior: Posterior) -> tuple[Index, ...]:
    """Sampled coordinates of the plant, and of the noise of each axis."""
    rows = [posterior.table.rows[k] for k in posterior.sampled]
    keys = [row.place.first if row.noise else -1 for row in rows]
    return tuple(np.flatnonzero([key == one for key in keys]) for one in dict.fromkeys(keys))


def _weighted(posterior: Posterior, chart: Chart, y: Matrix, charted: Vector, raw: Vector) -> Weighted:
    """Charted draws of one proposal with their densities in the chart and their log weights."""
    z, exists = chart.uncharted(y)
    usable = exists & np.isfinite(charted)
    z = z[usable]
    density = charted[usable] + chart.charted(z)[1] - posterior.table.log_permutations
    return Weighted.of(posterior, z, density, raw[usable], len(y), smooth=True)
