"""Effects that a study declares: their kinds, their scales from the fit records, and their parameters.

An effect's formula counts deflections in the largest one and drives in the largest one. Both come from the
fit records, not from a fit, so that a coefficient has a meaning before anything is fitted; a study may state
them. Default priors: normal(0, scale) of a coefficient, half-normal of one that is never negative, with the
scale the effect gives it; of an internal constant log-uniform, or uniform over less than a factor of 4, from
end to end of what the loop tries.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.requirements import unmet
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.effects.declared import Declared
from lcopa_bayes.model.effects.effect import (
    Coefficient,
    Constant,
    Effect,
    Ranges,
    ScatterEffect,
    devices_of,
)
from lcopa_bayes.model.effects.scales import own_drives
from lcopa_bayes.model.layout import Layout

_REACHED = 0.995
"""Quantile of the deflections of a record that counts as its largest [-]: a few outliers are none."""
_DECADES = 4.0
"""Largest over smallest value of a constant from which its default prior is even in its logarithm [-]."""


def used_kinds(study: Study, layout: Layout) -> tuple[tuple[type[Effect], ...], list[str]]:
    """Kinds of the effects that a study uses, in its order, and what is wrong with the others."""
    known = catalogue(study.effects.add, study.folder) if study.effects.use or study.effects.add else {}
    kinds, problems = [], []
    for name in dict.fromkeys(study.effects.use):
        count = study.effects.use.count(name)
        if count > 1:
            problems.append(f"[effects] use: {name!r} is listed {count} times; list it once")
        kind = known.get(name)
        if kind is None:
            problems.append(f"[effects] use: no effect is named {name!r}{nearest(name, known)}")
        elif not kind.applies(layout):
            problems.append(
                f"[effects] use: {name!r} has no place in a plant of {_counted(len(layout.drives), 'drive')} "
                f"and {_counted(len(layout.responses), 'response')}"
            )
        else:
            kinds.append(kind)
    scatter = [kind for kind in kinds if issubclass(kind, ScatterEffect)]
    for kind in scatter:
        if kind.noise == study.noise.kind:
            problems.append(
                f"[effects] use: {kind.card.name!r} is the noise of [noise] kind = {study.noise.kind!r} "
                "already; leave one of them out"
            )
    if len(scatter) > 1:
        each = ", ".join(kind.card.name for kind in scatter)
        problems.append(f"[effects] use: {each} each replace the noise; use one of them")
    names = [axis.name for axis in layout.responses]
    problems += [
        f"[effects] deflection: no response axis is named {axis!r}{nearest(axis, names)}"
        for axis in study.effects.deflection
        if axis not in names
    ]
    return tuple(kinds), problems


def obstacles(study: Study) -> list[str]:
    """What keeps a fit of a study's records from meaning anything (`requirements`), given its effects: one
    that goes on at rest describes a response that drifts where no drive moves."""
    known = catalogue(study.effects.add, study.folder) if study.effects.use else {}
    return unmet(
        study, described=any(known[name].card.resting for name in study.effects.use if name in known)
    )


def _counted(count: int, what: str) -> str:
    return f"{count} {what}{'s' if count != 1 else ''}"


def noise_of(kinds: Sequence[type[Effect]], stated: str) -> str:
    """Noise model of a study: that of an effect that replaces it, else the one it states."""
    return next((kind.noise for kind in kinds if issubclass(kind, ScatterEffect)), stated)


def campaign_places(study: Study) -> dict[str, float]:
    """Place of every record in the campaign by its name, -1/2 to 1/2 [-]: records, fitted or held out, count
    as taken in the order of their names, numbers by value."""
    names = sorted((one.name for one in (*study.fit, *study.held_out)), key=_natural)
    places = np.linspace(-0.5, 0.5, len(names)) if len(names) > 1 else np.zeros(1)
    return dict(zip(names, places.tolist(), strict=True))


def _natural(name: str) -> list[tuple[int, str]]:
    """Digits by value: run2 before run10."""
    return [(int(part), "") if part.isdigit() else (0, part) for part in re.split(r"(\d+)", name)]


def record_ranges(study: Study, layout: Layout, scales: Scales) -> Ranges:
    """Scales of effects from the fit records and what the study states of them.

    Deflections count from the level at rest, in proportion to the largest drive of the unit: responses to a
    resting drive and to a smaller one are taken for as large a part of it. A drive or a response that never
    moves has scale 1 in its unit.
    """
    direct = own_drives(layout)
    largest = np.max([np.abs(record.drive).max(axis=0) for record in study.fit], axis=0)
    units = [axis.unit for axis in layout.drives]
    drive = np.array([max(v for v, u in zip(largest, units, strict=True) if u == unit) for unit in units])
    drive = np.where(drive > 0, drive, 1.0)
    samples = [Samples.of(record, scales.period) for record in study.fit]
    response = np.zeros(len(layout.responses))
    for i, axis in enumerate(layout.responses):
        own = largest[direct[i]]
        moved = scales.excursion[direct[i]]
        deflected = max(_deflection(one, i) for one in samples)
        reach = drive[direct[i]] / own * max(own / moved, 1.0) if own > 0 else 1.0
        response[i] = study.effects.deflection.get(axis.name, deflected * reach)
    speeds = [speed for one in samples for i in range(response.size) if (speed := _speed(one, i)) > 0]
    speed = study.effects.speed or min(speeds, default=scales.span)
    return Ranges(
        drive=drive,
        response=np.where(response > 0, response, 1.0),
        period=scales.period,
        span=scales.span,
        speed=float(speed),
        direct=direct,
        names=tuple(axis.name for axis in layout.responses),
        devices=devices_of([axis.unit for axis in layout.responses]),
    )


def _level(one: Samples, axis: int) -> float:
    """Response of a record at rest: mean before any drive has changed, else the first sample."""
    quiet = one.quiet(axis).values
    return float(quiet.mean() if quiet.size else one.axes[axis].values[0])


def _deflection(one: Samples, axis: int) -> float:
    """Largest deflection of a record from its level at rest [response unit]; 0 without samples."""
    values = one.axes[axis].values
    return float(np.quantile(np.abs(values - _level(one, axis)), _REACHED)) if values.size else 0.0


def _speed(one: Samples, axis: int) -> float:
    """Time from the first change to half of a record's largest deflection [time unit]; 0 without any."""
    size = _deflection(one, axis)
    observed = one.axes[axis]
    if not (size > 0 and np.isfinite(one.first_change)):
        return 0.0
    half = np.abs(observed.values - _level(one, axis)) >= 0.5 * size
    after = half & (one.times[observed.index] > one.first_change)
    at = one.times[observed.index][after]
    return float(at[0] - one.first_change) if at.size else 0.0


