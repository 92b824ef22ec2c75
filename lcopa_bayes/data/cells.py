"""A record file as cells of text, so that every bad cell can be quoted with its place."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, NoReturn, TypeAlias, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.errors import InputError, nearest

SUFFIXES = (".csv", ".parquet")
"""Kinds of record files."""
TEXTS = (".csv", ".tsv", ".txt", ".dat", ".asc")
"""Suffixes of text files that are tables."""
FORM = "time_<unit>, drive_<axis>_<unit> or response_<axis>_<unit>"
"""How columns are named."""
Texts: TypeAlias = Sequence[str] | np.ndarray[Any, Any]
"""Cells of a column, (n,), text where they are an array."""
CHUNK = 10_000
"""Rows held as lists of objects at a time: a cell takes 100 bytes there, and 16 in an array."""
NAMED = 5
"""Problems named per column, so that one shifted column does not bury the others."""


@final
@dataclass(frozen=True)
class CellTable:
    """A file as text, so that every bad cell can be quoted; `rows` are numbers of lines, or of rows."""

    path: Path
    names: list[str]
    rows: Sequence[int]
    columns: list[Texts]
    problems: list[str]
    sheet: str = ""
    """Where a workbook has several."""

    @property
    def where(self) -> str:
        """The file, and the sheet of it."""
        return f"{self.path}, sheet {self.sheet!r}" if self.sheet else f"{self.path}"

    @property
    def counted(self) -> str:
        """What `rows` are numbers of."""
        return "line" if self.path.suffix.lower() in TEXTS else "row"

    def place(self, column: int, row: int | None = None) -> str:
        """Place of a column or of one of its cells in the user's file."""
        middle = "" if row is None else f", {self.counted} {self.rows[row]}"
        return f"{self.where}{middle}, column {self.names[column]!r}"

    def add(self, problems: Sequence[str], place: str) -> None:
        """Add the first problems of a kind and the number of the others."""
        self.problems.extend(problems[:NAMED])
        if len(problems) > NAMED:
            self.problems.append(f"{place}: and {len(problems) - NAMED} more like these")


def refuse(path: Path, why: str) -> NoReturn:
    """Raise InputError about a file."""
    raise InputError(f"{path}: {why}")


def _array(cells: Sequence[str]) -> np.ndarray[Any, Any]:
    """Cells in little memory; what UTF-8 cannot write becomes a question mark."""
    try:
        return np.array(cells, dtype=np.dtypes.StringDType())
    except UnicodeEncodeError:
        return _array([cell.encode(errors="replace").decode() for cell in cells])


def packed(rows: Iterable[Sequence[str]], width: int) -> list[Texts]:
    """Columns of rows of `width` cells each."""
    rest, parts = iter(rows), [[_array([])] * width]
    while chunk := list(islice(rest, CHUNK)):
        parts.append([_array(cells) for cells in zip(*chunk, strict=True)])
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


def _csv_cells(path: Path) -> CellTable:
    lines, ragged = array("q"), list[str]()

    def rectangular(names: Sequence[str]) -> Iterator[list[str]]:
        for row in reader:
            if len(row) == len(names):
                lines.append(reader.line_num)
                yield row
            elif len(row) > 1 or "".join(row).strip():  # an empty line is no row
                what = f"has {len(row)} cell(s) where the header has {len(names)}"
                ragged.append(f"{path}, line {reader.line_num}: {what}; write every cell, even if empty")

    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file, skipinitialspace=True, strict=True)
        try:
            names = [name.strip() for name in next((row for row in reader if row), [])]
            columns = packed(rectangular(names), len(names))
        except UnicodeDecodeError:
            refuse(
                path,
                "is not UTF-8 text; save it as comma-separated UTF-8, or convert it with `lcopa-bayes new`",
            )
        except csv.Error as error:
            refuse(path, f"line {reader.line_num} is not comma-separated text ({error})")
    if not names:
        refuse(path, f"is empty; expected a header of columns {FORM}")
    if len(names) == 1 and any(separator in names[0] for separator in ";\t"):
        raise InputError(
            f"{path}, line 1: the columns are not separated by commas; `lcopa-bayes new` reads such tables"
        )
    table = CellTable(path, names, lines, columns, [])
    table.add(ragged, str(path))
    return table


def frame_cells(frame: pd.DataFrame, path: Path) -> CellTable:
    """The cells of a frame as text, called `path` in messages; rows are counted from 1."""

    def text(value: object) -> str:
        gone = value is None or value is pd.NA or (isinstance(value, float) and math.isnan(value))
        return "" if gone else str(value)  # str of a float is exact

    def column(values: pd.Series[Any]) -> Texts:
        chunks = (values.iloc[first : first + CHUNK] for first in range(0, max(1, len(values)), CHUNK))
        return np.concatenate([_array([text(v) for v in chunk.tolist()]) for chunk in chunks])

    columns = [column(frame.iloc[:, j]) for j in range(frame.shape[1])]
    return CellTable(path, [str(c) for c in frame.columns], range(1, len(frame) + 1), columns, [])


def _frame(path: Path) -> pd.DataFrame:
    try:
        return pd.read_parquet(path)
    except (LookupError, TypeError, AttributeError) as error:  # of damaged notes beside the columns
        refuse(path, f"is not sound Parquet ({type(error).__name__}: {error}); write it anew")


def read_cells(path: Path) -> CellTable:
    """The file as text; InputError when there is none or it cannot be read."""
    try:
        if not path.exists():
            beside = (f for f in path.parent.glob("[!.]*") if f.is_dir() or f.suffix.lower() in SUFFIXES)
            refuse(path, f"no such file{nearest(path.name, (f.name for f in beside))}")
        if path.suffix.lower() not in SUFFIXES or not path.is_file():
            ends = " or ".join(SUFFIXES)
            refuse(
                path, f"is not a record; expected a file ending in {ends}; `lcopa-bayes new` converts others"
            )
        return _csv_cells(path) if path.suffix.lower() == ".csv" else frame_cells(_frame(path), path)
    except InputError:
        raise
    except (OSError, ValueError, NotImplementedError) as error:
        refuse(path, f"cannot be read ({error})")
