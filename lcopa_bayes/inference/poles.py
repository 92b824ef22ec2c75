"""Poles of a plant from a regression of each sample on the two before it.

Starts that prior draws hardly meet: a lightly damped plant fills too little of the prior, and beside its
resonance every delay of a whole number of half cycles is a local optimum.
"""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.posterior import Posterior

LAGS = (0, 1, 2, 3, 5, 8, 13, 21, 34)
"""Sampling periods of delay tried [-]."""
_EVEN = 1e-2
"""Gaps this close to one sampling period are one [periods]."""
_FEWEST = 30
"""Rows below which no regression is tried [-]."""


def regressed(posterior: Posterior, drawn: Matrix) -> Matrix:
    """Drawn table values, (draws, rows), with poles and delays from a regression at one lag each, (at most
    lags, rows); none where the samples do not give them.

    All paths to a response have the same poles. Only free parameters are set, and only to values of their
    domain; all other entries stay as drawn.
    """
    table, samples, out = posterior.table, posterior.samples, list[Vector]()
    layout = table.layout
    longest = max((one.times for one in samples), key=np.size)
    period = float(np.median(np.diff(longest)))
    for lag, row in zip(LAGS, drawn, strict=False):
        wanted = dict[tuple[str, int, int], float]()
        for i, (elements, delays) in enumerate(zip(layout.element_of, layout.delay_of, strict=True)):
            poles = _poles(samples, i, lag, period)
            if poles is None:
                continue
            wanted |= dict.fromkeys((("delay", d, 0) for d in delays), max(lag - 0.5, 0.1) * period)
            for element in elements:
                for term, (time, order) in enumerate(_terms(poles, layout.elements[element].terms)):
                    wanted["time", element, term], wanted["order", element, term] = time, order
        own = row.copy()
        for (kind, first, second), value in wanted.items():
            k = table.at(kind, first, second)
            low, high = table.rows[k].domain
            if table.rows[k].free and low <= value <= high:
                own[k] = value
        if wanted and table.supported(own[None])[0]:
            out.append(own)
    return np.asarray(table.canonical(np.array(out))) if out else drawn[:0]


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
    """Time constant and order of each term: ``(T1 s)^2 + T2 s + 1``, or of one with the slower pole.

    ``(T s)^a + 1`` vanishes at ``s = exp(±i pi / a) / T``.
    """
    if count == 1:
        slow = poles[np.argmin(np.abs(poles))]
        return [(float(1 / np.abs(slow)), float(np.pi / np.abs(np.angle(slow))))]
    product = float((poles[0] * poles[1]).real)
    return [(product**-0.5, 2.0), (float(-(poles[0] + poles[1]).real) / product, 1.0)]
