"""Figures engineers read off a step response, each with its credible interval."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.core.estimate import Estimate
from lcopa_bayes.core.units import per
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.layout import Layout, Unit
from lcopa_bayes.results.stepcurves import StepCurves, curves_at, step_curves
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws

_LATER = 4.0
"""Time after the record over which a response must stay where it settled, in spans of the record [-]: a fast
mode that crosses the steady value at the record's end is outside it again long before."""
_LATER_POINTS = 800
"""Samples of the response after the record."""
_FAST, _NEAREST, _ONSET_POINTS = 20.0, 1e-3, 120
"""Samples of a step response below which a rise is read off times of its own after each delay, the first of
these [sampling periods], and their number [-]."""
_SETTLED = 0.02
"""A response within this share of its steady value counts as settled [-]."""
_ROUNDING = 1e-6
"""Excess over its steady value that the calculated response of a plant without overshoot may have [-]."""
_HALF = 0.5
"""Share of the draws from which an element counts as too fast for the sampling [-]."""


def too_fast(draws: Draws, curves: StepCurves, period: float) -> list[Limitation]:
    """A limitation for every element whose step response rises within a sampling `period` [time unit].

    Rise is from 10 to 90 % of what the response reaches by the end of the record, in half of the draws or
    more: of such a response no sample shows the course, and its times and orders are what the priors allow.
    """
    table = draws.table
    out: list[Limitation] = []
    for unit in table.layout.units:
        k = _curve_of(table.layout, curves, unit)
        reached = curves.normalised[k] / curves.normalised[k][:, -1:]
        rise = _difference(crossing(curves.time, reached, 0.9), crossing(curves.time, reached, 0.1))
        terms = table.terms[unit.element]
        names = tuple(table.names[k] for k in terms.every if table.rows[k].free)
        if names and float(np.mean(rise < period)) >= _HALF and all(names != one.parameters for one in out):
            out.append(
                Limitation(
                    "tentative",
                    f"the step response rises within one sampling period: {', '.join(names)} say no more "
                    "than that it is too fast for the sampling, within their priors",
                    "sample faster, or fix them under [priors]",
                    names,
                )
            )
    return out


def _curve_of(layout: Layout, curves: StepCurves, unit: Unit) -> int:
    """A curve of the first path that a unit response belongs to."""
    paths = ((i, j) for i, row in enumerate(layout.unit_of) for j, k in enumerate(row))
    i, j = next((i, j) for i, j in paths if layout.units[layout.unit_of[i][j]] == unit)
    return curves.curve_of[i][j]


def crossing(time: Vector, curves: Matrix, level: float) -> Vector:
    """First time at which each curve (draws, n) reaches `level`; infinite when it never does."""
    above = curves >= level
    first = above.argmax(axis=1)
    reached = above.any(axis=1)
    rows = np.arange(curves.shape[0])
    before = np.where(first > 0, curves[rows, first - 1], 0.0)
    start = np.where(first > 0, time[first - 1], 0.0)
    after = curves[rows, first]
    share = (level - before) / np.where(after > before, after - before, 1.0)
    return np.where(reached, start + share * (time[first] - start), np.inf)


def settling(time: Vector, curves: Matrix, band: float, *, until: float = np.inf) -> Vector:
    """Last time at which each curve (draws, n) is `band` away from 1; infinite when that is after `until`.

    Infinite too when it is farther at the end. Curves that go on beyond `until` tell a response that has
    settled by then from one that only passes through the band at that time.
    """
    time = np.concatenate(([0.0], time))
    away = np.pad(curves - 1.0, ((0, 0), (1, 0)), constant_values=-1.0)  # nothing has moved at time 0
    last = time.size - 1 - (np.abs(away) > band)[:, ::-1].argmax(axis=1)
    after = np.minimum(last + 1, time.size - 1)
    rows = np.arange(curves.shape[0])
    outside, inside = away[rows, last], away[rows, after]
    travelled = np.where(last < after, outside - inside, 1.0)
    share = (outside - np.sign(outside) * band) / travelled
    settled = np.where(last < after, time[last] + share * (time[after] - time[last]), np.inf)
    return np.where(settled <= until, settled, np.inf)


def path_metrics(draws: Draws, *, span: float, time_unit: str, path: str | None = None) -> list[Estimate]:
    """`step_metrics` over any `span` [time unit], of one path ``<response>_<drive>`` or of all.

    The only path of a plant goes by the name of its response. InputError for a span that is not positive and
    a path the plant does not have.
    """
    if not 0 < span < np.inf:
        raise InputError(f"`span` must be a positive time [{time_unit}]; got {span!r}")
    paths = [one.name for one in draws.table.layout.paths]
    if path is not None and path not in paths:
        raise InputError(f"the plant has no path {path!r}{nearest(path, paths)}")
    metrics = step_metrics(draws, step_curves(draws, span), time_unit=time_unit)
    return [one for one in metrics if path is None or one.name.endswith(f"[{path}]")]


@final
@dataclass(frozen=True, eq=False)
class Metric:
    """One figure of a step response at every draw."""

    name: str
    unit: str
    values: Vector
    """(draws,) [unit]; infinite where it is not reached."""
    note: str = ""


