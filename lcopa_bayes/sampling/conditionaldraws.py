"""Draws of what a posterior has beside orders, delays and noise, with their exact density.

Given these the likelihood is Gaussian in the coordinates of `conditional`, to a good approximation. The prior
is not: where a term is negligible its time may be anything below a limit, and its share has no lower end.
Every subset of an element's terms is therefore drawn in turn from the prior, and the other terms, with what
else there is, from the Gaussian given these. Of many such draws, whose weights cost no response, one is kept
by its weight: the mean of the weights is the conditional evidence, without bias, so that the draw kept has a
proper weight (Naesseth, Lindsten and Schön 2015, Nested sequential Monte Carlo methods, ICML).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import NamedTuple, final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.inference.conditional import Conditional, Element, Expanded
from lcopa_bayes.inference.posterior import Posterior

_WIDER = 1.1
"""Standard deviation of the Gaussians drawn from, over those of the expansion [-]."""
_ROUNDING = 1e-10
"""Least information added along every coordinate, over its own [-]."""
_LOG_2PI = float(np.log(2 * np.pi))


@final
class Kept(NamedTuple):
    """One draw for each of a batch of points."""

    coordinates: Matrix
    """Sampled coordinates of the posterior, (batch, dimension); NaN where no draw lies inside the prior."""
    log_likelihood: Vector
    """Of the expansion, (batch,) [nat]; -inf where there is no draw."""
    log_evidence: Vector
    """Log of the integral of prior times expanded likelihood, estimated, (batch,) [nat]."""
    efficiency: Vector
    """Effective share of the draws tried, (batch,) [-]."""


@final
class _Block(NamedTuple):
    """Gaussian of a few coordinates given those before them, those after them integrated out."""

    part: slice
    precision: Array
    """(batch, own, own)."""
    cross: Array
    """(batch, own, before)."""
    pull: Matrix
    """Precision times mean where those before are 0, (batch, own)."""


def kept(conditional: Conditional, at: Expanded, tries: int, rng: np.random.Generator) -> Kept:
    """One of `tries` draws for each expansion."""
    posterior, batch = conditional.posterior, len(at.values)
    limits = 1.0 / _widths(conditional, at) ** 2
    at = _definite(at, limits)
    x, log_source, exists = _drawn(conditional, at, limits, tries, rng)
    flat = x.reshape(batch * tries, -1)
    values, possible = conditional.values(flat, np.repeat(at.values, tries, axis=0))
    usable = np.flatnonzero(exists.ravel() & possible)
    coordinates = np.full((batch * tries, posterior.dimension), np.nan)
    prior = np.full(batch * tries, -np.inf)
    if usable.size:
        inside = np.flatnonzero(in_domain(posterior, conditional.columns, values[usable]))
        usable = usable[inside]
        coordinates[usable] = posterior.coordinates(values[usable])
        prior[usable] = posterior.log_prior(coordinates[usable])
    apart = x - at.x[:, None]
    likelihood = at.log_likelihood[:, None] + (apart * at.gradient[:, None]).sum(axis=2)
    likelihood -= 0.5 * ((apart @ at.information) * apart).sum(axis=2)
    by_point = prior.reshape(batch, tries)
    fine = np.isfinite(by_point) & np.isfinite(log_source)
    log_weights = np.where(fine, likelihood + by_point - np.where(fine, log_source, 0.0), -np.inf)
    any_fine = fine.any(axis=1)
    log_weights[~any_fine] = 0.0
    total = logsumexp(log_weights, axis=1)
    choice = np.argmax(log_weights + rng.gumbel(size=log_weights.shape), axis=1)
    rows = np.arange(batch)
    effective = np.exp(2 * total - logsumexp(2 * log_weights, axis=1)) / tries
    return Kept(
        np.where(any_fine[:, None], coordinates.reshape(batch, tries, -1)[rows, choice], np.nan),
        np.where(any_fine, likelihood[rows, choice], -np.inf),
        np.where(any_fine, total - np.log(tries), -np.inf),
        np.where(any_fine, effective, 0.0),
    )


def _definite(at: Expanded, limits: Matrix) -> Expanded:
    """Expansions whose information, with that of the `limits`, (batch, size), is positive definite.

    Where one term is nearly all of D(s_0), changes of its time and of the gain cancel but for a part in 1e8
    or less, and rounding is more than what is left: it is as large as the most negative curvature shows, in
    coordinates of information 1, and curvature below that is not known.
    """
    own = np.maximum(np.diagonal(at.information, axis1=1, axis2=2), 0.0) + limits
    eye, sd = np.eye(at.x.shape[1]), 1.0 / np.sqrt(own)
    scaled = (at.information + eye * limits[:, None, :]) * sd[:, :, None] * sd[:, None, :]
    rounding = np.full(len(own), _ROUNDING)
    try:
        np.linalg.cholesky(scaled + _ROUNDING * eye)
    except np.linalg.LinAlgError:
        rounding = np.maximum(rounding, -2.0 * np.linalg.eigvalsh(scaled)[:, 0])
    return at._replace(information=at.information + eye * (rounding[:, None] * own)[:, None, :])


def in_domain(posterior: Posterior, columns: Sequence[int], values: Matrix) -> Flags:
    """Whether table values lie in the domains of the rows `columns`, (batch,)."""
    out = np.ones(len(values), dtype=bool)
    for k in columns:
        low, high = posterior.table.rows[k].domain
        out &= (values[:, k] > low) & (values[:, k] < high)
    return out


def _blocks(conditional: Conditional, at: Expanded, limits: Matrix) -> list[_Block]:
    """Gaussians of each element's shares in turn, then of the rest, no wider than the `limits`."""
    precision = at.information + np.eye(at.x.shape[1]) * limits[:, None, :]
    pull = (precision @ at.x[..., None])[..., 0] + at.gradient
    parts = [element.part for element in conditional.elements if element.free]
    first = parts[-1].stop if parts else 0
    if first < at.x.shape[1]:
        parts.append(slice(first, at.x.shape[1]))
    out = []
    for part in reversed(parts):
        before = slice(0, part.start)
        own, cross = precision[:, part, part], precision[:, part, before]
        out.append(_Block(part, own, cross, pull[:, part]))
        across = np.linalg.solve(own, np.concatenate([cross, pull[:, part, None]], axis=2))
        precision = precision[:, before, before] - cross.swapaxes(1, 2) @ across[:, :, :-1]
        pull = pull[:, before] - (cross.swapaxes(1, 2) @ across[:, :, -1:])[..., 0]
    return out[::-1]


