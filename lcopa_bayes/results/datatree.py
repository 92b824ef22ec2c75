"""The draws of a fit as an ArviZ data tree, and its netCDF file."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from io import BytesIO
from itertools import count
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, final

import arviz_base
import numpy as np
import xarray as xr
from xarray import DataTree

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.results.prediction import record_draws, responses
from lcopa_bayes.results.runfolder import settings_of

if TYPE_CHECKING:
    from lcopa_bayes.results.fit import Fit

POSTERIOR = "posterior.nc"
"""File of a run folder that holds the tree."""
_PORTION = 64
"""Draws predicted at a time."""
_CELLS = 10_000_000
"""Draws times samples of a group of all fit records at most ..."""
_FEWEST = 400
"""... but so many draws at least [-]."""
_PRIOR_DRAWS, _FEWER = 200, 32
"""Draws of the prior."""


def save_tree(tree: DataTree, path: Path) -> None:
    """Write a data tree as netCDF, compressed without loss.

    Bytes are sorted by significance first: draws are then smaller by a seventh at the least level than at
    level four without, in half the time. HDF5 writes into memory: it does not survive a full disk.
    """
    squeezed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    squeezed = {node.path: dict.fromkeys(node.data_vars, squeezed) for node in tree.subtree}
    image = BytesIO()
    tree.to_netcdf(image, engine="h5netcdf", encoding=squeezed)
    path.write_bytes(image.getbuffer())


def load_tree(path: Path) -> DataTree:
    """The data tree in a netCDF file, in memory; InputError when it cannot be read."""
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            return tree.load()
    except Exception as error:  # whatever a damaged file leads the library to
        raise InputError(f"{path}: cannot be read as draws ({error}); run `fit` again to write it") from None


def posterior_draws(path: Path) -> dict[str, Matrix]:
    """Draws of every free parameter by its name, (chains, draws), in the netCDF file of a fit; what xarray
    raises for another file passes through."""
    with xr.open_dataset(path, group="posterior", engine="h5netcdf") as group:
        return {
            str(one.attrs.get("parameter", name)): one.transpose("chain", "draw").to_numpy()
            for name, one in group.data_vars.items()
            if set(one.dims) == {"chain", "draw"}
        }


def posterior_tree(fit: Fit, *, compact: bool = False) -> DataTree:
    """Draws of a fit with its data and prior in the ArviZ groups.

    `posterior`, `prior` and `log_prior` hold one variable per free parameter, with its name and unit as
    attributes; per response axis of a record, `<record>_<axis>` with both as attributes, there are
    `log_likelihood`, `posterior_predictive` and `prior_predictive` (plant with noise) and `observed_data`,
    and of held-out records `predictions` (with noise) and, beside the drives, `predictions_constant_data`.
    Their dimension is `<record>_<axis>_time` with the times as coordinate. Drives are in the constant data
    by `<record>_drive_time` and `drive`, the axes' names; `record` lists the records.

    Of long records, and of all where it shall be `compact`, `log_likelihood` and `posterior_predictive` hold
    every k-th draw, as their coordinate `draw` says; a compact tree has no groups of the prior, which depends
    on the study and its seed alone. The priors of single parameters add up to that of all but for a constant,
    the attribute `joint_support` of `log_prior`: decreasing orders and resolved terms hold a part of the
    mass. A slash in a name, which netCDF keeps for groups, is written as a vertical bar; names that would be
    the same get a number (`variable_names`).
    """
    draws, problem = fit.draws, fit.problem
    posterior, table, study = problem.posterior, draws.table, fit.study
    free = [k for k, row in enumerate(table.rows) if row.free]
    variables = dict(zip(free, variable_names([table.names[k] for k in free]), strict=True))
    rng = np.random.default_rng([study.seed, 3])
    fitted = _Series.of(posterior.samples)
    shape = draws.values.shape[:2]
    cells = 0 if compact else _CELLS
    some = slice(None, None, _step(shape, sum(each.size for each in fitted.observed.values()), cells))
    kept = draws.values[:, some]
    flat = kept.reshape(-1, kept.shape[2])
    likelihood, predictive = _predicted(fit, fitted, flat, rng, likelihood=True)
    groups: dict[str, dict[str, Any]] = {
        "posterior": {name: draws.values[..., k] for k, name in variables.items()},
        "sample_stats": {"lp": draws.log_density},
        "log_likelihood": {name: each.reshape(*kept.shape[:2], -1) for name, each in likelihood.items()},
        "posterior_predictive": {
            name: each.reshape(*kept.shape[:2], -1) for name, each in predictive.items()
        },
        "observed_data": fitted.observed,
    }
    if not compact:
        groups |= _before(fit, fitted, variables)
    series = [fitted]
    drives = _commanded(study.fit)
    groups["constant_data"] = {name: one.drive for name, one in drives.items()}
    if study.held_out:
        samples, model = problem.simulated(study.held_out)
        apart, later = _Series.of(samples), _commanded(study.held_out)
        drawn = record_draws(draws, model, samples, posterior.noise, held_out=True, seed=fit.run.plan.seed)
        names = {pair: name for name, pair in apart.origins.items()}
        groups["predictions"] = {
            names[record, axis.name]: (response + offset[0][:, None] + noises)[None].astype(np.float32)
            for (record, axis, _), _, _, response, noises, offset in drawn
        }
        groups["predictions_constant_data"] = apart.observed | {
            name: one.drive for name, one in later.items()
        }
        series, drives = [fitted, apart], drives | later
    dims, coords = _dimensions(series, drives, [axis.name for axis in study.drive_axes])
    tree = arviz_base.from_dict(groups, dims=dims, coords=coords, pred_dims=dims, pred_coords=coords)
    for name in ("log_likelihood", "posterior_predictive"):
        tree[name].coords["draw"] = np.arange(shape[1])[some]
    _describe(tree, fit, variables, series)
    return tree


def _before(fit: Fit, fitted: _Series, variables: Mapping[int, str]) -> dict[str, dict[str, Any]]:
    """The groups of the prior: its draws, what they predict, and its density at the draws of the fit."""
    draws, table, seed = fit.draws, fit.draws.table, fit.study.seed
    count = _PRIOR_DRAWS if table.effects is None else _FEWER
    prior = table.draw(count, np.random.default_rng([seed, 9]))
    _, predicted = _predicted(fit, fitted, prior, np.random.default_rng([seed, 10]), likelihood=False)
    return {
        "log_prior": {
            name: table.rows[k].log_prior(draws.values[..., k].ravel()).reshape(draws.values.shape[:2])
            for k, name in variables.items()
        },
        "prior": {name: prior[None, :, k] for k, name in variables.items()},
        "prior_predictive": {name: each[None] for name, each in predicted.items()},
    }


def _step(draws: tuple[int, ...], samples: int, cells: int) -> int:
    """Every so many draws of (chains, draws) are kept of what has one number for each sample, for so many
    numbers or the fewest draws."""
    fits = max(cells // max(samples, 1), _FEWEST)
    return max(1, min(prod(draws) // fits, draws[1]))


def _dimensions(
    series: Sequence[_Series], drives: Mapping[str, Record], axes: Sequence[str]
) -> tuple[dict[str, list[str]], dict[str, Any]]:
    """Dimensions of every variable beyond chain and draw, and their coordinates."""
    dims: dict[str, list[str]] = {}
    coords: dict[str, Any] = {"drive": list(axes)}
    for one in series:
        dims |= {name: [f"{name}_time"] for name in one.observed}
        coords |= {f"{name}_time": times for name, times in one.times.items()}
    dims |= {name: [f"{name}_time", "drive"] for name in drives}
    return dims, coords | {f"{name}_time": one.time for name, one in drives.items()}


def _describe(tree: DataTree, fit: Fit, variables: Mapping[int, str], series: Sequence[_Series]) -> None:
    """Names, units, records and what the whole rests on, as attributes and coordinates."""
    table, study, grade = fit.draws.table, fit.study, fit.draws.grade
    for k, name in variables.items():
        for group in {"posterior", "prior"} & set(tree.children):
            tree[group][name].attrs |= {"parameter": table.rows[k].name, "units": table.rows[k].unit}
    units = {axis.name: axis.unit for axis in study.response_axes}
    for node in tree.children.values():
        for one in series:
            for name, (record, axis) in one.origins.items():
                if name in node.data_vars:
                    more = {} if node.name == "log_likelihood" else {"units": units[axis]}
                    node[name].attrs |= {"record": record, "axis": axis, **more}
        for coordinate in node.coords:
            if str(coordinate).endswith("_time"):
                node[str(coordinate)].attrs["units"] = study.time_unit
    for group, records in (("constant_data", study.fit), ("predictions_constant_data", study.held_out)):
        if group in tree.children:
            tree[group].coords["record"] = [record.name for record in records]
    if "log_prior" in tree.children:
        tree["log_prior"].attrs["joint_support"] = table.log_support - table.log_permutations
    tree.attrs |= {
        "study": study.name,
        "version": version("lcopa-bayes"),
        "seed": study.seed,
        "settings": json.dumps(settings_of(study), sort_keys=True),
        "time_unit": study.time_unit,
        "grade": grade.level,
        "grade_reason": grade.reason,
        "noise": fit.problem.posterior.noise.kind,
    }


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


@final
@dataclass(frozen=True)
class _Series:
    """What was seen of some records, by variable name."""

    origins: dict[str, tuple[str, str]]
    """Record and axis."""
    places: dict[str, tuple[int, int]]
    """Their positions."""
    observed: dict[str, Vector]
    times: dict[str, Vector]

    @classmethod
    def of(cls, samples: Sequence[Samples]) -> _Series:
        """Of every axis of every record that has a sample."""
        origins = {
            (r, axis): (record.record.name, record.record.response_axes[axis].name)
            for r, record in enumerate(samples)
            for axis, seen in enumerate(record.axes)
            if seen.values.size
        }
        names = variable_names(["_".join(pair) for pair in origins.values()])
        places = dict(zip(names, origins, strict=True))
        return cls(
            dict(zip(names, origins.values(), strict=True)),
            places,
            {name: samples[r].axes[axis].values for name, (r, axis) in places.items()},
            {name: samples[r].times[samples[r].axes[axis].index] for name, (r, axis) in places.items()},
        )


def _commanded(records: Sequence[Record]) -> dict[str, Record]:
    """Records by the names of the variables that hold their drives."""
    names = variable_names([f"{record.name}_drive" for record in records])
    return dict(zip(names, records, strict=True))


def _predicted(
    fit: Fit, fitted: _Series, values: Matrix, rng: np.random.Generator, *, likelihood: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Log likelihood, where it is wanted, and predictive draws of table values, (draws, samples) each, of
    every axis of every fit record by variable name.

    Single precision, a few draws at a time: these are by far the largest arrays of a run.
    """
    posterior, table = fit.near, fit.draws.table
    size = values.shape[0]
    density, drawn = (
        {name: np.empty((size, seen.size), np.float32) for name, seen in fitted.observed.items()}
        for _ in range(2)
    )
    for first in range(0, size, _PORTION):
        rows = slice(first, first + _PORTION)
        part = values[rows]
        # draws have bounded responses; those of the prior that have none are NaN
        known = posterior.responses(part) if likelihood else ()
        plant = () if likelihood else responses(table, fit.problem.thrifty.posterior.model, part)
        for name, (r, axis) in fitted.places.items():
            seen, parameters = posterior.samples[r].axes[axis], posterior.noise_parameters(part, axis)
            noise = posterior.noise.draw(parameters, seen.gaps, rng)
            if likelihood:
                misfit = posterior.residual(axis, r, seen, part, known[r])
                density[name][rows] = posterior.noise.pointwise(misfit, parameters, seen.gaps)
                drawn[name][rows] = seen.values - misfit + noise
            else:
                offset = table.offset(part, axis, r)[:, None]
                drawn[name][rows] = plant[r][axis][:, seen.index] + offset + noise
    return density if likelihood else {}, drawn