def step_metrics(draws: Draws, curves: StepCurves, *, time_unit: str) -> list[Estimate]:
    """Intervals of `metrics_of`, under the grade of the draws."""
    grade, ess = draws.grade.level, draws.ess
    return [
        Estimate.of(one.name, one.unit, one.values, ess=ess, grade=grade, note=one.note)
        for one in metrics_of(draws.table, curves, time_unit=time_unit)
    ]


def metrics_of(table: ParameterTable, curves: StepCurves, *, time_unit: str) -> list[Metric]:
    """`figures_of` of a plant of a parameter table."""
    return figures_of(table.layout, curves, lambda time: curves_at(table, curves, time), time_unit=time_unit)


def figures_of(
    layout: Layout, curves: StepCurves, later_at: Callable[[Vector], Array], *, time_unit: str
) -> list[Metric]:
    """Metrics of every path: rise 10-90 %, delay, settling, overshoot, value at the end, steady state.

    Times are counted from the step. What is not reached within the record is open above; a response has
    settled when it stays within the band after the record too, to which the overshoot refers as well:
    `later_at` has the curves at such times, and at those just after a delay, (curves, draws, n) [-].
    """
    out: list[Metric] = []
    end = float(curves.time[-1])
    after = end * (1 + _LATER * np.arange(1, _LATER_POINTS + 1) / _LATER_POINTS)
    later, within, normalised = later_at(after), curves.time, curves.normalised
    early = _onset(curves)
    if early.size:
        within = np.concatenate((within, early))
        order = np.argsort(within)
        within, normalised = within[order], np.concatenate((normalised, later_at(early)), axis=2)[..., order]
    time = np.concatenate((within, after))

    def add(name: str, unit: str, values: Vector, note: str = "") -> None:
        out.append(Metric(name, unit, values, note))

    for i, j, path, unit in layout.paths:
        k = curves.curve_of[i][j]
        curve, whole = normalised[k], np.concatenate((normalised[k], later[k]), axis=1)
        gain = curves.gains[:, i, j]
        low, high = crossing(within, curve, 0.1), crossing(within, curve, 0.9)
        settled = settling(time, whole, _SETTLED, until=end)
        unsettled = float(np.mean(np.isinf(settled)))
        note = (
            f"{100 * unsettled:.0f} % of draws have not settled to {100 * _SETTLED:.0f} % of steady "
            "state by the end of the record"
            if unsettled > 0.05
            else ""
        )
        add(f"rise_10_90[{path}]", time_unit, _difference(high, low), note)
        add(f"delay[{path}]", time_unit, curves.delays[:, layout.delay_of[i][j]])
        add(f"settling_2[{path}]", time_unit, settled, note)
        add(f"settling_5[{path}]", time_unit, settling(time, whole, 0.05, until=end), note)
        beyond = whole.max(axis=1) - 1.0
        add(f"overshoot[{path}]", "-", np.where(beyond > _ROUNDING, beyond, 0.0))
        add(f"value_at_end[{path}]", unit, gain * curve[:, -1])
        add(f"steady_state[{path}]", unit, gain, note)
    out.extend(_crosstalk(layout, curves))
    return out


def _onset(curves: StepCurves) -> Vector:
    """Times just after the delays at which a fast response is read too; none where every rise lasts many
    samples."""
    period = float(curves.time[0])
    rises = [
        _difference(crossing(curves.time, one, 0.9), crossing(curves.time, one, 0.1))
        for one in curves.normalised
    ]
    if not any(np.median(rise) < _FAST * period for rise in rises):
        return np.empty(0)
    since = period * np.geomspace(_NEAREST, 2 * _FAST, _ONSET_POINTS)
    times = np.unique(np.median(curves.delays, axis=0)[:, None] + since)
    return np.asarray(times[times < curves.time[-1]])


def share_unsettled(curve: Matrix) -> float:
    """Share of draws that are not within 2 % of their steady state at the end."""
    return float(np.mean(np.abs(curve[:, -1] - 1.0) > _SETTLED))


def _difference(high: Vector, low: Vector) -> Vector:
    """high - low, infinite where `high` is never reached."""
    reached: Flags = np.isfinite(high)
    return np.where(reached, np.where(reached, high, 0.0) - np.where(reached, low, 0.0), np.inf)


def _crosstalk(layout: Layout, curves: StepCurves) -> list[Metric]:
    """Steady response of the other axes over that of the driven one, where two axes respond."""
    out = []
    for name, (i, own, j) in crosstalk_of(layout).items():
        direct, other = curves.gains[:, own, j], curves.gains[:, i, j]
        ratio = np.where(direct != 0, other / np.where(direct != 0, direct, 1), np.inf)
        out.append(Metric(name, per(layout.responses[i].unit, layout.responses[own].unit), ratio))
    return out


def crosstalk_of(layout: Layout) -> dict[str, tuple[int, int, int]]:
    """Figures that compare the steady responses to one drive, by name: the other axis, the one that the drive
    belongs to, and the drive."""
    out = {}
    for j, drive in enumerate(layout.drives):
        own = layout.own_response(j)
        for i, response in enumerate(layout.responses):
            if own is not None and i != own:
                name = f"crosstalk[{response.name}/{layout.responses[own].name} by {drive.name}]"
                out[name] = i, own, j
    return out
