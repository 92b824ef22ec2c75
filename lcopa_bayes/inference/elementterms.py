"""How many viscous terms each element of a plant has, and the same plant with fewer in some of them."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.wording import listed
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.parameters import ParameterTable


def terms_in_words(counts: Mapping[str, int]) -> str:
    """Numbers of terms [-] of elements by name, as in "2 terms in a, b, and 1 in the others"."""
    most = max(counts.values())
    richest = [name for name, terms in counts.items() if terms == most]
    said = f"{most} term{'s' * (most > 1)}"
    if len(richest) == len(counts):
        return said
    fewer = sorted({terms for terms in counts.values() if terms < most})
    return f"{said} in {listed(richest)}, and {' or '.join(map(str, fewer))} in the others"


def further(table: ParameterTable, smaller: ParameterTable) -> set[str]:
    """Names of the elements that have more terms than in a smaller plant; none of a plant of one element,
    whose plant with fewer terms is the smaller one itself."""
    counts, least = table.layout.terms, smaller.layout.terms
    return {name for name in counts if counts[name] > least[name]} if len(counts) > 1 else set()


def reduced(
    problem: Problem, values: Vector, smaller: ParameterTable, theirs: Vector, elements: Collection[str]
) -> tuple[Problem, Vector]:
    """The study of a problem with as many terms in some elements as a smaller plant has, and table values:
    these elements, with gains and delays of their paths, as in the smaller plant at `theirs`, all else as at
    `values`, (rows,) each."""
    table = problem.posterior.table
    counts = table.layout.terms | {name: smaller.layout.terms[name] for name in elements}
    settings = problem.study.model.for_plant(len(table.layout.drives), len(table.layout.responses))
    study = replace(problem.study, model=replace(settings, terms=counts))
    fewer = problem_of(study).at_least(problem.refinement)
    known, inner = _named(table, values), _named(smaller, theirs)
    known |= {name: inner[name] for element in elements for name in _rows(smaller, element)}
    return fewer, np.array([known[row.name] for row in fewer.posterior.table.rows])


def _named(table: ParameterTable, values: Vector) -> dict[str, float]:
    return dict(zip((row.name for row in table.rows), values.tolist(), strict=True))


def _rows(table: ParameterTable, element: str) -> list[str]:
    """Names of the parameters of an element, of the gains of its paths, and of the delays that no other path
    has."""
    layout = table.layout
    own = [slot.name for slot in layout.elements].index(element)
    places = [(path.response, path.drive) for path in layout.paths]
    paths = [(i, j) for i, j in places if layout.element_of[i][j] == own]
    others = {layout.delay_of[i][j] for i, j in places if (i, j) not in paths}
    delays = {layout.delay_of[i][j] for i, j in paths} - others
    rows = [*table.terms[own].times, *table.terms[own].orders]
    rows += [table.at("gain", i, j) for i, j in paths] + [table.at("delay", slot) for slot in delays]
    return [table.rows[k].name for k in rows]
