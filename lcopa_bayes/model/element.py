"""The fractional generalised Kelvin element and the paper's two ways to scale it."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from math import inf
from typing import final


@final
@dataclass(frozen=True)
class Element:
    """Denominator ``1 + sum_i (T_i s)^order_i`` (Ta et al. 2026, Eq. 28, stiffness divided out).

    Equal orders are one term in effect; the paper's integer rival has orders 2, 1, 1. Raises ValueError
    for anything the fields do not allow.
    """

    times: tuple[float, ...]
    """Time constants T_i [time unit], one per order; positive."""
    orders: tuple[float, ...]
    """Fractional orders [-], not increasing, in (0, 2]."""

    def __post_init__(self) -> None:
        if len(self.times) != len(self.orders) or not self.orders:
            raise ValueError(f"one time constant per order; got {len(self.times)} and {len(self.orders)}")
        if not all(0 < time < inf for time in self.times):
            raise ValueError(f"`times` must be positive and finite; got {self.times}")
        falling = all(a >= b for a, b in pairwise(self.orders))  # NaN fails
        if not (self.orders[0] <= 2 and falling and self.orders[-1] > 0):
            raise ValueError(f"`orders` must not increase and lie within (0, 2]; got {self.orders}")


@final
@dataclass(frozen=True)
class PaperForm:
    """The same path as the paper prints it: ``gain / (sum_i eta_i s^order_i + stiffness)``."""

    gain: float
    """b [response unit per drive unit, times stiffness]."""
    etas: tuple[float, ...]
    """Viscosities [time unit^order times stiffness]."""
    orders: tuple[float, ...]
    """Fractional orders [-]."""
    stiffness: float
    """k [-]."""


def to_paper(gain: float, element: Element, *, stiffness: float | None = None) -> PaperForm:
    """`gain` over `element` with the given stiffness k, or, without one, scaled to eta_last = 1.

    Scaling gain, viscosities and stiffness together leaves the response unchanged, so one of them
    is a convention: the text takes k as known (Eq. 62), the identified model prints eta3 = 1 (Eq. 65).
    """
    bare = [time**order for time, order in zip(element.times, element.orders, strict=True)]
    k = 1.0 / bare[-1] if stiffness is None else stiffness
    return PaperForm(gain * k, tuple(k * eta for eta in bare), element.orders, k)


def from_paper(form: PaperForm) -> tuple[float, Element]:
    """Gain at rest and element of a path in the paper's form."""
    times = tuple(
        (eta / form.stiffness) ** (1.0 / order) for eta, order in zip(form.etas, form.orders, strict=True)
    )
    return form.gain / form.stiffness, Element(times, form.orders)
