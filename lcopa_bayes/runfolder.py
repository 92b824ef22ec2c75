"""The folder a run leaves: results, tables, draws and provenance, each file whole."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import arviz_base
import numpy as np
import pandas as pd

from lcopa_bayes.estimate import plain
from lcopa_bayes.files import write_text, write_whole
from lcopa_bayes.fit import Fit, results
from lcopa_bayes.predict import responses
from lcopa_bayes.provenance import provenance
from lcopa_bayes.tables import tables


def save_fit(fit: Fit, folder: Path, command: Sequence[str]) -> dict[str, Any]:
    """Write a fit's files into `folder` and return what `results.json` holds."""
    told = results(fit)
    (folder / "tables").mkdir(exist_ok=True)
    for name, table in tables(fit).items():
        save_table(table, folder / "tables" / f"{name}.csv")
    write_whole(folder / "posterior.nc", lambda beside: save_posterior(fit, beside))
    save_json(provenance(fit.study, command), folder / "provenance.json")
    save_json(told, folder / "results.json")
    return told


def save_table(table: pd.DataFrame, path: Path) -> None:
    """Write a table as CSV."""
    write_whole(path, lambda beside: table.to_csv(beside, index=False))


def save_json(values: Mapping[str, Any], path: Path) -> None:
    """Write plain values as JSON."""
    write_text(path, json.dumps(plain(values), indent=1, allow_nan=False) + "\n")


def save_posterior(fit: Fit, path: Path) -> None:
    """Draws as netCDF with the ArviZ groups.

    One variable per free parameter; per record and axis one of `log_likelihood`,
    `posterior_predictive` (plant with noise) and `observed_data`, named `<record>_<axis>`. A slash in a
    name, which netCDF keeps for groups, is written as a vertical bar.
    """
    draws, posterior = fit.draws, fit.problem.posterior
    table, shape = draws.table, draws.values.shape[:2]
    free = [k for k, row in enumerate(table.rows) if row.free]
    likelihood, predictive, observed, constant = _by_record(fit)
    tree = arviz_base.from_dict(
        {
            "posterior": {_variable(table.names[k]): draws.values[..., k] for k in free},
            "sample_stats": {"lp": draws.log_density},
            "log_prior": {
                _variable(row.name): row.log_prior(draws.values[..., k].ravel()).reshape(shape)
                for k, row in enumerate(table.rows)
                if row.free
            },
            "log_likelihood": likelihood,
            "posterior_predictive": predictive,
            "observed_data": observed,
            "constant_data": constant,
        }
    )
    for k in free:
        tree["posterior"][_variable(table.names[k])].attrs["units"] = table.rows[k].unit
    tree.attrs["grade"] = draws.grade.level
    tree.attrs["grade_reason"] = draws.grade.reason
    tree.attrs["noise"] = posterior.noise.kind
    tree.to_netcdf(path, engine="h5netcdf")


def _variable(name: str) -> str:
    return name.replace("/", "|")


def _by_record(fit: Fit) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Log likelihood, predictive draws, observations and times of every axis of every fit record."""
    draws, posterior = fit.draws, fit.problem.posterior
    values, shape = draws.flat, draws.values.shape[:2]
    rng = np.random.default_rng([fit.run.plan.seed, 3])
    parts = np.array_split(values, max(1, values.shape[0] // 64))
    pointwise = [posterior.pointwise(part) for part in parts]
    plant = [responses(draws.table, posterior.model, part) for part in parts]
    likelihood, predictive, observed, constant = {}, {}, {}, {}
    for r, samples in enumerate(posterior.samples):
        for axis, seen in enumerate(samples.axes):
            if seen.values.size == 0:
                continue
            name = _variable(f"{samples.record.name}_{samples.record.response_axes[axis].name}")
            density = np.concatenate([part[r][axis] for part in pointwise])
            response = np.concatenate([part[r][axis][:, seen.index] for part in plant])
            offset = draws.table.offset(values, axis, r)
            noise = posterior.noise.draw(posterior.noise_parameters(values, axis), seen.gaps, rng)
            likelihood[name] = density.reshape(*shape, -1).astype(np.float32)
            predictive[name] = (response + offset[:, None] + noise).reshape(*shape, -1).astype(np.float32)
            observed[name] = seen.values
            constant[f"{name}_time"] = samples.times[seen.index]
    return likelihood, predictive, observed, constant
