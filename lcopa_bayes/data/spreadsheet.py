"""Tables as people save them: spreadsheets and text of any separator, encoding and decimal sign.

Everything is read as text first, with the line or row it stands in, so that a message can quote it. Above the
header there may be lines of remarks, below it a line of units.
"""

from __future__ import annotations

import csv
import datetime
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from itertools import count, zip_longest
from pathlib import Path
from zipfile import BadZipFile

from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.data.cells import TEXTS, CellTable, read_cells

WORKBOOKS = (".xlsx", ".xlsm")
"""Suffixes of spreadsheets; anything else is text."""
_SEPARATORS = ";\t,|"
_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}
_NUMBER = re.compile(r"[+-]?(\d[\d\s\u00a0\u202f.,']*|[.,]\d+)(e[+-]?\d+)?", re.IGNORECASE)
"""A number in any notation."""
_STAMP = re.compile(r"[\d./: T+-]*\d[:./-]\d[\d./: TZ+-]*([ap]m)?(\d*[.,]\d+)?", re.IGNORECASE)
"""Something like a date or a time of day."""
_SHORT = 4
"""Longest unit without brackets."""
_HEADED = 40
"""Most lines in which a header is looked for."""


def read_spreadsheet(path: Path, *, sheet: str | None = None) -> CellTable:
    """The cells of a table as text under their headers, units in brackets behind them.

    `sheet` names the sheet of a workbook, by default its only one or the first with a table. InputError when
    there is no such file or sheet, it cannot be read, or it holds no table.
    """
    path = Path(path)
    if not path.is_file():
        beside = (one.name for one in path.parent.glob("*") if one.suffix.lower() in (*WORKBOOKS, *TEXTS))
        raise InputError(f"{path}: no such file{nearest(path.name, beside)}")
    if path.suffix.lower() == ".parquet":
        return read_cells(path)
    if path.suffix.lower() in WORKBOOKS:
        return _workbook(path, sheet)
    if sheet is not None:
        raise InputError(f"{path}: is text and has no sheets; leave `sheet` out")
    return _text(path)


def _text(path: Path) -> CellTable:
    content = path.read_bytes()
    encoding = next((name for mark, name in _BYTE_ORDER_MARKS.items() if content.startswith(mark)), "utf-8")
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError:
        text = content.decode("cp1252", errors="replace")
    if "\0" in text:
        raise InputError(f"{path}: is not a text file; save the table as CSV or xlsx")
    best: tuple[int, int] = (0, 0)
    rows: list[tuple[int, list[str]]] = []
    for separator in _SEPARATORS:
        split = _split(text, separator)
        widths = Counter(len(cells) for _, cells in split if len(cells) > 1)
        width, lines = widths.most_common(1)[0] if widths else (0, 0)
        if (lines, width) > best:
            best, rows = (lines, width), split
    if not best[0]:
        raise InputError(
            f"{path}: holds no table; expected columns separated by comma, semicolon, tab or bar, below a "
            "header"
        )
    return _tabled(path, rows, best[1])


def _split(text: str, separator: str) -> list[tuple[int, list[str]]]:
    """Line numbers and cells of the lines that are not empty."""
    reader = csv.reader(text.splitlines(), delimiter=separator, skipinitialspace=True)
    try:
        lines = [(reader.line_num, [cell.strip() for cell in cells]) for cells in reader]
    except csv.Error:
        return []
    return [(number, cells) for number, cells in lines if any(cells)]


