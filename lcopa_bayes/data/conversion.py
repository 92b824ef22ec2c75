"""Records from tables of free headers: which column is time, which is driven, which responds.

What is not stated is decided by the words of the headers and then by the data: a drive is piecewise constant,
a response is not. Every decision is returned as a sentence, so that a reader can object.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.core.units import TIME_UNITS
from lcopa_bayes.data.cells import CellTable
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.spreadsheet import decimal_sign, numbers
from lcopa_bayes.data.timestamps import seconds

_TIME = re.compile(
    r"(?<![a-z])(time|times|timestamp|date|datetime|datum|zeit|uhrzeit|elapsed|clock|temps|tiempo|tempo|t)(?![a-z\d])"
)
_DRIVE = re.compile(
    r"(?<![a-z])(drive|driven|command|commanded|cmd|set ?point|input|stimulus|heater|heating|pwm|duty|valve"
    r"|u\d*|excitation|stellgr(ö|oe)(ß|ss)e|sollwert|eingang)(?![a-z])|^in ?\d*$"
)
_RESPONSE = re.compile(
    r"(?<![a-z])(response|output|measured|measurement|sensor|temp|temperature|temperatur|position|angle|y\d*"
    r"|istwert|ausgang)(?![a-z])|^out ?\d*$"
)
_UNIT_OF_TIME: Mapping[str, str] = {
    **{unit: unit for unit in TIME_UNITS},
    **dict.fromkeys(("µs", "μs", "usec", "microseconds"), "us"),
    **dict.fromkeys(("msec", "millisecond", "milliseconds"), "ms"),
    **dict.fromkeys(("sec", "secs", "second", "seconds", "sekunden"), "s"),
    **dict.fromkeys(("mins", "minute", "minutes", "minuten"), "min"),
    **dict.fromkeys(("hr", "hrs", "hour", "hours", "std", "stunden"), "h"),
}
_LONGEST = 100
"""Characters of a header in which a unit is looked for."""
_HELD = 0.1
"""Share of rows at which a piecewise constant column changes, at most [-]."""
_LEVELS = 5
"""Levels that make a rarely changing column a drive whatever its jumps [-]."""
_QUANTA = 2.0
"""Median jump over the smallest above which jumps are no quanta of a sensor [-]."""
_MIDNIGHT = " 00:00:00"
"""What workbooks and data bases add to a date without a time of day."""
UNKNOWN = "-"
"""Unit of a column whose header names none."""


@final
@dataclass(frozen=True)
class Mapped:
    """Columns as a user names them, by header, by header without its unit or by number, each perhaps behind a
    new name, as in ``heater [%]=Column B``; empty: recognised from the tables."""

    time: str = ""
    drives: tuple[str, ...] = ()
    responses: tuple[str, ...] = ()
    time_unit: str = ""
    """Unit of a numeric time column whose header names none."""
    decimal: str = ""
    """Decimal sign, ``.`` or ``,``; empty: recognised from the numbers."""
    time_format: str = ""
    """Format of time stamps, as of `datetime.strptime`; empty: recognised from them."""
    until: bool = False
    """Whether the drive of a row is that which acted until it, and not that from it on."""


@final
@dataclass(frozen=True)
class _Column:
    """A header: its words, its unit, and how its cells read in every table."""

    header: str
    axis: Axis
    values: tuple[Vector, ...]
    """Numbers by table, NaN for what is none."""

    @property
    def numeric(self) -> bool:
        """Whether most filled cells of every table are numbers."""
        return all(np.isfinite(one).any() for one in self.values)

    @property
    def moves(self) -> bool:
        """Whether it takes more than one value in any table."""
        return any(np.unique(one[np.isfinite(one)]).size > 1 for one in self.values)

    @property
    def piecewise(self) -> bool:
        """Whether it is constant but for few jumps that are no quanta of a sensor's reading."""
        filled = [one[np.isfinite(one)] for one in self.values]
        jumps = np.concatenate([np.diff(one) for one in filled])
        size = np.abs(jumps[jumps != 0])
        if jumps.size == 0 or size.size > _HELD * jumps.size:
            return False
        levels = np.unique(np.concatenate(filled)).size
        return bool(levels <= _LEVELS or np.median(size) > _QUANTA * size.min())