def _widths(conditional: Conditional, at: Expanded) -> Matrix:
    """Widths no Gaussian exceeds by much: those of shares, of gains and of the priors."""
    out = np.tile(conditional.widths, (len(at.x), 1))
    for element in conditional.elements:
        out[:, element.part] = 1.0 / conditional.powers(element, at.values)[:, element.free]
    for position, _ in conditional.gains:
        out[:, position] = 2.0 * np.abs(at.x[:, position])
    return out


def _drawn(
    conditional: Conditional, at: Expanded, limits: Matrix, tries: int, rng: np.random.Generator
) -> tuple[Array, Matrix, Flags]:
    """Coordinates (batch, tries, size), log density in the sampled coordinates, and existence."""
    batch, size = at.x.shape
    x = np.zeros((batch, tries, size))
    log_source = np.zeros((batch, tries))
    exists = np.ones((batch, tries), dtype=bool)
    elements = {element.part.start: element for element in conditional.elements if element.free}
    levels = np.zeros((len(conditional.elements), batch, tries))
    for e, element in enumerate(conditional.elements):
        if not element.free:
            levels[e] = (1 / conditional.rest(element, at.values))[:, None]
    for block in _blocks(conditional, at, limits):
        pull = block.pull[:, None] - x[..., : block.part.start] @ block.cross.swapaxes(1, 2)
        if block.part.start in elements:
            element = elements[block.part.start]
            subsets = _Subsets(conditional, element, at.values)
            shares, level = subsets.drawn(block.precision, pull, rng)
            x[..., block.part] = shares
            exists &= (shares > 0).all(axis=2) & (level > 0)
            log_source += subsets.log_density(
                block.precision, pull, np.where(exists[..., None], shares, 1.0), np.where(exists, level, 1.0)
            )
            levels[conditional.elements.index(element)] = level
        else:
            factor = np.asarray(np.linalg.cholesky(block.precision)[:, None], dtype=float)
            mean = np.linalg.solve(block.precision[:, None], pull[..., None])[..., 0]
            normal = rng.standard_normal(mean.shape)
            x[..., block.part] = mean + _WIDER * _back(factor, normal)
            log_source += _log_normal(normal, factor)
            for position, k in enumerate(conditional.columns):
                if position < block.part.start:
                    continue
                row, own = conditional.posterior.table.rows[k], x[..., position]
                of = dict(conditional.gains).get(position)
                inverse = levels[of] if of is not None else 1.0
                if row.log_scale:
                    exists &= own > 0
                    log_source += np.log(np.where(own > 0, own, 1.0))
                else:
                    log_source += np.log(np.where(exists, inverse, 1.0)) if of is not None else 0.0
    return x, log_source, exists


