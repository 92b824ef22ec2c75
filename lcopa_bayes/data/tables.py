"""Tables of a study file, or of the same keys in Python, read into settings with every problem at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

from lcopa_bayes.core.errors import InputError, gathered, nearest
from lcopa_bayes.core.rules import FLAG, Ruled
from lcopa_bayes.data.settings import (
    STAGES,
    CandidateSettings,
    CompareSettings,
    EffectsSettings,
    ModelSettings,
    NoiseSettings,
    PriorSettings,
    SamplerSettings,
)

_DATA = ("fit", "held_out", "records")
"""Keys that would give a candidate records of its own."""
S = TypeVar("S")


def settings_from(kind: type[S], table: object, where: str, problems: list[str]) -> S | None:
    """`kind` from a table of a study file; what is wrong joins `problems`, each after `where`.

    None when a value is wrong; an unknown key alone is a problem but leaves the others usable.
    """
    if not isinstance(table, Mapping):
        problems.append(f"{where}: must be a table of settings; got {table!r}")
        return None
    known = {one.name for one in dataclasses.fields(kind)}  # type: ignore[arg-type]
    problems += [f"{where}: unknown key {key!r}{nearest(key, known)}" for key in table if key not in known]
    values = {key: tuple(v) if isinstance(v, list) else v for key, v in table.items() if key in known}
    with gathered(problems, f"{where}: "):
        return kind(**values)
    return None


def prior_settings(
    table: object, where: str, problems: list[str], *, improper: bool = False
) -> dict[str, PriorSettings]:
    """Priors by parameter name from values to fix, tables with `dist`, or settings; what is wrong joins
    `problems`, and so does a prior that is no distribution, unless `improper` ones are allowed."""
    if not isinstance(table, Mapping):
        problems.append(f"{where}: must be a table of settings; got {table!r}")
        return {}
    priors = {}
    for name, value in table.items():
        with gathered(problems, f"{where}: "):
            if isinstance(value, PriorSettings):
                priors[name] = value
            elif isinstance(value, Mapping):
                parameters = {key: number for key, number in value.items() if key != "dist"}
                priors[name] = PriorSettings(name, dist=value.get("dist"), parameters=parameters)
            else:
                priors[name] = PriorSettings(name, fixed=value)
    wrong = {} if improper else {name: prior for name, prior in priors.items() if prior.improper}
    problems += [
        f"{where}: prior of {name!r}: {prior.dist} is no distribution; only a candidate of a comparison may "
        "have such a prior"
        for name, prior in wrong.items()
    ]
    return {name: prior for name, prior in priors.items() if name not in wrong}


def population_priors(values: Mapping[str, Any], group: int, where: str) -> dict[str, dict[str, Any]]:
    """Priors of the next device of a group of a fleet, by parameter name, from what `fleet` wrote; InputError
    after `where` when it holds no such group, or no population of it."""
    groups = values.get("groups")
    if not isinstance(groups, list):
        raise InputError(f"{where}: holds no fleet; give the fleet.json that `fleet` wrote")
    if not 1 <= group <= len(groups):
        raise InputError(f"{where}: holds {len(groups)} groups of devices, none of the number {group}")
    rows = groups[group - 1]["parameters"]
    unusable = [row["grade_reason"] for row in rows if row["grade"] == "unusable"]
    if unusable or not rows:
        reason = unusable[0] if unusable else groups[group - 1]["sentence"] or "it has no draws"
        raise InputError(f"{where}: group {group} has no population to take priors from: {reason}")
    return {row["name"]: dict(row["prior"]) for row in rows}


def candidate_settings(rows: object, where: str, problems: list[str]) -> tuple[CandidateSettings, ...]:
    """Candidates from the tables ``[[candidates]]``; what is wrong joins `problems`."""
    if not isinstance(rows, list | tuple) or not all(
        isinstance(row, Mapping | CandidateSettings) for row in rows
    ):
        problems.append(f"{where}: write each candidate as a table [[candidates]]; got {rows!r}")
        rows = []
    read = [_candidate(row, f"{where} {number}", problems) for number, row in enumerate(rows, start=1)]
    candidates = tuple(one for one in read if one is not None)
    names = [one.name for one in candidates]
    problems += [
        f"{where}: {names.count(name)} candidates are named {name!r}; give each a name of its own"
        for name in sorted({name for name in names if names.count(name) > 1})
    ]
    return candidates


def _candidate(
    row: Mapping[str, Any] | CandidateSettings, place: str, problems: list[str]
) -> CandidateSettings | None:
    if isinstance(row, CandidateSettings):
        return row
    problems += [
        f"{place}: `{key}` is not for a candidate: all candidates must see the same data; "
        "set the records in the study"
        for key in _DATA
        if key in row
    ]
    if "name" not in row:
        problems.append(f"{place}: needs a `name`")
        return None
    settings = {key: value for key, value in row.items() if key not in _DATA}
    given = row.get("priors", {})
    settings["priors"] = prior_settings(given, f"{place}, priors", problems, improper=True)
    return settings_from(CandidateSettings, settings, place, problems)


def _stages(given: object, where: str, problems: list[str]) -> tuple[str, ...]:
    """Stages to run: a list of names, or a table of ``name = true`` and ``name = false``."""
    if given == {}:
        return STAGES
    chosen: object = dict.fromkeys(map(str, given), True) if isinstance(given, list | tuple) else given
    if not isinstance(chosen, Mapping):
        problems.append(f"{where}: must be a table or a list of stages; got {given!r}")
        return ()
    problems += [
        f"{where}: unknown stage {name!r}{nearest(name, STAGES)}" for name in chosen if name not in STAGES
    ]
    problems += [
        f"{where}: {one}" for name in STAGES if name in chosen for one in FLAG.problems(name, chosen[name])
    ]
    if not any(value is not False for value in chosen.values()):
        problems.append(f"{where}: names no stage to run; name one or more of {', '.join(STAGES)}")
    return tuple(name for name in STAGES if chosen.get(name, False) is not False)


TABLES: Mapping[str, type[Ruled]] = MappingProxyType(
    {
        "model": ModelSettings,
        "noise": NoiseSettings,
        "sampler": SamplerSettings,
        "effects": EffectsSettings,
        "compare": CompareSettings,
    }
)
"""Tables of a study that are settings by key."""


def study_settings(
    given: Mapping[str, Any], where: Callable[[str], str], problems: list[str]
) -> dict[str, Any]:
    """Settings of a study by table: as given, or of their keys and values, or the defaults.

    What is wrong joins `problems`, each after `where` of its table; a table with a wrong value comes out as
    None. A plant whose orders are given has as many terms, unless their number is given too.
    """
    model = given.get("model")
    if isinstance(model, Mapping) and isinstance(model.get("orders"), list | tuple):
        given = {**given, "model": {"terms": max(1, len(model["orders"])), **model}}
    out: dict[str, Any] = {}
    for name, kind in TABLES.items():
        value = given.get(name, {})
        settings = value if isinstance(value, kind) else settings_from(kind, value, where(name), problems)
        out[name] = settings
    out["priors"] = prior_settings(given.get("priors", {}), where("priors"), problems)
    out["stages"] = _stages(given.get("stages", STAGES), where("stages"), problems)
    out["candidates"] = candidate_settings(given.get("candidates", []), where("[candidates]"), problems)
    return out
