"""How many terms a plant has and what its paths share, where a study leaves that to its records.

Structures are looked at by least squares, from the fewest terms per element on: those beside the best so far,
which differ from it in an element, or a delay, of its own for every path, or by one term, until none of them
is better. The best by BIC is fitted (Schwarz 1978, Ann. Statist. 6): Laplace's approximation of the evidence
needs a mode that is close to a normal distribution, which that of a plant with a term too many is not. What
other structures leave open of a number is a question for `compare`, which samples them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import log
from time import monotonic
from typing import Any, final

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, table_of
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.elementterms import further, reduced, terms_in_words
from lcopa_bayes.inference.optimum import Optimum, optima_near
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.results.firstlook import FirstLook, look_at, searched

_WORTHWHILE = 2.0
"""Time that the first structure takes from which processes share the search of others [s]."""
_MOST = 4
"""Most terms that are looked at."""
_SHOWN = 3
"""Most structures that a sentence names beside the one chosen."""


@final
@dataclass(frozen=True, eq=False)
class Looked:
    """One structure, by least squares."""

    problem: Problem
    optima: tuple[Optimum, ...]
    """Best first."""

    @property
    def study(self) -> Study:
        """With that structure."""
        return self.problem.study

    @property
    def table(self) -> ParameterTable:
        """Its parameters."""
        return self.problem.posterior.table

    @property
    def name(self) -> str:
        """In words."""
        layout = self.table.layout
        parts = [terms_in_words(layout.terms)]
        if len(layout.drives) * len(layout.responses) > 1:
            parts += [f"elements: {len(layout.elements)}", f"delays: {len(layout.delays)}"]
        return ", ".join(parts)

    @cached_property
    def max_log_likelihood(self) -> float:
        """At the best optimum [nat]."""
        posterior = self.problem.posterior
        best = posterior.table.canonical(self.optima[0].values[None])
        return float(posterior.joint_log_likelihood(best)[0])

    @cached_property
    def parameters(self) -> int:
        """Free parameters, noise and offsets included [-]."""
        return sum(row.free for row in self.problem.posterior.table.rows)

    @property
    def bic(self) -> float:
        """``k log n - 2 log L`` [-]; n counts samples as if they were independent."""
        return self.parameters * log(self.problem.posterior.size) - 2 * self.max_log_likelihood


@final
@dataclass(frozen=True, eq=False)
class Structure:
    """The structure that the records chose, and those they chose from."""

    looked: tuple[Looked, ...]
    """In the order they were looked at."""

    @property
    def chosen(self) -> Looked:
        """The one of the least BIC."""
        return min(self.looked, key=lambda one: one.bic)

    @property
    def look(self) -> FirstLook:
        """Of that structure."""
        return look_at(self.chosen.problem, self.chosen.optima)

    @property
    def sentence(self) -> str:
        """What was chosen of what."""
        names = [one.name for one in self.looked if one is not self.chosen]
        others = "; ".join(names) if len(names) <= _SHOWN else f"{len(names)} others"
        return (
            f"The records chose a structure by BIC: {self.chosen.name}; looked at beside it: {others}. "
            "`compare` shows what the others leave open."
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        rows = [attributes(one, "name", "parameters", "max_log_likelihood", "bic") for one in self.looked]
        return plain({"chosen": self.chosen.name, "candidates": rows, "sentence": self.sentence})


def structure_of(
    study: Study, *, sharing: bool = True, jobs: int = 1, quiet: bool = True
) -> Structure | None:
    """The structure of a study whose terms are "auto"; None where it states them. Without `sharing`, what
    paths share is as the study says. Unless `quiet`, it is said what is looked at.

    InputError as `first_look` of the fewest terms, and for priors that no number of terms has a use for.
    """
    if study.model.terms != "auto":
        return None
    least, begin = with_least_terms(study), monotonic()
    with Progress(desc="choosing how many terms, by least squares", unit="structure", quiet=quiet) as bar:
        looked, tried = [Looked(*searched(least))], [least.model]
        if monotonic() - begin < _WORTHWHILE:
            jobs = 1
        while True:
            bar.update()
            best = Structure(tuple(looked)).chosen.study.model
            beside = _beside(best, least, sharing=sharing)
            model = next((one for one in beside if one not in tried), None)
            if model is None:
                return Structure((*looked, *_by_element(looked, jobs)))
            tried.append(model)
            more = _if_possible(replace(least, model=model), looked, jobs)
            looked += [] if more is None else [more]


def _by_element(looked: Sequence[Looked], jobs: int) -> Iterator[Looked]:
    """Structures in which single elements have a term that all have in the best one, or in that with one term
    more, where they are better than the best."""
    best = Structure(tuple(looked)).chosen
    own, terms = best.study.model, best.study.model.most_terms
    uniform = {
        one.study.model.most_terms: one
        for one in looked
        if replace(one.study.model, terms=terms) == own  # what paths share is equal
    }
    for most in (terms, terms + 1):
        if most in uniform and most - 1 in uniform:
            one = _thinned(uniform[most], uniform[most - 1])
            if len(set(one.table.layout.terms.values())) > 1 and one.bic < best.bic:
                contained = uniform[most - 1].problem.posterior, uniform[most - 1].optima[0]
                yield Looked(*searched(one.study, [contained], jobs=jobs))


def _thinned(one: Looked, smaller: Looked) -> Looked:
    """A structure without the terms of single elements that cost more than they bring beside those of a
    smaller one: those that are missed least are taken out first."""
    names = further(one.table, smaller.table)
    for name in sorted(names, key=lambda name: -_with_fewer(one, smaller, name)[2]):
        problem, start, _ = _with_fewer(one, smaller, name)
        optima = optima_near(problem.posterior, [start])
        fewer = Looked(problem, optima)
        one = fewer if optima and fewer.bic <= one.bic else one
    return one


def _with_fewer(one: Looked, smaller: Looked, element: str) -> tuple[Problem, Vector, float]:
    """Problem and table values with the terms of a smaller plant in an element, and their log likelihood
    [nat]."""
    theirs = smaller.optima[0].values
    problem, start = reduced(one.problem, one.optima[0].values, smaller.table, theirs, {element})
    return problem, start, float(problem.posterior.joint_log_likelihood(start[None])[0])


def _beside(model: ModelSettings, least: Study, *, sharing: bool) -> Iterator[ModelSettings]:
    """Structures one step from another: more or less is shared than paths do from the start, where `sharing`
    is asked for, a term more or less."""
    own = least.model
    if sharing and len(least.drive_axes) * len(least.response_axes) > 1:
        yield replace(model, share="none" if model.share == own.share else own.share)
        yield replace(model, delay="path" if model.delay == own.delay else own.delay)
    terms = model.most_terms
    if terms < _MOST:
        yield replace(model, terms=terms + 1)
    if terms > own.most_terms:
        yield replace(model, terms=terms - 1)


def settled(study: Study, *, jobs: int = 1) -> Study:
    """The study itself, or where its terms are "auto" with the structure that its records chose."""
    structure = structure_of(study, jobs=jobs)
    return study if structure is None else structure.chosen.study


def with_least_terms(study: Study) -> Study:
    """The study with the fewest terms that its priors need where its terms are "auto", else as it is.

    InputError for priors that no number of terms has a use for.
    """
    if study.model.terms != "auto":
        return study
    for terms in range(1, _MOST):
        least = replace(study, model=replace(study.model, terms=terms))
        try:
            _table(least)
        except InputError:
            continue
        return least
    most = replace(study, model=replace(study.model, terms=_MOST))
    _table(most)
    return most


def _table(study: Study) -> ParameterTable:
    """InputError where its priors are not of its parameters."""
    layout = Layout.of(study.drive_axes, study.response_axes, study.model)
    return table_of(study, layout, Scales.of(study.fit))[2]


def _if_possible(study: Study, looked: Sequence[Looked], jobs: int) -> Looked | None:
    """None where the records cannot determine so many parameters, or priors are of other parameters."""
    likeliest = sorted(looked, key=lambda one: one.max_log_likelihood, reverse=True)
    try:
        others = [(one.problem.posterior, one.optima[0]) for one in likeliest]
        return Looked(*searched(study, others, jobs=jobs))
    except InputError:
        return None
