"""Campaign files: what the virtual bench is to measure, as TOML, and the folder of what it measured.

    [campaign]
    name = "paper-step"
    seed = 7
    [bench]                      # defaults: the paper's bench
    noise_sd = 1.8e-4
    [[path]]                     # defaults: the paper's four paths
    response = "x"
    drive = "x"
    gain = 0.1
    delay = 3.0
    etas = [16.0, 12.5]
    orders = [1.8, 0.9]
    stiffness = 5.57
    [[record]]
    name = "x_on"
    duration = 25.0
    x = { step = 1.5708 }        # or { on_off = 1.5, hold = 5 }, { staircase = [1, 2], hold = 5 },
                                 # { prbs = [0, 1.5], hold = 1 }; each with `at` and `rest`
    held_out = false

Times are milliseconds, angles radians. A table ``[undeclared]`` with `effects`, `drives`, `correlation` and
`noise_sd` replaces bench, paths and records: see `undeclared.UndeclaredPlan`.
"""

from __future__ import annotations

import json
import os
import tempfile
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from lcopa_bayes.bench.acquisition import PAPER_BENCH, Bench, simulate
from lcopa_bayes.bench.command import Command, on_off, prbs, quiet, staircase, step
from lcopa_bayes.bench.device import PAPER_DEVICE, Device
from lcopa_bayes.bench.inversion import unsuited
from lcopa_bayes.bench.undeclared import UndeclaredPlan
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.core.files import writable_folder, write_text, writing
from lcopa_bayes.data.record import Axis, Record, save_record
from lcopa_bayes.model.path import TransferPath

_TABLES = {"campaign", "bench", "path", "record", "undeclared"}
_MEASURED = ("bench", "path", "record")
_KINDS = {"step", "on_off", "staircase", "prbs"}
_COMMAND_KEYS = _KINDS | {"at", "rest", "hold"}
_PATH_KEYS = {"response", "drive"} | {field.name for field in fields(TransferPath)}


@final
@dataclass(frozen=True, eq=False)
class Plan:
    """A campaign that can be run."""

    name: str
    seed: int
    device: Device
    bench: Bench
    records: tuple[Mapping[str, Any], ...]

    settings: ClassVar[str] = ""
    """Tables of the study file beside the records."""

    @property
    def held_out(self) -> tuple[str, ...]:
        """Names of the records not for fitting."""
        return tuple(record["name"] for record in self.records if record.get("held_out", False))

    def run(self, rng: np.random.Generator) -> tuple[Record, ...]:
        """Measure every record, in the order of the file."""
        return tuple(
            simulate(
                self.device,
                self.bench,
                _command(record, self.device, rng),
                duration=float(record["duration"]),
                name=record["name"],
                rng=rng,
            )
            for record in self.records
        )


def load_plan(path: Path) -> Plan | UndeclaredPlan:
    """Read a campaign file; InputError with everything wrong in it."""
    try:
        tables = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path}: is not valid TOML: {error}") from None
    problems = [
        f"{path}: unknown table [{key}]{nearest(key, _TABLES)}" for key in tables if key not in _TABLES
    ]
    heading = tables.get("campaign", {})
    problems += _unknown(path, "[campaign]", heading, {"name", "seed"})
    if "undeclared" in tables and not problems:
        return _undeclared(path, tables)
    bench_keys = {field.name for field in fields(Bench)}
    problems += _unknown(path, "[bench]", tables.get("bench", {}), bench_keys)
    for number, entry in enumerate(tables.get("path", []), start=1):
        problems += _unknown(path, f"[[path]] {number}", entry, _PATH_KEYS)
        problems += _missing(path, f"[[path]] {number}", entry, _PATH_KEYS)
    records = tables.get("record", [])
    if not records:
        problems.append(f"{path}: has no [[record]]; add one with `name`, `duration` and a drive")
    if problems:
        raise InputError(problems)
    device = _device(path, tables.get("path", []))
    known = {"name", "duration", "held_out"} | {axis.name for axis in device.drive_axes}
    for number, entry in enumerate(records, start=1):
        problems += _unknown(path, f"[[record]] {number}", entry, known)
        problems += _missing(path, f"[[record]] {number}", entry, {"name", "duration"})
        for axis in device.drive_axes:
            problems += _drive_problems(f"{path}: [[record]] {number}, {axis.name}", entry.get(axis.name))
    if problems:
        raise InputError(problems)
    settings = {name: getattr(PAPER_BENCH, name) for name in bench_keys} | tables.get("bench", {})
    sd = settings["noise_sd"]
    bench = Bench(**settings | {"noise_sd": tuple(sd) if isinstance(sd, list) else sd})
    return Plan(heading.get("name", path.stem), int(heading.get("seed", 0)), device, bench, tuple(records))


