"""Sections become one HTML page that needs nothing else, and figures become files."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.report.savedrun import load_run
from lcopa_bayes.report.section import Drawing, Section, stopped
from lcopa_bayes.report.sections import parameters, records, responses, sampling
from lcopa_bayes.report.theme import inlined, look
from lcopa_bayes.results.stored import stored_values

_SECTIONS = (
    parameters.overview,
    parameters.estimates,
    responses.steps,
    responses.frequency,
    records.data,
    records.residuals,
    parameters.pairs,
    parameters.priors,
    parameters.sensitivity,
    parameters.traces,
    sampling.evidence,
    sampling.cross_check,
    sampling.provenance,
)
"""What a report shows, in this order; a later stage adds its own section here."""
_ADVICE = {
    "reliable": "The sampling behind the numbers is reliable.",
    "tentative": "Read the numbers below with caution: a longer run or another model may change them.",
    "unusable": "Do not use the numbers below.",
}


@dataclass(frozen=True)
class Verdict:
    """Grade, sentence and reason in the box at the top of a page."""

    grade: str
    sentence: str
    reason: str

    @property
    def advice(self) -> str:
        """What the grade means for the reader."""
        return _ADVICE.get(self.grade, "")

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Verdict:
        """Verdict of a result; the reason is not repeated."""
        sentence, reason = str(values["verdict"]), str(values["grade_reason"])
        return cls(str(values["grade"]), stopped(sentence), "" if reason in sentence else reason)


def write_report(folder: Path) -> Path:
    """Draw the report of a run folder: `figures/*.svg` and `report.html`, whose path is returned.

    Reads only the folder and calculates nothing; the same folder gives the same bytes. InputError when a
    file of the folder is missing or cannot be used.
    """
    run = load_run(folder)
    with look():
        sections = [compose(run) for compose in _SECTIONS]
    return write_page(folder, str(run.results["study"]), sections, Verdict.of(run.results))


def write_graded(
    folder: Path,
    verb: str,
    title: str,
    compose: Callable[[Mapping[str, Any]], Sequence[Section]],
    *,
    box: Callable[[Mapping[str, Any]], Verdict] = Verdict.of,
    file: str | None = None,
    name: str | None = None,
) -> Path:
    """Write the page of a verb's result: the sections that `compose` draws of its values, below its grade;
    returns the path of the page.

    `file` and `name`, of values and page, are by default named after the verb. InputError when the values
    cannot be read or a key is absent.
    """
    values = stored_values(folder, verb, ("study",), file=file)
    try:
        with look():
            sections = compose(values)
        verdict = box(values)
    except KeyError as error:
        raise InputError(f"{folder / (file or f'{verb}.json')}: lacks {error}; run `{verb}` again") from error
    return write_page(folder, f"{values['study']}: {title}", sections, verdict, name or f"{verb}.html")


def write_page(
    folder: Path,
    title: str,
    sections: Sequence[Section],
    verdict: Verdict | None = None,
    name: str = "report.html",
) -> Path:
    """Write the figures of some sections and the page `name` that shows them; returns its path."""
    figures = writable_folder(folder / "figures")
    for section in sections:
        for drawing in section.drawings:
            write_text(figures / f"{file_stem(drawing)}.svg", drawing.svg)
    path = folder / name
    write_text(path, page(title, sections, verdict))
    return path


def page(title: str, sections: Sequence[Section], verdict: Verdict | None = None) -> str:
    """The page as HTML with its figures inside."""
    environment = Environment(
        loader=PackageLoader("lcopa_bayes.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["tied"] = lambda text: text.replace(" %", "\u00a0%").replace("p = ", "p\u00a0=\u00a0")
    environment.filters["svg"] = lambda drawing: Markup(inlined(drawing.svg, file_stem(drawing)))
    shown = environment.get_template("report.html")
    return shown.render(title=title, sections=sections, verdict=verdict) + "\n"


def file_stem(drawing: Drawing) -> str:
    """Stem of a drawing's file, whatever its record is called."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", drawing.stem)
