"""What of a drive lies beyond what the fit records cover: in size, in duration and in frequency.

A model predicts there too, but by its form alone. Nothing is refused for it: each thing outside becomes a
sentence with the time from which it counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.drive import axis_drives, first_change
from lcopa_bayes.data.record import Axis, Driven

_SLIGHT = 0.01
"""Excess over the fitted range of a drive, as a share of that range, that counts as inside [-]."""
_WEAK = 0.01
"""Energy of the fit records' drive over that of the drive to predict, in a band of frequencies, below which
the records say little there [-]: an error of the response that is below their noise may be ten times that
noise under the drive."""
_NOTABLE = 0.01
"""Share of the response's energy from which a band of frequencies counts [-]."""
_BANDS = 6
"""Bands per decade of frequency."""
_PADDED = 8
"""Length of a transform over that of the drive [-]: bands hold several lines."""
_MOST = 1 << 15
"""Most blocks of a drive whose spectrum is taken."""


@final
@dataclass(frozen=True)
class Outside:
    """One thing that lies outside the fitted range."""

    kind: Literal["amplitude", "rest", "time", "frequency"]
    axis: str
    """Drive axis; empty for what concerns all."""
    since: float | None
    """Time from which it counts [time unit]; None: throughout."""
    sentence: str

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self)


@final
@dataclass(frozen=True, eq=False)
class FittedRange:
    """What the fit records covered."""

    records: tuple[Driven, ...]
    axes: tuple[Axis, ...]
    span: float
    """Longest time from a first change of a drive to the last sample [time unit]."""
    period: float
    """Median sampling period [time unit]."""
    time_unit: str

    @property
    def low(self) -> Vector:
        """Least value of each drive [drive unit]."""
        return np.asarray(np.min([record.drive.min(axis=0) for record in self.records], axis=0))

    @property
    def high(self) -> Vector:
        """Largest value of each drive [drive unit]."""
        return np.asarray(np.max([record.drive.max(axis=0) for record in self.records], axis=0))

    @property
    def rests(self) -> tuple[Vector, Vector]:
        """Least and largest value of each drive before the first change of a record [drive unit]."""
        rests = np.array([record.drive[0] for record in self.records]) + 0.0  # no negative zero in sentences
        return rests.min(axis=0), rests.max(axis=0)

    @property
    def usual_rest(self) -> Vector:
        """Resting values of most fit records, of the first such group [drive unit]."""
        rests = [tuple(record.drive[0]) for record in self.records]
        return np.array(max(rests, key=lambda one: (rests.count(one), -rests.index(one))))

    def resting_at(self, rest: Vector) -> list[int]:
        """Positions of the fit records that rest as given, (axes,) [drive unit]; of all where none does."""
        slack = _SLIGHT * (self.high - self.low)
        alike = [k for k, one in enumerate(self.records) if (np.abs(one.drive[0] - rest) <= slack).all()]
        return alike or list(range(len(self.records)))

    def other_rest(self, rest: Sequence[float]) -> list[str]:
        """A clause for every drive axis that rests where no fit record, nor anything between two, did."""
        slack = _SLIGHT * (self.high - self.low)
        (least, largest), out = self.rests, []
        for k, axis in enumerate(self.axes):
            if not least[k] - slack[k] <= rest[k] <= largest[k] + slack[k]:
                known = f"{least[k]:.6g}" if least[k] == largest[k] else f"{least[k]:.6g} to {largest[k]:.6g}"
                out.append(
                    f"drive axis {axis.name!r} is at {measured(rest[k], axis.unit, '.6g')} before its first "
                    f"change, but the study's records rest at {measured(known, axis.unit)}"
                )
        return out

    def outside(self, driven: Driven, times: Vector, squared: Array | None) -> tuple[Outside, ...]:
        """What of a drive lies outside, predicted at `times` (n,) [time unit].

        `squared`: magnitude squared of every path at `centres`, (responses, drives, bands)
        [(response unit / drive unit)^2]; None leaves frequencies out.
        """
        marks = [*self._amplitudes(driven), *self._rests(driven), *self._times(driven, times)]
        if squared is not None:
            marks += self._frequencies(driven, times, squared)
        return tuple(marks)

    def _amplitudes(self, driven: Driven) -> list[Outside]:
        slack, out = _SLIGHT * (self.high - self.low), []
        for k, axis in enumerate(self.axes):
            column = driven.drive[:, k]
            beyond = (column > self.high[k] + slack[k]) | (column < self.low[k] - slack[k])
            if beyond.any():
                since = float(driven.time[beyond.argmax()])
                out.append(
                    Outside(
                        "amplitude",
                        axis.name,
                        since,
                        f"Drive {axis.name} runs from {column.min():.4g} to "
                        f"{measured(column.max(), axis.unit, '.4g')}, in the fit records from "
                        f"{self.low[k]:.4g} to {measured(self.high[k], axis.unit, '.4g')}: from {since:.4g} "
                        f"{self.time_unit} on the bands rest on the form of the model.",
                    )
                )
        return out

    def _rests(self, driven: Driven) -> list[Outside]:
        return [
            Outside(
                "rest", "", None, f"{clause[0].upper()}{clause[1:]}: the bands rest on the form of the model."
            )
            for clause in self.other_rest(driven.drive[0])
        ]

    def _times(self, driven: Driven, times: Vector) -> list[Outside]:
        begin = first_change(driven)
        last = begin + self.span
        if times[-1] <= last + self.period:
            return []
        return [
            Outside(
                "time",
                "",
                last,
                f"From {last:.4g} {self.time_unit} on the prediction is more than {self.span:.4g} "
                f"{self.time_unit} after the first change of a drive, longer than any fit record: "
                "slow parts of the response are extrapolated there.",
            )
        ]

    def edges(self, driven: Driven, times: Vector) -> Vector:
        """Ends of the bands of frequency that are looked at, (bands + 1,) [cycles / time unit]."""
        length = max(float(times[-1]) - first_change(driven), self.period)
        gaps = np.diff(np.unique(driven.time))
        finest = min(self.period, float(gaps.min()) if gaps.size else self.period)
        finest = max(finest, length / _MOST)
        low, high = 0.5 / max(length, self.span), 1.0 / finest
        return np.geomspace(low, high, max(2, round(_BANDS * np.log10(high / low)) + 1))

    def centres(self, driven: Driven, times: Vector) -> Vector:
        """Middle of each band, (bands,) [cycles / time unit]."""
        edges = self.edges(driven, times)
        return np.asarray(np.sqrt(edges[1:] * edges[:-1]))

    def _frequencies(self, driven: Driven, times: Vector, squared: Array) -> list[Outside]:
        edges, centres = self.edges(driven, times), self.centres(driven, times)
        wanted = energies(driven, float(times[-1]), edges)
        fitted = np.sum([energies(one, float(one.time[-1]), edges) for one in self.records], axis=0)
        fitted = np.where(centres <= 0.5 / self.period, fitted, 0.0)
        energy = squared * wanted
        total = energy.sum(axis=(1, 2), keepdims=True)
        share = np.max(energy / np.where(total > 0, total, 1.0), axis=0)
        # of a drive that repeats what the records show, a stretch as long as the longest of them counts
        length = max(float(times[-1]) - first_change(driven), self.period)
        excursion = np.max([np.abs(one.drive - one.drive[0]).max(axis=0) for one in self.records], axis=0)
        size = np.abs(driven.drive - driven.drive[0]).max(axis=0)
        larger = np.maximum(size / np.where(excursion > 0, excursion, 1.0), 1.0)  # marked as amplitude
        scaled = wanted * min(1.0, self.span / length) / larger[:, None] ** 2
        out = []
        for k, axis in enumerate(self.axes):
            weak = (fitted[k] < _WEAK * scaled[k]) & (share[k] > _NOTABLE) & (centres >= 1.0 / self.span)
            if weak.any():
                low, high = edges[:-1][weak].min(), edges[1:][weak].max()
                out.append(
                    Outside(
                        "frequency",
                        axis.name,
                        None,
                        f"Between {low:.3g} and {high:.3g} cycles per {self.time_unit} drive "
                        f"{axis.name} brings {100 * float(share[k][weak].sum()):.0f} % of the "
                        "response's energy, where the fit records hold less than a hundredth of its "
                        "energy or no samples to tell: the bands rest on the form of the model there.",
                    )
                )
        return out


