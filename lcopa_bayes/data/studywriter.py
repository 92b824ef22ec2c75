"""A study written as a study file with its records beside, so that reading it gives the same study."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.core.files import writable_folder, write_text, write_whole
from lcopa_bayes.data.record import in_time_unit, save_record
from lcopa_bayes.data.settings import EffectsSettings, PriorSettings
from lcopa_bayes.data.study import Study


def write_study(study: Study, path: Path, *, note: str = "") -> tuple[Path, ...]:
    """Write a study file, with `note` as a comment at its head, and the records in a folder of its name.

    Numbers are written to the last digit. Tables of candidates and stages are not written. Returns the paths,
    the study file last; InputError when one of them cannot be written.
    """
    folder = writable_folder(path.parent / path.stem)
    files = {}
    for role, records in (("fit", study.fit), ("held_out", study.held_out)):
        files[role] = [folder / f"{record.name}.csv" for record in records]
        for record, file in zip(records, files[role], strict=True):
            write_whole(file, lambda beside, record=record: save_record(record, beside))  # type: ignore[misc]
    named = {role: [f"{folder.name}/{file.name}" for file in each] for role, each in files.items()}
    model = _given(study.model)
    model["exposure_ms"] = float(in_time_unit(model.pop("exposure"), study.time_unit, "ms"))
    tables: dict[str, dict[str, Any]] = {
        "study": {"name": study.name, "time_unit": study.time_unit, "seed": study.seed},
        "records": {role: each for role, each in named.items() if each},
        "model": model,
        "noise": _given(study.noise),
        "sampler": _given(study.sampler),
        "effects": _effects(study.effects, study.folder, path.parent),
        "priors": {name: _prior(prior) for name, prior in study.priors.items()},
    }
    lines = [f"# {line}".rstrip() for line in note.splitlines()]
    for name, table in tables.items():
        if table:
            lines += ["", f"[{name}]", *(f"{_key(key)} = {_toml(value)}" for key, value in table.items())]
    write_text(path, "\n".join(lines).lstrip("\n") + "\n")
    return (*files["fit"], *files["held_out"], path)


def _given(settings: Any) -> dict[str, Any]:
    """Settings that say something."""
    values = {field.name: getattr(settings, field.name) for field in dataclasses.fields(settings)}
    return {key: value for key, value in values.items() if value is not None}


def _effects(effects: EffectsSettings, before: Path | None, after: Path) -> dict[str, Any]:
    """Settings of effects; files of the user's own by their paths from the new folder."""
    given = {key: value for key, value in _given(effects).items() if value not in ((), {})}
    if effects.add:
        own = (before or Path()).resolve()
        given["add"] = [os.path.relpath(own / text, after.resolve()) for text in effects.add]
    return given


def _prior(prior: PriorSettings) -> float | dict[str, Any]:
    if prior.dist is None:
        assert prior.fixed is not None
        return prior.fixed
    return {"dist": prior.dist, **prior.parameters}


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
