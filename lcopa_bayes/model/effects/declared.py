"""Effects that belong to a plant, over a set of records: what the forward model carries along."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.model.effects.effect import (
    DriveEffect,
    Effect,
    ElementEffect,
    ForceEffect,
    Ranges,
    ReadoutEffect,
    SensorEffect,
)


@final
@dataclass(frozen=True, eq=False)
class Declared:
    """Kinds of effects with their scales, and what they need to know of every record."""

    kinds: tuple[type[Effect], ...]
    ranges: Ranges
    epochs: Vector
    """Place of each record in the campaign, (records,), -1/2 to 1/2 [-]."""
    times: tuple[Vector, ...]
    """Sample times of each record [time unit]."""
    fitted: tuple[int | None, ...]
    """Position of each record among the records of the fit; None for any other record, whose own
    coefficients are unknown."""

    def __post_init__(self) -> None:
        if not len(self.epochs) == len(self.times) == len(self.fitted):
            raise ValueError(
                f"one epoch, one array of times and one position per record; got {len(self.epochs)}, "
                f"{len(self.times)} and {len(self.fitted)}"
            )

    def only(self, records: Sequence[int]) -> Declared:
        """The same over some of the records."""
        chosen = list(records)
        return replace(
            self,
            epochs=self.epochs[chosen],
            times=tuple(self.times[r] for r in chosen),
            fitted=tuple(self.fitted[r] for r in chosen),
        )

    def joined(self, other: Declared) -> Declared:
        """The same over the records of both."""
        return replace(
            self,
            epochs=np.concatenate([self.epochs, other.epochs]),
            times=(*self.times, *other.times),
            fitted=(*self.fitted, *other.fitted),
        )

    @property
    def affine(self) -> bool:
        """Whether every response axis is linear in the gains of its own paths."""
        return all(kind.affine for kind in self.kinds)

    @property
    def read_out(self) -> bool:
        """Whether something acts on the deflection after everything has been added to it."""
        return any(issubclass(kind, ReadoutEffect) for kind in self.kinds)

    @property
    def bending(self) -> bool:
        """Whether something acts between commands and reading."""
        return any(issubclass(kind, (ElementEffect, ForceEffect, SensorEffect)) for kind in self.kinds)

    @property
    def forced(self) -> bool:
        """Whether all that acts between commands and reading are forces that take many plants at once."""
        acting = any(issubclass(kind, (ElementEffect, SensorEffect)) for kind in self.kinds)
        forces = [kind for kind in self.kinds if issubclass(kind, ForceEffect)]
        return bool(forces) and not acting and all(k.batched and not k.card.per_record for k in forces)

    @property
    def commanding(self) -> bool:
        """Whether something changes the commands, and not only when they act."""
        return any(issubclass(kind, DriveEffect) and not kind.lags for kind in self.kinds)

    @property
    def per_record(self) -> bool:
        """Whether some coefficients belong to single records."""
        return any(kind.card.per_record for kind in self.kinds)
