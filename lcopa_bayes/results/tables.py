"""The tables of a run: every curve and number a figure shows, as one tidy table each."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from lcopa_bayes.data.study import Study
from lcopa_bayes.results.bands import QUANTILE_NAMES, QUANTILES
from lcopa_bayes.results.prediction import Band
from lcopa_bayes.results.residuals import Residual
from lcopa_bayes.results.summary import results
from lcopa_bayes.sampling.crosscheck import CrossCheck

if TYPE_CHECKING:
    from lcopa_bayes.results.fit import Fit

_PRIOR_POINTS = 200
_BINS = 30


def tables(fit: Fit) -> dict[str, pd.DataFrame]:
    """Tables by file name."""
    values = results(fit)
    return {
        "parameters": pd.DataFrame(values["parameters"]),
        "sensitivity": pd.DataFrame(values["sensitivity"]),
        "step_metrics": pd.DataFrame(values["step_metrics"]),
        "scores": pd.DataFrame(
            [row | {"held_out": False} for row in values["fit_scores"]]
            + [row | {"held_out": True} for row in values["held_out"]]
        ),
        **data_tables(fit.study, fit.bands, fit.residuals),
        "step_response": _step_response(fit),
        "frequency_response": fit.frequency.table(),
        "priors": _priors(fit),
        "prior_density": _prior_density(fit),
    } | ({} if fit.cross_check is None else _cross_check(fit, fit.cross_check))


def data_tables(
    study: Study, bands: Sequence[Band], residuals: Sequence[Residual]
) -> dict[str, pd.DataFrame]:
    """Records with their bands, drives and residuals, by file name."""
    return {
        "bands": pd.concat([band.table() for band in bands], ignore_index=True),
        "drives": _drives(study),
        "residuals": _of_residuals(
            residuals,
            lambda one: {
                "unit": one.unit,
                "time": one.time,
                "residual": one.values,
                "innovation": one.innovations,
            },
        ),
        "autocorrelation": _of_residuals(
            residuals,
            lambda one: {
                "lag": np.arange(1, one.autocorrelation.size + 1),
                "autocorrelation": one.autocorrelation,
                "white_band_95": one.white_band,
            },
        ),
        "spectrum": _of_residuals(
            residuals, lambda one: {"frequency": one.frequency, "power_over_white": one.spectrum}
        ),
    }


def _drives(study: Study) -> pd.DataFrame:
    frames = [
        pd.DataFrame(
            {
                "record": record.name,
                "axis": axis.name,
                "unit": axis.unit,
                "time": record.time,
                "drive": record.drive[:, j],
            }
        )
        for record in (*study.fit, *study.held_out)
        for j, axis in enumerate(record.drive_axes)
    ]
    return pd.concat(frames, ignore_index=True)


def _of_residuals(
    residuals: Sequence[Residual], columns: Callable[[Residual], dict[str, Any]]
) -> pd.DataFrame:
    """Columns of every residual below each other; empty when every record is too short for one."""
    frames = [
        pd.DataFrame({"record": one.record, "axis": one.axis, "held_out": one.held_out, **columns(one)})
        for one in residuals
    ]
    return pd.concat(frames, ignore_index=True) if frames else pd.DataFrame()


def _step_response(fit: Fit) -> pd.DataFrame:
    layout, curves, frames = fit.draws.table.layout, fit.curves, []
    for i, j, path, unit in layout.paths:
        response_curve = curves.gains[:, i, j, None] * curves.normalised[curves.curve_of[i][j]]
        rows = np.quantile(response_curve, QUANTILES, axis=0)
        steady = np.quantile(curves.gains[:, i, j], (0.05, 0.5, 0.95))
        columns = {"path": path, "unit": unit, "time": curves.time}
        columns |= {f"response_{q}": row for q, row in zip(QUANTILE_NAMES, rows, strict=True)}
        columns |= {f"steady_{q}": v for q, v in zip(("05", "50", "95"), steady, strict=True)}
        frames.append(pd.DataFrame(columns))
    return pd.concat(frames, ignore_index=True)


def _priors(fit: Fit) -> pd.DataFrame:
    return pd.DataFrame(
        [
            {
                "name": row.name,
                "unit": row.unit,
                "prior": f"fixed at {row.value:.6g}" if row.prior is None else str(row.prior),
                "from": "default" if row.default and row.free else "study",
                "integrated_out": k in fit.problem.posterior.linear,
            }
            for k, row in enumerate(fit.draws.table.rows)
        ]
    )


def _prior_density(fit: Fit) -> pd.DataFrame:
    """Prior densities over the range the posterior covers, on the scale each parameter is sampled on."""
    frames = []
    for row in fit.draws.table.rows:
        if row.prior is None:
            continue
        drawn = fit.draws.column(row.name)
        low, high = float(drawn.min()), float(drawn.max())
        reach = 0.3 * (high - low)
        if row.log_scale:
            factor = (high / low) ** 0.3
            x = np.geomspace(low / factor, high * factor, _PRIOR_POINTS)
        else:
            x = np.linspace(low - reach, high + reach, _PRIOR_POINTS)
        density = np.exp(row.log_prior(x)) * (x if row.log_scale else 1.0)
        frames.append(
            pd.DataFrame({"name": row.name, "log_scale": row.log_scale, "x": x, "density": density})
        )
    return pd.concat(frames, ignore_index=True)


def _cross_check(fit: Fit, check: CrossCheck) -> dict[str, pd.DataFrame]:
    """Marginals by both methods, as numbers and as densities over the same bins, which span 99.8 % of the
    draws of both."""
    rows, densities = [], []
    for one in check.parameters:
        row = {"name": one.name, "unit": one.unit}
        for method, summary in (("ensembles", one.run), ("nested", one.nested)):
            row |= {f"{method}_{key}": value for key, value in summary.as_json().items()}
        rows.append(row | {"distance": one.distance, "p": one.p, "resolution": one.resolution})
        k = fit.draws.table.names.index(one.name)
        log = fit.draws.table.rows[k].log_scale
        both = [draws[:, k] for draws in (fit.draws.flat, check.nested.values)]
        both = [np.log(draws) for draws in both] if log else both
        ends = np.array([np.quantile(draws, (0.001, 0.999)) for draws in both])
        edges = np.linspace(ends[:, 0].min(), ends[:, 1].max(), _BINS + 1)
        heights = [np.histogram(draws, edges)[0] / (draws.size * np.diff(edges)) for draws in both]
        shown = np.exp(edges) if log else edges
        densities.append(
            pd.DataFrame(
                {
                    **{"name": one.name, "log_scale": log, "left": shown[:-1], "right": shown[1:]},
                    **{"ensembles": heights[0], "nested": heights[1]},
                }
            )
        )
    return {"cross_check": pd.DataFrame(rows), "cross_check_density": pd.concat(densities, ignore_index=True)}
