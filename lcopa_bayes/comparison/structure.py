"""How many terms a plant has and what its paths share, where a study leaves that to its records.

Structures are looked at by least squares: one term per element, then two, until a further one is not worth
its parameters; then the same with an element, and with a delay, of its own for every path. The best by BIC is
fitted (Schwarz 1978, Ann. Statist. 6): Laplace's approximation of the evidence needs a mode that is close to
a normal distribution, which that of a plant with a term too many is not. What other structures leave open of
a number is a question for `compare`, which samples them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import log
from typing import Any, final

from lcopa_bayes.comparison.candidates import Candidate, derived, known_settings
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.results.firstlook import FirstLook, look_at, searched

_MOST = 4
"""Most terms that are looked at."""
_SHARING = ("separate", "delays")
"""Variants of candidates that are asked of a plant with several paths."""


@final
@dataclass(frozen=True, eq=False)
class Looked:
    """One structure, by least squares."""

    candidate: Candidate
    problem: Problem
    optima: tuple[Optimum, ...]
    """Best first."""

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
    def study(self) -> Study:
        """With that structure."""
        return self.chosen.candidate.study

    @property
    def look(self) -> FirstLook:
        """Of that structure."""
        return look_at(self.chosen.problem, self.chosen.optima)

    @property
    def sentence(self) -> str:
        """What was chosen of what."""
        best = self.chosen.candidate
        others = [one.candidate.name for one in self.looked if one.candidate is not best]
        return (
            f"The records chose {best.name} ({best.about}) by BIC, of this and {', '.join(others)}; "
            "`compare` shows what the others leave open."
        )

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        rows = [
            attributes(one.candidate, "name", "about")
            | attributes(one, "parameters", "max_log_likelihood", "bic")
            for one in self.looked
        ]
        return plain({"chosen": self.chosen.candidate.name, "candidates": rows, "sentence": self.sentence})


def structure_of(study: Study) -> Structure | None:
    """The structure of a study whose terms are "auto"; None where it states them.

    InputError as `first_look` of one term.
    """
    if study.model.terms != "auto":
        return None
    looked = [_looked(study, "fractional-1")]
    for terms in range(2, _MOST + 1):
        more = _if_possible(study, f"fractional-{terms}")
        if more is None:
            break
        looked.append(more)
        if Structure(tuple(looked)).chosen is not more:
            break
    for variant in _SHARING if len(study.drive_axes) * len(study.response_axes) > 1 else ():
        best = Structure(tuple(looked)).chosen.candidate
        more = _if_possible(study, f"{best.name}-{variant}")
        if more is not None and more.candidate.study.model != best.study.model:
            looked.append(more)
    return Structure(tuple(looked))


def settled(study: Study) -> Study:
    """The study itself, or where its terms are "auto" with the structure that its records chose."""
    structure = structure_of(study)
    return study if structure is None else structure.study


def _looked(study: Study, name: str) -> Looked:
    candidate = derived(study, known_settings(name, study))
    return Looked(candidate, *searched(candidate.study))


def _if_possible(study: Study, name: str) -> Looked | None:
    """None where the records cannot determine so many parameters."""
    try:
        return _looked(study, name)
    except InputError:
        return None
