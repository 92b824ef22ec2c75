"""Responses of every path to a unit step, on blocks that resolve them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.sampling.draws import Draws

_POINTS = 1000
"""Samples of the step response."""
_DRAWS = 1000
"""Draws behind the metrics."""
_EFFECT_DRAWS = 250
"""The same with effects, which take a simulation each."""
_AWAY = 1e6
"""A response without bounds, over its steady value [-]."""
_STATIC, _CALM = 1e-60, 0.5
"""Time constant [time unit] and order [-] of a plant that follows at once: on blocks much wider than its time
constant the response of an order above 1 alternates and grows."""
_RESOLVED, _RINGING = 1.0, 0.1
"""Width of blocks over the longest time constant of an element of an order just above 1, and of order 2 [-]:
on much wider ones the response alternates and grows."""
_MOST, _ACTED, _CELLS = 1 << 16, 1 << 14, 1 << 20
"""Blocks of a step response at most, with effects too, and of all draws with these that are simulated at once
[-]."""
_SETTLED_SPANS = 200.0
"""Time after which what effects add has settled, in spans of the record [-]."""


@final
@dataclass(frozen=True, eq=False)
class StepCurves:
    """Responses of every path to a unit step at time 0, over the longest record."""

    time: Vector
    """(n,) [time unit]."""
    normalised: Array
    """Response over its steady value, (curves, draws, n) [-]; steady is 1 by construction."""
    gains: Array
    """Steady response per unit step, (draws, responses, drives) [response unit / drive unit]."""
    delays: Matrix
    """(draws, delay slots) [time unit]."""
    curve_of: tuple[tuple[int, ...], ...]
    """Curve of each path, [response][drive]."""
    values: Matrix
    """Table values of the draws, (draws, rows)."""


def step_curves(draws: Draws, span: float) -> StepCurves:
    """Unit step responses of posterior draws over `span` [time unit].

    With effects the step is as high as the largest drive of the records, and the response is divided by it;
    draws without a bounded response are left out.
    """
    count = _DRAWS if draws.table.effects is None else _EFFECT_DRAWS
    return curves_of(draws.table, draws.thinned(count), span)


def step_times(span: float) -> Vector:
    """Times of a step response over `span` [time unit], (n,)."""
    return span * np.arange(1, _POINTS + 1) / _POINTS


def curves_of(table: ParameterTable, values: Matrix, span: float) -> StepCurves:
    """`step_curves` at table values (draws, rows)."""
    time = step_times(span)
    if table.effects is not None:
        return _with_effects(table, values, time)
    units, delays = _unit_steps(table, values, time), table.dynamics(values).delays
    return StepCurves(time, units, table.gains(values), delays, table.layout.unit_of, values)


def _with_effects(table: ParameterTable, values: Matrix, time: Vector) -> StepCurves:
    """Curves of every path by simulation, over the static response of the plant with its effects."""
    moved = _effect_steps(table, values, time)
    still = values.copy()
    still[:, table.of_kind("time")] = _STATIC
    still[:, table.of_kind("order")] = _CALM
    still[:, table.of_kind("delay")] = 0.0
    level = _effect_steps(table, still, time[-1] * np.linspace(0.5, 1.0, 16) * _SETTLED_SPANS)[..., -1]
    kept = np.isfinite(moved).all(axis=(0, 2)) & np.isfinite(level).all(axis=0)
    values, moved, level = values[kept], moved[:, kept], level[:, kept]
    shape = (len(table.layout.responses), len(table.layout.drives))
    whole = np.where(level == 0.0, 1.0, level)[..., None]
    normalised = np.where(level[..., None] == 0.0, 1.0, moved / whole)
    paths = tuple(tuple(i * shape[1] + j for j in range(shape[1])) for i in range(shape[0]))
    gains = level.T.reshape(-1, *shape)
    return StepCurves(time, normalised, gains, table.dynamics(values).delays, paths, values)


def _effect_steps(table: ParameterTable, values: Matrix, time: Vector) -> Array:
    """Responses to a step of each drive at time 0 over its height, (paths, draws, n) [response unit / drive
    unit]; NaN where there is no bounded one."""
    effects = table.effects
    assert effects is not None
    widest = max(float(_resolved(table.dynamics(values)).min()), float(time[-1]) / _ACTED)
    heights, experiments, mesh = effects.ranges.drive, [], Mesh.of_samples(time, 0.0, widest=widest)
    for j, height in enumerate(heights):
        step = AxisDrive(np.zeros(1), np.array([float(height)]))
        drives = tuple(step if j == k else AxisDrive(np.empty(0), np.empty(0)) for k in range(heights.size))
        experiments.append(Experiment("step", mesh, drives, np.zeros(heights.size)))
    count = len(experiments)
    over = replace(effects, epochs=np.zeros(count), times=(time,) * count, fitted=(None,) * count)
    model = ForwardModel(table.layout, tuple(experiments), over)
    simulation, size = Simulation(table, model), max(1, _CELLS // mesh.grid.n)
    parts = [simulation.responses(values[at : at + size]) for at in range(0, len(values), size)]
    read = [np.concatenate(each, axis=1) for each in zip(*parts, strict=True)]
    by_drive = [one / height for one, height in zip(read, heights, strict=True)]
    return np.concatenate(list(np.stack(by_drive, axis=1)))


def _unit_steps(table: ParameterTable, values: Matrix, time: Vector) -> Array:
    """Responses to a unit step at time 0 over their steady values, (units, draws, n) [-].

    After so many blocks that resolve its fastest term a response is read without terms of an order above 1,
    which have long ended; draws of about as fast ones together.
    """
    dynamics = table.dynamics(values)
    widths, out = _resolved(dynamics), np.empty((len(table.layout.units), len(values), time.size))
    decades = np.floor(np.log10(np.minimum(widths * _MOST / time[-1], 1.0)))
    for decade in np.unique(decades):
        rows = np.flatnonzero(decades == decade)
        rows = rows[np.argsort(widths[rows], kind="stable")]
        for some in np.array_split(rows, max(1, rows.size // 64)):
            part, widest = dynamics[some], float(widths[some].min())
            begin = int(np.searchsorted(time, _MOST * widest))
            if begin:
                out[:, some, :begin] = _stepped(table.layout, part, time[:begin], widest)
            if begin < time.size:
                late = _without_fast_terms(part)
                out[:, some, begin:] = _stepped(table.layout, late, time[begin:], np.inf)
    return out


def _stepped(layout: Layout, dynamics: Dynamics, time: Vector, widest: float) -> Array:
    """The same at some of the times, on blocks of a width at most."""
    step = AxisDrive(np.zeros(1), np.ones(1))
    mesh, rest = Mesh.of_samples(time, 0.0, widest=widest), np.zeros(len(layout.drives))
    experiment = Experiment("step", mesh, tuple(step for _ in layout.drives), rest)
    return ForwardModel(layout, (experiment,)).unit_responses(dynamics)[0]


def _resolved(dynamics: Dynamics) -> Vector:
    """Width of blocks that resolve every element of an order above 1 of each plant, (batch,) [time unit];
    infinite without any."""
    widest = np.full(dynamics.batch, np.inf)
    for times, orders in zip(dynamics.times, dynamics.orders, strict=True):
        top = orders.max(axis=1)
        share = np.where(top > 1.0, _RESOLVED + (_RINGING - _RESOLVED) * (top - 1.0), np.inf)
        widest = np.minimum(widest, share * times.max(axis=1))
    return widest


def _without_fast_terms(dynamics: Dynamics) -> Dynamics:
    """Elements without their terms of an order above 1."""
    pairs = list(zip(dynamics.times, dynamics.orders, strict=True))
    times = tuple(np.where(orders > 1.0, _STATIC, own) for own, orders in pairs)
    return Dynamics(times, tuple(np.minimum(orders, 1.0) for _, orders in pairs), dynamics.delays)


def curves_at(table: ParameterTable, curves: StepCurves, time: Vector) -> Array:
    """The curves at other times, (curves, draws, n) [-]; far away where there is no bounded response."""
    if table.effects is None:
        return _unit_steps(table, curves.values, time)
    level = np.concatenate([curves.gains[:, i].T for i in range(curves.gains.shape[1])])[..., None]
    moved = _effect_steps(table, curves.values, time)
    moved = np.where(level == 0.0, 1.0, moved / np.where(level == 0.0, 1.0, level))
    return np.where(np.isfinite(moved), moved, _AWAY)
