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
from lcopa_bayes.inference.elementterms import terms_in_words
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.structure import structure_of

STUDY = "study"
"""Name of the candidate that is the study unchanged."""
BY_ELEMENT = "fractional-by-element"
"""Name of the candidate whose elements have as many terms as the records choose."""
KNOWN = (
    STUDY,
    "fractional-1",
    "fractional-2",
    "fractional-3",
    BY_ELEMENT,
    "first-order",
    "second-order",
    "integer-kept",
)
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
        """Whether every order is fixed at an integer, by the model or by priors."""
        orders = [row for row in _table(self.study).rows if row.kind == "order"]
        return all(not row.free and float(row.value).is_integer() for row in orders)

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
    elif base == BY_ELEMENT:
        settings["terms"] = "auto"
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


def derived(study: Study, settings: CandidateSettings, *, jobs: int = 1) -> Candidate:
    """A candidate of a study; InputError when its settings do not fit the study's axes.

    Terms that the records are to choose are looked for by least squares, in `jobs` processes.
    """
    notes: list[str] = []
    if settings.terms == "auto":
        settings = replace(settings, terms=_chosen_terms(study, settings, jobs))
        notes.append("has as many terms in each element as the records choose by BIC, by least squares")
    model = settings.model(study.model)
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
            f"has an improper prior of {name}, so its evidence is undefined; its other scores are under the "
            "default prior in its place"
        )
    candidate = replace(candidate, priors=priors | stated | fixed)
    about = _about(study, model, settings.cross)
    if study.effects.use or candidate.effects.use:
        about += f", {', '.join(candidate.effects.use) or 'no effects'}"
    return Candidate(settings.name, candidate, about, tuple(notes), improper)


def _chosen_terms(study: Study, settings: CandidateSettings, jobs: int) -> int | Mapping[str, int]:
    """Viscous terms of the elements of a candidate that the records choose [-], with what its paths share as
    it says; InputError as `structure_of`."""
    least = derived(study, replace(settings, terms=1)).study
    structure = structure_of(
        replace(least, model=replace(least.model, terms="auto")), sharing=False, jobs=jobs
    )
    assert structure is not None
    terms = structure.chosen.study.model.terms
    assert terms != "auto"
    return terms


def candidates_of(
    study: Study,
    extra: Sequence[CandidateSettings] = (),
    pick: Sequence[str] | None = None,
    *,
    chosen: bool = False,
    jobs: int = 1,
) -> tuple[Candidate, ...]:
    """The candidates to compare: those picked by name, or a short list and all of `extra`.

    `chosen` says that the study's numbers of terms are those that its records choose already; those of other
    candidates are looked for in `jobs` processes. InputError for a name that is unknown, and when fewer than
    two different models are left.
    """
    own = {one.name: one for one in (*study.candidates, *extra)}
    asked = pick if pick is not None else study.compare.pick or None
    wanted = (*_short_list(study, chosen), *own) if asked is None else asked
    problems: list[str] = []
    candidates: list[Candidate] = []
    for name in dict.fromkeys(wanted):
        try:
            settings = own[name] if name in own else known_settings(name, study)
            candidates.append(derived(study, settings, jobs=jobs))
        except InputError as error:
            if asked is None and name == BY_ELEMENT:  # what is wrong with the study, the others say
                continue
            problems += [f"candidate {name!r}: {p}" if repr(name) not in p else p for p in error.problems]
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


def _short_list(study: Study, chosen: bool) -> list[str]:
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
    if len(_layout(study, model).elements) > 1 and not chosen:
        fractional.append(BY_ELEMENT)
    return [*own, *fractional, *(["first-order"] if most <= 2 and not own else []), "second-order"]


def _same(one: Candidate, other: Candidate) -> bool:
    """Whether two candidates are one model."""

    def key(candidate: Candidate) -> tuple[object, ...]:
        study = candidate.study
        return study.model, study.noise, study.effects, dict(study.priors), candidate.improper

    return key(one) == key(other)


def _names(study: Study) -> tuple[str, ...]:
    """Names of the parameters a study without priors of its own has."""
    names = _table(study).names
    return (*names, *{name.partition("[")[0] for name in names if "[" in name})


def _table(study: Study) -> ParameterTable:
    return table_of(study, _layout(study, study.model), Scales.of(study.fit))[2]


def _layout(study: Study, model: ModelSettings) -> Layout:
    return Layout.of(study.drive_axes, study.response_axes, model)


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
    layout = _layout(study, model)
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
    terms = terms_in_words(_layout(study, model).terms)
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
