"""Derivatives of responses with effects in every row of the table, coefficients and constants included."""

from __future__ import annotations

from dataclasses import replace

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.inference.effects import Effected
from lcopa_bayes.inference.simulation import Simulation
from lcopa_bayes.model.effects.effect import Effect

_STEP = 1e-4
"""Step of a constant, over its value or, where it lies between 0 and 1, over 1 [-]."""


def effect_slopes(simulation: Simulation, values: Vector, *, exact: bool = True) -> list[Array]:
    """Per record (samples, axes, rows), in the table's units, at canonical values (rows,).

    Coefficients by differences through the simulator (`model.effects.jacobian`), constants by central ones
    over 1e-4. The plant's rows as there; unless `exact` those of the plant alone, fifty times cheaper and
    good enough to descend with. Raises UnstableError where there is no bounded response.
    """
    model, psi = _effected(simulation, values), simulation.psi(values)
    plant = model if exact else model.with_effects(())
    out = plant.jacobian(values, psi if exact else plant.vanishing)
    rows = [k for each in simulation.coefficients for k in each]
    if rows:
        for whole, slope in zip(out, model.signature(values, psi), strict=True):
            whole[..., rows] = slope
    for e, constants in enumerate(simulation.constants):
        for position, k in enumerate(constants):
            if simulation.table.rows[k].free:
                for whole, slope in zip(out, _by_constant(model, values, psi, (e, position, k)), strict=True):
                    whole[..., k] = slope
    return out


def _effected(simulation: Simulation, values: Vector) -> Effected:
    declared = simulation.declared
    names = tuple(one.name for one in simulation.model.experiments)
    offsets = tuple(-2 if place is None else place for place in declared.fitted)
    return Effected(simulation.table, simulation.simulator(simulation.effects(values)), names, offsets)


def _by_constant(model: Effected, values: Vector, psi: Vector, at: tuple[int, int, int]) -> list[Matrix]:
    """Derivative in one internal constant: effect, its position there, row of the table."""
    effect, position, k = at
    row = model.table.rows[k]
    step = _STEP * (1.0 if row.kind == "fraction" else float(values[k]))
    ends = [values[k] - step, values[k] + step]
    if row.kind == "fraction":
        ends = [max(ends[0], 0.0), min(ends[1], 1.0)]
    sides = [_responses(model, values, psi, _moved(model, effect, position, end)) for end in ends]
    return [(b - a) / (ends[1] - ends[0]) for a, b in zip(*sides, strict=True)]


def _moved(model: Effected, effect: int, position: int, value: float) -> tuple[Effect, ...]:
    """The effects with one constant of one of them at another value."""
    effects = list(model.effects)
    name = list(effects[effect].constants)[position]
    effects[effect] = replace(effects[effect], **{name: value})
    return tuple(effects)


def _responses(model: Effected, values: Vector, psi: Vector, effects: tuple[Effect, ...]) -> list[Matrix]:
    return model.with_effects(effects).responses(values, psi)