@np.errstate(over="ignore")  # differences of numbers of 1e308 are infinite, and only compared
def convert(tables: Sequence[CellTable], mapped: Mapped) -> tuple[list[Record], list[str]]:
    """Records of tables that share their headers, one each, and in a sentence each what was taken for what.

    InputError with everything that is ambiguous, absent or unreadable, and what to state.
    """
    records: list[Record] = []
    notes: list[str] = []
    shared = [name for name in tables[0].names if all(name in t.names for t in tables)]
    if not shared:
        raise InputError(
            f"{tables[0].path} and {tables[-1].path} have no header in common; convert them one by one"
        )
    problems: list[str] = []
    notes += [f"{t.path.name}: sheet {t.sheet!r} is read; --sheet names another." for t in tables if t.sheet]
    signs = [decimal_sign(table, problems, mapped.decimal) for table in tables]
    refuse_if(problems)
    columns = {
        name: _Column(
            name,
            axis_of(name),
            tuple(
                numbers(table.columns[table.names.index(name)], sign)
                for table, sign in zip(tables, signs, strict=True)
            ),
        )
        for name in shared
    }
    time, times, unit = _time(tables, columns, mapped, notes)
    left = {name: one for name, one in columns.items() if name not in time}
    drives, responses = _roles(tables[0], left, mapped, notes)
    for k, table in enumerate(tables):
        late = np.flatnonzero(np.diff(times[k]) <= 0).tolist()
        rule = "the time does not come after that of the row before; sort the rows, and keep one of two alike"
        at = table.names.index(time[0])
        table.add([f"{table.place(at, row + 1)}: {rule}" for row in late], table.where)
        for axis_name, name in (*drives.items(), *responses.items()):
            _unreadable(table, name, columns[name].values[k], axis_name.name)
        problems += table.problems
    refuse_if(problems)
    for k, table in enumerate(tables):
        held = [_held(columns[name].values[k]) for name in drives.values()]
        first = [name for name, one in zip(drives.values(), held, strict=True) if np.isnan(one[0])]
        if first:
            problems.append(
                f"{table.where}: the first row has no value of the drive {first[0]!r}; fill it in"
            )
            continue
        if any(np.isnan(columns[name].values[k]).any() for name in drives.values()):
            notes.append(f"{table.path.name}: an empty cell of a drive holds the value above it.")
        if mapped.until:
            held = [np.append(one[1:], one[-1]) for one in held]
        measured = np.column_stack([columns[name].values[k] for name in responses.values()])
        records.append(
            Record(
                table.path.stem, times[k], np.column_stack(held), measured, (*drives,), (*responses,), unit
            )
        )
    refuse_if(problems)
    if mapped.until:
        notes.append("A drive acts until its row: every value stands one row earlier in the records.")
    return records, notes


def axis_of(header: str) -> Axis:
    """Name and unit of a header: ``Heater [%]``, ``T1 (°C)``, ``valve %``, ``p in bar``, ``force / N``."""
    pattern = (
        r"^(?P<name>.*?)\s*(?:\[(?P<a>[^\]]*)\]|\((?P<b>[^)]*)\)|\s+in\s+(?P<c>\S+)|\s*/\s*(?P<d>\S+)"
        r"|\s+(?P<e>%|°\s?\w+))$"
    )
    match = re.match(pattern, header.strip()[:_LONGEST])
    name, unit = header, ""
    if match and match["name"].strip():
        name, unit = match["name"], next((text for text in match.groups()[1:] if text), "")
    words = re.sub(r"\W+", "_", name.strip()).strip("_")
    return Axis(words or "column", re.sub(r"[\s_]+", "", unit) or UNKNOWN)


def resolved(wanted: str, names: Sequence[str]) -> str | None:
    """The header that `wanted` means: itself, without unit or case, or by its number from 1."""
    plain = {name: name.casefold().strip() for name in names}
    for match in (
        [name for name in names if name == wanted],
        [name for name in names if plain[name] == wanted.casefold().strip()],
        [name for name in names if axis_of(name).name.casefold() == axis_of(wanted).name.casefold()],
    ):
        if len(match) == 1:
            return match[0]
    return names[int(wanted) - 1] if wanted.isdigit() and 0 < int(wanted) <= len(names) else None


