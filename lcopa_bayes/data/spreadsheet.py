"""Tables as people save them: spreadsheets and text of any separator, encoding and decimal sign.

Everything is read as text first, with its line or row, so that a message can quote it. Above the
header there may be lines of remarks, below it a line of units.

Numbers in the notations of spreadsheets.
"""

from __future__ import annotations

import csv
import datetime
import io
import re
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, contextmanager
from itertools import chain, count, islice, zip_longest
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.data.cells import NAMED, TEXTS, CellTable, Texts, packed, read_cells

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
_FEWEST = 3
"""Columns of a table, fewest: time, drive and response."""
_HEADED = 40
"""Most lines in which a header is looked for."""


def read_spreadsheet(path: Path, *, sheet: str | None = None) -> CellTable:
    """The cells of a table as text under their headers, units in brackets behind them.

    `sheet` names the sheet of a workbook, by default the first with a table of three columns or more, else of
    two. InputError when there is no such file or sheet, it cannot be read, or it holds no table.
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
        heads = {
            name: list(islice(_texts(path, book[name]), _HEADED + 1))
            for name in ([sheet] if sheet is not None else book.sheetnames)
            if hasattr(book[name], "iter_rows")  # a chart has none
        }
        tables = [name for name, head in heads.items() if max((_filled(c) for _, c in head), default=0) > 1]
        named = (name for name in tables if _named(heads[name]) >= _FEWEST)
        name = next(named, next(iter(tables), None))
        if name is not None:
            if _has_formulas(path):
                refuse_if(list(islice(_open_formulas(path, name), NAMED)))
            width = max(len(cells) for _, cells in heads[name])  # a column may have no name
            whole = ((n, [*cells, *[""] * (width - len(cells))]) for n, cells in _texts(path, book[name]))
            return _tabled(path, whole, sheet=name if len(book.sheetnames) > 1 else "")
        where = f"{path}, sheet {sheet!r}" if sheet is not None else f"{path}"
        others = ", ".join(repr(name) for name in book.sheetnames if name != sheet)
    more = f"; the other sheets are {others}" if sheet is not None and others else ""
    raise InputError(f"{where}: holds no table; expected a header and rows of numbers{more}")


def _book(path: Path, *, data_only: bool) -> Any:
    """A workbook that is read where it is asked for a row; with the results of formulas, or these."""
    from openpyxl import load_workbook  # loaded where a workbook is read, which is rare

    with _sound(path):
        return load_workbook(path, data_only=data_only, read_only=True)


def _texts(path: Path, page: Any) -> Iterator[tuple[int, list[str]]]:
    """Numbers and texts of the rows of a sheet that are not empty."""
    texts = ((number, [_cell(cell.value) for cell in cells]) for number, cells in _rows(path, page))
    return ((number, cells) for number, cells in texts if any(cells))


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
        whole, part = divmod(value.total_seconds(), 60.0)
        return f"{int(whole // 60)}:{int(whole % 60):02}:{part:09.6f}"  # hours may be more than 24
    return str(value).strip()


def _tabled(path: Path, rows: Iterable[tuple[int, list[str]]], *, sheet: str = "") -> CellTable:
    """Rows of cells below their header; what is wrong joins the problems of the table."""
    rest = iter(rows)
    head = list(islice(rest, _HEADED + 1))
    table = CellTable(path, [], [], [], [], sheet)
    first = _first(head)
    if not first:
        what = "has no header" if first == 0 else "has no rows of numbers"
        raise InputError(f"{table.where}: {what}; expected a line of column names above the rows of numbers")
    above = [cells for _, cells in head[:first]]
    units = _units(above[-1]) if len(above) > 1 and _names(*above[-2:]) else None
    header = [name[:_LONGEST] for name in (above[-2] if units else above[-1])]
    at = f"{table.where}, {table.counted} {head[first][0]}"
    if _filled(header) < 2:
        raise InputError(f"{at}: there is no line of column names above the numbers")
    names = [
        f"{name} [{unit[:_LONGEST]}]" if units and unit else name
        for name, unit in zip_longest(header, (units or [])[: len(header)], fillvalue="")
    ]
    lines, ragged = array("q"), list[str]()

    def fitting() -> Iterator[list[str]]:
        for number, cells in chain(head[first:], rest):
            if _filled(cells) > len(header):
                ragged.append(
                    f"{table.where}, {table.counted} {number}: has {len(cells)} cells where the header has "
                    f"{len(header)}; if decimals are written with commas, save the table with semicolons "
                    "between its columns"
                )
                continue
            lines.append(number)
            yield [*cells, *[""] * (len(header) - len(cells))][: len(header)]

    columns = packed(fitting(), len(header))
    used = [k for k, name in enumerate(names) if name or any(columns[k])]
    names = _distinct([names[k] or f"column {k + 1}" for k in used])
    if ragged and not lines:  # the same fault throughout
        ragged = [f"{ragged[0].replace(at, table.where)} (so in all {len(ragged)} rows)"]
    table = CellTable(path, names, lines, [columns[k] for k in used], [], sheet)
    table.add(ragged, table.where)
    refuse_if(table.problems)
    return table


def _first(head: Sequence[tuple[int, list[str]]]) -> int | None:
    """Position of the first row of data in the head of a table, the one below its header; None without any.

    Remarks above a header may look like data: a date, or a name and a number. A header is the widest line
    above data, and wider than all such remarks.
    """
    data = [len(cells) > 1 and _holds_data(cells) for _, cells in head]
    widths = [_reach(cells) for _, cells in head]
    starts = [k for k, is_so in enumerate(data) if is_so and not (k and data[k - 1])]

    def named(k: int) -> int:
        return max((widths[j] for j in range(max(0, k - 2), k) if not data[j]), default=0)

    below = [k for k in starts[1:] if all(widths[j] < named(k) for j in range(k) if data[j])]
    return max([*starts[:1], *below], key=named, default=None)


def _named(head: Sequence[tuple[int, list[str]]]) -> int:
    """Columns that the line above the first row of data names."""
    first = _first(head)
    return max((_filled(cells) for _, cells in head[max(0, first - 2) : first]), default=0) if first else 0


def _names(names: Sequence[str], units: Sequence[str]) -> bool:
    """Whether a line names as many columns as one below it that may hold their units."""
    return _filled(names) > 1 and _reach(names) >= _reach(units)


def _reach(cells: Sequence[str]) -> int:
    """Number of cells up to the last filled one."""
    return max((k for k, cell in enumerate(cells, start=1) if cell), default=0)


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
            f"{table.where}: {first!r} may be a number of thousands or have a decimal comma; state the "
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
