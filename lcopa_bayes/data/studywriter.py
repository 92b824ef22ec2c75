"""A study written exactly: as a study file with its records beside, or as plain values with all it needs."""

from __future__ import annotations

import dataclasses
import json
import os
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.files import UNFINISHED, refuse_code, writable_folder, write_text, writing
from lcopa_bayes.core.rules import FOLDER
from lcopa_bayes.data.record import Axis, Record, save_record
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.tables import TABLES


def _tables(study: Study) -> dict[str, Any]:
    """Tables of a study file, without those of records."""
    return {
        "study": {"name": study.name, "time_unit": study.time_unit, "seed": study.seed},
        **{name: _given(getattr(study, name)) for name in TABLES},
        "priors": {name: _prior(prior) for name, prior in study.priors.items()},
    }


def write_study(study: Study, path: Path, *, note: str = "") -> tuple[Path, ...]:
    """Write a study file, with `note` as a comment at its head, and the records in a folder of its name.

    Numbers are written to the last digit. Candidates and stages are not written. Returns the paths, the study
    file last; InputError when one of them cannot be written.
    """
    folder = writable_folder(path.parent / path.stem)
    files = {}
    for role, records in (("fit", study.fit), ("held_out", study.held_out)):
        files[role] = [folder / f"{record.name}.csv" for record in records]
        for record, file in zip(records, files[role], strict=True):
            save_record(record, file)
    named = {role: [f"{folder.name}/{file.name}" for file in each] for role, each in files.items() if each}
    tables = _tables(study)
    tables = {"study": tables.pop("study"), "records": named, **tables}
    if study.effects.add:  # files of the user's own by their paths from the new folder
        own, after = (study.folder or Path()).resolve(), path.parent.resolve()
        tables["effects"]["add"] = [os.path.relpath(own / text, after) for text in study.effects.add]
    lines = [f"# {line}".rstrip() for line in note.splitlines()]
    for name, table in tables.items():
        if name != "compare":
            rows = [f"{_key(key)} = {_toml(value)}" for key, value in table.items() if value not in ([], {})]
            lines += ["", f"[{name}]", *rows] if rows else []
    write_text(path, "\n".join(lines).lstrip("\n") + "\n")
    return (*files["fit"], *files["held_out"], path)


def write_folder(
    folder: Path, study: Study, *, notes: Sequence[str] = (), settings: str = "", overwrite: bool = False
) -> tuple[Path, ...]:
    """Write the records of a study and a `study.toml` that names them into one folder; returns the paths,
    the study file last.

    Parameters: `notes`, comments at its head; `settings`, tables after those of the study and its records.
    Everything is written beside its place first and then renamed, the study last: a folder cut short holds
    no file half written and no new study without its records. InputError when a file is there already
    (unless `overwrite`), a record has no name for a file, or one cannot be written.
    """
    roles = {"fit": study.fit, "held_out": study.held_out}
    names = [record.name for records in roles.values() for record in records]
    targets = [*(folder / f"{name}.csv" for name in names), folder / "study.toml"]
    problems = [one for name in names for one in FOLDER.problems("record name", name)]
    problems += [
        f"{path}: is there already; choose another folder or allow --overwrite"
        for path in targets
        if path.exists() and not overwrite
    ]
    refuse_if(problems)
    heading = _tables(study)["study"]
    files = {role: [f"{record.name}.csv" for record in records] for role, records in roles.items()}
    lines = [*(f"# {note}" for note in notes), "", "[study]"]
    lines += [*(f"{key} = {_toml(value)}" for key, value in heading.items()), "", "[records]"]
    lines += [f"{role} = {_toml(own)}" for role, own in files.items() if own]
    if not study.held_out:
        lines.append('# held_out = ["another.csv"]  # only predicted: the best check of a model')
    text = "\n".join([*lines, "", settings.strip()]).strip()
    writable_folder(folder)
    with writing(folder), tempfile.TemporaryDirectory(prefix=UNFINISHED, dir=folder) as beside:
        try:
            for record, target in zip((*study.fit, *study.held_out), targets, strict=False):
                save_record(record, Path(beside) / target.name)
            write_text(Path(beside) / "study.toml", f"{text}\n")
        except InputError as error:  # name the file that was wanted
            raise InputError([one.replace(beside, str(folder)) for one in error.problems]) from error
        for target in targets:
            with writing(target):
                os.replace(Path(beside) / target.name, target)
    return tuple(targets)


def study_to_json(study: Study) -> dict[str, Any]:
    """Everything a study says, its records included; `study_from_json` gives the same study."""
    candidates = [
        _given(one) | {"priors": {name: _prior(prior) for name, prior in one.priors.items()}}
        for one in study.candidates
    ]
    return _tables(study) | {
        "folder": str(study.folder) if study.folder and study.effects.add else None,  # of its own effects
        "fit": [_record(record) for record in study.fit],
        "held_out": [_record(record) for record in study.held_out],
        "stages": list(study.stages),
        "inputs": dict(study.inputs),
        "candidates": candidates,
    }


def study_from_json(values: Mapping[str, Any]) -> Study:
    """The study of `study_to_json`; KeyError, TypeError or ValueError (InputError too) for other values."""
    refuse_code("effects of its own", values["effects"].get("add", ()))
    return Study(
        folder=None if values["folder"] is None else Path(values["folder"]),
        fit=[_record_of(record) for record in values["fit"]],
        held_out=[_record_of(record) for record in values["held_out"]],
        **values["study"],
        **{key: values[key] for key in (*TABLES, "priors", "stages", "inputs", "candidates")},
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


def _record_of(values: Mapping[str, Any]) -> Record:
    response = [[np.nan if v is None else v for v in column] for column in values["response"]]
    return Record(
        name=values["name"],
        time=np.array(values["time"], dtype=float),
        drive=np.array(values["drive"], dtype=float).T,
        response=np.array(response, dtype=float).T,
        drive_axes=tuple(Axis(*axis) for axis in values["drive_axes"]),
        response_axes=tuple(Axis(*axis) for axis in values["response_axes"]),
        time_unit=values["time_unit"],
    )


def _given(settings: Any) -> dict[str, Any]:
    """Settings that say something, by key."""
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    return {key: _plain(value) for key, value in values.items() if value is not None}


def _plain(value: Any) -> Any:
    """Mappings as dictionaries, tuples as lists."""
    return dict(value) if isinstance(value, Mapping) else list(value) if isinstance(value, tuple) else value


def _prior(prior: PriorSettings) -> float | dict[str, Any] | None:
    return prior.fixed if prior.dist is None else {"dist": prior.dist, **prior.parameters}


def _key(key: str) -> str:
    bare = key.replace("_", "").replace("-", "")
    return key if bare.isascii() and bare.isalnum() else json.dumps(key, ensure_ascii=False)


def _toml(value: Any) -> str:
    """A value as TOML writes it."""
    if isinstance(value, Mapping):
        inside = ", ".join(f"{_key(str(key))} = {_toml(each)}" for key, each in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, (bool, str)):
        return json.dumps(value, ensure_ascii=False)
    return repr(float(value)) if isinstance(value, float) else str(int(value))
