r"""Frequency response of every path, with bands: ``gain exp(-s delay) / (1 + sum_i (T_i s)^order_i)``.

At ``s = i 2 pi f`` (Ta et al. 2026, Eq. 31, stiffness divided out)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array, Index, Matrix, Vector, frozen
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import Estimate, plain
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.powerseries import denominator
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS, Bands, named
from lcopa_bayes.results.result import notebook_table
from lcopa_bayes.sampling.draws import Draws

_DRAWS = 2000
"""Draws behind the bands."""
_POINTS = 120
"""Frequencies of the default grid."""
_HALF_POWER = float(np.sqrt(0.5))
"""Gain over that at rest at the bandwidth [-]: 3 dB less."""
_SEARCHED = (1e-6, 1e2)
"""A bandwidth is searched from this share of the lowest to this multiple of the highest frequency that the
fit records resolve [-]."""
_SEARCH_POINTS = 300
_SHOWN = 24
"""Most frequencies of which a summary shows all [-]."""
_SIGN = 0.05
"""Share of draws with a gain of the other sign from which the phase has two values [-]."""


@final
@dataclass(frozen=True, eq=False)
class PathResponse:
    """Frequency response of one path."""

    path: str
    """``<response>_<drive>``, or the response's name when the plant has one path."""
    unit: str
    """Unit of the gain [response unit / drive unit]."""
    gain: Bands
    """Magnitude [`unit`]; simultaneous bands hold its logarithm."""
    phase: Bands
    """Phase, continuous from rest [deg]; a negative gain counts as -180 deg."""
    bandwidth: Estimate
    """First frequency at which the magnitude is 3 dB below that at rest [cycles / time unit], whatever the
    frequencies asked for; infinite beyond a hundred times the highest that the records resolve, 0 below a
    millionth of the lowest: the steady gain of a slow tail is an extrapolation."""
    note: str = ""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        curves = {"gain": self.gain._asdict(), "phase_deg": self.phase._asdict()}
        out = plain({"path": self.path, "unit": self.unit, **curves, "bandwidth": self.bandwidth.as_json()})
        return out | ({"note": self.note} if self.note else {})


@final
@dataclass(frozen=True, eq=False)
class FrequencyResponse:
    """Gain and phase of every path over frequency."""

    frequency: Vector
    """(n,) [cycles / time unit]."""
    time_unit: str
    """Unit that frequencies are the inverse of."""
    paths: tuple[PathResponse, ...]
    """Gain, phase and bandwidth of each path, by response and drive."""
    outside: tuple[str, ...]
    """A sentence for frequencies below or above those that the fit records resolve, and for effects."""
    draws: int
    """Draws behind the bands."""

    def table(self) -> pd.DataFrame:
        """One row per path and frequency: ends of the bands of gain [`unit`] and phase [deg]."""
        frames = []
        for one in self.paths:
            columns: dict[str, Any] = {"path": one.path, "unit": one.unit, "frequency": self.frequency}
            columns |= named("gain", one.gain) | named("phase", one.phase)
            frames.append(pd.DataFrame(columns))
        return pd.concat(frames, ignore_index=True)

    def summary(self) -> pd.DataFrame:
        """One row per path and frequency, of many a few per decade: gain [`unit`] and phase [deg], and the
        bandwidth of the path [cycles / time unit], with 90 % intervals."""
        frames = []
        for one in self.paths:
            columns: dict[str, Any] = {"path": one.path, "unit": one.unit, "frequency": self.frequency}
            for name, band in (("gain", one.gain), ("phase", one.phase)):
                ends = {"": 2, "_lower": 0, "_upper": 4}
                columns |= {f"{name}{end}": band.pointwise[k] for end, k in ends.items()}
            width = one.bandwidth
            columns |= {"bandwidth": width.value, "bandwidth_lower": width.lower}
            columns |= {"bandwidth_upper": width.upper, "grade": width.grade, "note": one.note}
            frames.append(pd.DataFrame(columns).iloc[self._shown])
        return pd.concat(frames, ignore_index=True)

    @property
    def _shown(self) -> Index:
        """Frequencies of the summary: all where they are few, else those nearest to 1, 2 and 5 a decade."""
        known = np.log10(np.maximum(self.frequency, np.finfo(float).tiny))
        if known.size <= _SHOWN:
            return np.arange(known.size)
        decades = np.arange(np.floor(known.min()), np.ceil(known.max()) + 1)
        wanted = (decades[:, None] + np.log10([1.0, 2.0, 5.0])).ravel()
        wanted = wanted[(wanted >= known.min()) & (wanted <= known.max())]
        return np.unique(np.abs(known[:, None] - wanted).argmin(axis=0))

    def to_json(self) -> dict[str, Any]:
        """Frequencies, bands and bandwidths as plain values."""
        return plain(
            {
                "frequency": self.frequency,
                "time_unit": self.time_unit,
                "bands": [POINTWISE, SIMULTANEOUS],
                "paths": [one.as_json() for one in self.paths],
                "outside": self.outside,
                "draws": self.draws,
            }
        )

    def _repr_html_(self) -> str:
        return notebook_table(self.summary())


