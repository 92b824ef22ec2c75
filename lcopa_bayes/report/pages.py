"""Which page shows the result of which verb, and the page of a fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeAlias

from jinja2 import UndefinedError

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.plot.rundata import RunData, load_run
from lcopa_bayes.plot.theme import look
from lcopa_bayes.report import (
    audit,
    calibrate,
    check,
    claims,
    compare,
    design,
    draws,
    fleet,
    identify,
    loop,
    optics,
    predict,
    records,
    responses,
)
from lcopa_bayes.report.answers import answers
from lcopa_bayes.report.page import Drawings, Verdict, write_page
from lcopa_bayes.report.rules import rules
from lcopa_bayes.results.result import Fresh
from lcopa_bayes.results.stored import stored_values

Draw: TypeAlias = Callable[[Path, Mapping[str, Any]], Drawings]
"""Gives the figures of a page from the run folder and the values of a result, under `verdict` the box at its
top where it is another than that of the values, or None."""
Part: TypeAlias = Callable[[RunData], Drawings]
_HALVES: tuple[tuple[Part, ...], ...] = (
    (draws.pairs,),
    (draws.parameters, records.drawn, responses.drawn, draws.sampling),
)
"""What draws the page of a fit: the corner plot takes as long as all other figures."""


def write_report(folder: Path, fresh: Fresh | None = None, halves: Sequence[Drawings] = ()) -> Path:
    """Draw the report of a run folder: `figures/*.svg` and `report.html`, whose path is returned.

    Reads only the folder, and values and draws that are to be there where they are `fresh`, and calculates
    nothing; the same folder gives the same bytes. The figures may be there as the `drawn_half` of both
    halves. InputError when a file of the folder is missing or cannot be used.
    """
    with _complete(folder / "results.json", "fit"):
        run = load_run(folder, fresh)

    def drawn(*_: object) -> Drawings:
        figures = halves or [_figures(run, parts) for parts in _HALVES]
        return {key: one for half in figures for key, one in half.items()} | {"run": run, "rules": rules()}

    return _written(folder, "fit", "", run.results, drawn)


def drawn_half(folder: Path, fresh: Fresh | None, half: int) -> Drawings:
    """One half of the figures of a fit, 0 or 1; arguments and errors as `write_report`."""
    with _complete(folder / "results.json", "fit"), look():
        return _figures(load_run(folder, fresh), _HALVES[half])


def _figures(run: RunData, parts: Sequence[Part]) -> Drawings:
    return {key: one for part in parts for key, one in part(run).items()}


_PAGES: Mapping[str, tuple[str, Draw]] = {
    "check": ("what was understood", check.checked),
    "look": ("first look", check.looked),
    "audit": ("identifiability", audit.drawn),
    "design": ("what to measure next", design.drawn),
    "compare": ("comparison", compare.drawn),
    "loop": ("what the model lacks", loop.drawn),
    "calibrate": ("calibration", calibrate.drawn),
    "fleet": ("fleet", fleet.drawn),
    "predict": ("response to {drive}", predict.drawn),
    "optics": ("Static optics of the array", optics.drawn),
    "identify": ("identification", identify.drawn),
    "claims": ("Claims of the paper", claims.drawn),
}
"""Title, which may hold entries of the values, and what draws the figures."""
_REPORTS = ("fit", "calibrate")
"""Verbs whose values and page are called results and report."""


def write_page_of(verb: str, folder: Path) -> Path:
    """Draw the page of a verb's result from the files of its run folder alone; returns its path.

    InputError when a file is missing or cannot be used.
    """
    if verb == "fit":
        return write_report(folder)
    title, draw = _PAGES[verb]
    values = stored_values(folder, verb, (), file="results.json" if verb in _REPORTS else None)
    return _written(folder, verb, title, values, draw)


def _plant(folder: Path) -> Sequence[str]:
    """Equation of the fit beside a result; none where there is no fit."""
    if not (folder / "results.json").is_file():
        return ()
    fitted = stored_values(folder, "fit", (), file="results.json")
    return list(fitted["overview"]["plant"]) if "overview" in fitted else ()


def _written(folder: Path, verb: str, title: str, values: Mapping[str, Any], draw: Draw) -> Path:
    """Write a page by the template of its verb, with the verdict that is drawn, else that of the values."""
    name, file = ("report.html", "results.json") if verb in _REPORTS else (f"{verb}.html", f"{verb}.json")
    with _complete(folder / file, verb):
        with look():
            shown = draw(folder, values)
        verdict = shown["verdict"] if "verdict" in shown else Verdict.of(values)
        titled = ": ".join(filter(None, (values.get("study"), title.format_map(values))))
        overview = values.get("overview") or {"plant": _plant(folder), "answers": answers(verb, values)}
        return write_page(
            folder, f"{verb}.html", titled, values, shown, verdict=verdict, overview=overview, name=name
        )


@contextmanager
def _complete(file: Path, verb: str) -> Iterator[None]:
    """Within it what a file of a verb's values lacks is an InputError that names it."""
    try:
        yield
    except (KeyError, UndefinedError) as error:
        raise InputError(f"{file}: lacks {error}; run `{verb}` again") from error
