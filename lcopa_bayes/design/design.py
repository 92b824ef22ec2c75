"""The verb `design`: which drive, for how long, makes which parameters how precise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, final

import numpy as np

from lcopa_bayes.arrays import Flags, Matrix, Vector
from lcopa_bayes.audit.bayes import prior_draws, prior_spread
from lcopa_bayes.audit.landscape import Landscape
from lcopa_bayes.audit.structure import Structure, structure
from lcopa_bayes.design.candidates import PLAIN, candidates
from lcopa_bayes.design.information import Bench
from lcopa_bayes.design.limits import Limits, bench_times, limits_of
from lcopa_bayes.design.precision import Promise, promises, reached, within
from lcopa_bayes.estimate import Estimate, plain
from lcopa_bayes.fit import Fit
from lcopa_bayes.problems import InputError

DRAWS = 24
"""Draws of the posterior that are averaged over."""
WANTED = 0.1
"""Relative standard deviation that bench times are sought for [-]."""
_PRIOR_POINTS = 12
"""Draws of the prior at which symmetries are looked for, besides those of the posterior."""


@final
@dataclass(frozen=True, eq=False)
class Design:
    """Promises of every drive at every bench time tried."""

    fit: Fit
    limits: Limits
    repeats: int
    time: float
    """Bench time designed for [time unit]."""
    draws: Matrix
    """Table values averaged over, (draws, rows)."""
    names: tuple[str, ...]
    """Plant parameters."""
    tried: tuple[tuple[Promise, ...], ...]
    """Per bench time, increasing, one promise per drive, the plain step first."""
    structure: Structure

    @cached_property
    def here(self) -> tuple[Promise, ...]:
        """Promises at the bench time designed for."""
        return next(row for row in self.tried if row[0].time == self.time)

    @property
    def step(self) -> Promise:
        """The plain step of equal time."""
        return self.here[0]

    @cached_property
    def determined(self) -> Flags:
        """Whether some drive determines a parameter within the time designed for, (parameters,)."""
        best = np.min([one.expected for one in self.here], axis=0)
        blind = np.array([name in self.structure.blind for name in self.names])
        return np.asarray(np.isfinite(best) & ~blind)

    @cached_property
    def winner(self) -> Promise:
        """Best for the worst parameter; the better on the whole where drives are equal in that."""
        return min(self.here, key=lambda one: (one.worst(self.determined), one.typical(self.determined)))

    @cached_property
    def overall(self) -> Promise:
        """D-optimal: smallest volume of the region of confidence."""
        return min(self.here, key=lambda one: one.typical(self.determined))

    @property
    def worst(self) -> str:
        """The parameter the winner knows least."""
        spread = np.where(self.determined, self.winner.expected, -np.inf)
        return self.names[int(np.argmax(spread))]

    @property
    def factor(self) -> float:
        """Worst expected standard deviation after the plain step over that after the winner [-]; infinite
        when the step leaves a parameter open."""
        return self.step.worst(self.determined) / self.winner.worst(self.determined)

    def estimate(self, promise: Promise, name: str) -> Estimate:
        """Expected relative standard deviation of a parameter, with its spread over the draws."""
        column = promise.relative[:, self.names.index(name)]
        grade = self.fit.draws.grade.level
        return Estimate.of(name, "-", column, ess=float(column.size), grade=grade)

    def best(self, name: str, row: tuple[Promise, ...]) -> Promise:
        """Best drive for one parameter at one bench time."""
        at = self.names.index(name)
        return min(row, key=lambda one: float(one.expected[at]))

    def time_needed(self, name: str) -> tuple[float, bool] | None:
        """Bench time for `WANTED` on a parameter by the best drive at each; see `reached`."""
        at = self.names.index(name)
        times = np.array([row[0].time for row in self.tried])
        spreads = np.array([self.best(name, row).expected[at] for row in self.tried])
        return None if name in self.structure.blind else reached(times, spreads, WANTED)

    def reason(self, name: str) -> str:
        """Why a parameter has no number, in words; empty when it has."""
        for symmetry in self.structure.symmetries:
            if name in symmetry.parameters:
                return f"structurally unidentifiable: before any noise, {symmetry.sentence}"
        if not self.determined[self.names.index(name)]:
            unit = self.fit.study.time_unit
            return f"at most draws of the posterior no drive tried determines it within {self.time:g} {unit}"
        return ""

    @cached_property
    def sentence(self) -> str:
        """The design in a sentence."""
        unit = self.fit.study.time_unit
        if not self.determined.any():
            return f"no drive tried determines any parameter within {self.time:g} {unit}"
        told = (
            f"{self.winner.candidate.name} for {self.time:g} {unit}: worst expected relative standard "
            f"deviation {self.winner.worst(self.determined):.3g} ({self.worst})"
        )
        if self.winner is self.step:
            return f"{told}; no drive tried is better than the plain step"
        if not np.isfinite(self.factor):
            return f"{told}; the plain step of equal time leaves a parameter open"
        return f"{told}, {self.factor:.3g} times smaller than after the plain step of equal time"


def design(
    fit: Fit,
    *,
    time: float | None = None,
    repeats: int = 1,
    amplitude: float | None = None,
    refresh: float | None = None,
    with_prior: bool = False,
    draws: int = DRAWS,
    ladder: bool = True,
) -> Design:
    """Compare candidate drives for a fitted study at many bench times.

    `time` [time unit of the study] is what the winner is chosen for, by default 40 spans of the records;
    without `ladder` no other time is tried. The measurement counts alone unless `with_prior`. InputError as
    `limits_of` and `bench_times`, for fewer than one repeat, and when no plant parameter is free.
    """
    problem, study = fit.problem, fit.study
    if repeats < 1:
        raise InputError(f"`repeats` must be one or more; got {repeats}")
    limits = limits_of(problem, amplitude=amplitude, refresh=refresh)
    times, chosen = bench_times(problem, limits, time)
    first = Bench(problem, times[0], limits.period)
    if not first.columns:
        raise InputError(f"{study.name}: no parameter of the plant is free; there is nothing to design for")
    averaged = fit.draws.thinned(draws)
    landscape = Landscape(problem.posterior)
    rng = np.random.default_rng([fit.run.plan.seed, 7])
    believed = prior_draws(landscape, rng)
    known = prior_spread(landscape, believed)[list(first.columns)] if with_prior else None
    tried = []
    for each in times if ladder else (chosen,):
        drives = candidates(limits, each, np.random.default_rng([study.seed, 8]), unit=study.time_unit)
        possible = [drive for drive in drives if within(drive, limits)]
        if not possible or possible[0].name != PLAIN:
            raise InputError(f"no candidate drive lies inside the amplitude limit at {each:g}")
        bench = Bench(problem, each, limits.period)
        tried.append(tuple(promises(bench, possible, averaged, repeats=repeats, prior=known)))
    found = _symmetries(first, limits, np.concatenate([averaged, believed[:_PRIOR_POINTS]]))
    return Design(fit, limits, repeats, chosen, averaged, first.names, tuple(tried), found)


def _symmetries(bench: Bench, limits: Limits, points: Matrix) -> Structure:
    """What no drive can tell apart, from all candidates of the shortest bench time together."""
    unit = bench.problem.study.time_unit
    drives = candidates(limits, bench.time, np.random.default_rng(0), unit=unit)
    slopes, values = [], []
    for point in points:
        elements, sizes = bench.elements(point), bench.sizes(point)
        if not (sizes > 0).all():  # a size of zero has no relative change
            continue
        stacked = [s for drive in drives for s in bench.slopes(point, elements, drive.command)]
        slopes.append((np.concatenate(stacked, axis=1) * sizes[:, None]).T)
        values.append(point[list(bench.columns)])
    if not slopes:
        return Structure((), 0, 0, True, np.empty(0))
    return structure(bench.names, slopes, values)


def as_json(made: Design) -> dict[str, Any]:
    """Every number of a design; what is infinite or undefined is None and has a reason in words."""
    study, table = made.fit.study, made.fit.draws.table
    determined = bool(made.determined.any())
    told: dict[str, Any] = plain(
        {
            "study": study.name,
            "verdict": made.sentence,
            "grade": made.fit.draws.grade.level,
            "grade_reason": made.fit.draws.grade.reason,
            "time": made.time,
            "time_unit": study.time_unit,
            "repeats": made.repeats,
            "draws": made.draws.shape[0],
            "refresh": made.limits.refresh,
            "period": made.limits.period,
            "range": [
                {"axis": axis.name, "unit": axis.unit, "rest": rest, "low": low, "high": high}
                for axis, rest, low, high in zip(
                    study.drive_axes, made.limits.rest, made.limits.low, made.limits.high, strict=True
                )
            ],
            "winner": _row(made, made.winner) if determined else None,
            "d_optimal": made.overall.candidate.name if determined else None,
            "factor_over_step": {
                "value": made.factor if determined else None,
                "unit": "-",
                "step": made.step.worst(made.determined) if determined else None,
                "winner": made.winner.worst(made.determined) if determined else None,
                "parameter": made.worst if determined else None,
            },
            "parameters": [_parameter(made, name, table.rows[table.names.index(name)].unit) for name in made.names],
            "table": [_row(made, one) for one in made.here],
            "curve": _curve(made),
            "structure": [one.as_json() for one in made.structure.symmetries],
        }
    )
    return told


def _row(made: Design, promise: Promise) -> dict[str, Any]:
    """One drive at one bench time."""
    among = made.determined
    return {
        "drive": promise.candidate.name,
        "family": promise.candidate.family,
        "words": promise.candidate.words if promise.excites else "excites nothing that could be seen",
        "changes": promise.candidate.command.times.size,
        "time": promise.time,
        "worst": promise.worst(among) if among.any() else None,
        "typical": promise.typical(among) if among.any() else None,
        "relative_sd": [
            made.estimate(promise, name).as_json() if made.determined[k] else None
            for k, name in enumerate(made.names)
        ],
    }


def _parameter(made: Design, name: str, unit: str) -> dict[str, Any]:
    """What becomes of one parameter."""
    at, needed, reason = made.names.index(name), made.time_needed(name), made.reason(name)
    best = made.best(name, made.here)
    sizes = np.abs(made.draws[:, made.fit.draws.table.names.index(name)])
    spread: Vector = best.relative[:, at] * sizes
    told = "not by any drive tried"
    if needed is not None:
        told = f"{'at most ' * needed[1]}{needed[0]:.3g} {made.fit.study.time_unit}"
    return {
        "name": name,
        "unit": unit,
        "reason": reason,
        "best_drive": None if reason else best.candidate.name,
        "relative_sd": None if reason else made.estimate(best, name).as_json(),
        "sd": None
        if reason
        else Estimate.of(
            name, unit, spread, ess=float(spread.size), grade=made.fit.draws.grade.level
        ).as_json(),
        "relative_sd_step": None if reason else made.estimate(made.step, name).as_json(),
        "relative_sd_winner": None if reason else made.estimate(made.winner, name).as_json(),
        "time_for_10_percent": None if needed is None else needed[0],
        "time_is_upper_bound": needed is not None and needed[1],
        "time_words": told,
    }


def _curve(made: Design) -> list[dict[str, Any]]:
    """Per bench time, the best drive and the plain step for every parameter."""
    out = []
    for row in made.tried:
        best = {name: made.best(name, row) for name in made.names if name not in made.structure.blind}
        out.append(
            {
                "time": row[0].time,
                "best": {name: one.expected[made.names.index(name)] for name, one in best.items()},
                "drive": {
                    name: one.candidate.name
                    for name, one in best.items()
                    if np.isfinite(one.expected[made.names.index(name)])
                },
                "step": {name: row[0].expected[made.names.index(name)] for name in best},
            }
        )
    return out
