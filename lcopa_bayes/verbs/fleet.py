"""`fleet`: one verb over the studies of many devices, and the population that the devices come from."""

from __future__ import annotations

import shutil
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import csv_of, read_json, save_json, writable_folder, write_text, write_whole
from lcopa_bayes.core.parallel import loss, on_cluster, workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.core.rules import word_of
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.tables import population_priors
from lcopa_bayes.fleets.devices import basis, curve_of, plant_of, row_of, studies_in
from lcopa_bayes.fleets.summary import results
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.result import Result, shown
from lcopa_bayes.results.runfolder import opened, provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.verbs.audit import audit
from lcopa_bayes.verbs.compare import compare
from lcopa_bayes.verbs.fit import fit
from lcopa_bayes.verbs.loop import loop
from lcopa_bayes.verbs.sources import StudyLike, study_of

Verb = Literal["fit", "audit", "loop", "compare"]
"""What is done with every device."""
_VERBS: Mapping[str, Callable[..., Result]] = {"fit": fit, "audit": audit, "loop": loop, "compare": compare}
_DEVICES, _DONE, _DRAWS, _ERROR = "devices", "device.json", "device.npy", "error.txt"
"""Folder of the run folders of devices, and files in each of these: what the fleet needs of it, its draws,
the trace of an unforeseen error."""
_TABLE, _EACH = "tables/fleet", "tables/devices.csv"
"""The table of the fleet, and that of every device and parameter by itself and given the others."""
_SHOWN, _MOST_SHOWN = ("device", "grade", "differs_in", "p_odd", "verdict", "effects", "preferred"), 20
"""Columns and most rows of the table that is printed; the whole one is a file."""


@final
@dataclass(frozen=True, eq=False)
class FleetResult(StoredResult):
    """A table of devices, and the population of their parameters."""

    verb, file, beside = "fleet", "fleet.json", (f"{_TABLE}.csv", _EACH)

    def summary(self) -> pd.DataFrame:
        """One row per device, the worst first: grade and its reason, what the verb says of it, median and
        ends of the 90 % interval of every parameter [unit of the parameter], the parameters it differs in,
        and the largest probability that it does not belong [-]."""
        return pd.DataFrame(self.values["devices"])

    def __str__(self) -> str:
        devices = self.summary().reindex(columns=_SHOWN).dropna(axis="columns", how="all").head(_MOST_SHOWN)
        tables = [devices, *([self.population()] if self.values["groups"] else [])]
        texts = [one.to_string(index=False, float_format=shown, na_rep="") for one in tables]
        return "\n\n".join([*texts, self.verdict])

    def population(self) -> pd.DataFrame:
        """One row per parameter of each group of devices: median and ends of the 90 % intervals of mean and
        spread over the devices, of the next device [`unit`], and grade. The spread of what is sampled by its
        logarithm is half of the range that holds 68 % of the devices."""
        return pd.DataFrame(
            [
                {"group": group["number"], "parameter": one["name"], "unit": one["unit"]}
                | {
                    name + suffix: one[key][end]
                    for key, name in (("mean", "mean"), ("spread", "spread"), ("next", "next_device"))
                    for end, suffix in (("value", ""), ("lower", "_lower"), ("upper", "_upper"))
                }
                | {"grade": one["grade"]}
                for group in self.values["groups"]
                for one in group["parameters"]
            ]
        )

    def priors(self, group: int = 1) -> dict[str, dict[str, Any]]:
        """Priors of the next device of a group, as `Study` takes them; a study file takes them by `[priors]
        from`. InputError for a group that is not there or has no population."""
        return population_priors(self.values, group, "fleet")

    def save(self, folder: Path | str) -> Path:
        """Write the result into a run folder, its table as CSV and Parquet; returns the folder. InputError as
        `StoredResult.save`."""
        with opened(folder, self.origin) as path:
            super().save(path)
            table = writable_folder((path / _TABLE).parent) / f"{Path(_TABLE).name}.parquet"
            write_whole(table, partial(self.summary().to_parquet, index=False))
        return path


