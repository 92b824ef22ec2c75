"""Candidates: models of the same records, each a study derived from one."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import final

from lcopa_bayes.core.errors import InputError, nearest, refuse_if
from lcopa_bayes.data.settings import CandidateSettings, ModelSettings, NoiseSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import table_of
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.results.predictive import Predictive

STUDY = "study"
"""Name of the candidate that is the study unchanged."""
KNOWN = (STUDY, "fractional-1", "fractional-2", "fractional-3", "first-order", "second-order", "integer-kept")
"""Candidates any study has."""
VARIANTS: Mapping[str, str] = {
    "separate": "an element of its own for every path",
    "delays": "a delay of its own for every path",
    "shared": "one element and one delay for all paths",
    "no-cross": "no cross paths",
    "no-effects": "no effects",
}
"""What may follow the name of a known candidate, after a hyphen."""
_MOST = 3
"""Most terms of the candidates a study has without asking."""


@final
@dataclass(frozen=True, eq=False)
class Candidate:
    """A model to compare."""

    name: str
    study: Study
    about: str
    """In words."""
    notes: tuple[str, ...] = ()
    improper: tuple[str, ...] = ()
    """Parameters whose prior is improper."""
    fit: Predictive | None = None
    """Its finished fit; None: it is fitted."""

    @property
    def integer(self) -> bool:
        """Whether every order is fixed at an integer."""
        orders = self.study.model.orders
        return orders != "free" and all(float(order).is_integer() for order in orders)

    @property
    def terms(self) -> int:
        """Viscous terms of the richest element [-]."""
        return self.study.model.most_terms


def known_settings(name: str, study: Study) -> CandidateSettings:
    """Settings of a candidate any study has, by its name; InputError for any other name."""
    base, variants = name, []
    while (result := re.fullmatch(rf"(.+)-({'|'.join(VARIANTS)})", base)) is not None:
        base = result[1]
        variants.append(result[2])
    most = study.model.most_terms
    settings: dict[str, object] = {}
    fractional = re.fullmatch(r"fractional-([1-6])", base)
    if fractional:
        settings["terms"] = int(fractional[1])
    elif base == "first-order":
        settings["orders"] = (1.0,)
    elif base == "second-order":
        settings["orders"] = (2.0, 1.0)
    elif base == "integer-kept":
        settings["orders"] = (2.0, *[1.0] * (most - 1)) if most > 1 else (1.0,)
    elif base != STUDY:
        raise InputError(
            f"no candidate {name!r}{nearest(base, KNOWN)}; any of them may end in "
            f"{', '.join('-' + key for key in VARIANTS)}; or describe it under [[candidates]]"
        )
    settings |= {"share": "none"} if "separate" in variants else {}
    settings |= {"delay": "path"} if "delays" in variants else {}
    settings |= {"share": "all", "delay": "shared"} if "shared" in variants else {}
    settings |= {"effects": ()} if "no-effects" in variants else {}
    return CandidateSettings(name, cross="no-cross" not in variants, **settings)  # type: ignore[arg-type]


def derived(study: Study, settings: CandidateSettings) -> Candidate:
    """A candidate of a study; InputError when its settings do not fit the study's axes."""
    model = settings.model(study.model)
    notes: list[str] = []
    fixed: dict[str, PriorSettings] = {}
    if not settings.cross:
        model, fixed = _uncrossed(study, settings.name, model)
    candidate = replace(
        study,
        model=model,
        noise=study.noise if settings.noise is None else NoiseSettings(settings.noise),
        effects=study.effects if settings.effects is None else replace(study.effects, use=settings.effects),
        priors={},
    )
    names = _names(candidate)
    priors = dict(study.priors)
    if model.orders != "free":
        priors = {name: prior for name, prior in priors.items() if not name.startswith("order_")}
    dropped = sorted(set(study.priors) - set(names)) if settings.name != STUDY else []
    if dropped:
        notes.append(f"has no {', '.join(dropped)}: the study's priors of these do not apply")
        priors = {name: prior for name, prior in priors.items() if name in names}
    improper = tuple(name for name, prior in settings.priors.items() if prior.improper)
    stated = {name: prior for name, prior in settings.priors.items() if not prior.improper}
    for name in improper:
        if name not in names:
            raise InputError(f"candidate {settings.name!r}: no parameter {name!r}{nearest(name, names)}")
        priors.pop(name, None)
        notes.append(
            f"the prior of {name} is improper, so the evidence is undefined; the other scores are under the "
            "default prior in its place"
        )
    candidate = replace(candidate, priors=priors | stated | fixed)
    about = _about(study, model, settings.cross)
    if study.effects.use or candidate.effects.use:
        about += f", {', '.join(candidate.effects.use) or 'no effects'}"
    return Candidate(settings.name, candidate, about, tuple(notes), improper)


