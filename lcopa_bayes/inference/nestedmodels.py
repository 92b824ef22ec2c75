"""Which candidate contains which, and what values of the smaller are in the larger.

A model contains another when it gives the same responses at some of its own parameters: with more terms,
freer orders, elements, delays and levels that are shared less, or a noise that can become the other's. Terms
that the smaller lacks are a share of one of its own, of the same order, or too fast to be seen.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior

_SPLIT = (0.3, 0.7)
"""Smallest and largest share of a term that is split in two [-]."""
_LEAST_SPLIT = 0.1
"""Order above which a term is split [-]: parts of one of lower order are faster by ever more decades."""
_ORDERS_APART = 0.02
"""Relative distance of the orders of a term that is split [-]: equal ones are a singular point."""
_HARDLY = 0.1
"""White part over the correlated one that hardly shows [-]."""
_BECOMES = frozenset({("white", "ar1"), ("white", "student"), ("white", "white+ar1"), ("ar1", "white+ar1")})
"""Noise models, of which the second can become the first."""
_HARDLY_ACTS = 1e-3
"""Size of a coefficient that cannot be negative where it should vanish [prior standard deviation]."""
_FAST_ORDERS = (0.5, 1.0)
"""Orders of such a term where they are free [-]: above 1 a fast term is not resolved."""
Slots = tuple[tuple[int, ...], ...]
_FAST = (1e-3, 2e-2)
"""Quantiles of the prior between which the time of a term lies that is too fast to be seen [-]."""


def lifted(values: Matrix, small: Posterior, large: Posterior, rng: np.random.Generator) -> Matrix | None:
    """Table values of the larger model at which it is close to the smaller at `values` (n, rows); None when
    it does not contain the smaller.

    Where terms must be added each row has its own: repeat rows to get several.
    """
    return _Lift(small.table, large.table, small.noise.kind, large.noise.kind, rng)(values, large)


@final
@dataclass(frozen=True, eq=False)
class _Lift:
    small: ParameterTable
    large: ParameterTable
    small_noise: str
    large_noise: str
    rng: np.random.Generator

    def __call__(self, values: Matrix, target: Posterior) -> Matrix | None:
        free = [sum(row.free for row in table.rows) for table in (self.large, self.small)]
        axes = [(table.layout.drives, table.layout.responses) for table in (self.large, self.small)]
        if free[0] <= free[1] or axes[0] != axes[1]:
            return None
        out = np.full((len(values), len(self.large.rows)), np.nan)
        parts = (self._gains, self._elements, self._delays, self._levels, self._effects)
        if not all(part(values, out) for part in parts) or not self._noise(values, out, target):
            return None
        for k, row in enumerate(self.large.rows):
            if not row.free:
                if not (np.isclose(out[:, k], row.value).all() or self._without_effect(k)):
                    return None
                out[:, k] = row.value
        return self.large.sorted_with_source(out, every=True)[0] if self._orders_free() else out

    def _orders_free(self) -> bool:
        return all(self.large.rows[k].free for k in self.large.of_kind("order"))

    def _without_effect(self, k: int) -> bool:
        """Whether a time or order belongs to an element that no gain uses."""
        row, layout = self.large.rows[k], self.large.layout
        if row.kind == "delay":
            return not self._acting(layout.delay_of, row.place.first, self.large)
        if row.kind not in ("time", "order"):
            return False
        return not self._acting(layout.element_of, row.place.first, self.large)

    @staticmethod
    def _acting(
        slots: tuple[tuple[int, ...], ...], slot: int, table: ParameterTable
    ) -> list[tuple[int, int]]:
        """Paths of a slot whose gain is not held at zero."""
        paths = [(i, j) for i, line in enumerate(slots) for j, own in enumerate(line) if own == slot]
        return [(i, j) for i, j in paths if table.rows[table.at("gain", i, j)].value != 0.0]

    def _slot(self, of: str, slot: int) -> int | None:
        """The smaller model's slot in place of the larger's; None when there are several."""
        own, theirs = getattr(self.large.layout, of), getattr(self.small.layout, of)
        paths = [(i, j) for i, line in enumerate(own) for j, used in enumerate(line) if used == slot]
        acting = [(i, j) for i, j in paths if self.small.rows[self.small.at("gain", i, j)].value != 0.0]
        elements = {theirs[i][j] for i, j in acting or paths}
        return elements.pop() if len(elements) == 1 else None

    def _gains(self, values: Matrix, out: Matrix) -> bool:
        for k in self.large.of_kind("gain"):
            out[:, k] = values[:, self.small.at("gain", *self.large.rows[k].place)]
        return True

    def _delays(self, values: Matrix, out: Matrix) -> bool:
        for k in self.large.of_kind("delay"):
            slot = self._slot("delay_of", self.large.rows[k].place.first)
            if slot is None:
                return False
            out[:, k] = values[:, self.small.at("delay", slot)]
        return True

    def _levels(self, values: Matrix, out: Matrix) -> bool:
        theirs = {tuple(self.small.rows[k].place): k for k in self.small.of_kind("offset")}
        own = {tuple(self.large.rows[k].place): k for k in self.large.of_kind("offset")}
        for (axis, record), k in own.items():
            source = theirs.get((axis, record), theirs.get((axis, -1)))
            if source is None and any(place[0] == axis for place in theirs):
                if record != -1 or len([place for place in theirs if place[0] == axis]) > 1:
                    return False
                source = next(k for place, k in theirs.items() if place[0] == axis)  # the only record's
            out[:, k] = 0.0 if source is None else values[:, source]
        return not theirs or bool(own)

    def _effects(self, values: Matrix, out: Matrix) -> bool:
        """Effects of the smaller model keep their numbers; one that it lacks vanishes, or nearly so."""
        own = {
            row.name: k for k, row in enumerate(self.small.rows) if row.kind in (*COEFFICIENTS, *CONSTANTS)
        }
        for k, row in enumerate(self.large.rows):
            if row.name in own:
                out[:, k] = values[:, own.pop(row.name)]
            elif row.kind in CONSTANTS:
                out[:, k] = row.value if row.prior is None else row.draw(len(out), self.rng)
            elif row.kind == "magnitude" and row.prior is not None:
                out[:, k] = _HARDLY_ACTS * row.prior.sd
            elif row.kind in COEFFICIENTS:
                out[:, k] = 0.0 if row.free else row.value
        return not own

    def _noise(self, values: Matrix, out: Matrix, target: Posterior) -> bool:
        if (self.small_noise, self.large_noise) not in _BECOMES and self.small_noise != self.large_noise:
            return False
        for axis in range(len(self.large.layout.responses)):
            own = {
                row.kind: k for k, row in enumerate(self.small.rows) if row.noise and row.place.first == axis
            }
            columns = {name: values[:, k] for name, k in own.items()}
            if self.small_noise == "ar1" and self.large_noise == "white+ar1":
                columns |= {"sigma_ar": columns["sigma"], "sigma": _HARDLY * columns["sigma"]}
            elif self.small_noise != self.large_noise:
                sd = columns["sigma"]
                white = [target.noise.nearly_white(float(one)) for one in sd]
                columns = {name: np.array([one[name] for one in white]) for name in target.noise.names}
            for name, column in columns.items():
                out[:, self.large.at(name, axis)] = column
        return True

    def _elements(self, values: Matrix, out: Matrix) -> bool:
        for element, (own_times, own_orders) in enumerate(self.large.terms):
            source = self._slot("element_of", element)
            if source is None:
                return False
            times, orders = (values[:, columns] for columns in self.small.terms[source])
            fixed = sum(not self.large.rows[k].free for k in own_orders)
            if times.shape[1] > len(own_times) or 0 < fixed < len(own_orders):
                return False
            put = self._fixed(times, orders, element) if fixed else self._free(times, orders, element)
            if put is None:
                return False
            out[:, own_times], out[:, own_orders] = put
        return True

    def _fixed(self, times: Matrix, orders: Matrix, element: int) -> tuple[Matrix, Matrix] | None:
        """Terms of fixed orders: each of the smaller's finds its own, the rest are too fast to be seen."""
        held = [self.large.rows[k].value for k in self.large.terms[element].orders]
        if np.ptp(orders, axis=0).any() or Counter(orders[0].tolist()) - Counter(held):
            return None
        out = np.stack([self._fast(element, k, len(times)) for k in range(len(held))], axis=1)
        left = list(range(len(held)))
        for k, order in enumerate(orders[0]):
            place = next(p for p in left if held[p] == order)
            left.remove(place)
            out[:, place] = times[:, k]
        return out, np.tile(held, (len(times), 1))

    def _free(self, times: Matrix, orders: Matrix, element: int) -> tuple[Matrix, Matrix]:
        """Terms of free orders: those missing are split off one of the others, or too fast to be seen."""
        terms = self.large.layout.elements[element].terms
        while times.shape[1] < terms:
            n, count = times.shape
            rows, term = np.arange(n), self.rng.integers(count, size=n)
            order = orders[rows, term]
            share = self.rng.uniform(*_SPLIT, n)
            apart = np.exp(-_ORDERS_APART * self.rng.random((2, n))) * order
            strength = times[rows, term] ** order
            split: Flags = np.asarray((self.rng.random(n) < 0.5) & (order > _LEAST_SPLIT))
            power = 1 / np.maximum(order, _LEAST_SPLIT)
            own = np.where(split, (strength * share) ** power, times[rows, term])
            new = np.where(split, (strength * (1 - share)) ** power, self._fast(element, count, n))
            times, orders = times.copy(), orders.copy()
            times[rows, term], orders[rows, term] = own, np.where(split, apart[0], order)
            another = np.where(split, apart[1], self.rng.uniform(*_FAST_ORDERS, n))
            times, orders = np.column_stack([times, new]), np.column_stack([orders, another])
        return times, orders

    def _fast(self, element: int, term: int, n: int) -> Vector:
        row, order = (self.large.rows[columns[term]] for columns in self.large.terms[element])
        if row.prior is None:
            return np.full(n, row.value)
        if not order.free and order.value > 1.0 and self.large.resolution > 0:
            return np.asarray(self.large.resolution * np.exp(0.5 * self.rng.random(n)))
        return row.quantiles(self.rng.uniform(*_FAST, n))