def _time(
    tables: Sequence[CellTable], columns: Mapping[str, _Column], mapped: Mapped, notes: list[str]
) -> tuple[tuple[str, ...], list[Vector], str]:
    """Headers of the time, times of every table and their unit."""
    names = _time_columns(tables, columns, mapped)
    column = columns[names[0]]
    if len(names) == 1 and column.numeric and not mapped.time_format:
        for table, values in zip(tables, column.values, strict=True):
            _unreadable(table, names[0], values, "time", empty=True)
        unit = _UNIT_OF_TIME.get(column.axis.unit.lower(), mapped.time_unit)
        last = column.axis.name.rpartition("_")[2].lower()
        unit = mapped.time_unit or unit or _UNIT_OF_TIME.get(last, "")
        if unit not in TIME_UNITS:
            given = unit or (column.axis.unit if column.axis.unit != UNKNOWN else "")
            raise InputError(
                f"{tables[0].where}: the time column {names[0]!r} "
                + (f"is in {given!r}, which is not known" if given else "has no unit")
                + f"; state it with --time-unit, one of {', '.join(TIME_UNITS)}"
            )
        notes.append(f"{names[0]!r} is the time, in {unit}.")
        return names, list(column.values), unit
    times = []
    for table in tables:
        cells, *more = (table.columns[table.names.index(name)] for name in names)
        joined = [" ".join(both) for both in zip(map(_day, cells), *more, strict=True)] if more else cells
        times.append(seconds(table, names[0], joined, mapped.time_format))
    said = " and ".join(repr(name) for name in names)
    notes.append(f"The time is that of {said}, counted in s from the first row of each table.")
    return names, times, "s"


def _time_columns(
    tables: Sequence[CellTable], columns: Mapping[str, _Column], mapped: Mapped
) -> tuple[str, ...]:
    where = tables[0].where
    if mapped.time:
        name = resolved(mapped.time, list(columns))
        if name is None:
            raise InputError(f"{where}: has no column {mapped.time!r}{nearest(mapped.time, columns)}")
        return (name,)
    texts = [name for name, column in columns.items() if not column.numeric]

    def stamped(name: str, pattern: str) -> bool:
        cells = (cell for t in tables for cell in t.columns[t.names.index(name)] if cell)
        matches = (bool(re.fullmatch(pattern, cell, re.IGNORECASE)) for cell in cells)
        return next(matches, False) and all(matches)

    dates = [name for name in texts if stamped(name, rf"\d+[./-]\d+[./-]\d+({_MIDNIGHT})?")]
    clocks = [name for name in texts if stamped(name, r"\d+:\d+(:\d+([.,]\d+)?)?(\s*[ap]m)?")]
    if len(dates) == len(clocks) == 1:
        return dates[0], clocks[0]
    rising = [
        name
        for name, column in columns.items()
        if (column.numeric and all((np.diff(one) > 0).all() for one in column.values))
        or (name in texts and stamped(name, r"\d+[./:-]\d+.*"))
    ]
    named = [name for name, column in columns.items() if _called_time(column.axis)]
    alone = named if len(named) == 1 else []
    both = [name for name in named if name in rising] or alone or rising or named
    if len(both) != 1:
        what = "may hold the time: " + ", ".join(map(repr, both)) if both else "increases from row to row"
        raise InputError(
            f"{where}: {'several columns' if both else 'no column'} {what}; name it with --time, one of "
            + ", ".join(repr(name) for name in columns)
        )
    return (both[0],)


def _day(cell: str) -> str:
    return cell.removesuffix(_MIDNIGHT)


def _called_time(axis: Axis) -> bool:
    # T may be a temperature
    known = len(axis.name) > 1 or axis.unit == UNKNOWN or axis.unit.lower() in _UNIT_OF_TIME
    return known and bool(_TIME.search(axis.name.replace("_", " ").lower()))


