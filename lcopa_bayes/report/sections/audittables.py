"""What an audit found, as tables: verdicts first, then symmetries, functions and delays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from lcopa_bayes.report.formatting import NONE, figures, interval, percent
from lcopa_bayes.report.section import Column, Section, Table


def sections(told: Mapping[str, Any]) -> list[Section]:
    """Everything of an audit that is words and numbers."""
    return [_verdicts(told), _next(told), _symmetries(told), _functions(told), _delays(told)]


def _verdicts(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("name", "code"), Column("unit"), Column("verdict"), Column("profile, 90 %", "interval")),
        *(Column("contraction", "number"), Column("relative sd", "number")),
    )
    rows = []
    for row in told["parameters"]:
        lower, upper = row["profile"]["lower"], row["profile"]["upper"]
        spread = None if lower is None or upper is None else (upper - lower) / 3.29
        rows.append(
            (
                *(str(row["name"]), str(row["unit"]), str(row["verdict"]), interval(lower, upper, spread)),
                *(figures(row["contraction"], 2), figures(row["relative_sd"], 2)),
            )
        )
    caption = (
        "The profile interval is that of the likelihood alone, within the support of the priors. Contraction "
        "is 1 - posterior over prior variance on the sampled scale; relative sd is the Cramer-Rao bound "
        "at the maximum, a dash where the Fisher matrix is singular or the parameter belongs to the noise. "
        "Verdicts hold given this model. Identified: the data bound both ends of the interval, within a "
        "factor of 2 (6 dB, an octave), an order within 0.5 (45 degrees of phase), a delay within one "
        "sampling period or a factor of 2, an offset within half the range of the response. Weakly "
        "identified: bounded, but not as narrowly. Unresolved: a resonance faster than the samples resolve."
    )
    why = Table(
        (Column("name", "code"), Column("why", "prose"), Column("partners", "prose")),
        tuple(
            (str(row["name"]), str(row["reason"]), ", ".join(row["partners"]) or NONE)
            for row in told["parameters"]
        ),
        "Partners are parameters that can make up for this one, the most exact first.",
    )
    against = tuple(
        (str(row["name"]), str(row["verdict"]), "; ".join(row["disagreements"]))
        for row in told["parameters"]
        if row["disagreements"]
    )
    contrary = Table(
        (Column("name", "code"), Column("verdict"), Column("what speaks against it, or limits it", "prose")),
        against,
        "Where the four methods disagree; a verdict follows the symmetries and the profile.",
    )
    tables = (Table(columns, tuple(rows), caption), why, *((contrary,) if against else ()))
    return Section("Verdicts", (), (), tables)


def _next(told: Mapping[str, Any]) -> Section:
    advice = told["next_measurement"]
    limits = told["limitations"]
    if advice is None and limits:
        text = tuple(
            f"{_sentence(one['reason'])} To do: {one['remedy'] or 'see the report'}." for one in limits
        )
        return Section(
            "What to measure next",
            (
                "Given this model every parameter is identified, but the checks of the model speak against "
                "it: first mend the model, then ask again.",
                *text,
            ),
        )
    if advice is None:
        return Section(
            "What to measure next",
            ("Given this model every parameter is identified: its parameters need no further record.",),
        )
    text = (_sentence(advice["reason"]),)
    if not advice["parameters"]:
        return Section("What to measure next", text)
    columns = (
        *(Column("name", "code"), Column("best drive"), Column("relative sd", "number")),
        *(Column("after a plain step", "number"), Column("why none", "prose")),
    )
    rows = tuple(
        (
            *(row["name"], row["drive"] or NONE, *(_promised(row, key) for key in ("", "_step"))),
            row["reason"] or NONE,
        )
        for row in advice["parameters"]
    )
    caption = (
        f"Parameters that are not identified and what one more record of {advice['time']:g} "
        f"{advice['time_unit']} promises for each by the drive that is best for it: median Cramer-Rao bounds "
        "over draws of the posterior; above 1 it is still not determined. The verb design tries "
        "other times and confirms by simulation."
    )
    return Section("What to measure next", text, (), (Table(columns, rows, caption),))


def _sentence(clause: str) -> str:
    """A clause as a sentence."""
    return f"{clause[0].upper()}{clause[1:]}."


def _promised(row: Mapping[str, Any], which: str) -> str:
    """Expected relative standard deviation after the best drive or after the plain step."""
    found = row.get(f"expected_relative_sd{which}")
    return NONE if found is None else figures(found["value"], 2)


def _symmetries(told: Mapping[str, Any]) -> Section:
    text, printed = [], told["printed_form"]
    found = [f"{one['kind']}: {one['sentence']}." for one in told["symmetries"]]
    text += found or ["The model has no symmetry with these drives: every parameter acts on its own."]
    if not told["structure"]["certain"]:
        text.append(
            "The rank of the sensitivities changes with the tolerance: what is a symmetry and what is "
            "merely too weak to compute cannot be told apart, and no parameter is called structurally "
            "unidentifiable."
        )
    if printed is not None:
        text.append(
            f"In the printed parametrisation (Ta et al. 2026, Eqs. 16, 21, 28) only {printed['rank']} of "
            f"{printed['parameters']} numbers act: "
            + "; ".join(one["sentence"] for one in printed["symmetries"])
            + "."
        )
    if told["radial"] is not None:
        moved, fall = told["radial"]["moved"], told["radial"]["fall"]
        text.append(
            f"Radial test: {figures(told['radial']['reached'], 2)} prior standard deviations away from the "
            f"maximum twice the log likelihood has fallen by {figures(fall, 2)}; "
            f"{', '.join(moved) or 'no parameter'} moved."
        )
    return Section("Symmetries", tuple(text))


def _functions(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("function", "code"), Column("unit"), Column("median", "number")),
        *(Column("90 % interval", "interval"), Column("width / median", "number"), Column("verdict")),
        Column("grade", "grade"),
    )
    rows = tuple(
        (
            *(row["name"], row["unit"], figures(row["value"])),
            interval(row["lower"], row["upper"], _spread(row)),
            *(percent(row["relative_width"]), row["verdict"], row["grade"]),
        )
        for row in told["functions"]
    )
    caption = "Functions of the parameters, the most precisely known first; equal-tailed credible intervals."
    return Section("What is known best", (), (), (Table(columns, rows, caption),))


def _spread(row: Mapping[str, Any]) -> float | None:
    ends = (row["lower"], row["upper"])
    return None if None in ends else (ends[1] - ends[0]) / 3.29


def _delays(told: Mapping[str, Any]) -> Section:
    found = told["delays"]
    sentence = str(found["sentence"])
    text = (f"{sentence[0].upper()}{sentence[1:]}.",)
    rows: Sequence[Mapping[str, Any]] = found["separations"]
    if not rows:
        return Section("Delays of the paths", text)
    unit = found["paths"][0]["unit"]
    columns = (Column("pair", "code"), Column(f"told apart from [{unit}]", "number"))
    cells = tuple((" / ".join(row["pair"]), figures(row["smallest_difference"], 2)) for row in rows)
    caption = "Smallest difference a 90 % interval keeps apart from 0, linearised; a dash: none."
    return Section("Delays of the paths", text, (), (Table(columns, cells, caption),))
