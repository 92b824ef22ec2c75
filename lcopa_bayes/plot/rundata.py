"""Results, tables and draws of a fit as figures read them, from its run folder or just computed."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar, final
from weakref import WeakKeyDictionary

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.files import as_named
from lcopa_bayes.results.bands import POINTWISE, QUANTILE_NAMES, SIMULTANEOUS
from lcopa_bayes.results.datatree import POSTERIOR, posterior_draws
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.results.result import Fresh, Result
from lcopa_bayes.results.runfolder import ORIGINS
from lcopa_bayes.results.savedfit import SavedFit
from lcopa_bayes.results.summary import IMPORTANCE
from lcopa_bayes.results.tables import tables as computed

T = TypeVar("T")
_WORDS = ("record", "axis", "unit", "name", "path", "prior", "from")
_FLAGS = ("held_out", "log_scale", "integrated_out")
TABLES: Mapping[str, tuple[str, ...]] = {
    "bands": (
        *("record", "axis", "unit", "held_out", "time", "observed"),
        *(f"{kind}_{POINTWISE}_{q}" for kind in ("plant", "noisy") for q in QUANTILE_NAMES),
    ),
    "drives": ("record", "axis", "unit", "time", "drive"),
    "residuals": ("record", "axis", "unit", "held_out", "time", "residual"),
    "autocorrelation": ("record", "axis", "lag", "autocorrelation", "white_band_95"),
    "spectrum": ("record", "axis", "frequency", "power_over_white"),
    "step_response": (
        *("path", "unit", "time"),
        *(f"response_{q}" for q in QUANTILE_NAMES),
        *("steady_05", "steady_50", "steady_95"),
    ),
    "frequency_response": (
        *("path", "unit", "frequency"),
        *(f"{curve}_{POINTWISE}_{q}" for curve in ("gain", "phase") for q in QUANTILE_NAMES),
        *(f"{curve}_{SIMULTANEOUS}_{q}" for curve in ("gain", "phase") for q in ("05", "95")),
    ),
    "priors": ("name", "unit", "prior", "from", "integrated_out"),
    "prior_density": ("name", "log_scale", "x", "density"),
}
"""Tables the report draws and the columns it needs of each."""
_CHECK_TABLES: Mapping[str, tuple[str, ...]] = {
    "cross_check_density": ("name", "log_scale", "left", "right", "ensembles", "nested")
}
"""The same of a run that was checked by a second method."""


@final
@dataclass(frozen=True, eq=False)
class RunData:
    """Results, tables and draws of a fit."""

    results: Mapping[str, Any]
    provenance: Mapping[str, Any]
    """Of the fit; nothing where it was not saved."""
    tables: Mapping[str, pd.DataFrame]
    """By the names of their files; those that are needed are in `TABLES`."""
    draws: Mapping[str, Matrix]
    """Draws of each free parameter, (ensembles, draws), in the parameter's unit."""

    @property
    def time_unit(self) -> str:
        """Unit of all times."""
        return str(self.results["time_unit"])

    @property
    def weighted(self) -> bool:
        """Whether the draws are importance draws, else those of ensembles."""
        return bool(self.results["sampler"]["method"] == IMPORTANCE)

    @property
    def units(self) -> dict[str, str]:
        """Unit of each free parameter."""
        return {row["name"]: row["unit"] for row in self.results["parameters"]}

    @property
    def varying(self) -> list[str]:
        """Free parameters whose draws vary."""
        return [name for name in self.units if np.ptp(self.draws[name]) > 0]

    def part(self, table: str, record: str, axis: str) -> pd.DataFrame:
        """Rows of one axis of one record."""
        whole = self.tables[table]
        return whole[(whole["record"] == record) & (whole["axis"] == axis)]

    def records(self, table: str) -> list[tuple[str, str]]:
        """Record and axis pairs of a table: fitted records first, then held-out records, in the order
        saved."""
        pairs = self.tables[table][["record", "axis", "held_out"]].drop_duplicates()
        ordered = pairs.sort_values("held_out", kind="stable")
        return list(zip(ordered["record"], ordered["axis"], strict=True))

    def spans_decades(self, name: str) -> bool:
        """Whether a parameter sampled on a logarithmic scale has draws over more than a factor of ten."""
        low, high = np.quantile(self.draws[name], [0.0025, 0.9975])
        return bool(self.is_log(name) and low > 0 and high > 10 * low)

    def is_log(self, name: str) -> bool:
        """Whether a parameter is sampled on a logarithmic scale."""
        density = self.tables["prior_density"]
        return bool(density.loc[density["name"] == name, "log_scale"].any())


