"""What the identification scans: intervals of orders and delay, and the values of k (Eqs. 62-64)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise, product
from math import isfinite
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.errors import InputError, refuse_if

_ROUND = 9
"""Decimals to which orders are compared."""
_REACH = 0.4
"""Largest delay scanned by default, as a part of the shortest record [-]."""
MOST_TERMS = 3
"""The paper's element has three viscous terms; a lattice of more orders cannot be scanned."""


@final
class Interval(NamedTuple):
    """Ends of a scanned interval, both included."""

    low: float
    high: float


@final
class Candidates(NamedTuple):
    """Candidates of one round of the scan: every row of orders with every delay."""

    orders: Matrix
    """(rows, terms) [-], decreasing along a row."""
    delays: Vector
    """(delays,) [time unit]."""

    @property
    def size(self) -> int:
        """Number of candidates."""
        return int(self.orders.shape[0] * self.delays.size)


@final
@dataclass(frozen=True)
class Scan:
    """Intervals of a scan. InputError with all problems unless the fields are as they say."""

    orders: tuple[Interval, ...] | None = None
    """One interval per term within (0, 2] [-], that of the largest order (alpha) first; a path of fewer
    terms uses the first ones. None: from `order_step` to 2 for every term."""
    order_step: float = 0.1
    """Spacing of scanned orders [-]."""
    delay: Interval | None = None
    """[time unit]; None: from 0 to 0.4 of the shortest record."""
    whole_blocks: bool = True
    """Whether delays are whole blocks as in Eq. 51; if not, refinement goes below a block."""
    stiffness: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0)
    """Values of k [-]; the first one is reported, for no output error prefers any."""
    rounds: int = 4
    """Refinements around the best candidate, each three times finer [-]."""

    def __post_init__(self) -> None:
        problems = []
        for name, interval in zip(_names(len(self.orders or ())), self.orders or (), strict=True):
            problems += _interval_problems(f"the scan interval of {name}", interval)
            if not (interval[0] > 0 and interval[1] <= 2):
                problems.append(
                    f"the scan interval of {name} must lie within (0, 2]; got {tuple(interval)}: shorten it"
                )
        if self.orders == ():
            problems.append("the scan needs an interval for one order or more; got none")
        if not problems and self.orders:
            problems += _ordering_problems(self.orders)
        if not (0 < self.order_step <= 2):
            problems.append(f"`order_step` must lie in (0, 2]; got {self.order_step!r}")
        if self.delay is not None:
            problems += _interval_problems("the scan interval of the delay", self.delay)
            if not self.delay[0] >= 0:
                problems.append(f"a delay must not be negative; got the interval {tuple(self.delay)}")
        if not self.stiffness or not all(isfinite(k) and k > 0 for k in self.stiffness):
            problems.append(f"`stiffness` needs positive values of k; got {self.stiffness!r}")
        if isinstance(self.rounds, bool) or not isinstance(self.rounds, int) or self.rounds < 0:
            problems.append(f"`rounds` must be a whole number, 0 or more; got {self.rounds!r}")
        refuse_if(problems)

    def order_intervals(self, terms: int) -> tuple[Interval, ...]:
        """The interval of each order of a path with so many terms; InputError when they do not fit."""
        if terms > MOST_TERMS:
            raise InputError(
                f"the scan takes up to {MOST_TERMS} viscous terms; got {terms}: choose fewer under [model]"
            )
        if self.orders is None:
            return (Interval(self.order_step, 2.0),) * terms
        if len(self.orders) < terms:
            raise InputError(
                f"the scan has {len(self.orders)} order interval(s), a path has {terms} terms; give one each"
            )
        return self.orders[:terms]

    def first_round(self, terms: int, span: float, block: float) -> Candidates:
        """The lattice of orders with delays in steps of a block.

        Parameters: span [time unit] of the shortest record; block [time unit]. InputError when no
        candidate has alpha largest or no delay lies in the interval.
        """
        orders = decreasing([_lattice(each, self.order_step) for each in self.order_intervals(terms)])
        low, high = self.delay or Interval(0.0, _REACH * span)
        counts = np.arange(np.ceil(low / block - 1e-9), np.floor(high / block + 1e-9) + 1)
        problems = []
        if not orders.size:
            problems.append("no scanned combination has decreasing orders; let the intervals decrease")
        if high >= span:
            problems.append(
                f"the delay interval ends at {high:g}, but a record lasts only {span:g}: shorten it"
            )
        if not counts.size:
            problems.append(
                f"no whole number of blocks of {block:g} lies in the delay interval {(low, high)}"
            )
        refuse_if(problems)
        return Candidates(orders, block * counts)

    def next_round(
        self, orders: Sequence[float], delay: float, number: int, span: float, block: float
    ) -> Candidates:
        """Three finer steps to both sides of a candidate, within the intervals; `number` counts from 1."""
        step = self.order_step / 3.0**number
        around = np.arange(-3, 4)
        values = [
            _within(np.asarray(order + step * around, dtype=float), each)
            for order, each in zip(orders, self.order_intervals(len(orders)), strict=True)
        ]
        pace = block if self.whole_blocks else block / 3.0**number
        delays = np.asarray(delay + pace * around, dtype=float)
        if self.whole_blocks:
            delays = block * np.round(delays / block) + 0.0  # no negative zero
        reach = self.delay or Interval(0.0, _REACH * span)
        return Candidates(decreasing(values), _within(delays, reach))


def decreasing(values: Sequence[Vector]) -> Matrix:
    """All combinations with decreasing orders, (rows, terms)."""
    rows = [row for row in product(*values) if all(a > b + 10.0**-_ROUND for a, b in pairwise(row))]
    return np.round(np.array(rows, dtype=float).reshape(-1, len(values)), _ROUND)


def _names(terms: int) -> list[str]:
    return ["alpha", "beta", "gamma"][:terms] + [f"order {k + 1}" for k in range(3, terms)]


def _lattice(interval: Interval, step: float) -> Vector:
    count = int(np.floor((interval[1] - interval[0]) / step + 1e-9)) + 1
    return np.round(interval[0] + step * np.arange(count), _ROUND)


def _within(values: Array, interval: Interval) -> Vector:
    slack = 10.0**-_ROUND
    return values[(values >= interval[0] - slack) & (values <= interval[1] + slack)]


def _interval_problems(name: str, interval: Interval) -> list[str]:
    low, high = interval
    if isfinite(low) and isfinite(high) and low <= high:
        return []
    return [f"{name} is empty: {tuple(interval)}; give a lower end that is not above the upper end"]


def _ordering_problems(orders: Sequence[Interval]) -> list[str]:
    """Sentences when a later order may exceed every value of an earlier one."""
    return [
        f"{earlier} must be larger than {later}, alpha the largest of all; the interval of {later} ends at "
        f"{below[1]:g}, above {above[1]:g}, where that of {earlier} ends: swap or shorten them"
        for (earlier, above), (later, below) in pairwise(zip(_names(len(orders)), orders, strict=True))
        if below[1] > above[1]
    ]
