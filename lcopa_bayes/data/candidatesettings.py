"""What a study file or a file of candidates may say about a comparison: ``[compare]``, ``[[candidates]]``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Literal, final

from lcopa_bayes.core.checks import file_names, one_of, rebuilt, refuse_if
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.settings import (
    NOISE_KINDS,
    EffectsSettings,
    ModelSettings,
    NoiseSettings,
    PriorSettings,
    settings_from,
)

IMPROPER = frozenset({"flat", "improper", "jeffreys"})
"""Words for a prior that is no distribution."""
_DATA = ("fit", "held_out", "records")
"""Keys that would give a candidate records of its own."""


@final
@dataclass(frozen=True)
class CompareSettings:
    """Table ``[compare]``."""

    pick: tuple[str, ...] | None = None
    """Candidates by name; None: chosen from the study, and all of ``[[candidates]]``."""

    def __post_init__(self) -> None:
        if self.pick is not None and file_names("pick", self.pick):
            raise InputError(
                f'`pick` must be a list of candidates, as in ["fractional-1", "second-order"]; '
                f"got {self.pick!r}"
            )


@final
@dataclass(frozen=True)
class CandidateSettings:
    """One table of ``[[candidates]]``; what is left out is as in the study."""

    name: str
    """Also the name of the candidate's folder."""
    terms: int | Mapping[str, int] | None = None
    """Viscous terms [-]; None: as many as `orders`, else those of the study."""
    orders: Literal["free"] | tuple[float, ...] | None = None
    """Orders [-]; None: free where `terms` is given, else those of the study."""
    share: Literal["paper", "all", "none"] | None = None
    """Which paths share an element."""
    delay: Literal["shared", "element", "path"] | None = None
    """Which paths share a delay."""
    offset: Literal["record", "shared", "none"] | None = None
    """Which records share an offset."""
    noise: Literal["white", "ar1", "white+ar1", "student"] | None = None
    """Noise model."""
    cross: bool = True
    """Whether a drive moves other axes than its own."""
    effects: tuple[str, ...] | None = None
    """Effects of the plant by name; None: those of the study."""
    priors: Mapping[str, PriorSettings] = field(default_factory=dict)
    """In place of the study's, by parameter name."""
    improper: tuple[str, ...] = ()
    """Parameters whose prior is said to be improper."""

    def __post_init__(self) -> None:
        text = isinstance(self.name, str) and self.name.strip(" .")
        bad = not text or any(mark in self.name for mark in "/\\\0\n")
        problems = [f"`name` must be text fit for a folder; got {self.name!r}"] if bad else []
        if self.effects is not None:
            try:
                EffectsSettings(use=self.effects)
            except InputError as error:
                problems += [problem.replace("`use`", "`effects`") for problem in error.problems]
        if not isinstance(self.cross, bool):
            problems.append(f"`cross` must be true or false; got {self.cross!r}")
        if self.noise is not None:
            problems += one_of("noise", self.noise, NOISE_KINDS)
        refuse_if(problems)
        self.model(ModelSettings())  # refuses wrong values
        object.__setattr__(self, "priors", MappingProxyType(dict(self.priors)))

    __reduce__ = rebuilt

    def model(self, own: ModelSettings) -> ModelSettings:
        """Settings of the model, what is left out from `own`; InputError when they contradict each other."""
        terms, orders = self.terms, self.orders
        if terms is None and isinstance(orders, tuple):
            terms = max(1, len(orders))
        if orders is None:
            orders = own.orders if terms is None else "free"
        share = self.share or own.share
        if terms is None:
            terms = own.terms
            if isinstance(terms, Mapping) and share != own.share:  # other elements than the study names
                terms = max(terms.values())
        return replace(
            own,
            terms=terms,
            orders=orders,
            share=share,
            delay=self.delay or own.delay,
            offset=self.offset or own.offset,
        )

    def effects_settings(self, own: EffectsSettings) -> EffectsSettings:
        """Settings of the effects."""
        return own if self.effects is None else replace(own, use=self.effects)

    def noise_settings(self, own: NoiseSettings) -> NoiseSettings:
        """Settings of the noise."""
        return own if self.noise is None else NoiseSettings(self.noise)


def compare_settings(
    document: Mapping[str, Any], where: str, problems: list[str]
) -> tuple[CompareSettings, tuple[CandidateSettings, ...]]:
    """Tables ``[compare]`` and ``[[candidates]]`` of a document; what is wrong joins `problems`."""
    table = document.get("compare", {})
    if not isinstance(table, dict):
        problems.append(f"{where}, [compare]: must be a table of settings; got {table!r}")
        table = {}
    chosen = settings_from(CompareSettings, table, f"{where}, [compare]", problems) or CompareSettings()
    rows = document.get("candidates", [])
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        problems.append(f"{where}: write each candidate as a table [[candidates]]; got {rows!r}")
        rows = []
    made = []
    for number, row in enumerate(rows, start=1):
        place = f"{where}, [[candidates]] {number}"
        one = _candidate(row, place, problems)
        if one is not None:
            made.append(one)
    names = [one.name for one in made]
    problems += [
        f"{where}: {names.count(name)} candidates are named {name!r}; give each a name of its own"
        for name in sorted({name for name in names if names.count(name) > 1})
    ]
    return chosen, tuple(made)


def _candidate(row: Mapping[str, Any], place: str, problems: list[str]) -> CandidateSettings | None:
    told = {key: value for key, value in row.items() if key not in ("priors", *_DATA)}
    problems += [
        f"{place}: `{key}` is not for a candidate: all candidates must see the same data; "
        "set the records in the study"
        for key in _DATA
        if key in row
    ]
    if "name" not in told:
        problems.append(f"{place}: needs a `name`")
        return None
    given = row.get("priors", {})
    if not isinstance(given, dict):
        problems.append(f"{place}: `priors` must be a table; got {given!r}")
        return None
    priors, improper = {}, []
    for name, value in given.items():
        dist = value.get("dist") if isinstance(value, dict) else None
        if dist in IMPROPER:
            improper.append(name)
            continue
        try:
            priors[name] = (
                PriorSettings(
                    name, dist=dist, parameters={key: v for key, v in value.items() if key != "dist"}
                )
                if isinstance(value, dict)
                else PriorSettings(name, fixed=value)
            )
        except InputError as error:
            problems += [f"{place}: {problem}" for problem in error.problems]
    made = settings_from(CandidateSettings, told, place, problems)
    return None if made is None else replace(made, priors=priors, improper=tuple(improper))
