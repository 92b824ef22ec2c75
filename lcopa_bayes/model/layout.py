"""Which paths a plant has, and which of them share an element or a delay."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.core.units import per
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings


@final
class ElementSlot(NamedTuple):
    """An element that one or several paths use."""

    name: str
    """Empty when the plant has one element."""
    terms: int
    """Number of viscous terms."""


@final
class Unit(NamedTuple):
    """Response of an element to one delayed drive, before any gain."""

    element: int
    delay: int
    drive: int


@final
class PathSlot(NamedTuple):
    """A path from a drive to a response."""

    response: int
    drive: int
    name: str
    """``<response>_<drive>``, or the response's name when the plant has one path."""
    unit: str
    """Of its gain [response unit per drive unit]."""


@final
@dataclass(frozen=True)
class Layout:
    """Axes of a plant and the slots its paths take their element and delay from."""

    drives: tuple[Axis, ...]
    responses: tuple[Axis, ...]
    elements: tuple[ElementSlot, ...]
    element_of: tuple[tuple[int, ...], ...]
    """Element of each path, [response][drive]."""
    delays: tuple[str, ...]
    """Name of each delay slot; empty when there is one."""
    delay_of: tuple[tuple[int, ...], ...]
    """Delay of each path, [response][drive]."""

    @classmethod
    def of(cls, drives: Sequence[Axis], responses: Sequence[Axis], model: ModelSettings) -> Layout:
        """From axes and the `share`, `delay` and `terms` settings; InputError when they disagree.

        `share = "paper"`: direct paths (same axis, or same position when no axis name is both drive
        and response) have one element, cross paths another (Ta et al. 2026, Eq. 65).
        """
        model = model.for_plant(len(drives), len(responses))
        share, delay = str(model.share), str(model.delay)
        by_share = _slots(drives, responses, share)
        by_delay = _slots(drives, responses, {"shared": "all", "element": share, "path": "none"}[delay])
        names = _distinct(by_share)
        terms = _terms(names, model)
        delay_names = _distinct(by_delay)
        return cls(
            drives=tuple(drives),
            responses=tuple(responses),
            elements=tuple(ElementSlot(name, count) for name, count in zip(names, terms, strict=True)),
            element_of=tuple(tuple(names.index(name) for name in row) for row in by_share),
            delays=delay_names,
            delay_of=tuple(tuple(delay_names.index(name) for name in row) for row in by_delay),
        )

    @cached_property
    def terms(self) -> dict[str, int]:
        """Number of viscous terms of each element [-], by its name."""
        return {slot.name: slot.terms for slot in self.elements}

    @cached_property
    def units(self) -> tuple[Unit, ...]:
        """Distinct responses that the paths scale by their gains."""
        return tuple(dict.fromkeys(unit for row in self._unit_table for unit in row))

    @cached_property
    def unit_of(self) -> tuple[tuple[int, ...], ...]:
        """Index into `units` of each path, [response][drive]."""
        return tuple(tuple(self.units.index(unit) for unit in row) for row in self._unit_table)

    @cached_property
    def _unit_table(self) -> list[list[Unit]]:
        return [
            [Unit(self.element_of[i][j], self.delay_of[i][j], j) for j in range(len(self.drives))]
            for i in range(len(self.responses))
        ]

    @cached_property
    def paths(self) -> tuple[PathSlot, ...]:
        """All paths, by response and drive."""
        return tuple(
            PathSlot(i, j, self.path_name(i, j) or response.name, per(response.unit, drive.unit))
            for i, response in enumerate(self.responses)
            for j, drive in enumerate(self.drives)
        )

    def own_response(self, drive: int) -> int | None:
        """The response axis that a drive is meant to move; None when there is none."""
        own = [row[drive] for row in _direct(self.drives, self.responses)]
        return own.index(True) if any(own) else None

    def path_name(self, response: int, drive: int) -> str:
        """`<response>_<drive>`, or nothing when the plant has one path."""
        if len(self.drives) == len(self.responses) == 1:
            return ""
        return f"{self.responses[response].name}_{self.drives[drive].name}"

    def response_name(self, response: int) -> str:
        """Name of the response axis, or nothing when there is one."""
        return self.responses[response].name if len(self.responses) > 1 else ""


def _direct(drives: Sequence[Axis], responses: Sequence[Axis]) -> list[list[bool]]:
    """Whether a path leads from an axis to itself, [response][drive]: by name, or by position when no axis
    name is both drive and response."""
    shared = {axis.name for axis in drives} & {axis.name for axis in responses}
    return [
        [response.name == drive.name if shared else i == j for j, drive in enumerate(drives)]
        for i, response in enumerate(responses)
    ]


def _slots(drives: Sequence[Axis], responses: Sequence[Axis], share: str) -> list[list[str]]:
    """Slot name of each path, [response][drive]."""
    if share == "all" or len(drives) == len(responses) == 1:
        return [["" for _ in drives] for _ in responses]
    if share == "none":
        return [[f"{response.name}_{drive.name}" for drive in drives] for response in responses]
    direct = _direct(drives, responses)
    table = [["direct" if own else "cross" for own in row] for row in direct]
    if len({kind for row in table for kind in row}) == 1:
        return [["" for _ in drives] for _ in responses]
    return table


def _distinct(table: list[list[str]]) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name for row in table for name in row))


def _terms(names: tuple[str, ...], model: ModelSettings) -> list[int]:
    """Number of viscous terms of each element."""
    if not isinstance(model.terms, Mapping):
        return [model.most_terms] * len(names)
    if names == ("",) and (unknown := [key for key in model.terms if key]):
        raise InputError(
            f"[model] terms names {', '.join(map(repr, unknown))}, but this plant has one element, that of "
            "all its paths; give its number of terms alone, as in `terms = 2`"
        )
    problems = [
        f"[model] terms names the element {key!r}, which this plant does not have{nearest(key, names)}"
        for key in model.terms
        if key not in names
    ]
    problems += [
        f"[model] terms gives no number for the element {name!r}; add `{name} = 1`"
        for name in names
        if name not in model.terms
    ]
    refuse_if(problems)
    return [model.terms[name] for name in names]
