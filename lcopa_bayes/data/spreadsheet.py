"""Tables as people save them: spreadsheets and text of any separator, encoding and decimal sign.

Everything is read as text first, with its line or row, so that a message can quote it. Above the
header there may be lines of remarks, below it a line of units.

Numbers and time stamps in the notations of spreadsheets.
"""

from __future__ import annotations

import csv
import datetime
import io
import re
import warnings
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import chain, count, islice, product, zip_longest
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.data.cells import TEXTS, CellTable, Texts, packed, read_cells

WORKBOOKS = (".xlsx", ".xlsm")
"""Suffixes of spreadsheets; anything else is text."""
_SEPARATORS = ";\t,|"
_BYTE_ORDER_MARKS = {b"\xff\xfe": "utf-16", b"\xfe\xff": "utf-16", b"\xef\xbb\xbf": "utf-8-sig"}
_NUMBER = re.compile(r"[+-]?(\d[\d\s\u00a0\u202f.,']*|[.,]\d+)(e[+-]?\d+)?", re.IGNORECASE)
"""A number in any notation."""
_STAMP = re.compile(r"[\d./: T+-]*\d[:./-]\d[\d./: TZ+-]*([ap]m)?(\d*[.,]\d+)?", re.IGNORECASE)
"""Something like a date or a time of day."""
_LONGEST = 100
"""Characters of the longest number, time or column name: the time of a search may grow with their square."""
_SHORT = 4
"""Longest unit without brackets."""
_WRITTEN_FORMULA = re.compile(rb"<(\w+:)?f[\s/>]")
"""A formula in a part of a workbook."""
_NAMED = 5
"""Most cells that a message names."""
_HEADED = 40
"""Most lines in which a header is looked for."""


def read_spreadsheet(path: Path, *, sheet: str | None = None) -> CellTable:
    """The cells of a table as text under their headers, units in brackets behind them.

    `sheet` names the sheet of a workbook, by default its only one or the first with a table. InputError when
    there is no such file or sheet, it cannot be read, or it holds no table.
    """
    path = Path(path)
    if path.is_dir():
        raise InputError(f"{path}: is a folder; name the tables in it, such as {path}/step.csv")
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
        encoding = "cp1252"
        text = content.decode(encoding, errors="replace")
    if "\0" in text:
        raise InputError(f"{path}: is not a text file; save the table as CSV or xlsx")
    present = [separator for separator in _SEPARATORS if separator in text]
    del text  # below, lines are decoded as they are read: all rows as objects take 300 bytes each
    best, chosen = (0, 0), ""
    for separator in present:
        try:
            widths = Counter(len(cells) for _, cells in _split(content, encoding, separator))
        except csv.Error:
            continue
        widths.pop(1, None)
        width, lines = widths.most_common(1)[0] if widths else (0, 0)
        if (lines, width) > best:
            best, chosen = (lines, width), separator
    if not chosen:
        raise InputError(
            f"{path}: holds no table; expected columns separated by comma, semicolon, tab or bar, below a "
            "header"
        )
    return _tabled(path, _split(content, encoding, chosen))


def _split(content: bytes, encoding: str, separator: str) -> Iterator[tuple[int, list[str]]]:
    """Line numbers and cells of the lines that are not empty; csv.Error where they cannot be split."""
    text = io.TextIOWrapper(io.BytesIO(content), encoding, errors="replace", newline="\n")
    lines = (line for part in text for line in part.splitlines())  # all ends of lines there are
    reader = csv.reader(lines, delimiter=separator, skipinitialspace=True)
    for row in reader:
        cells = [cell.strip() for cell in row]
        if any(cells):
            yield reader.line_num, cells