_COMPUTED: WeakKeyDictionary[Fit, RunData] = WeakKeyDictionary()
"""Data of fits that were drawn already."""


def fit_of(result: Result) -> Fit | SavedFit:
    """The fit that a result is or rests on; InputError when it rests on none."""
    fit = result if isinstance(result, Fit | SavedFit) else getattr(result, "fit", None)
    if not isinstance(fit, Fit | SavedFit):
        raise InputError(f"the result of `{result.verb}` rests on no fit that is at hand; give a fit")
    return fit


def run_of(result: Result) -> RunData:
    """Data of the fit that a result is or rests on; InputError when there is none."""
    fit = fit_of(result)
    if isinstance(fit, SavedFit):
        return load_run(fit.folder)
    if fit not in _COMPUTED:
        _COMPUTED[fit] = RunData(fit.to_json(), {}, computed(fit), fit.by_name)
    return _COMPUTED[fit]


def load_run(folder: Path, fresh: Fresh | None = None) -> RunData:
    """Read a run folder, all of it but values and draws that are `fresh`; InputError names every file that is
    missing or cannot be used."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such run folder; give the folder `fit` wrote")
    problems: list[str] = []
    results: Mapping[str, Any]
    draws: Mapping[str, Matrix]
    if fresh:
        results, draws = fresh
    else:
        results = read_part(folder / "results.json", read_json, problems) or {}
        draws = read_part(folder / POSTERIOR, posterior_draws, problems) or {}
    origin = (read_part(folder / ORIGINS, read_json, problems) or {}).get("fit", {})
    wanted = {**TABLES, **(_CHECK_TABLES if results.get("cross_check") else {})}
    tables = {
        name: read_table(folder / "tables" / f"{name}.csv", problems, needs, "fit")
        for name, needs in wanted.items()
    }
    if not problems:
        problems += [
            f"{folder / POSTERIOR}: no draws of {row['name']!r}, which results.json lists; "
            "both must come from the same run, so run `fit` again"
            for row in results["parameters"]
            if row["name"] not in draws
        ]
    refuse_if(problems)
    return RunData(results, origin, tables, draws)


def read_part(path: Path, read: Callable[[Path], T], problems: list[str], verb: str = "fit") -> T | None:
    """What `read` makes of a file of the run folder of `verb`; None, and a problem more, where it cannot."""
    try:
        return read(path)
    except FileNotFoundError:
        problems.append(f"{path}: this file of the run folder is missing; run `{verb}` again to write it")
    except (OSError, ValueError, KeyError) as error:
        problems.append(f"{path}: cannot be read ({error}); run `{verb}` again to write it")
    return None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object."""
    return dict(json.loads(path.read_text(encoding="utf-8")))


def read_tables(
    paths: Mapping[str, Path], verb: str, needs: Mapping[str, Sequence[str]] | None = None
) -> dict[str, pd.DataFrame]:
    """Saved tables by name, with the columns each `needs`; names that look like numbers stay names.

    An empty file is a table without rows. InputError with all that is missing or cannot be used.
    """
    problems: list[str] = []
    tables = {
        name: read_table(path, problems, (needs or {}).get(name, ()), verb) for name, path in paths.items()
    }
    refuse_if(problems)
    return tables


def read_table(path: Path, problems: list[str], needs: Sequence[str], verb: str) -> pd.DataFrame:
    """One of them; what is wrong with it joins the problems."""
    table = read_part(path, _table, problems, verb)
    if table is None or not len(table.columns):
        return pd.DataFrame(columns=list(needs))
    problems += [
        f"{path}: the column {name!r} is missing; run `{verb}` again with this version of lcopa-bayes"
        for name in needs
        if name not in table
    ]
    return table


def _table(path: Path) -> pd.DataFrame:
    text = path.read_text(encoding="utf-8")
    if not text.strip():
        return pd.DataFrame()
    names = text.partition("\n")[0].strip().split(",")
    absent = {name: ["", "nan"] for name in names if name not in (*_WORDS, *_FLAGS)}
    words = dict.fromkeys(_WORDS, str)
    read = pd.read_csv(io.StringIO(text), dtype=words, keep_default_na=False, na_values=absent)
    for name in read.columns.intersection([*_WORDS]):
        read[name] = read[name].map(as_named)
    return read