def _undeclared(path: Path, tables: Mapping[str, Any]) -> UndeclaredPlan:
    """A campaign with hidden effects."""
    heading, table = tables.get("campaign", {}), tables["undeclared"]
    known = {field.name for field in fields(UndeclaredPlan)} - {"name", "seed"}
    problems = _unknown(path, "[undeclared]", table, known)
    problems += [
        f"{path}: [{k}] is not used beside [undeclared]; remove it" for k in tables if k in _MEASURED
    ]
    if problems:
        raise InputError(problems)
    values: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in table.items()}
    try:
        return UndeclaredPlan(heading.get("name", path.stem), int(heading.get("seed", 0)), **values)
    except InputError as error:
        raise InputError([f"{path}: {problem}" for problem in error.problems]) from None


def _unknown(path: Path, where: str, table: Mapping[str, Any], known: set[str]) -> list[str]:
    return [f"{path}: {where}: unknown key {key!r}{nearest(key, known)}" for key in table if key not in known]


def _missing(path: Path, where: str, table: Mapping[str, Any], needed: set[str]) -> list[str]:
    return [f"{path}: {where}: has no `{key}`; add it" for key in sorted(needed) if key not in table]


def _device(path: Path, entries: list[Mapping[str, Any]]) -> Device:
    """The device of the ``[[path]]`` tables, or the paper's; a path not listed has gain 0."""
    if not entries:
        return PAPER_DEVICE
    drives = list(dict.fromkeys(entry["drive"] for entry in entries))
    responses = list(dict.fromkeys(entry["response"] for entry in entries))
    dead = TransferPath(0.0, 0.0, (1.0,), (1.0,), 1.0)
    table = [[dead for _ in drives] for _ in responses]
    for entry in entries:
        values = {key: entry[key] for key in _PATH_KEYS - {"response", "drive"}}
        values |= {"etas": tuple(entry["etas"]), "orders": tuple(entry["orders"])}
        try:
            listed = TransferPath(**values)
            if problems := unsuited(listed):
                raise InputError(problems)
        except InputError as error:
            raise InputError([f"{path}: [[path]] {problem}" for problem in error.problems]) from None
        table[responses.index(entry["response"])][drives.index(entry["drive"])] = listed
    return Device(
        tuple(tuple(row) for row in table),
        tuple(Axis(name, "rad") for name in drives),
        tuple(Axis(name, "rad") for name in responses),
        tuple(0.0 for _ in responses),
    )


def _drive_problems(where: str, entry: object) -> list[str]:
    if entry is None:
        return []
    if not isinstance(entry, dict):
        return [f"{where}: must be a table such as {{ step = 1.5 }}; got {entry!r}"]
    problems = [
        f"{where}: unknown key {key!r}{nearest(key, _COMMAND_KEYS)}"
        for key in entry
        if key not in _COMMAND_KEYS
    ]
    kinds = [key for key in entry if key in _KINDS]
    if len(kinds) != 1:
        problems.append(f"{where}: name exactly one of {', '.join(sorted(_KINDS))}; got {kinds}")
    elif kinds[0] != "step" and "hold" not in entry:
        problems.append(f"{where}: {kinds[0]} needs `hold`, the time of each level [ms]")
    return problems


