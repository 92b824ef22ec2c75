"""What a reader asks a fit first: the plant, how well it follows the records, what to trust, what to do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.parameters import ParameterTable

if TYPE_CHECKING:
    from lcopa_bayes.results.fit import Fit

_NAMED = 8
"""Most parameters named in a sentence."""
_AT_REST = 8
"""Samples at rest without which their scatter is not shown [-]."""


def overview(fit: Fit) -> dict[str, Any]:
    """The equation of the plant at the draw of highest density, line by line, and the answer to each
    question, with the section of the page that has more.

    Medians of a posterior with several modes make a plant that no record supports.
    """
    draws = fit.draws
    return {
        "plant": plant(draws.table, draws.flat[int(draws.log_density.argmax())]),
        "answers": [
            {"question": question, "answer": answer, "section": section}
            for question, answer, section in (
                ("How good is the fit?", _fitted(fit), "Residuals"),
                ("Does it predict?", _predicted(fit), "Data and bands"),
                ("Which numbers can be trusted?", _trusted(fit), "Parameters"),
                ("What is missing?", _missing(fit), "Residuals"),
                ("What next?", _next(fit), ""),
            )
        ],
    }


def plant(table: ParameterTable, values: Vector) -> list[str]:
    """Transfer functions of all paths at table values (rows,), and the elements that they share."""
    layout = table.layout
    alone = len(layout.elements) == 1
    lines = []
    elements = {}
    for e, slot in enumerate(layout.elements):
        terms = [
            f"({values[table.at('time', e, k)]:.4g} s)^{values[table.at('order', e, k)]:.4g}"
            for k in range(slot.terms)
        ]
        elements[e] = " + ".join(["1", *terms])
    for i, response in enumerate(layout.responses):
        for j, drive in enumerate(layout.drives):
            e = layout.element_of[i][j]
            gain = values[table.at("gain", i, j)]
            delay = values[table.at("delay", layout.delay_of[i][j])]
            below = f"({elements[e]})" if alone else layout.elements[e].name
            lines.append(
                f"{response.name} / {drive.name} = {gain:.4g} {response.unit}/{drive.unit} "
                f"exp(-{delay:.4g} s) / {below}"
            )
    if not alone:
        lines += [f"{slot.name} = {elements[e]}" for e, slot in enumerate(layout.elements)]
    if table.effects is not None:
        lines += [
            f"with {row.name} = {value:.4g} {row.unit}"
            for row, value in zip(table.rows, values, strict=True)
            if row.kind in (*COEFFICIENTS, *CONSTANTS)
        ]
    return lines


def _fitted(fit: Fit) -> str:
    parts = []
    for axis, response in enumerate(fit.draws.table.layout.responses):
        own = [band for band in fit.bands if band.axis == response.name and not band.held_out]
        left = np.concatenate([band.observed - band.plant[2] for band in own])
        said = f"{response.name} is left with {np.sqrt(np.mean(left**2)):.3g} {response.unit} rms"
        still = [one.quiet(axis).values for one in fit.problem.posterior.samples]
        free = sum(max(0, values.size - 1) for values in still)
        if free >= _AT_REST:
            squares = sum(float(np.sum((values - values.mean()) ** 2)) for values in still if values.size)
            said += f", where samples at rest scatter by {np.sqrt(squares / free):.3g} {response.unit}"
        parts.append(said)
    return "; ".join(parts) + "."


def _predicted(fit: Fit) -> str:
    held = [band for band in fit.bands if band.held_out]
    if not held:
        return "Untested: no record was held out."
    worst = min(held, key=lambda band: band.coverage(0.9))
    several = "s" * (len(held) != 1)
    return (
        f"Of {len(held)} held-out response{several} the worst, {worst.record}/{worst.axis}, has "
        f"{100 * worst.coverage(0.9):.0f} % of its samples in the 90 % band and an error of {worst.rmse:.3g} "
        f"{worst.unit} rms."
    )


def _trusted(fit: Fit) -> str:
    by_grade: dict[str, list[str]] = {"reliable": [], "tentative": [], "unusable": []}
    for one in fit.draws.estimates():
        by_grade[one.grade].append(one.name)
    shown = {grade: names for grade, names in by_grade.items() if names}
    if len(shown) == 1:
        ((grade, names),) = shown.items()
        return f"All {len(names)} parameters are {grade}."
    return "; ".join(f"{grade}: {_listed(names)}" for grade, names in shown.items()) + "."


def _listed(names: Sequence[str]) -> str:
    more = len(names) - _NAMED
    return ", ".join(names[:_NAMED]) + (f" and {more} more" if more > 0 else "")


def _missing(fit: Fit) -> str:
    reasons = [one.reason for one in fit.draws.limitations if one.level != "reliable"]
    if fit.draws.modes:
        names = _listed([one.parameter for one in fit.draws.modes])
        reasons.append(f"the records leave several modes, of {names}")
    if not reasons:
        return "Nothing that the checks of the model against its records could see."
    return _joined(reasons)


def _next(fit: Fit) -> str:
    remedies = [one.remedy for one in fit.draws.limitations if one.level != "reliable" and one.remedy]
    if not fit.study.held_out:
        remedies.append("hold out a record (--held-out) to test the prediction")
    remedies.append("`audit` says what the records determine, `loop` what the model lacks")
    return _joined(remedies)


def _joined(clauses: Sequence[str]) -> str:
    """Clauses as one sentence, each once."""
    text = "; ".join(dict.fromkeys(clauses))
    return f"{text[0].upper()}{text[1:]}."