@final
@dataclass(frozen=True, eq=False)
class _Subsets:
    """Draws of the shares of one element, every subset of its times from the prior in turn."""

    conditional: Conditional
    element: Element
    values: Matrix

    @cached_property
    def _all(self) -> list[Flags]:
        """Whether each term is drawn by the Gaussian, for each subset."""
        return [np.array(flags) for flags in product((False, True), repeat=len(self.element.free))]

    @cached_property
    def _powers(self) -> Array:
        return self.conditional.powers(self.element, self.values)[:, None, self.element.free]

    @cached_property
    def _orders(self) -> Array:
        return self.values[:, self.element.orders][:, None, self.element.free]

    @cached_property
    def _rest(self) -> Matrix:
        return self.conditional.rest(self.element, self.values)[:, None]

    def drawn(self, precision: Array, pull: Array, rng: np.random.Generator) -> tuple[Array, Matrix]:
        """Shares (batch, tries, free) and 1 / D(s_0)."""
        batch, tries, _ = pull.shape
        rows = [self.conditional.posterior.table.rows[self.element.times[i]] for i in self.element.free]
        times = np.stack([row.draw(batch * tries, rng).reshape(batch, tries) for row in rows], axis=2)
        strength = times**self._orders
        shares, which = np.empty(pull.shape), rng.permuted(np.arange(tries) % len(self._all))
        for k, flags in enumerate(self._all):
            own = np.flatnonzero(which == k)
            if own.size:
                shares[:, own] = self._of(flags, strength[:, own], precision, pull[:, own], rng)
        return shares, (1.0 - (self._powers * shares).sum(axis=2)) / self._rest

    def _of(
        self, flags: Flags, strength: Array, precision: Array, pull: Array, rng: np.random.Generator
    ) -> Array:
        """Shares given the strengths of those terms that the prior gave."""
        constant, spanned, factor, mean = self._gaussian(flags, strength, precision, pull)
        normal = rng.standard_normal(mean.shape)
        drawn = mean + _WIDER * _back(factor, normal)
        return np.asarray(constant + (spanned @ drawn[..., None])[..., 0])

    def _gaussian(
        self, flags: Flags, strength: Array, precision: Array, pull: Array
    ) -> tuple[Array, Array, Array, Array]:
        """Shares as ``constant + spanned a``, and the Gaussian of a, the shares of the terms flagged."""
        fixed = np.where(flags, 0.0, strength)
        level = self._rest + (self._powers * fixed).sum(axis=2)
        constant = fixed / level[..., None]
        own = np.flatnonzero(flags)
        spanned = np.eye(len(flags))[:, own] - constant[..., None] * self._powers[..., None, own]
        across = precision[:, None] @ spanned
        inner = spanned.swapaxes(-1, -2) @ across
        bent = pull - (precision[:, None] @ constant[..., None])[..., 0]
        size = (np.diagonal(precision, axis1=1, axis2=2)[:, None, :, None] * spanned**2).sum(axis=2)
        inner += 1e-11 * np.eye(own.size) * size[..., None, :]
        factor = np.linalg.cholesky(inner)
        h = (spanned.swapaxes(-1, -2) @ bent[..., None])[..., 0]
        mean = np.linalg.solve(inner, h[..., None])[..., 0] if own.size else h
        return constant, spanned, factor, mean

    def log_density(self, precision: Array, pull: Array, shares: Array, level: Matrix) -> Matrix:
        """Log density of the logarithms of the times, (batch, tries)."""
        strength = shares / level[..., None]
        with np.errstate(over="ignore", under="ignore", divide="ignore"):
            times = strength ** (1 / self._orders)
        prior = np.stack(list(self._priors(times)), axis=2)
        parts = []
        for flags in self._all:
            _, _, factor, mean = self._gaussian(flags, strength, precision, pull)
            own = np.flatnonzero(flags)
            apart = (shares[..., own] - mean) / _WIDER
            normal = (factor.swapaxes(-1, -2) @ apart[..., None])[..., 0]
            # of the shares flagged in the logarithms of their times, the other times fixed
            fixed = np.where(flags, 0.0, strength)
            base = self._rest + (self._powers * fixed).sum(axis=2)
            steep = np.log(level * base) + np.log(shares * self._orders)[..., own].sum(axis=2)
            parts.append(
                _log_normal(normal, factor) + (steep if own.size else 0.0) + prior[..., ~flags].sum(axis=2)
            )
        return np.asarray(logsumexp(parts, axis=0) - np.log(len(parts)))

    def _priors(self, times: Array) -> Iterator[Matrix]:
        """Log prior density of the logarithm of each time."""
        for column, i in enumerate(self.element.free):
            row, own = self.conditional.posterior.table.rows[self.element.times[i]], times[..., column]
            low, high = row.domain
            safe = np.isfinite(own) & (own > low) & (own < high)
            inside = np.where(safe, own, 1.0 if low < 1.0 < high else 0.5 * (low + min(high, 2 * low + 1)))
            yield np.where(safe, row.log_prior(inside.ravel()).reshape(own.shape) + np.log(inside), -np.inf)


def _back(factor: Array, normal: Array) -> Array:
    """Draws with the precision whose lower Cholesky factor is given."""
    if not normal.shape[-1]:
        return normal
    return np.asarray(np.linalg.solve(factor.swapaxes(-1, -2), normal[..., None])[..., 0])


def _log_normal(normal: Array, factor: Array) -> Matrix:
    """Log density of wider draws, given their standard normal."""
    scale = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    size = normal.shape[-1]
    return np.asarray(-0.5 * (normal**2).sum(axis=-1) + scale - size * (0.5 * _LOG_2PI + np.log(_WIDER)))
