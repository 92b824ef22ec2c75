"""The parameter table: every number of the model in one order, and the orderings its terms may take."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import lgamma, log
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Index, Matrix, Vector
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.core.units import per
from lcopa_bayes.data.settings import ModelSettings, PriorSettings
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS, KINDS
from lcopa_bayes.inference.noise import NOISES
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.forward import Dynamics
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.path import TransferPath

_ORDERED_DRAWS = 200_000
"""Prior draws that measure how much mass an unexchangeable prior has where orders decrease."""
_LEAST_ORDERED = 1e-3
"""Below this mass the share is not measured to 7 % and draws are rejected for ever [-]."""


@final
class Terms(NamedTuple):
    """Positions of the parameters of an element, by term."""

    times: list[int]
    orders: list[int]

    @property
    def every(self) -> list[int]:
        """All of them, in table order."""
        return sorted(self.times + self.orders)


@final
@dataclass(frozen=True, eq=False)
class ParameterTable:
    """All parameters of a posterior; arrays of values have one column per row of the table."""

    layout: Layout
    rows: tuple[Parameter, ...]
    resolution: float = 0.0
    """Shortest time constant of a term of order above 1 under default priors [time unit]."""
    effects: Declared | None = None
    """Effects whose parameters are among the rows, over no record; None without any."""

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names, in table order."""
        return tuple(row.name for row in self.rows)

    @property
    def without_effects(self) -> ParameterTable:
        """The plant's and the noise's parameters alone."""
        rows = tuple(row for row in self.rows if row.kind not in (*COEFFICIENTS, *CONSTANTS))
        return replace(self, rows=rows, effects=None)

    def of_kind(self, kind: str) -> list[int]:
        """Positions of the parameters of a kind."""
        return [k for k, row in enumerate(self.rows) if row.kind == kind]

    def at(self, kind: str, first: int, second: int = 0) -> int:
        """Position of the parameter of a kind at a place."""
        return self._positions[kind, first, second]

    @cached_property
    def _positions(self) -> dict[tuple[str, int, int], int]:
        return {(row.kind, *row.place): k for k, row in enumerate(self.rows)}

    @cached_property
    def terms(self) -> tuple[Terms, ...]:
        """Positions of the terms of each element."""
        return tuple(
            Terms(*([self.at(kind, e, k) for k in range(slot.terms)] for kind in ("time", "order")))
            for e, slot in enumerate(self.layout.elements)
        )

    def acting_on(self, k: int) -> tuple[int, ...]:
        """Response axes that the parameter of row `k` acts on; several where paths share it."""
        row, layout = self.rows[k], self.layout
        slots = {"time": layout.element_of, "order": layout.element_of, "delay": layout.delay_of}
        if row.kind not in slots:
            return (row.response,)
        return tuple(axis for axis, own in enumerate(slots[row.kind]) if row.place.first in own)

    def shaping(self, unit: int) -> list[int]:
        """Positions of what shapes a unit response, in the order of its slopes (`ForwardModel.unit_slopes`):
        times and orders of its element, and its delay."""
        element, delay, _ = self.layout.units[unit]
        times, orders = self.terms[element]
        return [*times, *orders, self.at("delay", delay)]

    @cached_property
    def exchangeable(self) -> tuple[bool, ...]:
        """Per element: whether its terms have equal priors, so that they are sampled in any order."""
        out = []
        for times, orders in self.terms:
            priors = [(self.rows[t].prior, self.rows[o].prior) for t, o in zip(times, orders, strict=True)]
            free = all(t is not None and o is not None for t, o in priors)
            alike = all(str(pair) == str(priors[0]) and pair == priors[0] for pair in priors)
            out.append(len(priors) > 1 and free and alike)
        return tuple(out)

    @cached_property
    def log_support(self) -> float:
        """Log of 1 / (prior mass where orders decrease and terms are resolved), summed over elements."""
        total = 0.0
        for (times, orders), exchangeable in zip(self.terms, self.exchangeable, strict=True):
            if exchangeable or sum(self.rows[k].free for k in orders) <= (len(orders) == 1):
                masses = [self._resolved_mass(t, o) for t, o in zip(times, orders, strict=True)]
                total += (lgamma(len(orders) + 1) if exchangeable else 0.0) - sum(map(log, masses))
            else:
                total -= log(self._supported_share(times, orders))
        return total

    def _limited(self, time: int, order: int) -> bool:
        """Whether a term must be resolved: its priors are the default ones."""
        rows = self.rows[time], self.rows[order]
        return self.resolution > 0 and rows[0].free and all(row.default for row in rows)

    @cached_property
    def limited(self) -> tuple[tuple[int, int], ...]:
        """Positions of time and order of every term that must be resolved."""
        pairs = (pair for times, orders in self.terms for pair in zip(times, orders, strict=True))
        return tuple((t, o) for t, o in pairs if self._limited(t, o))

    def _resolved_mass(self, time: int, order: int) -> float:
        """Prior mass of a term where it is resolved."""
        if not self._limited(time, order):
            return 1.0
        row = self.rows[order]
        fast = self.rows[time].mass_below(self.resolution)
        return 1.0 - fast * (1.0 - row.mass_below(1.0) if row.free else float(row.value > 1.0))

    def _resolved(self, values: Matrix) -> Flags:
        """Whether every term that must be is resolved, (batch,)."""
        out = np.ones(values.shape[0], dtype=bool)
        for t, o in self.limited:
            out &= (values[:, o] <= 1.0) | (values[:, t] >= self.resolution)
        return out

    @cached_property
    def log_permutations(self) -> float:
        """Log of the number of term orders in which the same plant is sampled."""
        terms = (slot.terms for slot in self.layout.elements)
        return sum(lgamma(n + 1) for n, same in zip(terms, self.exchangeable, strict=True) if same)

    def _supported_share(self, times: list[int], orders: list[int]) -> float:
        rng = np.random.default_rng(0)
        drawn = {k: self.rows[k].draw(_ORDERED_DRAWS, rng) for k in (*orders, *times)}
        decreasing = np.all(np.diff([drawn[k] for k in orders], axis=0) <= 0, axis=0)
        for t, o in zip(times, orders, strict=True):
            if self._limited(t, o):
                decreasing &= (drawn[o] <= 1.0) | (drawn[t] >= self.resolution)
        share = float(np.mean(decreasing))
        if share < _LEAST_ORDERED:
            names = ", ".join(self.rows[k].name for k in orders)
            raise InputError(
                f"[priors] {names}: the priors have almost no mass where the orders decrease "
                f"({' > '.join(self.rows[k].name for k in orders)}); let them overlap or swap them"
            )
        return share

    def canonical(self, values: Matrix) -> Matrix:
        """The same plants with the terms of exchangeable elements by decreasing order."""
        return self.sorted_with_source(values)[0] if any(self.exchangeable) else values

    def sorted_with_source(self, values: Matrix, *, every: bool = False) -> tuple[Matrix, Index]:
        """Canonical values and where each given one went: ``canonical[b, source[b, k]] = values[b, k]``.

        With `every`, also where priors tell the terms apart; to the plant terms are always exchangeable.
        """
        out = values.copy()
        source = np.tile(np.arange(len(self.rows)), (values.shape[0], 1))
        for (times, orders), exchangeable in zip(self.terms, self.exchangeable, strict=True):
            if not (exchangeable or every):
                continue
            own = values[:, orders]
            if (own[:, 1:] <= own[:, :-1]).all():
                continue  # sorted already, as most are
            rank = np.argsort(-own, axis=1, kind="stable")
            back = np.argsort(rank, axis=1)
            for columns in (times, orders):
                out[:, columns] = np.take_along_axis(values[:, columns], rank, axis=1)
                source[:, columns] = np.array(columns)[back]
        return out, source

    def dynamics(self, values: Matrix) -> Dynamics:
        """What the forward model needs, from canonical values (batch, rows)."""
        delays = [self.at("delay", k) for k in range(len(self.layout.delays))]
        return Dynamics(
            tuple(values[:, times] for times, _ in self.terms),
            tuple(values[:, orders] for _, orders in self.terms),
            values[:, delays],
        )

    def gains(self, values: Matrix) -> Array:
        """Gains, (batch, responses, drives) [response unit per drive unit]."""
        shape = (len(self.layout.responses), len(self.layout.drives))
        return values[:, self.of_kind("gain")].reshape(-1, *shape)

    def paths(self, values: Vector) -> tuple[tuple[TransferPath, ...], ...]:
        """Paths of the linear plant at canonical values (rows,), ``[response][drive]``, of stiffness 1."""
        dynamics, gains, layout = self.dynamics(values[None]), self.gains(values[None])[0], self.layout
        shapes = [
            (times[0].tolist(), orders[0].tolist())
            for times, orders in zip(dynamics.times, dynamics.orders, strict=True)
        ]
        return tuple(
            tuple(
                TransferPath.of_times(
                    float(gains[i, j]), float(dynamics.delays[0, layout.delay_of[i][j]]), *shapes[element]
                )
                for j, element in enumerate(row)
            )
            for i, row in enumerate(layout.element_of)
        )

    def offsets(self, response: int) -> Mapping[int, int]:
        """Positions of the offsets of a response axis by fit record; -1 is that of all records."""
        return self._offsets[response]

    @cached_property
    def _offsets(self) -> list[dict[int, int]]:
        rows = [(k, self.rows[k].place) for k in self.of_kind("offset")]
        return [
            {place.second: k for k, place in rows if place.first == i}
            for i in range(len(self.layout.responses))
        ]

    def offset(self, values: Matrix, response: int, record: int) -> Vector:
        """Offset of a response axis on a fit record, (batch,) [response unit]; 0 when the model has none."""
        known = self.offsets(response)
        place = known.get(-1, known.get(record))
        return np.zeros(values.shape[0]) if place is None else values[:, place]

    def supported(self, values: Matrix) -> Flags:
        """Whether the orders of every element decrease and its terms are resolved, (batch,)."""
        out = self._resolved(values)
        for _, orders in self.terms:
            out &= np.all(np.diff(values[:, orders], axis=1) <= 0, axis=1)
        return out

    def draw(self, size: int, rng: np.random.Generator) -> Matrix:
        """Canonical values from the prior, (size, rows)."""
        out = np.empty((0, len(self.rows)))
        while out.shape[0] < size:
            values = np.stack([row.draw(size, rng) for row in self.rows], axis=1)
            values = self.canonical(values)
            out = np.concatenate([out, values[self.supported(values)]])
        return out[:size]


