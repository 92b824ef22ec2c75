"""Starts of a base fit: the best of many draws, far from each other.

Half are drawn from the prior. The other half have integer orders and time constants between the sampling
period and the records' length, and a few the poles of a regression: a lightly damped plant fills too little
of the prior to be met by chance.
"""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.optimum import distinct
from lcopa_bayes.inference.posterior import Posterior

_LAGS = 4
"""Sampling periods of delay tried [-]."""
_EVEN = 1e-2
"""Gaps this close to one sampling period are one [periods]."""
_FEWEST = 30
"""Rows below which no regression is tried [-]."""

_SCREENED = 512
"""Prior draws whose misfit is looked at [-]."""
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
    chosen = [posterior.coordinates(values[None]) for values in distinct(posterior, ranked, count)]
    return [posterior.complete(each, None)[0] for each in chosen]


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


def regressed(posterior: Posterior, drawn: Matrix) -> Matrix:
    """The drawn table values, (draws, rows), with poles and delays from a regression, draw k at lag k.

    Only free parameters are set, and only to values of their domain; all other entries stay as drawn.
    """
    table, out = posterior.table, drawn[:_LAGS].copy()
    layout, samples = table.layout, posterior.samples
    longest = max((one.times for one in samples), key=np.size)
    period = float(np.median(np.diff(longest)))
    for lag, row in enumerate(out):
        for i in range(len(layout.responses)):
            j = min(i, len(layout.drives) - 1)
            poles = _poles(samples, i, lag, period)
            if poles is None:
                continue
            element = layout.element_of[i][j]
            wanted = {("delay", layout.delay_of[i][j], 0): max(lag - 0.5, 0.1) * period}
            for term, (time, order) in enumerate(_terms(poles, layout.elements[element].terms)):
                wanted["time", element, term], wanted["order", element, term] = time, order
            for (kind, first, second), value in wanted.items():
                k = table.at(kind, first, second)
                low, high = table.rows[k].domain
                if table.rows[k].free and low <= value <= high:
                    row[k] = value
    legal = table.supported(out)
    out[~legal] = drawn[:_LAGS][~legal]
    return np.asarray(table.canonical(out))


def _poles(samples: tuple[Samples, ...], axis: int, lag: int, period: float) -> Vector | None:
    """Both poles at a lag, decaying ones only [1 / time unit]; None where the samples do not give them."""
    rows, values = [], []
    for one in samples:
        observed = one.axes[axis]
        y, at = observed.values, one.times[observed.index]
        drive = one.record.drive
        held = [
            drive[
                np.clip(np.searchsorted(one.record.time, at - k * period * (1 - 1e-6), "right") - 1, 0, None)
            ]
            for k in (lag, lag + 1)
        ]
        steady = np.abs(observed.gaps - 1.0) < _EVEN
        use = np.flatnonzero(steady[2:] & steady[1:-1]) + 2
        ones = np.ones((use.size, 1))
        rows.append(np.hstack([y[use - 1, None], y[use - 2, None], held[0][use], held[1][use], ones]))
        values.append(y[use])
    matrix, right = np.vstack(rows), np.concatenate(values)
    if right.size < _FEWEST:
        return None
    a1, a2 = np.linalg.lstsq(matrix, right, rcond=None)[0][:2]
    z = np.roots([1.0, -a1, -a2]).astype(complex)
    if not (np.abs(z) > 0).all() or (np.abs(z) >= 1).any() or ((z.imag == 0) & (z.real <= 0)).any():
        return None
    return np.asarray(np.log(z) / period)


def _terms(poles: Vector, count: int) -> list[tuple[float, float]]:
    """Time constant and order of each term: ``(T1 s)^2 + T2 s + 1``, or the slower pole's alone."""
    if count == 1:
        return [(float(1 / np.abs(poles).min()), 1.0)]
    product = float((poles[0] * poles[1]).real)
    return [(product**-0.5, 2.0), (float(-(poles[0] + poles[1]).real) / product, 1.0)]
