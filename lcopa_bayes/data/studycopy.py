"""A study as plain values, exactly: what a run folder keeps so that it needs no other file."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.data.candidatesettings import CandidateSettings, CompareSettings
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import (
    EffectsSettings,
    ModelSettings,
    NoiseSettings,
    PriorSettings,
    SamplerSettings,
)
from lcopa_bayes.data.study import Study

_SETTINGS: Mapping[str, type[Any]] = {
    "model": ModelSettings,
    "noise": NoiseSettings,
    "sampler": SamplerSettings,
    "compare": CompareSettings,
    "effects": EffectsSettings,
}


def study_to_json(study: Study) -> dict[str, Any]:
    """Everything a study says, its records included; `study_from_json` gives the same study."""
    return {
        "name": study.name,
        "folder": str(study.folder) if study.folder and study.effects.add else None,  # of its own effects
        "time_unit": study.time_unit,
        "seed": study.seed,
        "fit": [_record(record) for record in study.fit],
        "held_out": [_record(record) for record in study.held_out],
        "priors": _plain(study.priors),
        "stages": _plain(study.stages),
        "inputs": _plain(study.inputs),
        "candidates": _plain(study.candidates),
        **{key: _plain(getattr(study, key)) for key in _SETTINGS},
    }


def study_from_json(values: Mapping[str, Any]) -> Study:
    """The study of `study_to_json`; KeyError, TypeError or ValueError (InputError too) for other values."""
    folder = values["folder"]
    return Study(
        values["name"],
        None if folder is None else Path(folder),
        values["time_unit"],
        values["seed"],
        tuple(_read(record) for record in values["fit"]),
        tuple(_read(record) for record in values["held_out"]),
        priors={name: _settings(PriorSettings, prior) for name, prior in values["priors"].items()},
        stages=values["stages"],
        inputs=values["inputs"],
        candidates=tuple(_settings(CandidateSettings, one) for one in values["candidates"]),
        **{key: _settings(kind, values[key]) for key, kind in _SETTINGS.items()},
    )


def _record(record: Record) -> dict[str, Any]:
    response = [[None if np.isnan(v) else v for v in row] for row in record.response.T.tolist()]
    return {
        "name": record.name,
        "time": record.time.tolist(),
        "drive": record.drive.T.tolist(),
        "response": response,
        "drive_axes": [[axis.name, axis.unit] for axis in record.drive_axes],
        "response_axes": [[axis.name, axis.unit] for axis in record.response_axes],
        "time_unit": record.time_unit,
    }


def _read(values: Mapping[str, Any]) -> Record:
    response = [[np.nan if v is None else v for v in column] for column in values["response"]]
    return Record(
        values["name"],
        np.array(values["time"], dtype=float),
        np.array(values["drive"], dtype=float).T,
        np.array(response, dtype=float).T,
        tuple(Axis(*axis) for axis in values["drive_axes"]),
        tuple(Axis(*axis) for axis in values["response_axes"]),
        values["time_unit"],
    )


def _plain(value: Any) -> Any:
    """Dataclasses and mappings as dictionaries, tuples as lists."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {one.name: _plain(getattr(value, one.name)) for one in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _settings(kind: type[Any], values: Mapping[str, Any]) -> Any:
    """Settings from their fields."""
    fields: dict[str, Any] = {
        key: tuple(item) if isinstance(item, list) else item for key, item in values.items()
    }
    if kind is CandidateSettings:
        fields["priors"] = {name: _settings(PriorSettings, prior) for name, prior in fields["priors"].items()}
    return kind(**fields)