def declared(
    study: Study, kinds: Sequence[type[Effect]], ranges: Ranges, records: Sequence[Record]
) -> Declared | None:
    """Effects of a study over some records; None for a study without."""
    acting = tuple(kind for kind in kinds if not issubclass(kind, ScatterEffect))
    if not acting:
        return None
    places = campaign_places(study)
    fitted = [one.name for one in study.fit]
    return Declared(
        acting,
        ranges,
        np.array([places.get(record.name, 0.0) for record in records]),
        tuple(record.sampled for record in records),
        tuple(fitted.index(record.name) if record.name in fitted else None for record in records),
    )


def effect_rows(
    kinds: Sequence[type[Effect]], ranges: Ranges, records: Sequence[str], layout: Layout, time_unit: str
) -> list[Parameter]:
    """Parameters of effects: the coefficients of each, those of one record by record, then its constants."""
    units = {"time": time_unit, "1/time": f"1/{time_unit}"}
    rows: list[Parameter] = []
    acting = [kind for kind in kinds if not issubclass(kind, ScatterEffect)]
    adding = not Declared(tuple(acting), ranges, np.zeros(0), (), ()).read_out
    for e, kind in enumerate(acting):
        constants = kind.internal(ranges)
        instance = kind.with_constants(constants, [one.low for one in constants])
        coefficients = instance.coefficients(ranges)
        repeats = [f"[{name}]" for name in records] if kind.card.per_record and len(records) > 1 else [""]
        for r, suffix in enumerate(repeats):
            for k, one in enumerate(coefficients):
                unit = units.get(one.unit, one.unit)
                if unit == "response":
                    unit = layout.responses[one.axis or 0].unit
                rows.append(
                    Parameter(
                        f"{kind.card.name}.{one.name}{suffix}",
                        unit,
                        "magnitude" if one.one_signed else "coefficient",
                        Place(e, r * len(coefficients) + k),
                        coefficient_prior(one),
                        adds_to=one.axis if adding and kind.additive else None,
                    )
                )
        for k, constant in enumerate(constants):
            prior = constant_prior(constant)
            unit = units.get(constant.unit, constant.unit)
            name = f"{kind.card.name}.{constant.name}"
            value = np.nan if prior else constant.low
            rows.append(Parameter(name, unit, constant.kind, Place(e, k), prior, value))
    return rows