def candidates_of(
    study: Study, extra: Sequence[CandidateSettings] = (), pick: Sequence[str] | None = None
) -> tuple[Candidate, ...]:
    """The candidates to compare: those picked by name, or a short list and all of `extra`.

    InputError for a name that is unknown, and when fewer than two different models are left.
    """
    own = {one.name: one for one in (*study.candidates, *extra)}
    wanted = pick if pick is not None else (study.compare.pick or (*_short_list(study), *own))
    problems: list[str] = []
    candidates: list[Candidate] = []
    for name in dict.fromkeys(wanted):
        try:
            candidates.append(derived(study, own[name] if name in own else known_settings(name, study)))
        except InputError as error:
            problems += [f"candidate {name!r}: {p}" if name not in p else p for p in error.problems]
    refuse_if(problems)
    distinct: list[Candidate] = []
    for one in candidates:
        if not any(_same(one, other) for other in distinct):
            distinct.append(one)
    if len(distinct) < 2:
        raise InputError(
            f"{study.name}: {len(distinct)} candidate left to compare; name two different models or more, "
            f"such as {', '.join(KNOWN)}"
        )
    return tuple(distinct)


def of_studies(studies: Sequence[Study], fits: Sequence[Predictive | None]) -> tuple[Candidate, ...]:
    """Studies of the same records as candidates, called by their names, with a number where these repeat, and
    those of their fits that are finished."""
    names = [study.name for study in studies]
    called = [
        name if names.count(name) == 1 else f"{name}-{number}" for number, name in enumerate(names, start=1)
    ]
    return tuple(
        Candidate(name, study, _about(study, study.model, True), fit=fit)
        for name, study, fit in zip(called, studies, fits, strict=True)
    )


def _short_list(study: Study) -> list[str]:
    """A few candidates that ask how many terms, and whether fractional ones."""
    model, most = study.model, study.model.most_terms
    if study.effects.use:
        return [STUDY, f"{STUDY}-no-effects"]
    plain = model.orders == "free" and not isinstance(model.terms, Mapping) and most <= _MOST
    own = [] if plain else [STUDY]
    upto = 2 if own else min(max(most, 2), _MOST)
    fractional = [f"fractional-{terms}" for terms in range(1, upto + 1)]
    if len(study.drive_axes) != len(study.response_axes):  # do its paths have anything in common?
        fractional.insert(1, "fractional-1-shared")
    return [*own, *fractional, *(["first-order"] if most <= 2 and not own else []), "second-order"]


def _same(one: Candidate, other: Candidate) -> bool:
    """Whether two candidates are one model."""

    def key(candidate: Candidate) -> tuple[object, ...]:
        study = candidate.study
        return study.model, study.noise, study.effects, dict(study.priors), candidate.improper

    return key(one) == key(other)


def _names(study: Study) -> tuple[str, ...]:
    """Names of the parameters a study without priors of its own has."""
    layout = Layout.of(study.drive_axes, study.response_axes, study.model)
    names = table_of(study, layout, Scales.of(study.fit))[2].names
    return (*names, *{name.partition("[")[0] for name in names if "[" in name})


def _uncrossed(
    study: Study, name: str, model: ModelSettings
) -> tuple[ModelSettings, dict[str, PriorSettings]]:
    """The model without cross paths, and what holds their gains at zero and the rest out of the way."""
    axes = len(study.drive_axes), len(study.response_axes)
    if axes[0] != axes[1] or axes[0] < 2:
        raise InputError(
            f"candidate {name!r}: without cross paths makes sense for as many drives as responses, two or "
            f"more; this study has {axes[0]} and {axes[1]}"
        )
    if model.share == "paper":  # the direct paths' element is then the only one
        model = replace(model, share="all", terms=_direct_terms(model))
    layout = Layout.of(study.drive_axes, study.response_axes, model)
    direct = {(layout.own_response(j), j) for j in range(axes[1])}
    used = {layout.element_of[i][j] for i, j in direct if i is not None}
    delays = {layout.delay_of[i][j] for i, j in direct if i is not None}
    held: dict[str, float] = {}
    for i in range(axes[1]):
        for j in range(axes[0]):
            if (i, j) not in direct:
                held[f"gain_{layout.path_name(i, j)}"] = 0.0
    for e, slot in enumerate(layout.elements):
        for k in range(slot.terms if e not in used else 0):  # of no effect: any value does
            held |= {f"time_{k + 1}_{slot.name}": 1.0, f"order_{k + 1}_{slot.name}": 1.0}
    for d, slot_name in enumerate(layout.delays):
        if d not in delays:
            held[f"delay_{slot_name}"] = 0.0
    return model, {key: PriorSettings(key, fixed=value) for key, value in held.items()}


def _direct_terms(model: ModelSettings) -> int:
    if isinstance(model.terms, Mapping):
        return model.terms.get("direct", model.most_terms)
    return model.most_terms


def _about(study: Study, model: ModelSettings, cross: bool) -> str:
    if isinstance(model.terms, Mapping):
        terms = ", ".join(f"{name} {count}" for name, count in model.terms.items()) + " terms"
    else:
        terms = f"{model.most_terms} term{'s' if model.most_terms > 1 else ''}"
    orders = (
        "free orders"
        if model.orders == "free"
        else f"orders {', '.join(f'{order:g}' for order in model.orders)}"
    )
    shared = {"paper": "direct and cross elements", "all": "one element", "none": "an element per path"}
    delays = {"shared": "one delay", "element": "a delay per element", "path": "a delay per path"}
    effects = [f"with {', '.join(study.effects.use)}"] if study.effects.use else []
    if len(study.drive_axes) == len(study.response_axes) == 1:
        return ", ".join([terms, orders, *effects])
    parts = [
        terms,
        orders,
        shared[str(model.share)],
        delays[str(model.delay)],
        *([] if cross else ["no cross paths"]),
        *effects,
    ]
    return ", ".join(parts)
