"""Starts of a base fit: the best of many draws, far from each other.

Half are drawn from the prior. The other half have integer orders and time constants between the sampling
period and the records' length, and a few the poles of a regression: a lightly damped plant fills too little
of the prior to be met by chance.
"""

from __future__ import annotations

import numpy as np

from lcopa_bayes.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.loop.regressedstarts import regressed

_SCREENED = 512
"""Prior draws whose misfit is looked at [-]."""
_DISTINCT = 0.5
"""Starts closer than this in every sampled coordinate count as one [natural log or parameter unit]."""
_SCREEN_NOISE = 0.05
"""Noise scale of the screening over the spread of a response [-]: coarse, so that no draw is hopeless."""


def screened(posterior: Posterior, rng: np.random.Generator, *, count: int) -> list[Vector]:
    """Table values, (rows,), of the `count` best distinct prior draws, gains and offsets at their best."""
    table = posterior.table
    drawn = table.draw(_SCREENED, rng)
    drawn[_SCREENED // 2 :] = _classical(posterior, drawn[_SCREENED // 2 :], rng)
    told = regressed(posterior, drawn)
    drawn[: len(told)] = told
    for axis in range(len(table.layout.responses)):
        pooled = np.concatenate([samples.axes[axis].values for samples in posterior.samples])
        scale = _SCREEN_NOISE * (float(pooled.std()) or 1.0)
        for name, value in posterior.noise.nearly_white(scale).items():
            drawn[:, table.at(name, axis)] = value
    density = posterior.log_likelihood(drawn)
    ranked = drawn[np.argsort(-np.where(np.isnan(density), -np.inf, density), kind="stable")]
    return [_completed(posterior, values) for values in _distinct(posterior, ranked, count)]


def _classical(posterior: Posterior, drawn: Matrix, rng: np.random.Generator) -> Matrix:
    """The draws with integer orders, the highest first, and times that the samples resolve; values outside a
    parameter's domain stay as drawn."""
    table, out = posterior.table, drawn.copy()
    longest = max((one.times for one in posterior.samples), key=np.ptp)
    period, span = float(np.median(np.diff(longest))), float(np.ptp(longest))
    for element, slot in enumerate(table.layout.elements):
        highest = min(slot.terms, 2) if slot.terms > 1 else rng.integers(1, 3, out.shape[0])
        for term in range(slot.terms):
            order, time = table.at("order", element, term), table.at("time", element, term)
            wanted = {time: np.exp(rng.uniform(np.log(period), np.log(span), out.shape[0]))}
            if term < 2:
                wanted[order] = np.full(out.shape[0], highest - term, dtype=float)
            for k, values in wanted.items():
                low, high = table.rows[k].domain
                inside = (low <= values) & (values <= high) & table.rows[k].free
                out[inside, k] = values[inside]
    legal = table.supported(out)
    out[~legal] = drawn[~legal]
    return table.canonical(out)


def _completed(posterior: Posterior, values: Vector) -> Vector:
    return np.asarray(posterior.complete(posterior.coordinates(values[None]), None)[0])


def _distinct(posterior: Posterior, ranked: Matrix, count: int) -> list[Vector]:
    kept: list[Vector] = []
    places: list[Vector] = []
    for values in ranked:
        here = posterior.coordinates(values[None])[0]
        if all(np.abs(here - other).max() > _DISTINCT for other in places):
            kept.append(values)
            places.append(here)
        if len(kept) == count:
            break
    return kept
