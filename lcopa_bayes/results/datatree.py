"""The draws of a fit as an ArviZ data tree, and its netCDF file."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

import arviz_base
import numpy as np
import xarray as xr
from xarray import DataTree

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import enduring
from lcopa_bayes.results.prediction import responses

if TYPE_CHECKING:
    from lcopa_bayes.results.fit import Fit

POSTERIOR = "posterior.nc"
"""File of a run folder that holds the tree."""
_PORTION = 64
"""Draws written at a time."""


def save_tree(tree: DataTree, path: Path) -> None:
    """Write a data tree as netCDF, compressed without loss."""
    squeezed = {
        node.path: {name: {"compression": "gzip", "compression_opts": 4} for name in node.data_vars}
        for node in tree.subtree
    }
    with enduring(path) as file:
        tree.to_netcdf(file, engine="h5netcdf", encoding=squeezed)


def load_tree(path: Path) -> DataTree:
    """The data tree in a netCDF file, in memory; InputError when it cannot be read."""
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return tree.load()
    except (OSError, ValueError, RuntimeError) as error:
        raise InputError(f"{path}: cannot be read as draws ({error}); run `fit` again to write it") from None


def posterior_tree(fit: Fit) -> DataTree:
    """Draws of a fit with its data and prior in the ArviZ groups.

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
    return tree


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