def parameter_table(
    layout: Layout,
    scales: Scales,
    records: Sequence[str],
    *,
    time_unit: str,
    model: ModelSettings,
    noise: str,
    priors: Mapping[str, PriorSettings],
    effects: Declared | None = None,
    effect_rows: Sequence[Parameter] = (),
    noise_effect: str = "",
    problems: Sequence[str] = (),
) -> ParameterTable:
    """Table of a study; InputError when a prior names no parameter or has no mass in its domain.

    `effect_rows` are the parameters of its `effects`, `noise_effect` the name of an effect that gives the
    noise its shape; `problems` found before join those found here.
    """
    rows: list[Parameter] = []

    def add(kind: str, place: tuple[int, int], suffix: str, unit: str, prior: Prior) -> None:
        name = f"{kind}_{suffix}" if suffix else kind
        rows.append(Parameter(name, unit, kind, Place(*place), prior))

    for i, response in enumerate(layout.responses):
        for j, drive in enumerate(layout.drives):
            unit = per(response.unit, drive.unit)
            add("gain", (i, j), layout.path_name(i, j), unit, scales.gain(i, j))
    for e, slot in enumerate(layout.elements):
        for k in range(slot.terms):
            suffix = f"{k + 1}_{slot.name}" if slot.name else f"{k + 1}"
            add("time", (e, k), suffix, time_unit, scales.time())
            add("order", (e, k), suffix, "-", scales.order())
    for d, name in enumerate(layout.delays):
        add("delay", (d, 0), name, time_unit, scales.delay())
    for i, response in enumerate(layout.responses):
        axis = layout.response_name(i)
        if model.offset == "record":
            for r, record in enumerate(records):
                suffix = "_".join(filter(None, (axis, record if len(records) > 1 else "")))
                add("offset", (i, r), suffix, response.unit, scales.offset(i))
        elif model.offset == "shared":
            add("offset", (i, -1), axis, response.unit, scales.offset(i))
    for i, response in enumerate(layout.responses):
        for name, prior in NOISES[noise].priors(scales, i).items():
            unit = response.unit if KINDS[name].noise == "scale" else "-"
            add(name, (i, 0), layout.response_name(i), unit, prior)
            if noise_effect and KINDS[name].noise == "shape":
                rows[-1] = replace(rows[-1], name=f"{noise_effect}.{rows[-1].name}")
    rows += effect_rows
    names = [row.name for row in rows]
    if len(set(names)) < len(names):
        twice = ", ".join(sorted({name for name in names if names.count(name) > 1}))
        raise InputError(f"{twice}: axes and records together name two parameters alike; rename a record")
    rows = _fix_orders(rows, layout, model)
    return ParameterTable(layout, tuple(_with_priors(rows, priors, problems)), scales.resolution, effects)


