"""Studies: records to fit, records held out, and everything a study file says about them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from pathlib import Path
from types import MappingProxyType
from typing import Any, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.errors import InputError, gathered, refuse_if
from lcopa_bayes.core.rules import rebuilt
from lcopa_bayes.core.units import in_time_unit
from lcopa_bayes.data.agreement import Disagreement, disagreements
from lcopa_bayes.data.record import Axis, Record, RecordLike, records_of, several
from lcopa_bayes.data.settings import (
    CandidateSettings,
    CompareSettings,
    EffectsSettings,
    HeadingSettings,
    ModelSettings,
    NoiseSettings,
    PriorSettings,
    SamplerSettings,
)
from lcopa_bayes.data.tables import settings_from, study_settings


@final
@dataclass(frozen=True, eq=False, init=False)
class Study:
    """Records and settings of one study; every record has the axes of the first, in its order.

    ``Study(fit=["on.csv", frame], held_out=[record], terms=3, priors={"delay": 5.0})`` is the study that a
    study file with these keys describes: records are `Record`, paths, frames or arrays (`records_of`), tables
    of settings are their keys and values. Raises InputError with every problem unless the records have
    distinct names, one time unit and the same axes, those to fit hold information on the dynamics (a
    drive changes before a sample), and every setting is known and allowed.
    """

    name: str
    """Also the name of the run folder; by default the names of the fit records joined by ``-``."""
    folder: Path | None
    """Where the study file is; None when the study was made from records alone."""
    time_unit: str
    """Unit of every time in the records, priors and results; by default that of the first fit record."""
    seed: int
    """Seed of every random number."""
    fit: tuple[Record, ...]
    """Records to fit."""
    held_out: tuple[Record, ...]
    """Records the fit never sees."""
    model: ModelSettings
    """Elements, orders, delays and offsets."""
    priors: Mapping[str, PriorSettings]
    """By parameter name."""
    noise: NoiseSettings
    """Kind of noise."""
    sampler: SamplerSettings
    """How long to sample."""
    stages: tuple[str, ...]
    """Stages that `run` carries out."""
    inputs: Mapping[str, str]
    """SHA-256 of each input file, by file name."""
    compare: CompareSettings
    """How candidates are compared."""
    candidates: tuple[CandidateSettings, ...]
    """Models to compare besides those any study has."""
    effects: EffectsSettings
    """Effects of the plant beyond its linear elements."""
    file: Path | None
    """The study file, which messages name; None when the study was made otherwise."""

    def __init__(
        self,
        name: str | None = None,
        folder: Path | None = None,
        time_unit: str | None = None,
        seed: int = 0,
        fit: RecordLike | Iterable[RecordLike] = (),
        held_out: RecordLike | Iterable[RecordLike] = (),
        model: ModelSettings | Mapping[str, object] | None = None,
        priors: Mapping[str, Any] | None = None,
        noise: NoiseSettings | Mapping[str, object] | None = None,
        sampler: SamplerSettings | Mapping[str, object] | None = None,
        stages: Sequence[str] | None = None,
        inputs: Mapping[str, str] | None = None,
        compare: CompareSettings | Mapping[str, object] | None = None,
        candidates: Sequence[CandidateSettings | Mapping[str, object]] | None = None,
        effects: EffectsSettings | Mapping[str, object] | None = None,
        file: Path | None = None,
        *,
        terms: int | Mapping[str, int] | None = None,
    ) -> None:
        problems: list[str] = []
        heading = {"name": name or None, "time_unit": time_unit, "seed": seed}
        if settings_from(HeadingSettings, heading, "study", problems) is None:
            time_unit = None
        fitted, apart = _records(fit, held_out, time_unit, problems)
        if terms is not None:
            model = (
                replace(model, terms=terms)
                if isinstance(model, ModelSettings)
                else {**(model or {}), "terms": terms}
            )
        given = {
            "model": model,
            "priors": priors,
            "noise": noise,
            "sampler": sampler,
            "effects": effects,
            "stages": stages,
            "compare": compare,
            "candidates": candidates,
        }
        given = {key: value for key, value in given.items() if value is not None}
        settings = study_settings(given, "`{}`".format, problems)
        refuse_if(problems)
        unit = time_unit or (fitted[0].time_unit if fitted else "")
        records = (*fitted, *apart)
        problems = together(fitted, apart) if fitted else ["a study needs one or more records to fit"]
        problems += [
            f"record {r.name!r} is in {r.time_unit}, the study is in {unit}; convert its times"
            for r in records
            if r.time_unit != unit
        ]
        refuse_if(problems)
        settings |= {
            "name": name or default_name(fitted),
            "folder": folder,
            "time_unit": unit,
            "seed": seed,
            "fit": tuple(_in_order(r, fitted[0]) for r in fitted),
            "held_out": tuple(_in_order(r, fitted[0]) for r in apart),
            "inputs": inputs or {},
            "file": file,
        }
        plant = len(fitted[0].drive_axes), len(fitted[0].response_axes)
        settings["model"] = settings["model"].for_plant(*plant)
        for key, value in settings.items():
            locked = MappingProxyType(dict(value)) if isinstance(value, Mapping) else value
            object.__setattr__(self, key, locked)

    @contextmanager
    def located(self) -> Iterator[None]:
        """Within it, what is said to be wrong with a table of the study names its file."""
        try:
            yield
        except InputError as error:
            if self.file is None:
                raise
            said = [f"{self.file}, {one}" if one.startswith("[") else one for one in error.problems]
            raise InputError(said) from None

    @property
    def exposure(self) -> float:
        """Time over which a response sample is a mean [time unit]."""
        return float(in_time_unit(self.model.exposure_ms, "ms", self.time_unit))

    @property
    def drive_axes(self) -> tuple[Axis, ...]:
        """Axes of the drive of every record."""
        return self.fit[0].drive_axes

    @property
    def response_axes(self) -> tuple[Axis, ...]:
        """Axes of the response of every record."""
        return self.fit[0].response_axes

    @cached_property
    def disagreements(self) -> tuple[Disagreement, ...]:
        """What its records contradict, those held out too; calculated once."""
        return disagreements((*self.fit, *self.held_out))

    @property
    def contradictory(self) -> bool:
        """Whether they contradict each other so grossly that no plant follows them."""
        return any(one.gross for one in self.disagreements)

    def with_seed(self, seed: int) -> Study:
        """The same study with another seed."""
        return replace(self, seed=seed)

    def summary(self) -> pd.DataFrame:
        """One row per record: samples, first and last time [`time_unit`], axes [units], and whether it is
        held out."""
        return pd.DataFrame(
            [
                {
                    "record": one.name,
                    "samples": one.time.size,
                    "begin": one.time[0],
                    "end": one.time[-1],
                    "time_unit": one.time_unit,
                    "drives": ", ".join(f"{axis.name} [{axis.unit}]" for axis in one.drive_axes),
                    "responses": ", ".join(f"{axis.name} [{axis.unit}]" for axis in one.response_axes),
                    "held_out": held_out,
                }
                for held_out, records in ((False, self.fit), (True, self.held_out))
                for one in records
            ]
        )

    def __repr__(self) -> str:
        """Its records, without their numbers and the settings."""
        return f"Study({self.name!r}, fit={list(self.fit)}, held_out={list(self.held_out)})"

    __reduce__ = rebuilt


def default_name(fit: Sequence[Record]) -> str:
    """Name of a study made from records: the first names joined by ``-``; it becomes that of a folder."""
    more = [f"and-{len(fit) - 3}-more"] if len(fit) > 3 else []
    return "-".join([record.name for record in fit[:3]] + more)


def _records(
    fit: RecordLike | Iterable[RecordLike],
    held_out: RecordLike | Iterable[RecordLike],
    time_unit: str | None,
    problems: list[str],
) -> tuple[tuple[Record, ...], tuple[Record, ...]]:
    """Records to fit and held out; those read here come in one time unit. What is wrong joins `problems`."""
    out: list[tuple[Record, ...]] = []
    for given, called in ((several(fit), "record"), (several(held_out), "held-out")):
        read: tuple[Record, ...] = ()
        with gathered(problems):
            read = records_of(given, called=called)
        unit = time_unit or next((record.time_unit for role in (*out, read) for record in role), None)
        as_given = read and all(isinstance(one, Record) for one in given)
        out.append(read if as_given else records_of(read, unit))
    return out[0], out[1]


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