def _command(record: Mapping[str, Any], device: Device, rng: np.random.Generator) -> Command:
    """Joint command of all drive axes of a record."""
    commands = [_axis_command(record.get(axis.name), record, rng) for axis in device.drive_axes]
    times = np.unique(np.concatenate([command.times for command in commands]))
    values = np.hstack([command.at(times) for command in commands])
    return Command(times, values, np.hstack([command.rest for command in commands]))


def _axis_command(
    entry: Mapping[str, Any] | None, record: Mapping[str, Any], rng: np.random.Generator
) -> Command:
    if entry is None:
        return quiet()
    at, rest = entry.get("at", 0.0), entry.get("rest", 0.0)
    if "step" in entry:
        return step(entry["step"], at=at, rest=rest)
    if "on_off" in entry:
        return on_off(entry["on_off"], hold=entry["hold"], at=at, rest=rest)
    if "staircase" in entry:
        return staircase(entry["staircase"], hold=entry["hold"], start=at, rest=rest)
    low, high = entry["prbs"]
    duration = float(record["duration"]) - at
    return prbs(low, high, hold=entry["hold"], duration=duration, rng=rng, start=at, rest=rest)


def write_campaign(
    folder: Path,
    records: Sequence[Record],
    *,
    name: str,
    seed: int,
    held_out: Sequence[str] = (),
    settings: str = "",
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write one CSV per record and a ``study.toml`` that names them; return the paths, study last.

    Parameters: `name` and `seed` of the study; `held_out`, names of records not for fitting; `settings`,
    further tables of the study file. Everything is written beside its place first and then renamed, the study
    last: a campaign cut short leaves no file half written and no new study without its records. Raises
    InputError when a file is there already (unless `overwrite`), names repeat or cannot be file names, no
    record remains to fit, or the folder or a file in it cannot be written.
    """
    names = [record.name for record in records]
    fit = [each for each in names if each not in held_out]
    targets = [folder / f"{each}.csv" for each in names] + [folder / "study.toml"]
    problems = [
        f"record name {each!r} occurs {names.count(each)} times"
        for each in sorted({*names})
        if names.count(each) > 1
    ]
    problems += [
        f"record name {each!r} cannot be a file name; use letters, digits, '-' and '_'"
        for each in names
        if not each.replace("-", "").replace("_", "").isalnum()
    ]
    if not fit:
        problems.append("no record remains to fit; hold out fewer")
    problems += [
        f"{path} is there already; choose another folder or allow to overwrite"
        for path in targets
        if path.exists() and not overwrite
    ]
    if problems:
        raise InputError(problems)
    lines = ["[study]", f"name = {json.dumps(name, ensure_ascii=False)}"]
    lines += [f'time_unit = "{records[0].time_unit}"', f"seed = {seed}", "", "[records]"]
    roles = {"fit": fit, "held_out": [each for each in names if each in held_out]}
    lines += [f"{role} = {json.dumps([f'{each}.csv' for each in own])}" for role, own in roles.items() if own]
    lines += ["", settings] if settings else []
    writable_folder(folder)
    with writing(folder), tempfile.TemporaryDirectory(prefix=".campaign-", dir=folder) as beside:
        try:
            for record, target in zip(records, targets, strict=False):
                save_record(record, Path(beside) / target.name)
            write_text(Path(beside) / "study.toml", "\n".join(lines) + "\n")
        except InputError as error:  # name the file that was wanted
            raise InputError([p.replace(beside, str(folder)) for p in error.problems]) from error
        for target in targets:
            with writing(target):
                os.replace(Path(beside) / target.name, target)
    return tuple(targets)
