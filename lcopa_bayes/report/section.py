"""Parts of a report page: sections of text, tables and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias, TypeVar

from lcopa_bayes.report.formatting import figures, percent

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
