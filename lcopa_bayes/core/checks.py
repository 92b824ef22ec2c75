"""Checks of settings: each returns the problems it finds, in words for the user."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from numbers import Integral, Real
from typing import Any

from lcopa_bayes.core.errors import InputError, nearest


def is_number(value: object) -> bool:
    """Whether a value is one finite number."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer beyond the floats
        return False


def whole_number(key: str, value: object, low: int, high: int | None = None) -> list[str]:
    """Problems of a value that must be a whole number within bounds."""
    if (
        isinstance(value, Integral)
        and not isinstance(value, bool)
        and low <= int(value) <= (high or int(value))
    ):
        return []
    bounds = f"of at least {low}" if high is None else f"from {low} to {high}"
    return [f"`{key}` must be a whole number {bounds}; got {value!r}"]


def one_of(key: str, value: object, known: Iterable[str]) -> list[str]:
    """Problems of a value that must be one of the known words."""
    if isinstance(value, str) and value in known:
        return []
    hint = nearest(str(value), known).partition("; known")[0]
    return [f"`{key}` must be one of {', '.join(known)}; got {value!r}{hint}"]


def file_names(key: str, value: object) -> list[str]:
    """Problems of a value that must be a tuple of file names."""
    if isinstance(value, tuple) and all(isinstance(name, str) and name for name in value):
        return []
    return [f'`{key}` must be a list of file names, as in ["a.csv", "b.csv"]; got {value!r}']


def refuse_if(problems: list[str]) -> None:
    """Raise InputError when there are problems."""
    if problems:
        raise InputError(problems)


def rebuilt(made: Any) -> tuple[object, ...]:
    """For ``__reduce__``: make anew from the fields; a mapping proxy cannot go to another process."""

    def plain(value: object) -> object:
        return {k: plain(v) for k, v in value.items()} if isinstance(value, Mapping) else value

    return type(made), tuple(plain(getattr(made, f.name)) for f in dataclasses.fields(made))