def _workbook(path: Path, sheet: str | None) -> CellTable:
    """Row by row: a million rows held as a workbook's cells take 3 GB."""
    with closing(_book(path, data_only=True)) as book:
        if sheet is not None and sheet not in book.sheetnames:
            raise InputError(f"{path}: has no sheet {sheet!r}{nearest(sheet, book.sheetnames)}")
        formulas = _has_formulas(path)
        for name in [sheet] if sheet is not None else book.sheetnames:
            if not hasattr(book[name], "iter_rows"):
                continue  # a chart
            if formulas:
                refuse_if(list(islice(_open_formulas(path, name), _NAMED)))
            texts = ((n, [_cell(cell.value) for cell in cells]) for n, cells in _rows(path, book[name]))
            rows = ((number, cells) for number, cells in texts if any(cells))
            head = list(islice(rows, _HEADED + 1))
            if max((_filled(cells) for _, cells in head), default=0) > 1:
                width = max(len(cells) for _, cells in head)  # a column may have no name
                whole = ((n, [*cells, *[""] * (width - len(cells))]) for n, cells in chain(head, rows))
                return _tabled(path, whole)
        where = f"{path}, sheet {sheet!r}" if sheet is not None else f"{path}"
        others = ", ".join(repr(name) for name in book.sheetnames if name != sheet)
    more = f"; the other sheets are {others}" if sheet is not None and others else ""
    raise InputError(f"{where}: holds no table; expected a header and rows of numbers{more}")


def _book(path: Path, *, data_only: bool) -> Any:
    """A workbook that is read where it is asked for a row; with the results of formulas, or these."""
    from openpyxl import load_workbook  # loaded where a workbook is read, which is rare

    with _sound(path):
        return load_workbook(path, data_only=data_only, read_only=True)


def _rows(path: Path, page: Any) -> Iterator[tuple[int, Sequence[Any]]]:
    """Numbers and cells of the rows of a sheet, each up to its last cell."""
    page.reset_dimensions()  # what a program states of them may be wrong
    with _sound(path):
        yield from enumerate(page.iter_rows(), start=1)


@contextmanager
def _sound(path: Path) -> Iterator[None]:
    """Within it, whatever a damaged file leads the library to becomes an InputError."""
    try:
        yield
    except Exception as error:
        raise InputError(f"{path}: cannot be read as a workbook ({error}); save it as xlsx or CSV") from None


def _has_formulas(path: Path) -> bool:
    """Whether any part of a workbook may hold a formula: to read all cells a second time takes minutes."""
    with _sound(path), ZipFile(path) as archive:
        for name in archive.namelist():
            with archive.open(name) as part:
                end = b""
                while piece := part.read(1 << 20):
                    if _WRITTEN_FORMULA.search(end + piece):
                        return True
                    end = piece[-_LONGEST:]
    return False


def _open_formulas(path: Path, name: str) -> Iterator[str]:
    """What is wrong with formulas of a sheet that have no stored result."""
    with closing(_book(path, data_only=True)) as values, closing(_book(path, data_only=False)) as written:
        both = (_rows(path, book[name]) for book in (values, written))
        for (_, cells), (_, formulas) in zip(*both, strict=True):
            for cell, formula in zip(cells, formulas, strict=True):
                if cell.value is None and str(formula.value or "").startswith("="):
                    yield (
                        f"{path}, sheet {name!r}, cell {formula.coordinate}: the formula has no stored "
                        "result; open and save the file in a spreadsheet program, or save values"
                    )


def _cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, datetime.datetime | datetime.time):
        return value.isoformat(sep=" ") if isinstance(value, datetime.datetime) else value.isoformat()
    if isinstance(value, datetime.timedelta):
        return repr(value.total_seconds())
    return str(value).strip()


