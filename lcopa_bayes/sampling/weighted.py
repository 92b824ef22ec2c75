"""Weighted draws of a posterior: independent draws of a proposal with importance weights.

Weights are smoothed by a generalised Pareto distribution, whose shape k shows whether averages over them
converge (Vehtari, Simpson, Gelman, Yao and Gabry 2024, JMLR 25). As the draws are independent the error of
every average follows from the weights themselves (Owen 2013, Monte Carlo theory, methods and examples, 9).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from math import sqrt
from typing import final

import numpy as np
from scipy.special import logsumexp
from scipy.stats import norm

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.importanceweights import effective, smoothed
from lcopa_bayes.sampling.modes import boundaries

BATCHES = 4
"""Independent parts of weighted draws, compared as ensembles are."""
CHAIN = 8
"""Resampled draws that take the place of one walker."""
_TAILS = (0.05, 0.95)
"""Quantiles whose error counts."""


@final
@dataclass(frozen=True, eq=False)
class Weighted:
    """Independent draws with weights; those without density are counted only."""

    coordinates: Matrix
    """Sampled coordinates, exchangeable terms by decreasing order, (draws, dimension)."""
    log_density: Vector
    """Log posterior density, as `Posterior.log_density`, (draws,) [nat]."""
    raw: Vector
    """Log of the posterior density over that of the proposal, (draws,) [nat]."""
    log_weights: Vector
    """Normalised, and Pareto-smoothed where requested, (draws,) [nat]."""
    pareto_k: float
    """Shape of the weights' tail [-]; infinite where too few draws have any weight."""
    count: int
    """Draws of the proposal, those without density included."""
    log_evidence: float
    """Log of the integral of prior times likelihood [nat]."""
    log_evidence_sd: float
    """Standard error [nat]."""
    sampled: Matrix
    """Values of the sampled parameters, (draws, parameters)."""
    logarithmic: tuple[bool, ...]
    """Whether modes of a sampled parameter are looked for in its logarithm."""
    factors: tuple[tuple[Weighted, Index], ...] = ()
    """Of draws of a product: those of its factors, whose accuracies hold, and which sampled parameters each
    of them has."""

    @classmethod
    def of(
        cls,
        posterior: Posterior,
        coordinates: Matrix,
        log_density: Vector,
        raw: Vector,
        count: int,
        *,
        smooth: bool,
    ) -> Weighted:
        """Weights of the draws that have a density, out of `count`; `log_density` without permutations.

        Smoothing reduces the scatter of weights that have one tail, and biases those of a proposal that
        covers one mode less well than another.
        """
        padded = np.concatenate([raw, np.full(count - len(raw), -np.inf)])
        log_weights, k = tail_smoothed(padded)
        if not smooth and raw.size:
            log_weights = padded - logsumexp(raw)
        log_evidence, error = -np.inf, np.inf
        if raw.size:
            log_evidence = float(logsumexp(raw) - np.log(count))
            error = float(np.std(np.exp(padded - log_evidence)) / np.sqrt(count))
        rows = [posterior.table.rows[k] for k in posterior.sampled]
        return cls(
            coordinates,
            log_density,
            raw,
            log_weights[: len(raw)],
            k,
            count,
            log_evidence,
            error,
            posterior.values(coordinates)[:, posterior.sampled],
            tuple(row.log_scale for row in rows),
        )

    @classmethod
    def equal(
        cls, posterior: Posterior, coordinates: Matrix, log_density: Vector, log_evidence: float, sd: float
    ) -> Weighted:
        """Draws (draws, dimension) of equal weight, of a posterior whose log evidence is known [nat]."""
        raw = np.full(len(coordinates), log_evidence)
        drawn = cls.of(posterior, coordinates, log_density, raw, len(raw), smooth=False)
        return replace(drawn, log_evidence_sd=sd)

    @classmethod
    def product(
        cls,
        posterior: Posterior,
        coordinates: Matrix,
        log_density: Vector,
        raw: Vector,
        factors: tuple[tuple[Weighted, Index], ...],
    ) -> Weighted:
        """Draws (draws, dimension) of equal weight of a product of factors; `raw`, (draws,), is the log
        evidence of the batch that each is in [nat]."""
        parts = [one for one, _ in factors]
        log_evidence = sum(one.log_evidence for one in parts)
        error = float(np.hypot.reduce([one.log_evidence_sd for one in parts]))
        drawn = cls.equal(posterior, coordinates, log_density, log_evidence, error)
        return replace(drawn, raw=raw, pareto_k=max(one.pareto_k for one in parts), factors=factors)

    def shifted(self, by: float, sd: float) -> Weighted:
        """The same draws of a posterior whose density is larger by a factor, of log `by` and standard error
        `sd` [nat]."""
        error = float(np.hypot(self.log_evidence_sd, sd))
        return replace(self, raw=self.raw + by, log_evidence=self.log_evidence + by, log_evidence_sd=error)

    @property
    def batch_evidence(self) -> Vector:
        """Log evidence by the draws of each batch, (batches,) [nat]."""
        size = self.count / BATCHES
        return np.array([logsumexp(self.raw[part]) - np.log(size) for part in self.parts])

    def _of_factors(self, each: Callable[[Weighted], Vector]) -> Vector:
        """A number of every sampled parameter, from its factor, (parameters,)."""
        out = np.empty(self.sampled.shape[1])
        for one, own in self.factors:
            out[own] = each(one)
        return out

    @cached_property
    def ess(self) -> float:
        """Effective number of draws whatever is averaged, ``1 / sum w^2`` [draws]."""
        if self.factors:
            return min(one.ess for one, _ in self.factors)
        return effective(self.log_weights) if self.log_weights.size else 0.0

    @cached_property
    def _cumulative(self) -> tuple[Index, Matrix]:
        """Order of the draws by each sampled parameter, and the sum of weights up to each draw in that order,
        both (draws, parameters)."""
        rank = np.argsort(self.sampled, axis=0, kind="stable")
        return rank, np.cumsum(self._weights[rank], axis=0)

    @cached_property
    def scores(self) -> Matrix:
        """Normal scores of the sampled parameters, (draws, parameters) [-]."""
        rank, beyond = self._cumulative
        out = np.empty(self.sampled.shape)
        np.put_along_axis(out, rank, beyond - 0.5 * self._weights[rank], axis=0)
        return np.asarray(norm.ppf(np.clip(out, 1e-9, 1 - 1e-9)))

    @cached_property
    def below(self) -> Array:
        """Whether the sampled parameters are at most their 5 and 95 % quantiles, (2, draws, parameters)."""
        rank, beyond = self._cumulative
        out = np.empty((len(_TAILS), *self.sampled.shape))
        for k, column in enumerate(self.sampled.T):
            ends = np.minimum(np.searchsorted(beyond[:, k], _TAILS), column.size - 1)
            out[:, :, k] = column <= column[rank[ends, k]][:, None]
        return out

    @cached_property
    def centre_ess(self) -> Vector:
        """Effective sample size for the mean of each sampled parameter's normal scores, (parameters,); that
        of the weights where those that count are of one value."""
        if self.factors:
            return self._of_factors(lambda one: one.centre_ess)
        return self._known([_worth(own, self._weights) for own in self.scores.T])

    @cached_property
    def tail_ess(self) -> Vector:
        """The smaller effective sample size of the 5 and the 95 % quantile, (parameters,)."""
        if self.factors:
            return self._of_factors(lambda one: one.tail_ess)
        each = [[_worth(own, self._weights) for own in end.T] for end in self.below]
        return self._known(np.min(each, axis=0))

    def _known(self, worth: Sequence[float] | Vector) -> Vector:
        """Effective sample sizes, that of the weights where nothing varies."""
        return np.asarray(np.where(np.isinf(worth), self.ess, worth))

    @cached_property
    def boundaries(self) -> tuple[tuple[float, ...], ...]:
        """Between the modes of each sampled parameter, in its unit; a function of the weights alone."""
        if self.factors:
            edges: list[tuple[float, ...]] = [()] * self.sampled.shape[1]
            for one, own in self.factors:
                for k, found in zip(own.tolist(), one.boundaries, strict=True):
                    edges[k] = found
            return tuple(edges)
        columns = zip(self.sampled.T, self.centre_ess, self.logarithmic, strict=True)
        return tuple(
            boundaries(column, self._weights, ess, partial(error_of, self._weights), log_scale=logarithmic)
            for column, ess, logarithmic in columns
        )

    def shares(self, parameter: int) -> tuple[Vector, Vector]:
        """Posterior mass of each mode of a sampled parameter, and the number of independent draws that give
        it as accurately, (modes,)."""
        for one, own in self.factors:
            if parameter in own:
                return one.shares(own.tolist().index(parameter))
        edges = self.boundaries[parameter]
        mode = np.searchsorted(edges, self.sampled[:, parameter])
        inside = [(mode == k).astype(float) for k in range(len(edges) + 1)]
        worth = [_worth(one, self._weights) for one in inside]
        return np.array([self._weights @ one for one in inside]), np.array(worth)

    @property
    def smallest_ess(self) -> float:
        """Smallest effective sample size of a centre, a tail or a mode's share [draws]."""
        if not self.log_weights.size:
            return 0.0
        shares = [self.shares(k)[1] for k, edges in enumerate(self.boundaries) if edges]
        return float(np.min(np.concatenate([self.centre_ess, self.tail_ess, *shares])))

    @cached_property
    def _weights(self) -> Vector:
        return np.asarray(np.exp(self.log_weights))

    @property
    def parts(self) -> tuple[slice, ...]:
        """Parts of the draws that are independent of each other."""
        size = self.log_weights.size
        return tuple(slice(k * size // BATCHES, (k + 1) * size // BATCHES) for k in range(BATCHES))

    def batches(self, count: int, rng: np.random.Generator) -> Index:
        """Positions of resampled draws, `count` of every part, (batches, count)."""
        return np.stack([part.start + resampled(self.log_weights[part], count, rng) for part in self.parts])

    def resampling_variance(self, values: Array, count: int) -> Array:
        """Variance that `batches` add to means of `values`, (..., draws, columns), over that of a draw, (...,
        columns) [-].

        A draw is taken as often as is expected of its weight, up to the next whole number: what is random is
        the remainder f, with variance f (1 - f), in draws whose order is random. It is far less than that of
        independent choices where most draws are taken.
        """
        parts = [self.log_weights[part] for part in self.parts]
        remainder = np.concatenate([count * np.exp(part - logsumexp(part)) for part in parts]) % 1.0
        chance = remainder * (1.0 - remainder)
        share = chance / max(float(chance.sum()), 1e-300)
        apart = values - (share @ values)[..., None, :]
        spread = self._weights @ (values - (self._weights @ values)[..., None, :]) ** 2
        added = (chance @ apart**2) / (BATCHES * count) ** 2
        return np.asarray(np.divide(added, spread, out=np.zeros_like(added), where=spread > 0))


def tail_smoothed(log_weights: Vector) -> tuple[Vector, float]:
    """Normalised log weights with a smoothed tail, and its Pareto k; log weights of -inf are allowed.

    k is infinite, and nothing is smoothed, where so few weights are positive that there is no tail to fit.
    """
    positive = np.count_nonzero(np.isfinite(log_weights))
    if positive <= max(3 * np.sqrt(log_weights.size) + 1, log_weights.size // 5):
        return log_weights - (logsumexp(log_weights) if positive else 0.0), np.inf
    return smoothed(log_weights)


def resampled(log_weights: Vector, count: int, rng: np.random.Generator) -> Index:
    """Positions of `count` draws with equal weights, in random order, by systematic resampling."""
    share = np.cumsum(np.exp(log_weights - log_weights.max()))
    at = (rng.random() + np.arange(count)) / count
    return np.asarray(rng.permutation(np.minimum(np.searchsorted(share / share[-1], at), share.size - 1)))


def error_of(weights: Vector, values: Vector) -> float:
    """Standard error of the mean of values, (draws,), of independent draws with normalised weights.

    Its square is itself an average, which few draws may dominate: n of them know it to ``sqrt(2 / n)``, and
    by that it is taken larger.
    """
    terms = weights**2 * (values - weights @ values) ** 2
    total = float(terms.sum())
    return sqrt(total * (1 + sqrt(2 * float(terms @ terms)) / total)) if total > 0 else 0.0


def _worth(values: Vector, weights: Vector) -> float:
    """Number of independent draws that give the mean as accurately as the normalised weights; infinite where
    nothing varies."""
    error = error_of(weights, values)
    return float(weights @ (values - weights @ values) ** 2) / error**2 if error > 0 else np.inf
