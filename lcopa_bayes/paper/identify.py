"""The verb `identify`: the paper's identification of every path, and what to hold it against.

Output-error fit of one path: many starts, exact Jacobian, continuous delay.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal, final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError, gathered, refuse_if
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.data.settings import ModelSettings, NoiseSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.paper.intervals import Interval, Scan
from lcopa_bayes.paper.paths import PathData, equation_rmse, least_squares, output_rmse, path_data
from lcopa_bayes.paper.scan import Scanned, scan


def output_error_fit(
    study: Study,
    data: PathData,
    rng: np.random.Generator,
    *,
    terms: int,
    orders: tuple[float, ...] | Literal["free"] = "free",
    start: TransferPath | None = None,
    starts: int = 12,
) -> TransferPath:
    """Least sum of squares of response minus model over etas, b, orders and delay together.

    The data are those of the scan, resting levels subtracted. Starts are the best of many draws from
    the default priors and, if it is physical, the model `start` (as many terms, decreasing orders). The
    default normal prior of the gain, five times the record's, is the only penalty. k is 1 in the result.
    """
    posterior = _posterior(study, data, terms, orders)
    solutions = [optimum.values for optimum in find_optima(posterior, rng, starts=starts)]
    if start is not None and start.physical:
        least = LeastSquares(posterior)
        values = least.with_noise(_values(posterior, start))
        solutions.append(least.solve(values)[0])
    models = [posterior.table.paths(values)[0][0] for values in solutions]
    return min(models, key=lambda model: output_rmse(data.records, model))


def _posterior(
    study: Study, data: PathData, terms: int, orders: tuple[float, ...] | Literal["free"]
) -> Posterior:
    single = Study(
        f"{study.name}-{data.name}",
        None,
        study.time_unit,
        study.seed,
        tuple(each.record for each in data.records),
        model=ModelSettings(terms=terms, orders=orders, offset="none", exposure_ms=study.model.exposure_ms),
        noise=NoiseSettings("white"),
    )
    return problem_of(single).posterior


def _values(posterior: Posterior, model: TransferPath) -> Vector:
    """Table values of a physical model; the noise scale is a guess."""
    table = posterior.table
    out = np.zeros(len(table.rows))
    out[table.at("gain", 0)] = model.steady
    times, orders = table.terms[0]
    out[times], out[orders] = model.times, model.orders
    out[table.at("delay", 0)] = model.delay
    out[table.at("sigma", 0)] = 1.0
    return out


@final
@dataclass(frozen=True)
class Identified:
    """A model of a path with its errors on the records it was identified from."""

    method: str
    model: TransferPath
    equation_rmse: float
    """Equation error over blocks, per unit of left side [response unit]; see `equation_rmse`."""
    output_rmse: float
    """Response minus model over samples [response unit]."""
    scanned: Scanned | None = None
    """The scan that it is the winner of; None for a fit."""


@final
@dataclass(frozen=True)
class Identification:
    """One path of a study, identified by several methods from the same records."""

    data: PathData
    scan: Identified
    """Least squares inside the scan with k given (Eqs. 62-64)."""
    scan_last_eta: Identified
    """The same with the last eta 1 instead (the form of Eq. 65)."""
    output_error: Identified
    """Output-error fit: many starts, continuous delay."""
    integer: Identified
    """The scan with k given and orders 2, 1, 1 (Section 5.2); equal orders act as one term."""
    integer_output_error: Identified
    """Output-error fit with the integer orders."""
    stiffness: tuple[tuple[float, float], ...]
    """Values of k scanned at the winner [-] and the output error with each [response unit]."""

    @property
    def models(self) -> tuple[Identified, ...]:
        """All models, in the order of the fields."""
        return (self.scan, self.scan_last_eta, self.output_error, self.integer, self.integer_output_error)


def identify(
    study: Study, *, plan: Scan | None = None, quiet: bool = True, jobs: int = 1
) -> tuple[Identification, ...]:
    """Identify every path of a study, row by row; the same for any number of `jobs`.

    A path is identified from the fit records in which its drive alone moves. Its number of terms, and
    its orders if fixed, are the study's. InputError when records or intervals cannot be used, or the study
    uses effects.
    """
    paths = scannable(study, plan)
    plan = _within_study(plan or Scan(), study)
    if jobs <= 1 or len(paths) == 1:
        with Progress(total=0, unit="candidate", desc="searching", quiet=quiet) as bar:
            return tuple(_identify(study, data, plan, bar) for data in paths)
    with workers((study, plan), jobs=min(jobs, len(paths))) as crew:
        identified = crew.each(_identified, paths)
        return tuple(Progress(identified, total=len(paths), unit="path", desc="identifying", quiet=quiet))


def _identified(shared: tuple[Study, Scan], data: PathData) -> Identification:
    return _identify(shared[0], data, shared[1])


def scannable(study: Study, plan: Scan | None = None) -> tuple[PathData, ...]:
    """Every path of a study that the plan can scan; InputError when records or intervals cannot be used, or
    the study uses effects."""
    if study.effects.use:
        raise InputError(
            f"{study.name}: uses {', '.join(study.effects.use)}, and the paper's model has no effects: its "
            "paths would take them up; leave `use` out of [effects], or `fit` the study"
        )
    plan = _within_study(plan or Scan(), study)
    paths = path_data(study)
    problems: list[str] = []
    for data in paths:
        with gathered(problems, f"path {data.name}: "):
            plan.first_round(data.terms, data.span, data.records[0].blocks.grid.step)
    refuse_if(problems)
    return paths


def integer_orders(terms: int) -> tuple[float, ...]:
    """Orders 2, 1, 1 of the integer rival, the equal ones merged: their terms act as one."""
    return (2.0, 1.0) if terms > 1 else (1.0,)


def _within_study(plan: Scan, study: Study) -> Scan:
    """The plan with the orders that the study fixes."""
    orders = study.model.orders
    if orders == "free":
        return plan
    distinct = sorted(set(orders), reverse=True)  # equal orders act as one term
    return replace(plan, orders=tuple(Interval(order, order) for order in distinct))


def _identify(study: Study, data: PathData, plan: Scan, bar: Progress | None = None) -> Identification:
    fixed, whole = study.model.orders != "free", integer_orders(data.terms)
    rigid = replace(plan, orders=tuple(Interval(order, order) for order in whole))
    scanned = []
    for title, count, limits, normalisation in (
        ("k given", data.terms, plan, Normalisation.STIFFNESS),
        ("last eta = 1", data.terms, plan, Normalisation.LAST_ETA),
        ("integer orders", len(whole), rigid, Normalisation.STIFFNESS),
    ):
        if bar is not None:
            bar.set_description(f"{data.name}, {title}")
        best = scan(data.blocks, count, data.span, limits, normalisation=normalisation, bar=bar)
        scanned.append(_described(f"scan, {title}", data, best.model, best))
    winner = scanned[0].model
    if bar is not None:
        bar.set_description(f"{data.name}, output error")
    rng = np.random.default_rng([study.seed, data.response, data.drive])
    free = output_error_fit(
        study, data, rng, terms=data.terms, orders=winner.orders if fixed else "free", start=winner
    )
    rival = scanned[2].model
    stiff = output_error_fit(study, data, rng, terms=len(whole), orders=whole, start=rival)
    with_k = {
        k: least_squares(data.blocks, winner.orders, winner.delay, known=k) for k in plan.stiffness
    }  # Eq. 63 solved anew at the winner's orders and delay
    return Identification(
        data,
        scanned[0],
        scanned[1],
        _described("output error", data, free),
        scanned[2],
        _described("output error, integer orders", data, stiff),
        tuple((k, output_rmse(data.records, model)) for k, model in with_k.items()),
    )


def _described(
    method: str, data: PathData, model: TransferPath, scanned: Scanned | None = None
) -> Identified:
    errors = equation_rmse(data.blocks, model), output_rmse(data.records, model)
    return Identified(method, model, *errors, scanned)


def results(study: Study, identified: tuple[Identification, ...], plan: Scan | None = None) -> dict[str, Any]:
    """Every number as plain JSON values; units beside them."""
    stiffness = (plan or Scan()).stiffness[0]
    return plain(
        {
            "study": study.name,
            "time_unit": study.time_unit,
            "verdict": " ".join(_sentence(each, study.time_unit) for each in identified),
            "paths": [_path(each, stiffness, study.time_unit) for each in identified],
        }
    )


def _sentence(identified: Identification, time_unit: str) -> str:
    """Result of the scan for one path, and how much worse integer orders are."""
    best, whole, unit = identified.scan, identified.integer, identified.data.response_unit
    orders = ", ".join(f"{order:.3g}" for order in best.model.orders)
    return (
        f"Path {identified.data.name}: orders {orders}, delay {best.model.delay:.4g} {time_unit}, RMSE "
        f"{best.output_rmse:.3g} {unit}; with integer orders {whole.output_rmse:.3g}."
    )


def _path(identified: Identification, stiffness: float, time_unit: str) -> dict[str, Any]:
    data = identified.data
    return {
        "path": data.name,
        "response_unit": data.response_unit,
        "drive_unit": data.drive_unit,
        "block": data.records[0].blocks.grid.step,
        "block_unit": time_unit,
        "records": [
            {"record": each.record.name, "level": each.level, "level_from": each.level_from}
            for each in data.records
        ],
        "models": [_model(each, stiffness, time_unit) for each in identified.models],
        "stiffness_scan": [{"stiffness": k, "output_rmse": rmse} for k, rmse in identified.stiffness],
    }


def _model(identified: Identified, stiffness: float, time_unit: str) -> dict[str, Any]:
    model, scanned = identified.model, identified.scanned
    return {
        "method": identified.method,
        "orders": model.orders,
        "delay": model.delay,
        "delay_unit": time_unit,
        "coefficients": {
            normalisation.value: {"gain": path.gain, "etas": path.etas, "stiffness": path.stiffness}
            for normalisation in Normalisation
            for path in (model.normalised(normalisation, stiffness),)
        },
        "steady": model.steady,
        "physical": model.physical,
        **attributes(identified, "equation_rmse", "output_rmse"),
        "candidates": scanned and scanned.candidates,
        "physical_candidates": scanned and scanned.physical,
        "unconstrained_output_rmse": scanned and scanned.unconstrained_rmse,
    }