def transfer_function(table: ParameterTable, values: Matrix, frequency: Vector) -> tuple[Array, Array]:
    """Magnitude and continuous phase of every path at table values (draws, rows).

    Parameters: frequency (n,) [cycles / time unit]. Returns: magnitude [response unit / drive unit] and phase
    [rad], both (responses, drives, draws, n).
    """
    layout, dynamics, gains = table.layout, table.dynamics(values), table.gains(values)
    angular = 2 * np.pi * frequency
    size = (len(layout.responses), len(layout.drives), values.shape[0], frequency.size)
    magnitude, phase = np.empty(size), np.empty(size)
    elements = zip(dynamics.times, dynamics.orders, strict=True)
    below = [denominator(times, orders, angular) for times, orders in elements]
    for i, j in np.ndindex(size[:2]):
        element = below[layout.element_of[i][j]]
        gain, delay = gains[:, i, j, None], dynamics.delays[:, layout.delay_of[i][j], None]
        magnitude[i, j] = np.abs(gain) / np.abs(element)
        phase[i, j] = -angular * delay - np.angle(element) - np.pi * (gain < 0)
    return magnitude, phase


def frequency_response(
    draws: Draws, frequencies: ArrayLike | None = None, *, span: float, period: float, time_unit: str
) -> FrequencyResponse:
    """Gain and phase of every path with pointwise and simultaneous 50 and 90 % bands.

    Parameters: frequencies (n,) [cycles / time unit], increasing and positive; None: from one cycle in `span`
    to one in two sampling periods. `span` and `period` [time unit] of the fit records bound what these
    resolve. InputError for frequencies that are not positive, finite and increasing.
    """
    lowest, highest = 1.0 / span, 0.5 / period
    if frequencies is None:
        frequencies = np.geomspace(lowest, max(highest, 2 * lowest), _POINTS)
    try:
        frequency = frozen(np.atleast_1d(np.asarray(frequencies, dtype=float)), name="frequencies")
    except ValueError as error:
        raise InputError(f"frequencies [1/{time_unit}]: {error}") from None
    if not frequency.size or (frequency <= 0).any() or (np.diff(frequency) <= 0).any():
        raise InputError(f"frequencies must be positive and increase [1/{time_unit}]; got {frequencies!r}")
    table, values = draws.table, draws.thinned(_DRAWS)
    magnitude, phase = transfer_function(table, values, frequency)
    searched = np.geomspace(_SEARCHED[0] * lowest, _SEARCHED[1] * highest, _SEARCH_POINTS)
    reached, _ = transfer_function(table, values, searched)
    gains, layout = table.gains(values), table.layout
    paths = []
    for i, j, name, unit in layout.paths:
        log_gain = Bands.of(np.log(np.maximum(magnitude[i, j], np.finfo(float).tiny)))
        negative = float(np.mean(gains[:, i, j] < 0))
        either = min(negative, 1 - negative) > _SIGN
        wide = _bandwidth(searched, reached[i, j], np.abs(gains[:, i, j]))
        paths.append(
            PathResponse(
                path=name,
                unit=unit,
                gain=Bands(np.exp(log_gain.pointwise), np.exp(log_gain.simultaneous)),
                phase=Bands.of(np.degrees(phase[i, j])),
                bandwidth=Estimate.of(
                    f"bandwidth[{name}]", f"1/{time_unit}", wide, ess=draws.ess, grade=draws.grade.level
                ),
                note=f"the sign of the gain is open: {100 * negative:.0f} % of draws are negative, and the "
                "phase has two values 180 deg apart"
                if either
                else "",
            )
        )
    outside = []
    if table.effects is not None:
        names = ", ".join(kind.card.name for kind in table.effects.kinds)
        outside.append(f"It is that of the linear plant alone: its effects ({names}) are not included.")
    if frequency[0] < lowest * (1 - 1e-9):
        outside.append(
            f"Below {lowest:.3g} 1/{time_unit} the fit records are shorter than one cycle: the "
            "response there is an extrapolation."
        )
    if frequency[-1] > highest * (1 + 1e-9):
        outside.append(
            f"Above {highest:.3g} 1/{time_unit} the fit records have fewer than two samples a "
            "cycle: the response there is an extrapolation."
        )
    return FrequencyResponse(frequency, time_unit, tuple(paths), tuple(outside), values.shape[0])


def _bandwidth(frequency: Vector, magnitude: Matrix, at_rest: Vector) -> Vector:
    """First frequency at which each curve (draws, n) has fallen by 3 dB, interpolated in logarithms."""
    share = magnitude / np.where(at_rest > 0, at_rest, 1.0)[:, None]
    below = share <= _HALF_POWER
    first = below.argmax(axis=1)
    rows, before = np.arange(first.size), np.maximum(first - 1, 0)
    high, low = np.log(share[rows, before]), np.log(np.maximum(share[rows, first], np.finfo(float).tiny))
    fallen = np.where(high > low, high - low, 1.0)
    at = np.log(frequency[before]) + (high - np.log(_HALF_POWER)) / fallen * np.log(
        frequency[first] / frequency[before]
    )
    crossing = np.where(first > 0, np.exp(at), 0.0)
    return np.where(below.any(axis=1), crossing, np.inf)
