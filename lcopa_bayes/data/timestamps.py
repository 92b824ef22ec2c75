"""Time stamps, times of day and elapsed times in the notations of spreadsheets and loggers, as seconds."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from itertools import product

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.data.cells import CHUNK, NAMED, CellTable, Texts

_DATES = (
    *("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d/%m/%y", "%m/%d/%y"),
    *("%d-%m-%Y", "%d-%b-%Y"),
)
_CLOCKS = ("%H:%M:%S.%f", "%H:%M", "%I:%M:%S.%f %p", "%I:%M %p")
_ZONED = "%Y-%m-%d %H:%M:%S.%f%z"
_FORMATS = (*(f"{date} {clock}" for date, clock in product(_DATES, _CLOCKS)), _ZONED, *_CLOCKS, *_DATES)
_ELAPSED = r"(\d+):([0-5]\d):([0-5]\d\.\d+)"
"""Hours, which may be more than 24, minutes and seconds."""
_DAY = 86_400.0


def seconds(table: CellTable, column: str, cells: Texts, stated: str = "") -> Vector:
    """Time stamps as seconds since the first one, (n,).

    Times of day without a date go on over midnight, elapsed ones over 24 hours. A `stated` format, as of
    `datetime.strptime`, is that of the cells as they are written. InputError where it is no format, where
    stamps have several formats, none that is known, or may have the month or the day first.
    """
    if stated:
        return _as_stated(table, column, cells, stated)
    text = pd.Series([_stamp(cell) for cell in cells])
    elapsed = [one for form in _FORMATS for one in _read(text, form)] or list(_lapsed(text))
    if not elapsed:
        share = {form: _parsed(text[:CHUNK], form).notna().mean() for form in _FORMATS}
        best = max(share, key=share.__getitem__)
        known = f"the format {best} of the others" if share[best] > 0 else "a known format"
        raise InputError(_unlike(table, column, cells, _parsed(text, best), known))
    rising = [one for one in elapsed if (np.diff(one) > 0).all()] or elapsed[:1]
    refuse_if(
        [
            f"{table.where}: the dates of {column!r} may have the day or the month first; state their format "
            "with --time-format, such as %d/%m/%Y %H:%M:%S"
        ]
        if any(not np.allclose(rising[0], other) for other in rising[1:])
        else []
    )
    return rising[0]


def _as_stated(table: CellTable, column: str, cells: Texts, form: str) -> Vector:
    """Seconds of stamps in a stated format, as they are written or with what `_stamp` adds to them."""
    raw = pd.Series([str(cell).strip() for cell in cells])
    try:
        for elapsed in _read(raw, form):
            return elapsed
        parsed = _parsed(raw, form)
    except (ValueError, re.error) as error:
        raise InputError(
            f"--time-format: {form!r} is no format of times ({error}); write one such as %d.%m.%Y %H:%M:%S"
        ) from None
    for elapsed in _read(pd.Series([_stamp(cell) for cell in raw]), form):
        return elapsed
    raise InputError(_unlike(table, column, cells, parsed, f"the stated format {form}"))


def _read(text: pd.Series[str], form: str) -> Iterator[Vector]:
    """Seconds of stamps that are all in a format; nothing of others."""
    if _parsed(text[:1], form).notna().all() and (times := _parsed(text, form)).notna().all():
        elapsed = (times - times.iloc[0]).dt.total_seconds().to_numpy(dtype=float)
        if "%d" not in form and "%j" not in form:  # over midnight
            elapsed = elapsed + _DAY * np.concatenate(([0.0], np.cumsum(np.diff(elapsed) < -0.5 * _DAY)))
        yield np.asarray(elapsed)


def _lapsed(text: pd.Series[str]) -> Iterator[Vector]:
    """Seconds of elapsed times of a day and more; nothing of other text."""
    parts = text.str.extract(f"^{_ELAPSED}$").astype(float)
    if parts.notna().all(axis=None):
        whole = parts.to_numpy() @ [3600.0, 60.0, 1.0]
        yield whole - whole[0]


def _unlike(
    table: CellTable, column: str, cells: Texts, parsed: pd.Series[pd.Timestamp], known: str
) -> list[str]:
    """What is wrong with the first stamps that are not in a known format."""
    at = table.names.index(column)
    return [
        f"{table.place(at, int(row))}: {cells[row]!r} is not a time in {known}; write all times alike, or "
        "state their format with --time-format, such as %d.%m.%Y %H:%M:%S"
        for row in np.flatnonzero(parsed.isna())[:NAMED]
    ]


def _stamp(cell: str) -> str:
    """With a space between date and time, a point before fractions, which all times to the second have."""
    text = re.sub(r"(?<=\d)T(?=\d)", " ", cell.strip()).removesuffix("Z")
    text = re.sub(r"(:\d\d:\d\d),(\d)", r"\1.\2", text)
    text = re.sub(r"(\d)\s*([AaPp][Mm])$", r"\1 \2", text)
    text = re.sub(r"(:\d\d(?:\.\d+)?)\s+([+-]\d\d:?\d\d)$", r"\1\2", text)
    return re.sub(r"(:\d\d:\d\d)(?![.\d])", r"\1.0", text)


def _parsed(text: pd.Series[str], form: str) -> pd.Series[pd.Timestamp]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return pd.to_datetime(text, format=form, errors="coerce", utc=True)
