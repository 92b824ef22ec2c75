"""Studies: records to fit, records held out, and everything a study file says about them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import final

import numpy as np

from lcopa_bayes.core.checks import rebuilt
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.candidatesettings import CandidateSettings, CompareSettings
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import (
    STAGES,
    EffectsSettings,
    ModelSettings,
    NoiseSettings,
    PriorSettings,
    SamplerSettings,
)

DEFAULT_STAGES: Mapping[str, Mapping[str, object]] = MappingProxyType(
    {name: MappingProxyType({}) for name in STAGES if name != "claims"}  # claims concern one paper
)


@final
@dataclass(frozen=True, eq=False)
class Study:
    """Records and settings of one study; every record has the axes of the first, in its order.

    Raises InputError with every problem unless the records have distinct names, one time unit and the
    same axes, and those to fit can tell something about the dynamics: a drive changes before a sample.
    """

    name: str
    folder: Path | None
    """Where the study file is; None when the study was made from record files alone."""
    time_unit: str
    """Unit of every time in the records, priors and results."""
    seed: int
    fit: tuple[Record, ...]
    held_out: tuple[Record, ...] = ()
    model: ModelSettings = field(default_factory=ModelSettings)
    priors: Mapping[str, PriorSettings] = field(default_factory=dict)
    """By parameter name."""
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    sampler: SamplerSettings = field(default_factory=SamplerSettings)
    stages: Mapping[str, Mapping[str, object]] = field(default_factory=lambda: DEFAULT_STAGES)
    """Settings of every stage to run, by name."""
    inputs: Mapping[str, str] = field(default_factory=dict)
    """SHA-256 of each input file, by file name."""
    compare: CompareSettings = field(default_factory=CompareSettings)
    candidates: tuple[CandidateSettings, ...] = ()
    """Models to compare besides those any study has."""
    effects: EffectsSettings = field(default_factory=EffectsSettings)

    def __post_init__(self) -> None:
        records = (*self.fit, *self.held_out)
        problems = together(self.fit, self.held_out)
        problems += [
            f"record {r.name!r} is in {r.time_unit}" for r in records if r.time_unit != self.time_unit
        ]
        if problems or not self.fit:
            raise InputError(problems or ["a study needs one or more records to fit"])
        for key in ("fit", "held_out"):
            object.__setattr__(self, key, tuple(_in_order(r, self.fit[0]) for r in getattr(self, key)))
        locked = {name: MappingProxyType(dict(settings)) for name, settings in self.stages.items()}
        for key, mapping in (("priors", self.priors), ("stages", locked), ("inputs", self.inputs)):
            object.__setattr__(self, key, MappingProxyType(dict(mapping)))

    @property
    def drive_axes(self) -> tuple[Axis, ...]:
        """Axes of the drive of every record."""
        return self.fit[0].drive_axes

    @property
    def response_axes(self) -> tuple[Axis, ...]:
        """Axes of the response of every record."""
        return self.fit[0].response_axes

    def with_seed(self, seed: int) -> Study:
        """The same study with another seed."""
        return replace(self, seed=seed)

    __reduce__ = rebuilt


def _axes(record: Record, role: str) -> dict[str, Axis]:
    return {axis.name: axis for axis in (record.drive_axes if role == "drive" else record.response_axes)}


def _in_order(record: Record, first: Record) -> Record:
    """The record with its columns in the order of the first."""
    if (record.drive_axes, record.response_axes) == (first.drive_axes, first.response_axes):
        return record
    drive = record.drive[:, [record.drive_axes.index(axis) for axis in first.drive_axes]]
    response = record.response[:, [record.response_axes.index(axis) for axis in first.response_axes]]
    axes = (first.drive_axes, first.response_axes)
    return Record(record.name, record.time, drive, response, *axes, record.time_unit)


def _tells(record: Record) -> bool:
    """Whether a response sample follows a change of drive."""
    changed = np.flatnonzero((record.drive[1:] != record.drive[:-1]).any(axis=1))
    sampled = np.flatnonzero(np.isfinite(record.response).any(axis=1))
    return bool(changed.size) and bool(changed[0] + 1 < sampled[-1])


def together(fit: Sequence[Record], held_out: Sequence[Record], *, complete: bool = True) -> list[str]:
    """What is wrong with the records as a set; not `complete` when a record to fit failed to load."""

    def said(axis: Axis | None) -> str:
        return f"in {axis.unit}" if axis else "absent"

    records, problems = [*fit, *held_out], []
    for record, role in product(records[1:], ("drive", "response")):
        wanted, got = _axes(records[0], role), _axes(record, role)
        problems += [
            f"record {record.name!r}: {role} axis {name!r} is {said(got.get(name))}, but in record "
            f"{records[0].name!r} it is {said(wanted.get(name))}; all records of a study need the same axes"
            for name in wanted | got
            if wanted.get(name) != got.get(name)
        ]
    names = [record.name for record in records]
    repeated = sorted({name for name in names if names.count(name) > 1})
    problems += [
        f"{names.count(k)} records are named {k!r}; give each file a name of its own" for k in repeated
    ]
    alike = not problems  # else a response axis cannot be followed through the records
    if complete and fit and not any(_tells(record) for record in fit):
        problems.append(
            "the drive is constant throughout the fit records up to their last response sample: nothing can "
            "be learned about the dynamics; add a record in which a drive changes, or, where a drive was "
            "switched on as a record began, a row before its first with the drive before and empty responses"
        )
    for axis in fit[0].response_axes if complete and fit and alike else ():
        columns = (record.response[:, record.response_axes.index(axis)] for record in fit)
        if all(np.isnan(column).all() for column in columns):
            problems.append(f"response axis {axis.name!r} has no sample in any fit record; remove its column")
    return problems