def _roles(
    table: CellTable, columns: Mapping[str, _Column], mapped: Mapped, notes: list[str]
) -> tuple[dict[Axis, str], dict[Axis, str]]:
    """Headers of drives and responses by their axes."""
    problems: list[str] = []
    stated = {
        role: _stated(table, role, given, columns, problems)
        for role, given in (("drive", mapped.drives), ("response", mapped.responses))
    }
    refuse_if(problems)
    taken = [name for each in stated.values() for name in each.values()]
    roles: dict[str, dict[Axis, str]] = {role: dict(each) for role, each in stated.items()}
    for name, column in columns.items():
        if name in taken or (stated["drive"] and stated["response"]):
            continue
        if not column.numeric:
            notes.append(f"{name!r} holds no numbers and is left out.")
        elif not column.moves:
            notes.append(f"{name!r} is constant and is left out.")
        else:
            role, why = _role(column)
            if stated[role]:  # what is stated of a role is all of it
                notes.append(f"{name!r} is left out: the {role}s are stated.")
                continue
            if not _taken(table, role, column.axis, name, roles[role], problems):
                roles[role][column.axis] = name
                notes.append(f"{name!r} is a {role}, in {column.axis.unit} ({why}).")
    lacking = [role for role, each in roles.items() if not each]
    usable = [name for name, column in columns.items() if column.numeric and column.moves]
    free = [name for name in usable if name not in taken]
    known = f"only {usable[0]!r} holds" if len(usable) == 1 else "no other column holds"
    for role in lacking:
        remedy = f"name one with --{role}, one of {', '.join(map(repr, free))}"
        if len(usable) < 2 or not free:
            needed = "a record needs a drive that changes, and its response"
            remedy = f"besides the time {known} numbers that change; {needed}"
        problems.append(f"{table.where}: no column is recognised as a {role}; {remedy}")
    refuse_if(problems)
    return roles["drive"], roles["response"]


def _role(column: _Column) -> tuple[str, str]:
    """Whether a column is a drive or a response, and why."""
    words = column.axis.name.replace("_", " ").lower()
    driven, measured = bool(_DRIVE.search(words)), bool(_RESPONSE.search(words))
    if driven != measured:
        return ("drive" if driven else "response"), "by its name"
    return ("drive", "it is constant but for few jumps") if column.piecewise else ("response", "it varies")


def _stated(
    table: CellTable, role: str, given: Sequence[str], columns: Mapping[str, _Column], problems: list[str]
) -> dict[Axis, str]:
    out: dict[Axis, str] = {}
    for one in given:
        wanted, equals, column = one.rpartition("=")
        name = resolved(column, list(columns))
        if name is None:
            problems.append(f"{table.where}: has no column {column!r}{nearest(column, columns)}")
            continue
        axis = axis_of(wanted) if equals else columns[name].axis
        unit = axis.unit if axis.unit != UNKNOWN else columns[name].axis.unit
        if not columns[name].numeric:
            problems.append(f"{table.where}: the column {name!r} holds no numbers")
        if not _taken(table, role, axis, name, out, problems):
            out[Axis(axis.name, unit)] = name
    return out


def _taken(
    table: CellTable, role: str, axis: Axis, name: str, own: Mapping[Axis, str], problems: list[str]
) -> bool:
    """Whether another column of a role has the name of this axis; then `problems` say so."""
    other = next((header for known, header in own.items() if known.name == axis.name), "")
    if other:
        problems.append(
            f"{table.where}: the columns {other!r} and {name!r} would both be the {role} {axis.name!r}; give "
            f"one another name, such as --{role} {other!r} '{axis.name}_2={name}', or state one alone"
        )
    return bool(other)


def _unreadable(table: CellTable, name: str, values: Vector, called: str, *, empty: bool = False) -> None:
    """Add cells that are neither numbers nor, unless `empty` is refused, empty to the problems of a table."""
    column = table.names.index(name)
    cells = table.columns[column]
    remedy = "write a number in every row" if empty else "write a number as in the other rows, or nothing"
    gone = ("", "nan", "na", "n/a", "#n/a", "null", "none", "-", "--")
    bad = [
        f"{table.place(column, row)}: {cells[row]!r} is not a number of {called}; {remedy}"
        for row in np.flatnonzero(~np.isfinite(values)).tolist()
        if empty or cells[row].lower() not in gone
    ]
    table.add(bad, table.place(column))


def _held(values: Vector) -> Vector:
    """Empty cells hold the value above them."""
    at = np.maximum.accumulate(np.where(np.isfinite(values), np.arange(values.size), 0))
    return np.asarray(values[at])
