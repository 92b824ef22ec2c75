"""What is predicted from the rest: whole records, or the future of the only one.

Points inside a record are correlated through the plant's memory and the noise: leaving out single points
would measure how well a model fills gaps, not how well it predicts, and is not offered.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lcopa_bayes.core.arrays import Index
from lcopa_bayes.inference.observations import Observed, Samples
from lcopa_bayes.inference.posterior import Posterior

Kind = Literal["held-out record", "record left out", "future of the record"]

CUTS = (0.5, 0.625, 0.75, 0.875)
"""Shares of a single record that are known when what follows is predicted [-]."""


@dataclass(frozen=True, eq=False)
class Part:
    """Samples predicted from others."""

    name: str
    kind: Kind
    record: int
    """Number among the fit records, or among the held-out ones."""
    known: int
    """Time points of the record that are known [-]; 0 where the whole record is predicted."""
    until: int
    """First time point no longer predicted [-]."""


def parts_of(posterior: Posterior, held_out: Sequence[str]) -> tuple[Part, ...]:
    """Every record in turn from the others; of a single record the stretches after each cut; and the
    held-out records from all that were fitted."""
    records = posterior.samples
    out = [
        Part(name, "held-out record", number, 0, np.iinfo(np.intp).max)
        for number, name in enumerate(held_out)
    ]
    if len(records) > 1:
        out += [
            Part(one.record.name, "record left out", number, 0, one.times.size)
            for number, one in enumerate(records)
        ]
        return tuple(out)
    count = records[0].times.size
    ends = [round(share * count) for share in (*CUTS, 1.0)]
    out += [
        Part(f"{records[0].record.name} after {100 * share:g} %", "future of the record", 0, first, last)
        for share, first, last in zip(reversed(CUTS), reversed(ends[:-1]), reversed(ends[1:]), strict=True)
        if last > first
    ]
    return tuple(out)


def without(posterior: Posterior, part: Part) -> Posterior:
    """The posterior given the samples that are known when the part is predicted; the priors stay."""
    samples = list(posterior.samples)
    own = samples[part.record]
    samples[part.record] = Samples(
        own.record, own.times, tuple(_first(axis, axis.index < part.known) for axis in own.axes)
    )
    return replace(posterior, samples=tuple(samples))


def _first(observed: Observed, known: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Observed:
    return Observed(observed.index[known], observed.values[known], observed.gaps[known])


def predicted(observed: Observed, part: Part) -> Index:
    """Positions among an axis' samples that are predicted."""
    return np.flatnonzero((observed.index >= part.known) & (observed.index < part.until))