def _workbook(path: Path, sheet: str | None) -> CellTable:
    from openpyxl import load_workbook  # loaded where a workbook is read, which is rare

    try:
        values = load_workbook(path, data_only=True)
        formulas = load_workbook(path, data_only=False)
    except (OSError, KeyError, ValueError, BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as a workbook ({error}); save it as xlsx or CSV") from None
    if sheet is not None and sheet not in values.sheetnames:
        raise InputError(f"{path}: has no sheet {sheet!r}{nearest(sheet, values.sheetnames)}")
    for name in [sheet] if sheet is not None else values.sheetnames:
        page, written = values[name], formulas[name]
        if not hasattr(page, "iter_rows"):
            continue  # a chart
        rows, open_formulas = [], []
        for number, cells in enumerate(page.iter_rows(), start=1):
            texts = [_cell(cell.value) for cell in cells]
            if any(texts):
                rows.append((number, texts))
            open_formulas += [
                f"{path}, sheet {name!r}, cell {cell.coordinate}: the formula has no stored result; open and "
                "save the file in a spreadsheet program, or save values"
                for cell in cells
                if cell.value is None and str(written[cell.coordinate].value or "").startswith("=")
            ]
        refuse_if(open_formulas[:5])
        widths = Counter(len([cell for cell in cells if cell]) for _, cells in rows)
        if rows and max(widths) > 1:
            return _tabled(path, rows, max(len(cells) for _, cells in rows))
    raise InputError(f"{path}: holds no table; expected a header and rows of numbers")


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime.datetime | datetime.time):
        return value.isoformat(sep=" ") if isinstance(value, datetime.datetime) else value.isoformat()
    if isinstance(value, datetime.timedelta):
        return repr(value.total_seconds())
    return str(value).strip()


def _tabled(path: Path, rows: Sequence[tuple[int, list[str]]], width: int) -> CellTable:
    """Rows of cells below their header; what is wrong joins the problems of the table."""
    first = next((k for k, (_, cells) in enumerate(rows) if len(cells) > 1 and _holds_data(cells)), None)
    if first is None or first == 0 or first > _HEADED:
        what = "has no header" if first == 0 else "has no rows of numbers"
        raise InputError(f"{path}: {what}; expected a line of column names above the rows of numbers")
    above = [cells for _, cells in rows[:first] if any(cells)]
    units = _units(above[-1]) if len(above) > 1 and _filled(above[-2]) > 1 else None
    header = above[-2] if units else above[-1]
    if _filled(header) < 2:
        raise InputError(f"{path}, line {rows[first][0]}: no line of column names stands above the numbers")
    names = [
        f"{name} [{unit}]" if units and unit else name
        for name, unit in zip_longest(header, (units or [])[: len(header)], fillvalue="")
    ]
    used = [k for k, name in enumerate(names) if name or any(len(c) > k and c[k] for _, c in rows[first:])]
    names = _distinct([names[k] or f"column {k + 1}" for k in used])
    kept, lines, ragged = [], [], []
    for number, cells in rows[first:]:
        padded = [*cells, *[""] * (len(header) - len(cells))]
        if len([cell for cell in padded if cell]) > len(header):
            ragged.append(
                f"{path}, line {number}: has {len(cells)} cells where the header has {len(header)}; if "
                "decimals are written with commas, save the table with semicolons between its columns"
            )
            continue
        kept.append([padded[k] for k in used])
        lines.append(number)
    table = CellTable(path, names, lines, list(zip(*kept, strict=True)) if kept else [()] * len(names), [])
    table.add(ragged, str(path))
    refuse_if(table.problems)
    return table


def _holds_data(cells: Iterable[str]) -> bool:
    """Whether at least half of the filled cells are numbers or times."""
    filled = [cell for cell in cells if cell]
    data = [cell for cell in filled if _NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell)]
    return bool(data) and 2 * len(data) >= len(filled)


def _units(cells: Sequence[str]) -> list[str] | None:
    """The units in a line of units; None for another line."""
    bare = [re.sub(r"^[\[(]|[\])]$", "", cell).strip() for cell in cells]
    bracketed = all(re.fullmatch(r"[\[(].*[\])]", cell) for cell in cells if cell)
    short = _filled(cells) > 1 and all(len(one) <= _SHORT for one in bare)
    return bare if bracketed or short else None


def _filled(cells: Sequence[str]) -> int:
    return sum(map(bool, cells))


def _distinct(names: Sequence[str]) -> list[str]:
    """Names of which the repeated ones are numbered."""
    out: list[str] = []
    for name in names:
        out.append(next(one for k in count(1) if (one := name if k == 1 else f"{name} ({k})") not in out))
    return out
