"""Study files, files of candidates and bare record files, read into a `Study` and its candidates."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, final

from lcopa_bayes.core.errors import InputError, gathered, refuse_if
from lcopa_bayes.core.files import outside, read_json, read_tables, refuse_code, trusting
from lcopa_bayes.data.cells import SUFFIXES
from lcopa_bayes.data.record import Record, load_record
from lcopa_bayes.data.settings import CandidateSettings, CompareSettings, HeadingSettings, RecordsSettings
from lcopa_bayes.data.study import Study, together
from lcopa_bayes.data.tables import (
    TABLES,
    candidate_settings,
    population_priors,
    settings_from,
    study_settings,
)

_TABLES = ("study", "records", "priors", "stages", "candidates", *TABLES)
"""Tables of a study file."""


def _read(
    fit: Sequence[Path], held_out: Sequence[Path], time_unit: str | None, problems: list[str]
) -> dict[str, list[Record]]:
    """Records by role, in `time_unit` or that of the first; what is wrong joins `problems`, which may hold
    what is wrong with others."""
    complete = not problems
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
    problems += together(*records.values(), complete=complete and len(records["fit"]) == len(fit))
    return records


def _hashes(paths: Iterable[Path]) -> dict[str, str]:
    try:
        return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    except OSError as error:  # it has vanished since
        raise InputError(f"{error.filename}: cannot be read ({error.strerror})") from None


def _population(priors: Mapping[str, Any], folder: Path, time_unit: str) -> tuple[Path, dict[str, Any]]:
    """File that ``from`` of ``[priors]`` names, and the stated priors with those of its fleet for the others.

    InputError when it cannot be used for a study in this time unit.
    """
    name, _, number = str(priors["from"]).partition("#")
    refuse_if(outside(folder, [name]))
    path, group = folder / name, int(number) if number.isdecimal() else 1
    values = read_json(path, "give the fleet.json that `fleet` wrote")
    taken = population_priors(values, group, str(path))
    if not number and len(values["groups"]) > 1:
        about = "; ".join(f'"{name}#{one["number"]}" ({one["about"]})' for one in values["groups"])
        raise InputError(f"{path}: holds several groups of devices; name one: {about}")
    unit = values["groups"][group - 1]["time_unit"]
    if unit != time_unit:
        raise InputError(f"{path}: is in {unit}, this study is in {time_unit}; state time_unit in [study]")
    return path, taken | {key: value for key, value in priors.items() if key != "from"}


@final
class BrokenStudyError(InputError):
    """A study file with problems whose plant and records can be used: more may be wrong with these."""

    def __init__(self, problems: Sequence[str], study: Study) -> None:
        super().__init__(problems)
        self.study = study


def _from_file(path: Path, held_out: list[Path]) -> Study:
    (document, problems), folder = read_tables(path, _TABLES), path.parent

    def where(name: str) -> str:
        return f"{path}, [{name}]"

    heading = settings_from(HeadingSettings, document.get("study", {}), where("study"), problems)
    named = settings_from(RecordsSettings, document.get("records", {}), where("records"), problems)
    heading, fit, apart = heading or HeadingSettings(), [], held_out
    of_records: list[str] = []  # or of code: with these nothing more can be checked
    if named:
        apart = [*_inside(folder, named.held_out, where("records"), of_records), *held_out]
        kept = {file.resolve() for file in (*(folder / name for name in named.held_out), *held_out)}
        beside = [file for file in tables_in(folder) if file.resolve() not in kept]
        names = named.fit or [file.name for file in beside]
        fit = _inside(folder, names, where("records"), of_records)
        if not names:
            problems.append(
                f"{where('records')}: no record to fit; name one, or put one beside the study file"
            )
    records = _read(fit, apart, heading.time_unit, of_records)
    priors, used = document.get("priors"), [path]
    if isinstance(priors, Mapping) and "from" in priors:
        unit = records["fit"][0].time_unit if records["fit"] else heading.time_unit or ""
        document["priors"] = {key: value for key, value in priors.items() if key != "from"}
        with gathered(problems, f"{where('priors')}: from: "):
            population, document["priors"] = _population(priors, folder, unit)
            used.append(population)
    settings = study_settings(document, where, problems)
    if settings["effects"] is not None:
        with gathered(of_records):
            refuse_code(where("effects"), settings["effects"].add)
    problems += of_records
    plant = all(settings[key] is not None for key in ("model", "noise", "effects"))
    if problems and not (plant and records["fit"] and not of_records):
        raise InputError(problems)
    study = Study(
        heading.name or folder.resolve().name,
        folder,
        records["fit"][0].time_unit,  # stated, or that of the first fit record
        heading.seed,
        tuple(records["fit"]),
        tuple(records["held_out"]),
        inputs=_hashes([*used, *fit, *apart]),
        file=path,
        **settings | ({} if settings["stages"] else {"stages": None}),
    )
    if problems:
        raise BrokenStudyError(problems, study)
    return study


def _inside(folder: Path, names: Sequence[str], where: str, problems: list[str]) -> list[Path]:
    """Files of a folder; those outside it are not read, and join the problems."""
    wrong = {name: [f"{where}: {one}" for one in outside(folder, [name])] for name in names}
    problems += [one for own in wrong.values() for one in own]
    return [folder / name for name in names if not wrong[name]]


def tables_in(folder: Path) -> list[Path]:
    """Record files in a folder, by name."""
    return [file for file in sorted(folder.glob("[!.]*")) if file.suffix.lower() in SUFFIXES]


def load_study(source: Path | Sequence[Path], *, held_out: Sequence[Path] = (), trust: bool = False) -> Study:
    """The study in the folder or study file `source`, or one of default settings made from record files.

    The time unit is the one the study file states, else that of the first fit record; records in other units
    are converted. A folder without a study file is a study of all records in it. From record files the name
    is the first stems joined by ``-`` and the seed 0. `held_out` adds records to hold out; `trust` lets the
    study name files outside its folder and effects of its own, which are code. Raises InputError with
    everything wrong in the study file and all its records together; nothing is written.
    """
    with trusting(trust):
        return _load(source, held_out)


def _load(source: Path | Sequence[Path], held_out: Sequence[Path]) -> Study:
    sources = [Path(source)] if isinstance(source, (str, Path)) else [Path(path) for path in source]
    apart = [Path(path) for path in held_out]
    if len(sources) == 1 and sources[0].suffix.lower() == ".toml":
        return _from_file(sources[0], apart)
    name = None
    if len(sources) == 1 and sources[0].is_dir():
        folder = sources[0]
        if (folder / "study.toml").exists():
            return _from_file(folder / "study.toml", apart)
        own = {path.resolve() for path in apart}
        sources = [path for path in tables_in(folder) if path.resolve() not in own]
        name = folder.resolve().name
        refuse_if([f"{folder}: {one}" for one in outside(folder, [path.name for path in sources])])
        if not sources:
            raise InputError(
                f"{folder}: this folder holds neither a study.toml nor a record nor a finished fit; name a "
                "study, record files, or the run folder of a fit; `lcopa-bayes new` reads other tables"
            )
    if not sources:
        raise InputError("no study: name a folder, a study.toml, or one or more record files")
    problems: list[str] = []
    records = _read(sources, apart, None, problems)
    refuse_if(problems)
    fit, kept = tuple(records["fit"]), tuple(records["held_out"])
    return Study(name, fit=fit, held_out=kept, inputs=_hashes([*sources, *apart]))


def load_candidates(path: Path) -> tuple[tuple[str, ...] | None, tuple[CandidateSettings, ...]]:
    """Names picked, None for all, and candidates described in a TOML file.

    InputError with all that is wrong.
    """
    document, problems = read_tables(path, ("compare", "candidates"))
    chosen = settings_from(CompareSettings, document.get("compare", {}), f"{path}, [compare]", problems)
    described = candidate_settings(document.get("candidates", []), f"{path}, [[candidates]]", problems)
    if not document:
        problems.append(f"{path}: names no candidate; write [[candidates]] or [compare] pick")
    refuse_if(problems)
    return (chosen or CompareSettings()).pick, described
