"""Numbers and time stamps in the notations of spreadsheets."""

from __future__ import annotations

import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.data.cells import CellTable

_PLAIN = re.compile(r"[+-]?[\d.,]*\d[\d.,]*(e[+-]?\d+)?", re.IGNORECASE)
_SPACES = re.compile(r"[\s\u00a0\u202f']")
_DATES = ("%Y-%m-%d", "%Y/%m/%d", "%d.%m.%Y", "%d.%m.%y", "%d/%m/%Y", "%m/%d/%Y", "%d-%m-%Y")
_CLOCKS = ("%H:%M:%S.%f", "%H:%M", "%I:%M:%S.%f %p", "%I:%M %p")
_FORMATS = (*(f"{date} {clock}" for date, clock in product(_DATES, _CLOCKS)), *_CLOCKS, *_DATES)
_DAY = 86_400.0


@dataclass(frozen=True)
class Sign:
    """A decimal sign, or why it is ambiguous."""

    sign: str = "."
    problem: str = ""


def decimal_sign(table: CellTable, stated: str = "") -> Sign:
    """The decimal sign of a table's numbers, ``.`` or ``,``.

    A comma that three digits follow may separate thousands: where no other number of the table decides, the
    sign has to be stated.
    """
    if stated:
        return (
            Sign(stated)
            if stated in (".", ",")
            else Sign(problem=f"the decimal sign {stated!r} is not . or ,")
        )
    cells = (_SPACES.sub("", cell) for column in table.columns for cell in column)
    commas = [cell for cell in cells if "," in cell and _PLAIN.fullmatch(cell)]
    if not commas:
        return Sign()
    for cell in commas:
        if "." in cell:
            return Sign(max(",.", key=cell.rfind))
        if cell.count(",") > 1:
            return Sign(".")
        if not re.fullmatch(r"[+-]?[1-9]\d{0,2},\d{3}", cell):
            return Sign(",")
    return Sign(
        problem=f"{table.path}: {commas[0]!r} may be a number of thousands or have a decimal comma; state "
        "the decimal sign with --decimal"
    )


def numbers(cells: Sequence[str], sign: str) -> Vector:
    """Cells as numbers with a decimal `sign`, (n,); NaN for what is no number."""
    return np.array([_number(cell, sign) for cell in cells])


def _number(cell: str, sign: str) -> float:
    text = _SPACES.sub("", cell).replace("\u2212", "-").removesuffix("%")
    if not _PLAIN.fullmatch(text):
        return np.nan
    text = text.replace(".", "").replace(",", ".") if sign == "," else text.replace(",", "")
    try:
        value = float(text)
    except ValueError:
        return np.nan
    return value if np.isfinite(value) else np.nan


def seconds(table: CellTable, column: str, cells: Sequence[str], stated: str = "") -> Vector:
    """Time stamps as seconds since the first one, (n,).

    Times of day without a date go on over midnight. InputError where stamps have several formats, none that
    is known, or may have the month or the day first.
    """
    text = pd.Series([_stamp(cell) for cell in cells])
    parsed = {form: _parsed(text, form) for form in ([stated] if stated else _FORMATS)}
    share = {form: float(values.notna().mean()) for form, values in parsed.items()}
    best = max(share, key=lambda form: share[form])
    at = table.names.index(column)
    if share[best] < 1.0:
        bad = np.flatnonzero(parsed[best].isna())
        known = f"the format {best} of the others" if share[best] > 0 else "a known format"
        problems = [
            f"{table.place(at, int(row))}: {cells[row]!r} is not a time in {known}; write all times alike, "
            "or state their format with --time-format, such as %d.%m.%Y %H:%M:%S"
            for row in bad[:5]
        ]
        raise InputError(problems)
    elapsed = [_elapsed(parsed[form], form) for form in parsed if share[form] == 1.0]
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
