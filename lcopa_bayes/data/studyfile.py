"""Study files, files of candidates and bare record files, read into a `Study` and its candidates."""

from __future__ import annotations

import hashlib
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.data.candidatesettings import CandidateSettings, compare_settings
from lcopa_bayes.data.cells import SUFFIXES
from lcopa_bayes.data.record import Record, in_time_unit, load_record
from lcopa_bayes.data.settings import (
    STAGES,
    EffectsSettings,
    HeadingSettings,
    ModelSettings,
    NoiseSettings,
    RecordsSettings,
    SamplerSettings,
    prior_settings,
    settings_from,
)
from lcopa_bayes.data.study import DEFAULT_STAGES, Study, together

_KNOWN = ("compare", "candidates")

_TABLES = ("study", "records", "model", "priors", "noise", "sampler", "effects", "stages")
_COMPARED = ("compare", "candidates")


def _read(
    fit: Sequence[Path], held_out: Sequence[Path], time_unit: str | None, problems: list[str]
) -> dict[str, list[Record]]:
    """Records by role, in `time_unit` or that of the first; what is wrong joins `problems`."""
    records: dict[str, list[Record]] = {"fit": [], "held_out": []}
    listed: dict[Path, str] = {}
    for role, path in [*(("fit", path) for path in fit), *(("held_out", path) for path in held_out)]:
        if path.resolve() in listed:
            problems.append(f"{path}: listed in {role} but already in {listed[path.resolve()]}; list it once")
            continue
        listed[path.resolve()] = role
        try:
            records[role].append(load_record(path, time_unit))
        except InputError as error:
            problems += error.problems
        else:
            time_unit = time_unit or records[role][0].time_unit
    problems += together(*records.values(), complete=len(records["fit"]) == len(fit))
    return records


