"""Figures of results for a notebook or a paper: what the pages draw, one at a time."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import wraps
from typing import Any, ParamSpec

from matplotlib.figure import Figure

from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.data.drive import Drive
from lcopa_bayes.paper.staticoptics import OpticsPlan, StaticOptics, static_optics
from lcopa_bayes.plot.audit import profiles_figure
from lcopa_bayes.plot.comparison import evidence_figure
from lcopa_bayes.plot.designs import drive_figure, precision_figure
from lcopa_bayes.plot.draws import IN_CORNER, corner_figure, forest_figure, ranked
from lcopa_bayes.plot.fleet import population_figure
from lcopa_bayes.plot.loop import before_after_figure
from lcopa_bayes.plot.optics import director_figure, far_field_figure
from lcopa_bayes.plot.records import prediction_figure, residual_figure, response_figure
from lcopa_bayes.plot.responses import bode_figure, steps_figure
from lcopa_bayes.plot.rundata import fit_of, run_of
from lcopa_bayes.plot.theme import look
from lcopa_bayes.results.newdrive import Prediction
from lcopa_bayes.results.result import Result
from lcopa_bayes.results.stored import StoredResult

P = ParamSpec("P")


def _styled(draw: Callable[P, Figure]) -> Callable[P, Figure]:
    """The function, its figure in the look of the pages."""

    @wraps(draw)
    def drawn(*args: P.args, **options: P.kwargs) -> Figure:
        with look():
            return draw(*args, **options)

    return drawn


@_styled
def bands(fit: Result, record: str | None = None, axis: str | None = None) -> Figure:
    """A measured response with the 50 and 90 % bands of a fit, above its drives.

    Parameters: `fit`, or a result that rests on one; `record` and `axis`, by default the first. InputError
    for names that the fit does not have.
    """
    run = run_of(fit)
    return response_figure(run, *_series(run.records("bands"), record, axis))


@_styled
def residuals(fit: Result, record: str | None = None, axis: str | None = None) -> Figure:
    """The residual of a response over time, its autocorrelation and its spectrum; parameters as `bands`.

    InputError too where every record is too short for a residual.
    """
    run = run_of(fit)
    return residual_figure(run, *_series(run.records("residuals"), record, axis))


@_styled
def corner(fit: Result, parameters: Sequence[str] = ()) -> Figure:
    """Marginals and pairs of `parameters`, by default of the first eight that vary, by interest."""
    run = run_of(fit)
    return corner_figure(run, _known(parameters, run.units) or ranked(run.varying)[:IN_CORNER])


@_styled
def forest(fit: Result, parameters: Sequence[str] = ()) -> Figure:
    """Median and 90 % interval of `parameters`, by default of all that are free; hollow where not
    graded reliable."""
    rows = {row["name"]: row for row in fit_of(fit).to_json()["parameters"]}
    return forest_figure([rows[name] for name in _known(parameters, rows) or rows])


@_styled
def steps(fit: Result, paths: Sequence[str] = ()) -> Figure:
    """Responses of `paths`, by default of all, to a unit step."""
    run = run_of(fit)
    there = list(dict.fromkeys(run.tables["step_response"]["path"]))
    return steps_figure(run, _known(paths, there) or there)


@_styled
def bode(fit: Result, paths: Sequence[str] = ()) -> Figure:
    """Gain and phase of `paths`, by default of all, over the frequencies that the fit records resolve."""
    run = run_of(fit)
    there = list(dict.fromkeys(run.tables["frequency_response"]["path"]))
    return bode_figure(run, _known(paths, there) or there)


@_styled
def profiles(audit: StoredResult, parameters: Sequence[str] = ()) -> Figure:
    """Profile likelihoods of `parameters`, by default of all, over their marginals."""
    rows = {row["name"]: row for row in _values(audit, "audit")["parameters"]}
    return profiles_figure([rows[name] for name in _known(parameters, rows) or rows], run_of(audit))


@_styled
def evidence(comparison: StoredResult) -> Figure:
    """Log evidence of the candidates of a comparison against their number of terms."""
    models = _values(comparison, "compare")["models"]
    return evidence_figure([row for row in models if row["usable"] and row["log_evidence"] is not None])


@_styled
def before_after(loop: StoredResult, record: str | None = None, axis: str | None = None) -> Figure:
    """A residual before and after the effects that a loop identified; `record` and `axis` as in `bands`."""
    values = _values(loop, "loop")
    shown = json.loads(loop.texts["loop_curves.json"])["curves"]
    curves = {(one["record"], one["axis"]): one for one in shown}
    return before_after_figure(curves[_series(curves, record, axis)], values["time_unit"])


@_styled
def design(design: StoredResult) -> Figure:
    """Precision of every parameter against bench time, after the best drive and after the plain step."""
    return precision_figure(_values(design, "design"))


@_styled
def fleet(fleet: StoredResult, parameters: Sequence[str] = (), group: int = 1) -> Figure:
    """`parameters` of the devices of a `group`, by default of all and of the largest, against their
    population."""
    groups = {one["number"]: one for one in _values(fleet, "fleet")["groups"] if one["parameters"]}
    if group not in groups:
        raise InputError(
            f"no group {group} with a population; there are: {', '.join(map(str, groups)) or 'none'}"
        )
    rows = {row["name"]: row for row in groups[group]["parameters"]}
    return population_figure([rows[name] for name in _known(parameters, rows) or rows])


@_styled
def drive(drive: Drive) -> Figure:
    """A drive over time, such as the one that a design recommends."""
    return drive_figure(drive)


@_styled
def prediction(prediction: Prediction, axis: str | None = None) -> Figure:
    """The predicted response `axis`, by default the first, above its drives."""
    rows, drives = prediction.table(), prediction.drives()
    there = list(dict.fromkeys(rows["axis"]))
    shown = _known([axis] if axis else [], there) or there
    return prediction_figure(rows[rows["axis"] == shown[0]], drives, prediction.time_unit)


@_styled
def far_field(optics: StoredResult) -> Figure:
    """Far field of a line of elements steered to each target (Ta et al. 2026, Fig. 3)."""
    return far_field_figure(_solved(optics))


@_styled
def director(optics: StoredResult) -> Figure:
    """Tilt of the director across the cell at several voltages (Ta et al. 2026, Fig. 10)."""
    return director_figure(_solved(optics))


def _solved(optics: StoredResult) -> StaticOptics:
    return static_optics(OpticsPlan(**_values(optics, "optics")["plan"]))


def _values(result: StoredResult, verb: str) -> Mapping[str, Any]:
    """Values of a result of a verb; InputError for that of another."""
    if result.verb != verb:
        raise InputError(f"needs the result of `{verb}`; got that of `{result.verb}`")
    return result.values


def _known(names: Sequence[str], there: Iterable[str]) -> list[str]:
    """The names; InputError with those that are not there."""
    there = list(there)
    absent = [f"no {name!r} here{nearest(name, there)}" for name in names if name not in there]
    if absent:
        raise InputError(absent)
    return list(names)


def _series(
    there: Iterable[tuple[str, str]] | Mapping[tuple[str, str], Any], record: str | None, axis: str | None
) -> tuple[str, str]:
    """The first record and axis of these names; InputError when there is none."""
    there = list(there)
    for one in there:
        if record in (None, one[0]) and axis in (None, one[1]):
            return one
    known = ", ".join(f"{name} ({of})" for name, of in there) or "none"
    raise InputError(f"no record {record!r} with axis {axis!r}; there are: {known}")