def _tabled(path: Path, rows: Iterable[tuple[int, list[str]]]) -> CellTable:
    """Rows of cells below their header; what is wrong joins the problems of the table."""
    rest = iter(rows)
    head = list(islice(rest, _HEADED + 1))
    first = next((k for k, (_, cells) in enumerate(head) if len(cells) > 1 and _holds_data(cells)), None)
    if not first:
        what = "has no header" if first == 0 else "has no rows of numbers"
        raise InputError(f"{path}: {what}; expected a line of column names above the rows of numbers")
    above = [cells for _, cells in head[:first]]
    units = _units(above[-1]) if len(above) > 1 and _filled(above[-2]) > 1 else None
    header = [name[:_LONGEST] for name in (above[-2] if units else above[-1])]
    if _filled(header) < 2:
        raise InputError(f"{path}, line {head[first][0]}: there is no line of column names above the numbers")
    names = [
        f"{name} [{unit[:_LONGEST]}]" if units and unit else name
        for name, unit in zip_longest(header, (units or [])[: len(header)], fillvalue="")
    ]
    lines, ragged = array("q"), list[str]()

    def fitting() -> Iterator[list[str]]:
        for number, cells in chain(head[first:], rest):
            if _filled(cells) > len(header):
                ragged.append(
                    f"{path}, line {number}: has {len(cells)} cells where the header has {len(header)}; if "
                    "decimals are written with commas, save the table with semicolons between its columns"
                )
                continue
            lines.append(number)
            yield [*cells, *[""] * (len(header) - len(cells))][: len(header)]

    columns = packed(fitting(), len(header))
    used = [k for k, name in enumerate(names) if name or any(columns[k])]
    names = _distinct([names[k] or f"column {k + 1}" for k in used])
    if ragged and not lines:  # the same fault throughout
        ragged = [f"{ragged[0].replace(f', line {head[first][0]}', '')} (so in all {len(ragged)} rows)"]
    table = CellTable(path, names, lines, [columns[k] for k in used], [])
    table.add(ragged, str(path))
    refuse_if(table.problems)
    return table


def _holds_data(cells: Iterable[str]) -> bool:
    """Whether at least half of the filled cells are numbers or times."""
    filled = [cell for cell in cells if cell]
    short = (cell for cell in filled if len(cell) <= _LONGEST)
    data = [cell for cell in short if _NUMBER.fullmatch(cell) or _STAMP.fullmatch(cell)]
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
    """Names of which the repeated ones are numbered, before their unit."""
    out: list[str] = []
    for name in names:
        bare = re.sub(r"\s*[\[(][^\[(]*[\])]$", "", name)
        unit = name.removeprefix(bare)
        numbered = (f"{bare} ({k}){unit}" if k > 1 else name for k in count(1))
        out.append(next(one for one in numbered if one not in out))
    return out


_PLAIN = re.compile(r"[+-]?[\d.,]*\d[\d.,]*(e[+-]?\d+)?", re.IGNORECASE)
_WRITTEN = {
    sign: re.compile(
        rf"[+-]?(\d{{1,3}}(\{group}\d{{2,3}})*\{group}\d{{3}}|\d*)(\{sign}\d*)?(e[+-]?\d+)?", re.IGNORECASE
    )
    for sign, group in (".,", ",.")
}
"""Numbers by their decimal sign: the other one stands between groups of digits alone."""
_SPACES = re.compile(r"[\s\u00a0\u202f']")
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y")
_CLOCKS = ("%H:%M:%S.%f", "%H:%M", "%I:%M:%S.%f %p", "%I:%M %p")
_FORMATS = (*(f"{date} {clock}" for date, clock in product(_DATES, _CLOCKS)), *_CLOCKS, *_DATES)
_DAY = 86_400.0