def with_effects(
    posterior: Posterior,
    effects: Sequence[Effect],
    ranges: Ranges,
    epochs: Vector,
    *,
    free: Collection[str] = (),
    wider: Mapping[str, float] = MappingProxyType({}),
) -> Posterior:
    """The posterior of a plant with effects beside it, of these scales and default priors; `epochs` [-] are
    the places of the fit records in the campaign.

    Internal constants are held at those of each effect, but for those in `free`, ``<effect>.<constant>``;
    `wider` multiplies the prior scale of the coefficients of an effect [-].
    """
    kinds = tuple(type(effect) for effect in effects)
    names = [one.record.name for one in posterior.samples]
    unit, layout = posterior.samples[0].record.time_unit, posterior.table.layout
    rows = []
    for row in effect_rows(kinds, ranges, names, layout, unit):
        if row.kind in CONSTANTS and not (row.name in free and row.free):
            value = effects[row.place.first].constants[row.name.partition(".")[2]]
            row = replace(row, prior=None, value=float(value))
        elif row.kind in COEFFICIENTS and row.prior is not None:
            scale = row.prior.parameters["scale"] * wider.get(effects[row.place.first].name, 1.0)
            row = replace(row, prior=Prior(row.prior.dist, {"loc": 0.0, "scale": scale}))
        rows.append(row)
    times, fitted = tuple(one.times for one in posterior.samples), tuple(range(len(names)))
    table = replace(
        posterior.table,
        rows=(*posterior.table.rows, *rows),
        effects=Declared(kinds, ranges, np.zeros(0), (), ()),
    )
    model = replace(posterior.model, effects=Declared(kinds, ranges, epochs, times, fitted))
    return replace(posterior, table=table, model=model, surrogate=None)


def coefficient_prior(one: Coefficient) -> Prior:
    """Default prior of a coefficient."""
    if one.one_signed:
        return Prior("halfnorm", {"loc": 0.0, "scale": one.scale})
    return Prior("norm", {"loc": 0.0, "scale": one.scale})


def constant_prior(one: Constant) -> Prior | None:
    """Default prior of an internal constant; None where it is fixed."""
    if one.high <= one.low:
        return None
    if one.low > 0 and one.high / one.low >= _DECADES:
        return Prior("loguniform", {"a": one.low, "b": one.high})
    return Prior("uniform", {"loc": one.low, "scale": one.high - one.low})


def unused(key: str, study: Study) -> str | None:
    """What is wrong with a prior of an effect that the study does not use; None for any other name."""
    name = key.partition(".")[0]
    if "." not in key or name in study.effects.use:
        return None
    try:
        known = catalogue(study.effects.add, study.folder)
    except InputError:  # reported where the effects are
        return None
    if name not in known:
        return None
    return f"[priors] {key}: the effect {name!r} is not used; add it to [effects] use or leave this prior out"
