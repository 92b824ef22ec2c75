"""Parts of a report page: sections of text, tables and figures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, final

Kind = Literal["text", "number", "grade", "code", "interval", "prose"]
"""Cells of `text` and `number` stay on one line; those of `interval` and `prose` may wrap."""


@final
@dataclass(frozen=True)
class Column:
    """Heading of a table column and how its cells are set."""

    title: str
    kind: Kind = "text"


@final
@dataclass(frozen=True)
class Table:
    """A table of cells that are already formatted; a cell of a `grade` column is one of the three grades."""

    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""

    def __post_init__(self) -> None:
        wrong = [row for row in self.rows if len(row) != len(self.columns)]
        if wrong:
            raise ValueError(f"each row needs {len(self.columns)} cells; got {wrong[0]}")


@final
@dataclass(frozen=True)
class Drawing:
    """A figure as SVG, with the stem of its file name and its caption."""

    stem: str
    svg: str
    caption: str
    mark: str = ""
    """A word set before the caption that must not be overlooked, such as "held out"."""


@final
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