def _hashes(paths: Iterable[Path]) -> dict[str, str]:
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def _document(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8-sig")
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        end = f"at line {text.count(chr(10)) + 1}, the end of the file"
        why = str(error).replace("at end of document", end)
        raise InputError(f"{path}: is not valid TOML: {why}") from error
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as UTF-8 text ({error})") from error


def _stages(table: object, where: str, problems: list[str]) -> dict[str, Mapping[str, object]]:
    """Stages to run: a list of names, or a table of ``name = true``, ``name = false`` and settings."""
    if table == {}:
        return dict(DEFAULT_STAGES)
    chosen = dict.fromkeys(map(str, table), True) if isinstance(table, list) else table
    if not isinstance(chosen, dict):
        problems.append(f"{where}: must be a table or a list of stages; got {table!r}")
        return {}
    problems += [
        f"{where}: unknown stage {name!r}{nearest(name, STAGES)}" for name in chosen if name not in STAGES
    ]
    for name, value in chosen.items():
        if not isinstance(value, (bool, dict)):
            problems.append(f"{where}: `{name}` must be true, false or a table of settings; got {value!r}")
        elif isinstance(value, dict) and name in STAGES:
            problems += [
                f"{where}: {name} has no setting {key!r}{nearest(key, STAGES[name])}"
                for key in value
                if key not in STAGES[name]
            ]
    if not any(value is not False for value in chosen.values()):
        problems.append(f"{where}: names no stage to run; name one or more of {', '.join(STAGES)}")
    return {
        name: value if isinstance(value, dict) else {} for name, value in chosen.items() if value is not False
    }


def _from_file(path: Path, held_out: list[Path]) -> Study:
    document, folder = _document(path), path.parent
    problems = [
        f"{path}: unknown table [{key}]{nearest(key, (*_TABLES, *_COMPARED))}"
        for key in document
        if key not in (*_TABLES, *_COMPARED)
    ]
    where = {name: f"{path}, [{name}]" for name in _TABLES}
    tables: dict[str, Any] = {name: document.get(name, {}) for name in _TABLES}
    for name in _TABLES[:-1]:
        if not isinstance(tables[name], dict):
            problems.append(f"{where[name]}: must be a table of settings; got {tables[name]!r}")
            tables[name] = {}
    if isinstance(tables["model"].get("orders"), list):
        tables["model"].setdefault("terms", max(1, len(tables["model"]["orders"])))
    heading = settings_from(HeadingSettings, tables["study"], where["study"], problems) or HeadingSettings()
    named = settings_from(RecordsSettings, tables["records"], where["records"], problems)
    model = settings_from(ModelSettings, tables["model"], where["model"], problems) or ModelSettings()
    noise = settings_from(NoiseSettings, tables["noise"], where["noise"], problems) or NoiseSettings()
    sampler = (
        settings_from(SamplerSettings, tables["sampler"], where["sampler"], problems) or SamplerSettings()
    )
    effects = (
        settings_from(EffectsSettings, tables["effects"], where["effects"], problems) or EffectsSettings()
    )
    priors = prior_settings(tables["priors"], where["priors"], problems)
    stages = _stages(tables["stages"], where["stages"], problems)
    compare, candidates = compare_settings(document, str(path), problems)
    fit, apart = [], held_out
    if named:
        apart = [*(folder / name for name in named.held_out), *held_out]
        kept = {file.resolve() for file in apart}
        beside = [file for file in sorted(folder.glob("[!.]*")) if file.suffix.lower() in SUFFIXES]
        fit = [folder / k for k in named.fit or ()] or [file for file in beside if file.resolve() not in kept]
        if not fit:
            problems.append(
                f"{where['records']}: no record to fit; name one, or put one beside the study file"
            )
    records = _read(fit, apart, heading.time_unit, problems)
    if problems:
        raise InputError(problems)
    time_unit = records["fit"][0].time_unit  # stated, or that of the first fit record
    return Study(
        heading.name or folder.resolve().name,
        folder,
        time_unit,
        heading.seed,
        tuple(records["fit"]),
        tuple(records["held_out"]),
        replace(model, exposure=float(in_time_unit(model.exposure, "ms", time_unit))),
        priors,
        noise,
        sampler,
        stages,
        _hashes([path, *fit, *apart]),
        compare,
        candidates,
        effects,
    )


def load_study(source: Path | Sequence[Path], *, held_out: Sequence[Path] = ()) -> Study:
    """The study in the folder or study file `source`, or one of default settings made from record files.

    The time unit is the one the study file states, else that of the first fit record; records in other units
    are converted. From record files the name is the first stems joined by ``-`` and the seed 0. `held_out`
    adds records to hold out. Raises InputError with everything wrong in the study file and all its records
    together; nothing is written.
    """
    sources = [Path(source)] if isinstance(source, (str, Path)) else [Path(path) for path in source]
    apart = [Path(path) for path in held_out]
    if len(sources) == 1 and (sources[0].is_dir() or sources[0].suffix.lower() == ".toml"):
        return _from_file(sources[0] / "study.toml" if sources[0].is_dir() else sources[0], apart)
    if not sources:
        raise InputError("no study: name a folder with a study.toml, or one or more record files")
    problems: list[str] = []
    records = _read(sources, apart, None, problems)
    if problems:
        raise InputError(problems)
    fit, kept = tuple(records["fit"]), tuple(records["held_out"])
    return Study(fit=fit, held_out=kept, inputs=_hashes([*sources, *apart]))


def load_candidates(path: Path) -> tuple[tuple[str, ...] | None, tuple[CandidateSettings, ...]]:
    """Names picked, None for all, and candidates described in a TOML file.

    InputError with all that is wrong.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: cannot be read as TOML ({error}); give a file of candidates") from None
    problems = [
        f"{path}: unknown table [{key}]{nearest(key, _KNOWN)}" for key in document if key not in _KNOWN
    ]
    chosen, made = compare_settings(document, str(path), problems)
    if not document:
        problems.append(f"{path}: names no candidate; write [[candidates]] or [compare] pick")
    if problems:
        raise InputError(problems)
    return chosen.pick, made