def energies(driven: Driven, until: float, edges: Vector) -> Matrix:
    """Energy of every drive's deviation from rest in bands of frequency, up to the time `until` [time unit].

    Parameters: edges (bands + 1,) [cycles / time unit]. Returns: integral of the squared magnitude of the
    Fourier transform over each band, both signs of frequency, (drives, bands) [drive unit^2 time unit].
    Accuracy: the drive enters by exact means over blocks of a sixteenth of the shortest cycle.
    """
    begin = first_change(driven)
    length = max(until - begin, 1.0 / edges[-1])
    blocks = min(int(np.ceil(16 * length * edges[-1])), 4 * _MOST)
    corners = begin + length * np.arange(blocks + 1) / blocks
    width, out = length / blocks, []
    for one in axis_drives(driven):
        if not one.moves:
            out.append(np.zeros(edges.size - 1))
            continue
        means = one.block_means(corners, np.zeros(1))[0][0]
        size = _PADDED * blocks
        density = np.abs(np.fft.rfft(means, size) * width) ** 2
        frequency = np.fft.rfftfreq(size, width)
        density[0] /= 2  # half of the line at rest lies at negative frequencies
        smoothed = np.sinc(frequency * width) ** 2  # of the block means
        running = np.concatenate(([0.0], np.cumsum(density / np.maximum(smoothed, 0.4)))) / (size * width)
        out.append(2 * np.diff(np.interp(edges, np.append(0.0, frequency + 0.5 / (size * width)), running)))
    return np.array(out)
