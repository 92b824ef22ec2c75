"""Campaign files: what the virtual bench is to measure, as TOML, and the folder of what it measured.

    [campaign]
    name = "paper-step"
    seed = 7
    [bench]                      # defaults: the paper's bench
    noise_sd = 1.8e-4
    logged = false               # true: changes of the drive are written with the next sample
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

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, ClassVar, final

import numpy as np

from lcopa_bayes.bench.command import Command, joint, on_off, prbs, quiet, staircase, step
from lcopa_bayes.bench.device import PAPER_BENCH, PAPER_DEVICE, Bench, Device, simulate
from lcopa_bayes.bench.inversion import unsuited
from lcopa_bayes.bench.undeclared import UndeclaredPlan
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.core.files import read_tables
from lcopa_bayes.core.rules import FLAG, Rule, is_number, whole
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.model.path import TransferPath

_TEXT = Rule("text", lambda value: isinstance(value, str) and value != "")
_NUMBER = Rule("a number", is_number)
_NUMBERS = Rule("a list of numbers", lambda value: isinstance(value, list) and all(map(is_number, value)))
_PAIR = Rule("a list of two numbers", lambda value: _NUMBERS.holds(value) and len(value) == 2)
_EITHER = Rule("a number or a list of numbers", lambda value: is_number(value) or _NUMBERS.holds(value))
_TEXTS = Rule("a list of texts", lambda value: isinstance(value, list) and all(map(_TEXT.holds, value)))
_HEADING = {"name": _TEXT, "seed": whole(0)}
_BENCH = {field.name: _NUMBER for field in fields(Bench)} | {"noise_sd": _EITHER, "logged": FLAG}
_PATH = {
    **{"response": _TEXT, "drive": _TEXT, "gain": _NUMBER, "delay": _NUMBER},
    **{"etas": _NUMBERS, "orders": _NUMBERS, "stiffness": _NUMBER},
}
_RECORD = {"name": _TEXT, "duration": _NUMBER, "held_out": FLAG}
_KINDS = {"step": _NUMBER, "on_off": _NUMBER, "staircase": _NUMBERS, "prbs": _PAIR}
_DRIVE = {**_KINDS, "at": _NUMBER, "rest": _NUMBER, "hold": _NUMBER}
_TABLE = Rule("a table such as { step = 1.5 }", lambda value: isinstance(value, dict))
_UNDECLARED = {"effects": _TEXTS, "drives": _TEXT, "correlation": _NUMBER, "noise_sd": _NUMBER}
_TABLES = {"campaign", "bench", "path", "record", "undeclared"}


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
    tables, problems = read_tables(path, _TABLES)
    heading = tables.get("campaign", {})
    problems += _wrong(f"{path}: [campaign]", heading, _HEADING)
    problems += [
        f"{path}: write each {name} as a table [[{name}]]"
        for name in ("path", "record")
        if not isinstance(tables.get(name, []), list)
    ]
    refuse_if(problems)
    name, seed = heading.get("name", path.stem), heading.get("seed", 0)
    if "undeclared" in tables:
        return _undeclared(path, tables, name, seed)
    settings, paths, records = tables.get("bench", {}), tables.get("path", []), tables.get("record", [])
    problems += _wrong(f"{path}: [bench]", settings, _BENCH)
    for number, entry in enumerate(paths, start=1):
        problems += _wrong(f"{path}: [[path]] {number}", entry, _PATH, _PATH)
    if not records:
        problems.append(f"{path}: has no [[record]]; add one with `name`, `duration` and a drive")
    refuse_if(problems)
    with _about(path):
        bench = replace(PAPER_BENCH, **_tuples(settings))
    device = _device(path, paths)
    known = _RECORD | {axis.name: _TABLE for axis in device.drive_axes}
    for number, entry in enumerate(records, start=1):
        where = f"{path}: [[record]] {number}"
        problems += _wrong(where, entry, known, ("name", "duration"))
        for axis in device.drive_axes:
            if isinstance(entry, dict) and isinstance(entry.get(axis.name), dict):
                problems += _wrong_drive(f"{where}, {axis.name}", entry[axis.name])
    refuse_if(problems)
    return Plan(name, seed, device, bench, tuple(records))


def _undeclared(path: Path, tables: Mapping[str, Any], name: str, seed: int) -> UndeclaredPlan:
    """A campaign with hidden effects."""
    problems = _wrong(f"{path}: [undeclared]", tables["undeclared"], _UNDECLARED)
    problems += [
        f"{path}: [{key}] is not used beside [undeclared]; remove it"
        for key in ("bench", "path", "record")
        if key in tables
    ]
    refuse_if(problems)
    with _about(path):
        return UndeclaredPlan(name, seed, **_tuples(tables["undeclared"]))


def _wrong(where: str, table: object, rules: Mapping[str, Rule], needed: Iterable[str] = ()) -> list[str]:
    """Everything wrong in a table: unknown keys, keys that it needs, values that break their rule."""
    if not isinstance(table, dict):
        return [f"{where}: must be a table; got {table!r}"]
    problems = [f"unknown key {key!r}{nearest(key, rules)}" for key in table if key not in rules]
    problems += [f"has no `{key}`; add it" for key in sorted(needed) if key not in table]
    for key in [key for key in table if key in rules]:
        problems += rules[key].problems(key, table[key])
    return [f"{where}: {problem}" for problem in problems]


def _wrong_drive(where: str, entry: Mapping[str, Any]) -> list[str]:
    """Everything wrong in the drive of one axis."""
    problems, kinds = _wrong(where, entry, _DRIVE), [key for key in entry if key in _KINDS]
    if len(kinds) != 1:
        problems.append(f"{where}: name exactly one of {', '.join(sorted(_KINDS))}; got {kinds}")
    elif kinds[0] != "step" and "hold" not in entry:
        problems.append(f"{where}: {kinds[0]} needs `hold`, the time of each level [ms]")
    return problems


def _tuples(table: Mapping[str, Any]) -> dict[str, Any]:
    """The table with lists as tuples."""
    return {key: tuple(value) if isinstance(value, list) else value for key, value in table.items()}


@contextmanager
def _about(path: Path, where: str = "") -> Iterator[None]:
    """Within it, InputErrors name the file."""
    try:
        yield
    except InputError as error:
        raise InputError([f"{path}: {where}{problem}" for problem in error.problems]) from None


def _device(path: Path, entries: list[Mapping[str, Any]]) -> Device:
    """The device of the ``[[path]]`` tables, or the paper's; a path not listed has gain 0."""
    if not entries:
        return PAPER_DEVICE
    drives = list(dict.fromkeys(entry["drive"] for entry in entries))
    responses = list(dict.fromkeys(entry["response"] for entry in entries))
    dead = TransferPath(0.0, 0.0, (1.0,), (1.0,), 1.0)
    table = [[dead for _ in drives] for _ in responses]
    for entry in entries:
        values = _tuples(entry)
        drive, response = values.pop("drive"), values.pop("response")
        with _about(path, "[[path]] "):
            listed = TransferPath(**values)
            if problems := unsuited(listed):
                raise InputError(problems)
        table[responses.index(response)][drives.index(drive)] = listed
    return Device(
        tuple(tuple(row) for row in table),
        tuple(Axis(name, "rad") for name in drives),
        tuple(Axis(name, "rad") for name in responses),
        tuple(0.0 for _ in responses),
    )


def _command(record: Mapping[str, Any], device: Device, rng: np.random.Generator) -> Command:
    """Joint command of all drive axes of a record."""
    return joint(*(_axis_command(record.get(axis.name), record, rng) for axis in device.drive_axes))


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
