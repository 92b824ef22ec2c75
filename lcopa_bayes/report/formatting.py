"""Numbers and names as the report prints them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from math import isfinite
from typing import Any

from lcopa_bayes.core.estimate import HALF_WIDTH

OPEN = "open"
"""An end of an interval that no draw bounds."""
NOT_REACHED = "open (not reached within the record)"
"""The same for a time that the simulated response does not reach."""
NONE = "–"  # noqa: RUF001
"""An entry that is not defined."""
_MINUS = "−"  # noqa: RUF001
_HYPHEN = re.compile(r"(?<![\w.)\]-])-(?=\.?\d)")
_POWER = re.compile(r"(?<![\w.])\d(?:\.\d+)?e[+-]?\d+(?!\w)")
_NO_SIGN = re.compile(f"{_MINUS}(0(?:\\.0*)?)(?![\\d.])")
_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")
_PLAIN_FROM, _PLAIN_TO = 1e-3, 1e6
"""Between these sizes numbers are printed without a power of ten."""


def figures(value: float | None, count: int = 3) -> str:
    """`value` to `count` significant digits; a dash when undefined."""
    if value is None or not isfinite(value):
        return NONE
    if value == 0:
        return "0"
    return _printed(value, count - 1 - _power_of_ten(value, count))


def to_spread(value: float | None, spread: float | None) -> str:
    """`value` to the place of the second significant digit of `spread`, but no fewer than two digits.

    Without a positive spread three significant digits are printed.
    """
    if value is None or not isfinite(value):
        return NONE
    if spread is None or not isfinite(spread) or spread <= 0 or (value == 0 and spread < _PLAIN_FROM):
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
    return interval(row["lower"], row["upper"], spread(row))


def spread(row: Mapping[str, Any]) -> float | None:
    """Standard deviation of the normal distribution that has this 90 % interval; None where it is open."""
    lower, upper = row["lower"], row["upper"]
    return None if lower is None or upper is None else abs(upper - lower) / (2 * HALF_WIDTH)


def percent(share: float | None, digits: int | None = None) -> str:
    """A share [-] as a percentage, in whole per cent unless to so many significant digits."""
    if share is None:
        return NONE
    return f"{figures(100 * share, digits) if digits else f'{100 * share:.0f}'} %"


def probability(p: float) -> str:
    """`p = ...` for a p-value [-]."""
    return f"p\u00a0=\u00a0{figures(p, 2)}" if p > 0 else "p below the smallest number a computer holds"


def with_error(value: float | None, error: float | None, places: int = 2, *, bare: bool = True) -> str:
    """`value ± error` to so many decimals; without an error the value alone, unless that may not stand
    `bare`."""
    if value is None or (error is None and not bare):
        return NONE
    size = max(abs(value), error or 0.0)
    if size < 0.5 * 10.0**-places:
        return figures(value, 1)
    return f"{value:.{places}f}" if error is None else f"{value:.{places}f} ± {error:.{places}f}"


def signed(text: str) -> str:
    """Text with true minus signs before its numbers, and none before a zero; powers of ten are raised."""
    return _NO_SIGN.sub(r"\1", _HYPHEN.sub(_MINUS, _POWER.sub(_raised, text)))


def _raised(found: re.Match[str]) -> str:
    """A number such as 3.5e-05 with a raised power of ten, or in full where it is of usual size."""
    mantissa, _, power = found[0].partition("e")
    if _PLAIN_FROM <= float(found[0]) < _PLAIN_TO:
        return f"{float(found[0]):g}"
    return f"{mantissa}×10{str(int(power)).translate(_RAISED)}"  # noqa: RUF001


def sentence(clause: str) -> str:
    """A clause with a capital and a full stop."""
    return stopped(f"{clause[0].upper()}{clause[1:]}")


def stopped(clause: str) -> str:
    """A clause that may begin with a name, with a full stop."""
    return clause if clause.endswith((".", ":")) else f"{clause}."


def _place(value: float) -> int:
    """Decimal places that show two significant digits."""
    return 1 - _power_of_ten(value, 2)


def _power_of_ten(value: float, count: int) -> int:
    """Of `value` rounded to `count` digits, read off its decimals: powers of ten and logarithms fail at the
    smallest and the largest numbers."""
    return int(f"{value:.{count - 1}e}".partition("e")[2])


def _printed(value: float, places: int) -> str:
    size = abs(value)
    if value != 0 and not _PLAIN_FROM <= size < _PLAIN_TO:
        below = _power_of_ten(value, 17)
        decimals = max(0, min(15, below + places))
        mantissa, _, power = f"{value:.{decimals}e}".partition("e")
        if int(power) > below:  # rounded up to the next power, whose mantissa has one decimal more
            mantissa = f"{float(mantissa):.{max(0, min(15, int(power) + places))}f}"
        text = f"{mantissa}×10{str(int(power)).translate(_RAISED)}"  # noqa: RUF001
    else:
        text = f"{round(value, places):.{max(0, places)}f}"
    return signed(text)
