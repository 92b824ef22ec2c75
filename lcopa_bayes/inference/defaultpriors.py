"""Default priors, derived from the time span and the amplitude of the fit records. All of them are here.

With span = longest time from the first change of a drive to the last sample of its record, period = median
sampling period, A = range of a response axis over the records, D = largest deviation of a drive from rest:

===========  ======================================  ============================================
parameter    prior                                   why
===========  ======================================  ============================================
gain         normal(0, 5 A / D)                      either sign; a slow tail may hide most of it
time         log-uniform(period / 10, 100 span)      from unresolved to far slower than the record
order        uniform(0, 2), decreasing               where the element is passive
delay        uniform(0, 0.4 span)                    later onset leaves too little record to fit
offset       normal(mean response, 5 A (1 + U / D))  reading at zero drive; U = largest resting drive
sigma        log-uniform(1e-6 A, 2 A)                scale of the noise, over all plausible decades
rho          uniform(0, 1)                           correlation of noise one sampling period apart
nu           gamma(2, scale 10)                      Juarez and Steel 2010, J. Appl. Econometrics 25
===========  ======================================  ============================================

Noise of the kind ``white+ar1`` learns from Q, the samples taken before any drive has changed, where an axis
has 8 independent ones or more on 5 levels or more. N is span / period:

===========  ======================================  ============================================
sigma        log-normal(median by Q, s)              s^2 = (ln 2)^2 + variance of ln sigma by Q: noise
                                                     may well double with the level
sigma_ar     uniform(0, 1.5 sigma_Q), at most 2 A    sigma_Q = 97.5 % limit by Q: what lies further from
                                                     the plant than noise does at rest is no noise
sigma        log-uniform(1e-6 A, 2 A)                without Q
sigma_ar     log-uniform(1e-6 A, 2 A)                without Q
rho          uniform(exp(-1), exp(-20 / N)),         from one sampling period, as faster noise is white,
             upper end not below exp(-1 / 2)         to a twentieth of a record: what lasts longer is a
                                                     trend that the plant has to explain
===========  ======================================  ============================================

Terms of order above 1 resonate near 1 / T. Faster than the Nyquist frequency of the samples such a resonance
is an alias of whatever is periodic in the record, and blocks as wide as a sample cannot follow it: where both
priors are default ones, terms of order above 1 have time constants of period / pi or longer.

The end of `sigma_ar` is hard. A tail, however thin, would not hold: noise of 0.05 at rest under a misfit of
0.5 gains thousands of nats by growing tenfold, and what the plant lacks is then called noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.drive import first_change
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.observations import Observed, QuietNoise, Samples, quiet_noise, sampling_period
from lcopa_bayes.inference.priors import Prior

_LEAST = 1e-6
"""Standard deviation of the least noise that is considered, over the range of a response [-]."""
_TIMES = 20.0
"""Correlation times of the noise that fit into a record at least [-]."""
_SHORTEST, _SHORT = 1.0, 2.0
"""Shortest correlation time of a noise, and what its longest may always be [sampling periods]."""
_DOUBLE = 2.0
"""Factor by which white noise in motion may well exceed that at rest [-], a standard deviation of its log."""
_BEYOND = 1.5
"""Factor by which correlated noise in motion exceeds the limit at rest at most [-]."""


@final
@dataclass(frozen=True, eq=False)
class Scales:
    """What the default priors are derived from."""

    span: float
    """Longest time from the first drive change to the last sample [time unit]."""
    period: float
    """Median sampling period [time unit]."""
    amplitude: Vector
    """Range of each response axis over the records [response unit]."""
    level: Vector
    """Mean of each response axis [response unit]."""
    excursion: Vector
    """Largest deviation of each drive from its rest [drive unit]; 1 for a drive that never moves."""
    resting: Vector
    """Largest resting value of each drive [drive unit]."""
    at_rest: tuple[tuple[Observed, ...], ...]
    """Of each response axis, the samples of each record before any drive has changed."""

    @classmethod
    def of(cls, records: Sequence[Record]) -> Scales:
        """Scales of the fit records."""
        driven = [record for record in records if (record.drive != record.drive[0]).any()] or records
        spans = [record.time[-1] - first_change(record) for record in driven]
        response = np.concatenate([record.response for record in records])
        amplitude = np.nanmax(response, axis=0) - np.nanmin(response, axis=0)
        period = sampling_period(records)
        samples = [Samples.of(record, period) for record in records]
        moved = np.max([np.abs(record.drive - record.drive[0]).max(axis=0) for record in records], axis=0)
        return cls(
            span=float(max(spans)),
            period=period,
            amplitude=np.where(amplitude > 0, amplitude, 1.0),
            level=np.nanmean(response, axis=0),
            excursion=np.where(moved > 0, moved, 1.0),
            resting=np.max([np.abs(record.drive[0]) for record in records], axis=0),
            at_rest=tuple(tuple(one.quiet(axis) for one in samples) for axis in range(response.shape[1])),
        )

    def gain(self, response: int, drive: int) -> Prior:
        """Prior of a gain."""
        scale = 5 * self.amplitude[response] / self.excursion[drive]
        return Prior("norm", {"loc": 0.0, "scale": float(scale)})

    def time(self) -> Prior:
        """Prior of a time constant."""
        return Prior("loguniform", {"a": self.period / 10, "b": 100 * self.span})

    @property
    def resolution(self) -> float:
        """Shortest time constant whose resonance 1 / T samples tell from an alias [time unit]."""
        return self.period / float(np.pi)

    def order(self) -> Prior:
        """Prior of an order."""
        return Prior("uniform", {"loc": 0.0, "scale": 2.0})

    def delay(self) -> Prior:
        """Prior of a delay."""
        return Prior("uniform", {"loc": 0.0, "scale": 0.4 * self.span})

    def offset(self, response: int) -> Prior:
        """Prior of an offset."""
        reach = 1.0 + float(np.max(self.resting / self.excursion))
        scale = 5 * self.amplitude[response] * reach
        return Prior("norm", {"loc": float(self.level[response]), "scale": float(scale)})

    def sigma(self, response: int) -> Prior:
        """Prior of a noise scale."""
        ends = {"a": self.least_noise(response), "b": 2 * float(self.amplitude[response])}
        return Prior("loguniform", ends)

    def least_noise(self, response: int) -> float:
        """Standard deviation of the least noise that is considered [response unit]."""
        return _LEAST * float(self.amplitude[response])

    @staticmethod
    def rho() -> Prior:
        """Prior of a noise correlation."""
        return Prior("uniform", {"loc": 0.0, "scale": 1.0})

    def quiet(self, response: int) -> QuietNoise | None:
        """Noise of an axis as its samples at rest give it; None where these are too few, or have no noise but
        what rounding leaves."""
        if response not in self._quiet:
            pieces = [piece for piece in self.at_rest[response] if piece.values.size > 1]
            found = quiet_noise(pieces, self.correlations)
            least = self.least_noise(response)
            exact = found is not None and max(found.sigma, found.correlated) < least
            self._quiet[response] = None if exact else found
        return self._quiet[response]

    @cached_property
    def _quiet(self) -> dict[int, QuietNoise | None]:
        return {}

    @property
    def correlations(self) -> tuple[float, float]:
        """Least and largest correlation of noise that is neither white nor a trend [-]."""
        longest = max(self.span / self.period / _TIMES, _SHORT)
        return float(np.exp(-1 / _SHORTEST)), float(np.exp(-1 / longest))

    def sigma_white(self, response: int) -> Prior:
        """Prior of the white part of a noise, by the samples at rest where there are enough."""
        quiet = self.quiet(response)
        if quiet is None:
            return self.sigma(response)
        width = float(np.hypot(np.log(_DOUBLE), quiet.log_sd))
        return Prior("lognorm", {"s": width, "scale": quiet.sigma})

    def sigma_ar(self, response: int) -> Prior:
        """Prior of the correlated part of a noise, by the samples at rest where there are enough."""
        quiet = self.quiet(response)
        if quiet is None:
            return self.sigma(response)
        most = min(_BEYOND * quiet.correlated, 2 * float(self.amplitude[response]))
        return Prior("uniform", {"loc": 0.0, "scale": most})

    def rho_short(self) -> Prior:
        """Prior of a correlation that is forgotten well within a record."""
        least, largest = self.correlations
        return Prior("uniform", {"loc": least, "scale": largest - least})

    @staticmethod
    def nu() -> Prior:
        """Prior of the degrees of freedom."""
        return Prior("gamma", {"a": 2.0, "scale": 10.0})
