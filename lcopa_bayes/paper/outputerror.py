"""Output-error fit of one path: many starts, exact Jacobian, continuous delay."""

from __future__ import annotations

from typing import Literal

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.settings import ModelSettings, NoiseSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.equation import output_rmse
from lcopa_bayes.paper.paths import PathData


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