@final
@dataclass(frozen=True)
class _Work:
    """What is done with every device."""

    verb: Verb
    folder: Path
    quick: bool
    resume: bool

    def place(self, name: str) -> Path:
        """Run folder of a device."""
        return self.folder / _DEVICES / name

    def attempt(self, one: tuple[str, Study]) -> dict[str, Any]:
        """The outcome of a device, stored in its run folder; or why there is none, for others go on."""
        source, study = one
        place = self.place(study.name)
        try:
            if not self.resume and (place / _DONE).exists():
                shutil.rmtree(place)
            return self._outcome(source, study, writable_folder(place))
        except InputError as error:
            return _failed(study.name, source, "; ".join(error.problems))
        except Exception as error:
            said = f"unforeseen {type(error).__name__}: {error}"
            if place.is_dir():
                write_text(place / _ERROR, traceback.format_exc())
                said += f"; details are in {place / _ERROR}"
            return _failed(study.name, source, said)

    def _outcome(self, source: str, study: Study, place: Path) -> dict[str, Any]:
        began, mark = time.process_time(), {"basis": basis(study, self.verb, quick=self.quick)}
        save_json(mark, place / _DONE)
        more = {} if self.verb == "loop" else {"resume": self.resume}
        more |= {"compact": True} if self.verb == "fit" else {}
        result = _VERBS[self.verb](study, folder=place, quick=self.quick, **more)
        fitted = result if isinstance(result, Predictive) else getattr(result, "fit", None)
        plant = None
        if fitted is not None:
            plant, draws = plant_of(fitted)
            write_whole(place / _DRAWS, lambda path: np.save(path, draws))
        row = {"device": study.name, "source": source, **row_of(self.verb, result.to_json(), fitted)}
        outcome: dict[str, Any] = {**mark, "row": row, "plant": plant, "curve": curve_of(fitted)}
        outcome["seconds"] = time.process_time() - began
        save_json(outcome, place / _DONE)
        return plain(outcome)

    def lost(self, one: tuple[str, Study], error: BaseException) -> dict[str, Any]:
        """A device whose worker was lost."""
        return _failed(one[1].name, one[0], loss(error))

    def done(self, study: Study) -> dict[str, Any] | None:
        """The stored outcome of a device; None where there is none, or its study has changed: what a device
        left of another study is removed."""
        path = self.place(study.name) / _DONE
        if not path.exists():
            return None
        outcome = read_json(path, f"remove {path.parent} to do this device again")
        if outcome.get("basis") != basis(study, self.verb, quick=self.quick):
            shutil.rmtree(path.parent)
            return None
        return outcome if "row" in outcome else None

    def draws(self, outcomes: Sequence[Mapping[str, Any]]) -> dict[str, Matrix]:
        """Draws of the devices that have some."""
        names = [one["row"]["device"] for one in outcomes if one.get("plant")]
        return {name: np.load(self.place(name) / _DRAWS, allow_pickle=False) for name in names}


def _failed(name: str, source: str, reason: str) -> dict[str, Any]:
    return {"row": {"device": name, "source": source, "grade": "failed", "reason": reason}}


