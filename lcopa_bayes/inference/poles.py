"""Poles of a plant from a regression of each sample on those before it.

Starts that prior draws hardly meet: a lightly damped plant fills too little of the prior, and beside its
resonance every delay of a whole number of half cycles is a local optimum. Of several paths to a response the
regression has two samples for each, and which pair of poles is whose is left to what uses them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior

LAGS = (0, 1, 2, 3, 5, 8, 13, 21, 34)
"""Sampling periods of delay tried [-]."""
_STEPS = (1, 4)
"""Sampling periods from one sample of a regression to the next [-]: noise biases those of a fast clock."""
_EVEN = 1e-2
"""How far samples may lie from an even grid [periods]."""
_REAL = 1e-9
"""Imaginary part over the modulus below which a pole is real [-]."""
_FEWEST, _MOST = 30, 20_000
"""Rows below which no regression is tried, and about which one record has at most [-]."""
_SPARSE = 10
"""Places of the grid per sample above which it is not filled [-]."""


@final
class _Even(NamedTuple):
    """Samples of one axis of a record on an even grid."""

    record: Record
    times: Vector
    """(n,) [time unit]."""
    values: Vector
    """(n,) [response unit]."""


def regressed(posterior: Posterior, drawn: Matrix) -> Matrix:
    """Drawn table values, (draws, rows), with a pair of poles and a delay from regressions, one for each pair
    and lag, (rows); none where the samples do not give them.

    All paths to a response have the same pair. Only free parameters are set, and only to values of their
    domain; all other entries stay as drawn.
    """
    table, out = posterior.table, list[Vector]()
    layout = table.layout
    longest = max((one.times for one in posterior.samples), key=np.size)
    period = float(np.median(np.diff(longest)))
    kinds = [(order, step) for order in dict.fromkeys((2, 2 * len(layout.drives))) for step in _STEPS]
    even = [[_even(one, i, period) for one in posterior.samples] for i in range(len(layout.responses))]
    for lag in LAGS:
        found = [[pair for kind in kinds for pair in _pairs(own, lag, period, *kind)] for own in even]
        for number in range(max(map(len, found))):
            own = drawn[len(out) % len(drawn)].copy()
            for i, pairs in enumerate(found):
                if number < len(pairs):
                    _set(own, table, i, pairs[number], max(lag - 0.5, 0.1) * period)
            if table.supported(own[None])[0]:
                out.append(own)
    return np.asarray(table.canonical(np.array(out))) if out else drawn[:0]


def _set(values: Vector, table: ParameterTable, response: int, poles: Vector, delay: float) -> None:
    """Write poles and a delay of all paths to a response into table values."""
    layout = table.layout
    wanted = {("delay", d, 0): delay for d in layout.delay_of[response]}
    for element in layout.element_of[response]:
        for term, (time, order) in enumerate(_terms(poles, layout.elements[element].terms)):
            wanted["time", element, term], wanted["order", element, term] = time, order
    for (kind, first, second), value in wanted.items():
        k = table.at(kind, first, second)
        low, high = table.rows[k].domain
        if table.rows[k].free and low <= value <= high:
            values[k] = value


def _pairs(records: Sequence[_Even], lag: int, period: float, order: int, step: int) -> list[Vector]:
    """Pairs of poles of a regression on so many samples, a step apart, at a lag; decaying ones only [1 / time
    unit]."""
    rows, values, first = [], [], order * step
    for record, at, y in records:
        if at.size <= first:
            continue
        here = np.arange(first, at.size, max(1, at.size // _MOST))
        before = at[here, None] - (lag + step * np.arange(2)) * period * (1 - 1e-6)
        place = np.searchsorted(record.time, before, "right") - 1
        held = record.drive[np.maximum(place, 0)].reshape(here.size, -1)
        past = y[here[:, None] - step * np.arange(1, order + 1)]
        matrix = np.column_stack([past, held, np.ones(here.size)])
        use = np.isfinite(matrix).all(axis=1) & np.isfinite(y[here])
        rows.append(matrix[use])
        values.append(y[here][use])
    if sum(map(len, values)) < _FEWEST:
        return []
    matrix, right = np.vstack(rows), np.concatenate(values)
    z = np.roots([1.0, *-np.linalg.lstsq(matrix, right, rcond=None)[0][:order]]).astype(complex)
    real = np.sort(z[np.abs(z.imag) <= _REAL * np.abs(z)].real)
    ringing = z[z.imag > _REAL * np.abs(z)]
    pairs = [np.array([one, one.conj()]) for one in ringing]
    pairs += [np.array(pair, dtype=complex) for pair in zip(real[::2], real[1::2], strict=False)]
    decaying = [one for one in pairs if (np.abs(one) < 1).all() and ((one.imag != 0) | (one.real > 0)).all()]
    return [np.log(one) / (step * period) for one in decaying]


def _even(one: Samples, axis: int, period: float) -> _Even:
    """NaN where a grid has no sample, and between those of a clock that is not even their interpolation;
    nothing where samples fill little of it."""
    observed = one.axes[axis]
    at = one.times[observed.index]
    if at.size < 2 or at[-1] - at[0] > _SPARSE * at.size * period:
        return _Even(one.record, np.empty(0), np.empty(0))
    grid = np.arange(at[0], at[-1] + 0.5 * period, period)
    place = (at - at[0]) / period
    if np.abs(place - np.round(place)).max() > _EVEN:
        return _Even(one.record, grid, np.interp(grid, at, observed.values))
    out = np.full(grid.size, np.nan)
    out[np.round(place).astype(np.intp)] = observed.values
    return _Even(one.record, grid, out)


def _terms(poles: Vector, count: int) -> list[tuple[float, float]]:
    """Time constant and order of each term: ``(T1 s)^2 + T2 s + 1``, or of one with the slower pole.

    ``(T s)^a + 1`` vanishes at ``s = exp(±i pi / a) / T``.
    """
    if count == 1:
        slow = poles[np.argmin(np.abs(poles))]
        return [(float(1 / np.abs(slow)), float(np.pi / np.abs(np.angle(slow))))]
    product = float((poles[0] * poles[1]).real)
    return [(product**-0.5, 2.0), (float(-(poles[0] + poles[1]).real) / product, 1.0)]