def _fix_orders(rows: list[Parameter], layout: Layout, model: ModelSettings) -> list[Parameter]:
    """Orders given by the study are fixed."""
    if model.orders == "free":
        return rows
    if any(slot.terms != len(model.orders) for slot in layout.elements):
        raise InputError(
            f"[model] orders = {list(model.orders)} gives {len(model.orders)} order(s), but the elements "
            f"have {', '.join(str(slot.terms) for slot in layout.elements)} term(s); give one order per term"
        )
    return [
        replace(row, prior=None, value=float(model.orders[row.place.second])) if row.kind == "order" else row
        for row in rows
    ]


def _with_priors(
    rows: list[Parameter], priors: Mapping[str, PriorSettings], before: Sequence[str]
) -> list[Parameter]:
    """The study's priors and fixed values in place of the defaults.

    A coefficient that every record has may be given a prior for all of them, by its name without the record.
    """
    stems = {row.name: row.name.partition("[")[0] for row in rows if row.kind in COEFFICIENTS}
    names = {row.name for row in rows} | set(stems.values())
    problems = [
        *before,
        *(
            f"[priors] {key}: this model has no such parameter{nearest(key, names)}"
            for key in priors
            if key not in names
        ),
    ]
    out = []
    for row in rows:
        setting = priors.get(row.name, priors.get(stems.get(row.name, row.name)))
        if setting is None:
            out.append(row)
            continue
        prior = None if setting.dist is None else Prior(setting.dist, setting.parameters)
        value = np.nan if setting.fixed is None else setting.fixed
        out.append(replace(row, prior=prior, value=value, default=False))
        problems += out[-1].problems
    refuse_if(problems)
    return out
