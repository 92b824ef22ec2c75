"""A transfer path: the fractional generalised Kelvin element with gain and delay, in either normalisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf, isfinite
from typing import Self, final

from lcopa_bayes.core.errors import InputError, refuse_if

_SAME = 1e-9
"""Orders closer than this are one term [-]."""


@final
class Normalisation(Enum):
    """Which coefficient fixes the common scale of gain, viscosities and stiffness."""

    STIFFNESS = "k given"
    """k, which Ta et al. 2026, Eq. 62 takes as known."""
    LAST_ETA = "last eta = 1"
    """The viscosity of the last order, which Eq. 65 prints as 1."""


@final
@dataclass(frozen=True)
class TransferPath:
    """``gain exp(-delay s) / (sum_i eta_i s^order_i + stiffness)`` (Ta et al. 2026, Eqs. 31, 62, 65).

    Gain, viscosities and stiffness multiplied by one number give the same response: the class holds them in
    any scale, and `normalised` brings them to either of the paper's. Coefficients of any sign are possible,
    as least squares may give them; see `physical`. InputError unless there is one viscosity per order, the
    numbers are finite, orders positive, the stiffness not 0 and the delay not negative.
    """

    gain: float
    """b [response unit per drive unit, times the unit of the stiffness]."""
    delay: float
    """tau [time unit]."""
    etas: tuple[float, ...]
    """Viscosities [time unit^order, times the unit of the stiffness], one per order."""
    orders: tuple[float, ...]
    """Fractional orders [-]."""
    stiffness: float
    """k [-]."""

    def __post_init__(self) -> None:
        problems = []
        if not isfinite(self.gain):
            problems.append(f"a gain must be finite; got {self.gain}")
        if not 0 <= self.delay < inf:
            problems.append(f"a delay must be at least 0 and finite; got {self.delay}")
        if not self.orders or len(self.etas) != len(self.orders):
            problems.append(f"one viscosity per order is needed; got {self.etas} and orders {self.orders}")
        if not all(map(isfinite, (*self.etas, self.stiffness))) or self.stiffness == 0:
            problems.append(f"viscosities and stiffness must be finite, the stiffness not 0; got {self}")
        if not all(0 < order < inf for order in self.orders):
            problems.append(f"orders must be positive and finite; got {self.orders}")
        refuse_if(problems)

    @classmethod
    def of_times(cls, gain: float, delay: float, times: Sequence[float], orders: Sequence[float]) -> Self:
        """``gain exp(-delay s) / (1 + sum_i (T_i s)^order_i)``, the form in which a plant is fitted.

        Parameters: gain at rest [response unit per drive unit]; delay and times T_i [time unit]; orders [-].
        The stiffness is 1, and ``eta_i = T_i^order_i``. InputError unless times are positive and finite, one
        per order, and as the class.
        """
        if not all(0 < value < inf for value in times):
            raise InputError(f"times must be positive and finite; got {times}")
        if len(times) != len(orders):
            raise InputError(f"one time constant per order is needed; got {times} and orders {orders}")
        etas = (time**order for time, order in zip(times, orders, strict=True))
        return cls(gain, delay, tuple(etas), tuple(orders), 1.0)

    @property
    def physical(self) -> bool:
        """Whether viscosities and stiffness are positive, as dashpots and springs are."""
        return all(value > 0 for value in (*self.etas, self.stiffness))

    @property
    def steady(self) -> float:
        """Response at rest under a unit drive [response unit per drive unit]."""
        return self.gain / self.stiffness

    @property
    def times(self) -> tuple[float, ...]:
        """T_i of `of_times` [time unit]; InputError unless the path is physical."""
        if not self.physical:
            raise InputError(f"only positive viscosities and stiffness have time constants; got {self}")
        pairs = zip(self.etas, self.orders, strict=True)
        return tuple((eta / self.stiffness) ** (1 / order) for eta, order in pairs)

    def normalised(self, normalisation: Normalisation, stiffness: float = 1.0) -> Self:
        """The same path with the given stiffness, or with the last viscosity 1."""
        fixed = normalisation is Normalisation.STIFFNESS
        divisor = self.stiffness / stiffness if fixed else self.etas[-1]
        etas = tuple(eta / divisor for eta in self.etas)
        return replace(self, gain=self.gain / divisor, etas=etas, stiffness=self.stiffness / divisor)

    def merged(self) -> Self:
        """The same path with neighbouring terms of one order as one, their viscosities added."""
        etas, orders = list(self.etas[:1]), list(self.orders[:1])
        for eta, order in zip(self.etas[1:], self.orders[1:], strict=True):
            if abs(orders[-1] - order) < _SAME:
                etas[-1] += eta
            else:
                etas.append(eta)
                orders.append(order)
        return replace(self, etas=tuple(etas), orders=tuple(orders))
