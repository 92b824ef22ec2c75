"""The folder a run leaves: results, tables, draws and provenance, each file whole."""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import Any

import arviz_base
import numpy as np

from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import enduring, save_json, save_table, writable_folder, write_text, write_whole
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.integerrival import Rival
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.results.provenance import provenance
from lcopa_bayes.results.savedfit import NAME, fit_to_json
from lcopa_bayes.results.summary import results
from lcopa_bayes.results.tables import tables

_PORTION = 64
"""Draws written at a time."""


def save_fit(fit: Fit, folder: Path, command: Sequence[str], *, rival: Rival | None = None) -> dict[str, Any]:
    """Write a fit's files into `folder`, with its rival's scores, and return what `results.json` holds.

    InputError naming the first file that cannot be written; those before it are whole.
    """
    told = results(fit) | {"rival": plain(rival.as_json()) if rival else None}
    if rival:
        told["verdict"] += f" {rival.sentence}"
    writable_folder(folder / "tables")
    for name, table in tables(fit).items():
        save_table(table, folder / "tables" / f"{name}.csv")
    write_whole(folder / "posterior.nc", lambda beside: save_posterior(fit, beside))
    write_text(folder / NAME, json.dumps(fit_to_json(fit.problem, fit.draws), allow_nan=False) + "\n")
    save_json(provenance(fit.study, command), folder / "provenance.json")
    save_json(told, folder / "results.json")
    return told


def save_posterior(fit: Fit, path: Path) -> None:
    """Draws as netCDF with the ArviZ groups.

    One variable per free parameter; per record and axis one of `log_likelihood`,
    `posterior_predictive` (plant with noise) and `observed_data`, named `<record>_<axis>` with both in
    its attributes. The priors of single parameters add up to that of all but for a constant, the attribute
    `joint_support` of `log_prior`: decreasing orders and resolved terms hold a part of the mass. A slash in a
    name, which netCDF keeps for groups, is written as a vertical bar;
    names that would be the same are told apart by a number (`variable_names`).
    """
    draws, posterior = fit.draws, fit.problem.posterior
    table, shape = draws.table, draws.values.shape[:2]
    free = [k for k, row in enumerate(table.rows) if row.free]
    variables = dict(zip(free, variable_names([table.names[k] for k in free]), strict=True))
    seen, likelihood, predictive, observed, constant = _by_record(fit)
    tree = arviz_base.from_dict(
        {
            "posterior": {name: draws.values[..., k] for k, name in variables.items()},
            "sample_stats": {"lp": draws.log_density},
            "log_prior": {
                name: table.rows[k].log_prior(draws.values[..., k].ravel()).reshape(shape)
                for k, name in variables.items()
            },
            "log_likelihood": likelihood,
            "posterior_predictive": predictive,
            "observed_data": observed,
            "constant_data": constant,
        }
    )
    for k, name in variables.items():
        tree["posterior"][name].attrs |= {"parameter": table.rows[k].name, "units": table.rows[k].unit}
    for name, (record, axis) in seen.items():
        for group in ("log_likelihood", "posterior_predictive", "observed_data"):
            tree[group][name].attrs |= {"record": record, "axis": axis}
        tree["constant_data"][f"{name}_time"].attrs |= {"record": record, "axis": axis}
    tree["log_prior"].attrs["joint_support"] = table.log_support - table.log_permutations
    tree.attrs["grade"] = draws.grade.level
    tree.attrs["grade_reason"] = draws.grade.reason
    tree.attrs["noise"] = posterior.noise.kind
    with enduring(path) as file:
        tree.to_netcdf(file, engine="h5netcdf")


def variable_names(wanted: Sequence[str]) -> list[str]:
    """Distinct netCDF names: as wanted, a slash as a bar; where several would be the same, or one would
    be the time `<name>_time` of another, a number follows, in their order."""
    plain_names = [name.replace("/", "|") for name in wanted]
    times = {f"{name}_time" for name in plain_names}
    clear = [plain_names.count(name) == 1 and name not in times for name in plain_names]
    taken = {*plain_names, *times}
    out = []
    for name, is_clear in zip(plain_names, clear, strict=True):
        numbered = (f"{name}_{number}" for number in count(1))
        out.append(name if is_clear else next(n for n in numbered if not {n, f"{n}_time"} & taken))
        taken |= {out[-1], f"{out[-1]}_time"}
    return out


def _by_record(
    fit: Fit,
) -> tuple[dict[str, tuple[str, str]], dict[str, Any], dict[str, Any], dict[str, Any], dict[str, Any]]:
    """Record and axis, log likelihood, predictive draws, observations and times of every axis of every fit
    record, by variable name.

    Single precision, a few draws at a time: these are by far the largest arrays of a run.
    """
    draws, posterior = fit.draws, fit.problem.posterior
    values, shape = draws.flat, draws.values.shape[:2]
    rng = np.random.default_rng([fit.run.plan.seed, 3])
    likelihood: dict[str, Any] = {}
    predictive: dict[str, Any] = {}
    observed: dict[str, Any] = {}
    constant: dict[str, Any] = {}
    told = {
        (r, axis): (samples.record.name, samples.record.response_axes[axis].name)
        for r, samples in enumerate(posterior.samples)
        for axis, seen in enumerate(samples.axes)
        if seen.values.size
    }
    names = dict(zip(told, variable_names(["_".join(pair) for pair in told.values()]), strict=True))
    for (r, axis), name in names.items():
        samples, seen = posterior.samples[r], posterior.samples[r].axes[axis]
        likelihood[name], predictive[name] = (
            np.empty((values.shape[0], seen.values.size), np.float32) for _ in range(2)
        )
        observed[name] = seen.values
        constant[f"{name}_time"] = samples.times[seen.index]
    for first in range(0, values.shape[0], _PORTION):
        rows = slice(first, first + _PORTION)
        part = values[rows]
        density, plant = posterior.pointwise(part), responses(draws.table, posterior.model, part)
        for (r, axis), name in names.items():
            seen = posterior.samples[r].axes[axis]
            noise = posterior.noise.draw(posterior.noise_parameters(part, axis), seen.gaps, rng)
            offset = draws.table.offset(part, axis, r)[:, None]
            likelihood[name][rows] = density[r][axis]
            predictive[name][rows] = plant[r][axis][:, seen.index] + offset + noise
    for arrays in (likelihood, predictive):
        for name in arrays:
            arrays[name] = arrays[name].reshape(*shape, -1)
    return {names[at]: pair for at, pair in told.items()}, likelihood, predictive, observed, constant
