"""Parts of a report page: sections of text, tables and figures.

Numbers and names as the report prints them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import floor, isfinite, log10
from typing import Any, Literal, TypeAlias, TypeVar

OPEN = "open"
"""An end of an interval that no draw bounds."""
NOT_REACHED = "open (not reached within the record)"
"""The same for a time that the simulated response does not reach."""
NONE = "–"  # noqa: RUF001
"""An entry that is not defined."""
_MINUS = "−"  # noqa: RUF001
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN_FROM, _PLAIN_TO = 1e-3, 1e6
"""Between these sizes numbers are printed without a power of ten."""


def figures(value: float | None, count: int = 3) -> str:
    """`value` to `count` significant digits; a dash when undefined."""
    if value is None or not isfinite(value):
        return NONE
    if value == 0:
        return "0"
    return _printed(value, count - 1 - floor(log10(abs(float(f"{value:.{count - 1}e}")))))


def to_spread(value: float | None, spread: float | None) -> str:
    """`value` to the place of the second significant digit of `spread`, but no fewer than two digits.

    Without a positive spread three significant digits are printed.
    """
    if value is None or not isfinite(value):
        return NONE
    if spread is None or not isfinite(spread) or spread <= 0:
        return figures(value)
    places = _place(spread)
    if value != 0 and abs(value) > 1e-6 * spread:
        places = max(places, _place(value))
    return _printed(value, places)


def interval(lower: float | None, upper: float | None, spread: float | None, *, nothing: str = OPEN) -> str:
    """`lower to upper`; an undefined side is open, and `nothing` is said when both are."""
    ends = [OPEN if end is None else to_spread(end, spread) for end in (lower, upper)]
    return nothing if lower is None and upper is None else f"{ends[0]} to {ends[1]}"


def ends(row: Mapping[str, Any]) -> str:
    """The 90 % interval of an estimate, to the digits that its width allows."""
    lower, upper = row["lower"], row["upper"]
    return interval(lower, upper, None if lower is None or upper is None else abs(upper - lower) / 3.29)


def percent(share: float | None) -> str:
    """A share [-] as a percentage."""
    return NONE if share is None else f"{100 * share:.0f} %"


def probability(p: float) -> str:
    """`p = ...` for a p-value [-]."""
    return f"p\u00a0=\u00a0{figures(p, 2)}" if p > 0 else "p below the smallest number a computer holds"


def with_error(value: float | None, error: float | None, places: int = 2, *, bare: bool = True) -> str:
    """`value ± error` to so many decimals; without an error the value alone, unless that may not stand
    `bare`."""
    if value is None or (error is None and not bare):
        return NONE
    return f"{value:.{places}f}" if error is None else f"{value:.{places}f} ± {error:.{places}f}"


def sentence(clause: str) -> str:
    """A clause with a capital and a full stop."""
    return stopped(f"{clause[0].upper()}{clause[1:]}")


def stopped(clause: str) -> str:
    """A clause that may begin with a name, with a full stop."""
    return clause if clause.endswith((".", ":")) else f"{clause}."


def _place(value: float) -> int:
    """Decimal places that show two significant digits."""
    return 1 - floor(log10(abs(float(f"{value:.1e}"))))


def _printed(value: float, places: int) -> str:
    size = abs(value)
    if value != 0 and not _PLAIN_FROM <= size < _PLAIN_TO:
        power = floor(log10(size))
        mantissa = f"{value / 10.0**power:.{max(0, min(15, power + places))}f}"
        if abs(float(mantissa)) >= 10:
            power += 1
            mantissa = f"{value / 10.0**power:.{max(0, min(15, power + places))}f}"
        text = f"{mantissa}×10{str(power).translate(_RAISED)}"  # noqa: RUF001
    else:
        text = f"{round(value, places):.{max(0, places)}f}"
    return text.replace("-", _MINUS)


Kind = Literal["text", "number", "grade", "code", "interval", "prose"]
"""Cells of `text` and `number` stay on one line; those of `interval` and `prose` may wrap."""
Row: TypeAlias = Mapping[str, Any]
"""What a row of a table is about."""
Cell: TypeAlias = str | Callable[[Row], str]
T = TypeVar("T")


@dataclass(frozen=True)
class Column:
    """Heading of a table column and how its cells are set."""

    title: str
    kind: Kind = "text"


@dataclass(frozen=True)
class Table:
    """A table of cells that are already formatted; a cell of a `grade` column is one of the three grades."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    @classmethod
    def of(cls, rows: Iterable[Row], *columns: tuple[str, Kind, Cell], caption: str = "") -> Table:
        """One row per entry of `rows`, one column per title, kind and cell.

        A cell is a key of the entry, printed to three digits in columns of numbers, or a function of it.
        """
        return cls(
            tuple(Column(title, kind) for title, kind, _ in columns),
            tuple(tuple(_cell(row, kind, cell) for _, kind, cell in columns) for row in rows),
            caption,
        )

    @classmethod
    def pairs(cls, name: str, value: str, kind: Kind, rows: Mapping[str, object]) -> Table:
        """Two columns, of the keys and of the values; titles of both and the kind of the second."""
        return cls(
            (Column(name), Column(value, kind)), tuple((str(key), str(one)) for key, one in rows.items())
        )

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.columns)]
        if wrong:
            raise ValueError(f"each row needs {len(self.columns)} cells; got {wrong[0]}")


def score_columns() -> tuple[tuple[str, Kind, Cell], ...]:
    """Columns of error and coverage of a record's axis."""
    return (
        ("RMSE", "number", "rmse"),
        ("unit", "text", "unit"),
        ("in 50 % band", "number", lambda row: percent(row["coverage_50"])),
        ("in 90 % band", "number", lambda row: percent(row["coverage_90"])),
        ("samples", "number", "samples"),
        ("offset from", "prose", "offset_from"),
    )


def _cell(row: Row, kind: Kind, cell: Cell) -> str:
    if callable(cell):
        return cell(row)
    value = row[cell]
    return figures(value) if value is None or (kind == "number" and isinstance(value, float)) else str(value)


@dataclass(frozen=True)
class Drawing:
    """A figure as SVG, with the stem of its file name and its caption."""

    stem: str
    svg: str
    caption: str
    mark: str = ""
    """A word set before the caption that must not be overlooked, such as "held out"."""


def paged(
    stem: str, names: Sequence[T], most: int, draw: Callable[[Sequence[T]], str], caption: str
) -> tuple[Drawing, ...]:
    """Figures `<stem>_01` and so on, each of up to `most` of the `names`, as `draw` gives them."""
    parts = [names[k : k + most] for k in range(0, len(names), most)]
    return tuple(Drawing(f"{stem}_{k:02d}", draw(part), caption) for k, part in enumerate(parts, start=1))


@dataclass(frozen=True)
class Section:
    """A titled part of the page, shown in the order text, figures, tables, listing."""

    title: str
    text: tuple[str, ...] = ()
    drawings: tuple[Drawing, ...] = ()
    tables: tuple[Table, ...] = ()
    listing: str = ""
    """Text shown with its own line breaks."""

    @property
    def anchor(self) -> str:
        """Name of the section inside the page."""
        return "-".join("".join(c if c.isalnum() else " " for c in self.title.lower()).split())
