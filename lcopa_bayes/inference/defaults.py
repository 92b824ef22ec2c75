"""Default priors, derived from the time span and the amplitude of the fit records. All of them are here.

With span = longest time from a record's first drive change to its last sample, period = median sampling
period, A = range of a response axis over the records, D = largest deviation of a drive from rest:

==========  ======================================  =============================================
parameter   prior                                   why
==========  ======================================  =============================================
gain        normal(0, 5 A / D)                      either sign; a slow tail may hide most of it
time        log-uniform(period / 10, 100 span)      from unresolved to far slower than the record
order       uniform(0, 2), decreasing               where the element is passive
delay       uniform(0, 0.4 span)                    later onset leaves too little record to fit
offset      normal(mean response, 5 A (1 + U / D))  reading at zero drive; U = largest resting drive
sigma       log-uniform(1e-6 A, 2 A)                scale of the noise, over all plausible decades
rho         uniform(0, 1)                           correlation of noise one sampling period apart
nu          gamma(2, scale 10)                      Juarez and Steel 2010, J. Appl. Econometrics 25
==========  ======================================  =============================================
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.arrays import Vector
from lcopa_bayes.inference.data import sampling_period
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.plant.drive import Drive
from lcopa_bayes.record import Record


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

    @classmethod
    def of(cls, records: Sequence[Record]) -> Scales:
        """Scales of the fit records."""
        spans = []
        for record in records:
            drives = [Drive.of_rows(record.time, column) for column in record.drive.T]
            begin = min((drive.times[0] for drive in drives if drive.moves), default=record.time[0])
            spans.append(record.time[-1] - begin)
        response = np.concatenate([record.response for record in records])
        amplitude = np.nanmax(response, axis=0) - np.nanmin(response, axis=0)
        moved = np.max([np.abs(record.drive - record.drive[0]).max(axis=0) for record in records], axis=0)
        return cls(
            float(max(spans)),
            sampling_period(records),
            np.where(amplitude > 0, amplitude, 1.0),
            np.nanmean(response, axis=0),
            np.where(moved > 0, moved, 1.0),
            np.max([np.abs(record.drive[0]) for record in records], axis=0),
        )

    def gain(self, response: int, drive: int) -> Prior:
        """Prior of a gain."""
        scale = 5 * self.amplitude[response] / self.excursion[drive]
        return Prior("norm", {"loc": 0.0, "scale": float(scale)})

    def time(self) -> Prior:
        """Prior of a time constant."""
        return Prior("loguniform", {"a": self.period / 10, "b": 100 * self.span})

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
        amplitude = float(self.amplitude[response])
        return Prior("loguniform", {"a": 1e-6 * amplitude, "b": 2 * amplitude})

    @staticmethod
    def rho() -> Prior:
        """Prior of a noise correlation."""
        return Prior("uniform", {"loc": 0.0, "scale": 1.0})

    @staticmethod
    def nu() -> Prior:
        """Prior of the degrees of freedom."""
        return Prior("gamma", {"a": 2.0, "scale": 10.0})
