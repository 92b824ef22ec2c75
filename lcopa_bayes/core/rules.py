"""Rules: what the value of a setting must be, declared with its type and said in words where it is not."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from numbers import Integral, Real
from types import MappingProxyType, NoneType
from typing import Any, Literal, final, get_args, get_origin, get_type_hints

from lcopa_bayes.core.errors import nearest, refuse_if


@final
@dataclass(frozen=True)
class Rule:
    """What a value must be."""

    words: str
    """Completes "must be"."""
    holds: Callable[[Any], bool]
    known: tuple[str, ...] = ()
    """Words among which the nearest to a wrong one is named."""
    each: Rule | None = None
    """What each value of a mapping must be; None: a mapping is a value like any other."""

    def problems(self, key: str, value: object) -> list[str]:
        """What is wrong with the value of `key`."""
        if self.each is not None and isinstance(value, Mapping):
            return [one for name, v in value.items() for one in self.each.problems(f"{key}.{name}", v)]
        if self.holds(value):
            return []
        hint = nearest(str(value), self.known).partition("; known")[0]
        shown = list(value) if isinstance(value, tuple) else value
        return [f"`{key}` must be {self.words}; got {shown!r}{hint}"]


def is_number(value: object) -> bool:
    """Whether a value is one finite number."""
    try:
        return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
    except OverflowError:  # an integer beyond the floats
        return False


def whole(low: int, high: int | None = None) -> Rule:
    """A whole number within bounds."""

    def holds(value: object) -> bool:
        right = isinstance(value, Integral) and not isinstance(value, bool)
        return right and low <= int(value) <= (high or int(value))  # type: ignore[call-overload]

    bounds = f"of at least {low}" if high is None else f"from {low} to {high}"
    return Rule(f"a whole number {bounds}", holds)


def word_of(*known: str) -> Rule:
    """One of the known words."""
    return Rule(f"one of {', '.join(known)}", lambda value: isinstance(value, str) and value in known, known)


def texts(words: str, mark: str = "") -> Rule:
    """A tuple of texts that hold `mark`, none of them empty."""
    return Rule(
        words,
        lambda value: isinstance(value, tuple) and all(isinstance(v, str) and v and mark in v for v in value),
    )


POSITIVE = Rule("a number above 0", lambda value: is_number(value) and value > 0)
FOLDER = Rule(
    "text fit for a folder, of at most 100 letters",  # figures and unfinished files add to it
    lambda value: (
        isinstance(value, str)
        and value.strip(" .") != ""
        and not set(value) & set("/\\\0\n")
        and len(value) <= 100
    ),
)
FLAG = Rule("true or false", lambda value: isinstance(value, bool))


@cache
def _rules(kind: type[Any]) -> dict[str, Rule]:
    """Rule of each field that has one: in its annotation, or the words of its literal type."""
    rules = {}
    for name, hint in get_type_hints(kind, include_extras=True).items():
        stated = [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Rule)]
        parts = [hint] if get_origin(hint) is Literal else get_args(hint)
        options = [one for one in parts if one is not NoneType]
        if stated or [get_origin(one) for one in options] == [Literal]:
            rules[name] = stated[0] if stated else word_of(*get_args(options[0]))
    return rules


@dataclass(frozen=True)
class Ruled:
    """A frozen dataclass that raises InputError with every value that breaks the rule of its field.

    The rule is in the annotation, ``Annotated[int, whole(1)]``; a literal type is its own. None obeys any
    rule where it is the default.
    """

    def __post_init__(self) -> None:
        problems: list[str] = []
        rules = _rules(type(self))  # type: ignore[arg-type]  # a class has a hash
        for one in dataclasses.fields(self):
            value = getattr(self, one.name)
            if one.name in rules and not (value is None and one.default is None):
                problems += rules[one.name].problems(one.name, value)
            if isinstance(value, Mapping):
                object.__setattr__(self, one.name, MappingProxyType(dict(value)))
        refuse_if(problems or self.contradictions())

    def contradictions(self) -> list[str]:
        """What is wrong with values each of which obeys its rule."""
        return []

    def __reduce__(self) -> tuple[object, ...]:
        """Made anew from the fields: a mapping proxy cannot go to another process."""
        return rebuilt(self)


def rebuilt(result: Any) -> tuple[object, ...]:
    """For ``__reduce__``: make anew from the fields; a mapping proxy cannot go to another process."""

    def plain(value: object) -> object:
        return {k: plain(v) for k, v in value.items()} if isinstance(value, Mapping) else value

    return type(result), tuple(plain(getattr(result, f.name)) for f in dataclasses.fields(result))