def decimal_sign(table: CellTable, problems: list[str], stated: str = "") -> str:
    """The decimal sign of a table's numbers, ``.`` or ``,``; where it cannot be told, `problems` say why.

    A comma that three digits follow may separate thousands: where no other number of the table decides, the
    sign has to be stated.
    """
    if stated:
        problems += [] if stated in (".", ",") else [f"the decimal sign {stated!r} is not . or ,"]
        return stated
    cells = (_SPACES.sub("", cell) for column in table.columns for cell in column)
    first = ""
    for cell in (cell for cell in cells if "," in cell and len(cell) <= _LONGEST and _PLAIN.fullmatch(cell)):
        if "." in cell:
            return max(",.", key=cell.rfind)
        if cell.count(",") > 1:
            return "."
        if not re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", cell):
            return ","
        first = first or cell
    if first:
        problems.append(
            f"{table.path}: {first!r} may be a number of thousands or have a decimal comma; state the "
            "decimal sign with --decimal"
        )
    return "."


def numbers(cells: Texts, sign: str) -> Vector:
    """Cells as numbers with a decimal `sign`, (n,); NaN for what is no number."""
    return np.fromiter((_number(cell, sign) for cell in cells), dtype=float, count=len(cells))


def _number(cell: str, sign: str) -> float:
    text = _SPACES.sub("", cell).replace("\u2212", "-").removesuffix("%")
    if len(text) > _LONGEST or not (_PLAIN.fullmatch(text) and _WRITTEN[sign].fullmatch(text)):
        return np.nan
    text = text.replace(".", "").replace(",", ".") if sign == "," else text.replace(",", "")
    try:
        value = float(text)
    except ValueError:
        return np.nan
    return value if np.isfinite(value) else np.nan


def seconds(table: CellTable, column: str, cells: Texts, stated: str = "") -> Vector:
    """Time stamps as seconds since the first one, (n,).

    Times of day without a date go on over midnight. InputError where stamps have several formats, none that
    is known, or may have the month or the day first.
    """
    text = pd.Series([_stamp(cell) for cell in cells])
    forms = (stated,) if stated else _FORMATS
    readable = [form for form in forms if _parsed(text[:1], form).notna().all()]
    elapsed = [_elapsed(times, form) for form in readable if (times := _parsed(text, form)).notna().all()]
    if not elapsed:
        at, share = table.names.index(column), {form: _parsed(text, form).notna().mean() for form in forms}
        best = max(share, key=share.__getitem__)
        bad = np.flatnonzero(_parsed(text, best).isna())
        known = f"the format {best} of the others" if share[best] > 0 else "a known format"
        problems = [
            f"{table.place(at, int(row))}: {cells[row]!r} is not a time in {known}; write all times alike, "
            "or state their format with --time-format, such as %d.%m.%Y %H:%M:%S"
            for row in bad[:5]
        ]
        raise InputError(problems)
    rising = [one for one in elapsed if (np.diff(one) > 0).all()] or elapsed[:1]
    refuse_if(
        [
            f"{table.path}: the dates of {column!r} may have the day or the month first; state their format "
            "with --time-format, such as %d/%m/%Y %H:%M:%S"
        ]
        if any(not np.allclose(rising[0], other) for other in rising[1:])
        else []
    )
    return rising[0]


def _stamp(cell: str) -> str:
    """With a space between date and time, a point before fractions, which all times to the second have."""
    text = re.sub(r"(?<=\d)T(?=\d)", " ", cell.strip()).removesuffix("Z")
    text = re.sub(r"(:\d\d:\d\d),(\d)", r"\1.\2", text)
    text = re.sub(r"(\d)\s*([AaPp][Mm])$", r"\1 \2", text)
    return re.sub(r"(:\d\d:\d\d)(?![.\d])", r"\1.0", text)


def _parsed(text: pd.Series[str], form: str) -> pd.Series[pd.Timestamp]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pd.to_datetime(text, format=form, errors="coerce")


def _elapsed(times: pd.Series[pd.Timestamp], form: str) -> Vector:
    elapsed = (times - times.iloc[0]).dt.total_seconds().to_numpy(dtype=float)
    if "%d" not in form:  # over midnight
        elapsed = elapsed + _DAY * np.concatenate(([0.0], np.cumsum(np.diff(elapsed) < -0.5 * _DAY)))
    return np.asarray(elapsed)