def fleet(
    studies: Path | str | Sequence[StudyLike],
    verb: Verb = "fit",
    *,
    jobs: int = 1,
    dask: str | None = None,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> FleetResult:
    """Do one verb with the study of every device, and estimate the population that the devices come from.

    Parameters: `studies`, a folder with a study of each device, or these; `verb`, ``fit``, ``audit``,
    ``loop`` or ``compare``; `jobs`, processes to use, a device each; `dask`, address of a cluster whose
    workers see the same folders; `folder`, a run folder to write into, with one of each device in `devices`:
    a device that is finished there is not done again unless its study has changed; `resume`, go on within
    devices that were interrupted; `quick`, a quarter of the steps; `quiet`, no progress bar.

    A device that fails is listed with its reason, and the others go on. Populations come from the draws of
    `fit` and `audit`, for devices of the same axes and parameters. InputError when there is no study, two
    have one name, none could be done, a worker is lost, and for the folder as `fit`.
    """
    refuse_if(word_of(*_VERBS).problems("verb", verb))
    single = isinstance(studies, Path | str)
    sources: Sequence[StudyLike] = studies_in(Path(studies)) if single else list(studies)  # type: ignore[arg-type]
    name = Path(studies).resolve().name if single else "fleet"  # type: ignore[arg-type]
    outcomes, members = _members(sources)
    origin = plain(provenance(None, "fleet") | {"study": name})
    with (
        TemporaryDirectory() if folder is None else nullcontext(str(folder)) as place,
        opened(place, origin) as path,
    ):
        work = _Work(verb, path.resolve(), quick, resume)
        writable_folder(path / _DEVICES)  # or every device would fail for it
        stored = {study.name: work.done(study) for _, study in members}
        outcomes += [one for one in stored.values() if one is not None]
        missing = [one for one in members if stored[one[1].name] is None]
        grades = Counter(one["row"]["grade"] for one in outcomes)
        with (
            on_cluster(dask) as many,
            workers(work, jobs=many if dask else min(jobs, max(1, len(missing)))) as crew,
            Progress(
                total=len(outcomes) + len(missing),
                initial=len(outcomes),
                unit="device",
                quiet=quiet,
                desc=f"fleet: {verb}",
            ) as bar,
        ):
            for outcome in crew.finished(_Work.attempt, missing, work.lost) if missing else ():
                outcomes.append(outcome)
                grades[outcome["row"]["grade"]] += 1
                bar.set_postfix({grade: f"{count}" for grade, count in sorted(grades.items())})
                bar.update()
        if grades["failed"] == len(outcomes):
            first = outcomes[0]["row"]
            raise InputError(
                f"{name}: not one of {len(outcomes)} devices could be done; the first, {first['device']}: "
                f"{first['reason']}"
            )
        outcomes.sort(key=lambda one: str(one["row"]["device"]))
        values = results(name, verb, outcomes, work.draws(outcomes))
        texts = {f"{_TABLE}.csv": csv_of(pd.DataFrame(values["devices"]))}
        return FleetResult(values, origin, texts | {_EACH: csv_of(_each(values))}).kept(folder)


def _each(values: Mapping[str, Any]) -> pd.DataFrame:
    """One row per device and parameter: by itself, and given the others."""
    return pd.DataFrame(
        [
            {"device": one["device"], "parameter": row["name"], "unit": row["unit"]}
            | {
                f"{key}_{end}": one[key][end]
                for key in ("own", "shrunk")
                for end in ("value", "lower", "upper")
            }
            | {key: one[key] for key in ("p_odd", "pareto_k", "weights")}
            for group in values["groups"]
            for row in group["parameters"]
            for one in row["devices"]
        ]
    )


def _members(sources: Sequence[StudyLike]) -> tuple[list[dict[str, Any]], list[tuple[str, Study]]]:
    """Devices whose study is broken, and the studies of the others, each with where it comes from; InputError
    when two have one name or there is none."""
    broken, members = [], []
    for number, source in enumerate(sources, start=1):
        path = str(source) if isinstance(source, Path | str) else ""
        try:
            study = study_of(source)
            members.append((path or study.name, study))
        except InputError as error:
            broken.append(_failed(Path(path).stem or f"device {number}", path, "; ".join(error.problems)))
    names = Counter([study.name for _, study in members] + [one["row"]["device"] for one in broken])
    refuse_if(
        [
            f"{count} devices are named {name!r} ("
            + ", ".join(path for path, study in members if study.name == name)
            + "); give each [study] a name of its own"
            for name, count in names.items()
            if count > 1
        ]
        or ["a fleet needs one study or more"] * (not names)
    )
    return broken, members
