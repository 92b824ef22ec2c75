"""Pages: the template of each verb holds its words and tables, and figures are drawn for it.

A template calls `section`, `p`, `table` with `cells`, and `figures` of a `Page`, and prints the values of a
result through the functions of `formatting`. A page needs nothing else; its figures are files too.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.resources import files
from itertools import product
from pathlib import Path
from typing import Any, TypeAlias, final

from jinja2 import ChoiceLoader, Environment, FileSystemLoader, PackageLoader, StrictUndefined
from markupsafe import Markup, escape

from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.core.units import measured
from lcopa_bayes.report import formatting
from lcopa_bayes.report.svg import COLOURS, Drawing, inlined
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS
from lcopa_bayes.results.datatree import POSTERIOR

Drawings: TypeAlias = Mapping[str, Any]
"""Figures by the name under which a template places them, and what else it shows as it is."""
_KINDS = ("text", "number", "grade", "code", "interval", "prose")
"""Cells of `text` and `number` stay on one line; those of `interval` and `prose` may wrap."""
UNFOLDED = 4
"""Figures of a series that are shown at once."""
_CODE = re.compile(r"`([^`\n]+)`")
_POWER = re.compile(r"\^([-\u2212]?\d[\d.]*\d|[-\u2212]?\d)")
_PRINTED = ("figures", "percent", "ends", "spread", "sentence", "stopped", "probability")
"""Functions of `formatting` that are filters; a template calls the others."""
_CALLED = ("interval", "to_spread", "with_error", "NONE", "OPEN")
_ADVICE = {
    "reliable": "The sampling behind the numbers is reliable.",
    "tentative": "Read the numbers below with caution: a longer run or another model may change them.",
    "unusable": "Do not use the numbers below.",
}


@final
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

    @property
    def reasons(self) -> list[str]:
        """Clauses of the reason, without full stops: the first is the most severe."""
        return self.reason.split("; ") if self.reason else []

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Verdict:
        """Verdict of a result; grade and reason are not repeated."""
        grade, sentence, reason = (str(values[key]) for key in ("grade", "verdict", "grade_reason"))
        sentence = sentence.removeprefix(f"Grade {grade}: {reason}. ")
        return cls(grade, formatting.stopped(sentence), "" if reason in sentence else reason)


@final
@dataclass
class Page:
    """What a template puts on a page, in the order it does so."""

    folder: Path
    """The run folder, whose files a figure may name."""
    titles: list[str] = field(default_factory=list)
    drawings: list[Drawing] = field(default_factory=list)
    _kinds: list[str] = field(default_factory=list)

    def section(self, title: str, caller: Callable[[], str], folded: bool = False) -> Markup:
        """A titled part of the page, which may be `folded` until it is asked for."""
        self.titles.append(title)
        shown = '<section id="{}">\n<details{}>\n<summary><h2>{}</h2></summary>\n{}</details>\n</section>\n'
        state = "" if folded else Markup(" open")
        return Markup(shown).format(anchor(title), state, title, Markup(caller()))

    def p(self, text: str = "", caller: Callable[[], str] | None = None) -> Markup:
        """A paragraph."""
        return Markup("<p>{}</p>\n").format(tied(text if caller is None else caller()))

    def table(
        self, rows: Iterable[Any], *heads: str, caption: str = "", caller: Callable[[Any], str]
    ) -> Markup:
        """A table with a row for each of `rows`, whose `cells` the template gives; nothing without rows. Its
        caption is by default the title of the section.

        `heads` are titles, each with the kind of its column behind a colon unless it is `text`.
        """
        split = [head.rpartition(":") for head in heads]
        columns = [
            (title, kind) if kind in _KINDS else (head, "text")
            for head, (title, _, kind) in zip(heads, split, strict=True)
        ]
        self._kinds = [kind for _, kind in columns]
        body = [Markup("<tr>{}</tr>\n").format(Markup(caller(row).strip())) for row in rows]
        if not body:
            return Markup("")
        head = Markup("").join(
            Markup('<th scope="col" class="{}">{}</th>').format(kind, title) for title, kind in columns
        )
        shown = (
            '<div class="wide" tabindex="0" role="group" aria-label="{}">\n<table>\n'
            "<caption{}><span>{}</span></caption>\n<thead><tr>{}</tr></thead>\n<tbody>\n{}</tbody>\n"
            "</table>\n</div>\n"
        )
        hidden = Markup("") if caption else Markup(' class="hidden"')
        title = self.titles[-1] if self.titles else "Table"
        name = f"{title}: {columns[0][0]}"
        return Markup(shown).format(name, hidden, tied(caption or title), head, Markup("").join(body))

    def cells(self, *values: object) -> Markup:
        """Cells of a row; a number is printed to three digits, what is undefined as a dash.

        ValueError unless there is one for each column.
        """
        if len(values) != len(self._kinds):
            raise ValueError(f"each row needs {len(self._kinds)} cells; got {values}")
        row = Markup("").join(map(_cell, self._kinds, values))
        return Markup(str(row).replace("<td", '<th scope="row"', 1).replace("</td>", "</th>", 1))

    def figures(self, drawings: Iterable[Drawing], unfolded: int = UNFOLDED) -> Markup:
        """Figures with their captions; of many alike all but the first few are folded."""
        shown = [self._figure(one) for one in drawings]
        first, rest = shown[:unfolded], shown[unfolded:]
        out = Markup("").join(first)
        if rest:
            more = "<details>\n<summary>{} more</summary>\n{}</details>\n"
            out += Markup(more).format(len(rest), Markup("").join(rest))
        return out

    def _figure(self, one: Drawing) -> Markup:
        self.drawings.append(one)
        mark = Markup('<span class="mark">{}</span>').format(one.mark) if one.mark else ""
        data = ""
        if one.data == POSTERIOR or (one.data and (self.folder / one.data).is_file()):  # the first may follow
            data = Markup(' <a href="{0}">Numbers: {0}</a>').format(one.data)
        values = ""
        if one.series:
            text = json.dumps(one.series, allow_nan=False, separators=(",", ":")).replace("<", "\\u003c")
            values = Markup(
                '<details class="explore">\n<summary>Values and zoom</summary>\n'
                '<script type="application/json">{}</script>\n</details>\n'
            ).format(Markup(text))
        shown = (
            '<figure>\n<div class="wide" role="img" aria-label="{}">{}</div>\n'
            "<figcaption>{}{}{}</figcaption>\n{}</figure>\n"
        )
        svg = Markup(inlined(one.svg, file_stem(one)))
        return Markup(shown).format(one.caption, svg, mark, tied(one.caption), data, values)


def _cell(kind: str, value: object) -> Markup:
    number = kind == "number" and isinstance(value, float)
    text = formatting.figures(value) if value is None or number else value  # type: ignore[arg-type]
    if kind == "prose":
        text = tied(str(text))
    elif kind not in ("code", "grade"):
        text = formatting.signed(str(text))
    return Markup('<td class="{}">{}</td>').format(f"{kind} {text}" if kind == "grade" else kind, text)


def each(rows: Iterable[Mapping[str, Any]], *keys: str) -> list[tuple[Any, Any]]:
    """Every row with every entry of its lists of these keys."""
    return [(row, one) for row in rows for key in keys for one in row[key]]


def noted(rows: Iterable[Mapping[str, Any]]) -> dict[str, str]:
    """What a table shows in place of each `note` of its rows: the number of the note below the table, nothing
    for a row without one; empty where no row has any."""
    notes = dict.fromkeys(note for row in rows if (note := row.get("note", "")))
    return {note: str(number) for number, note in enumerate(notes, start=1)} | ({"": ""} if notes else {})


def anchor(title: str) -> str:
    """Name of a section inside its page."""
    return "-".join("".join(c if c.isalnum() else " " for c in title.lower()).split())


def tied(text: str) -> Markup:
    """A paragraph with true minus signs, without line breaks in percentages and p-values."""
    words = formatting.signed(re.sub(r"[ \n]+", " ", escape(text)).strip())
    words = words.replace(" %", "\u00a0%").replace("p = ", "p\u00a0=\u00a0")
    return Markup(_POWER.sub(r"<sup>\1</sup>", _CODE.sub(r"<code>\1</code>", words)))


def equation(lines: Sequence[str]) -> Markup:
    """Lines of a transfer function with raised exponents."""
    text = escape(formatting.signed("\n".join(lines)))
    return Markup(_POWER.sub(r"<sup>\1</sup>", str(text)))


def _script(name: str) -> Markup:
    return Markup(files("lcopa_bayes.report").joinpath(name).read_text(encoding="utf-8"))


def write_page(
    folder: Path,
    template: str | Path,
    title: str,
    values: Mapping[str, Any],
    drawn: Drawings,
    *,
    verdict: Verdict | None = None,
    overview: Mapping[str, Any] | None = None,
    name: str | None = None,
) -> Path:
    """Write a page and its figures; returns the path of the page, by default named as the template.

    The template, the package's by its name or a file, sees `values` as `v`, and the figures as `drawn`.
    Before it stands an `overview`: lines of `plant` and `answers` with their sections. ValueError where such
    a section is not on the page.
    """
    page, template = Page(folder), Path(template)
    environment = Environment(
        loader=ChoiceLoader([FileSystemLoader(template.parent), PackageLoader("lcopa_bayes.report", ".")]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {key: getattr(formatting, key) for key in _PRINTED} | {
        "anchor": anchor,
        "equation": equation,
        "tied": tied,
    }
    environment.globals |= {key: getattr(formatting, key) for key in _CALLED}
    environment.globals |= {key: getattr(page, key) for key in ("section", "p", "table", "cells", "figures")}
    environment.globals |= {
        "each": each,
        "noted": noted,
        "pairs": zip,
        "product": product,
        "measured": measured,
    }
    environment.globals |= {"POINTWISE": POINTWISE, "SIMULTANEOUS": SIMULTANEOUS}
    shown = {"v": values, "drawn": drawn, "overview": overview}
    first = environment.get_template("summary.html").render(shown) if overview else ""
    body = first + environment.get_template(template.name).render(shown)
    linked = re.findall(r'href="#([^"]+)">', first)
    if lost := set(linked) - set(map(anchor, page.titles)):
        raise ValueError(f"the overview names sections that the page lacks: {', '.join(sorted(lost))}")
    whole = environment.get_template("page.html")
    explored = any(one.series for one in page.drawings)
    text = whole.render(
        title=title,
        titles=page.titles,
        body=Markup(body),
        verdict=verdict,
        colours=COLOURS,
        styles=[_script("page.css"), *([_script("uplot.css")] if explored else [])],
        scripts=[_script("page.js"), *(map(_script, ("uplot.js", "explore.js")) if explored else [])],
    )
    figures = writable_folder(folder / "figures")
    for drawing in page.drawings:
        write_text(figures / f"{file_stem(drawing)}.svg", drawing.svg)
    path = folder / (name or template.name)
    write_text(path, f"{text}\n")
    return path


def file_stem(drawing: Drawing) -> str:
    """Stem of a drawing's file, whatever its record is called."""
    return re.sub(r"[^A-Za-z0-9_-]+", "_", drawing.stem)
