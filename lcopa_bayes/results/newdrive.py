"""Prediction by a fitted posterior: bands for a new drive, scores for a new record."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal, final

import numpy as np
import pandas as pd

from lcopa_bayes.core.arrays import Array, Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.files import save_json, save_table, writable_folder
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.drive import Drive, drive_of, first_change
from lcopa_bayes.data.record import Record, load_columns, record_of
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.declared import obstacles
from lcopa_bayes.results.bands import POINTWISE, SIMULTANEOUS
from lcopa_bayes.results.fittedrange import FittedRange, Outside
from lcopa_bayes.results.frequency import transfer_function
from lcopa_bayes.results.prediction import Band, band_of, bands, disturbances, named_rng, plant_draws
from lcopa_bayes.results.result import Result
from lcopa_bayes.results.runfolder import add_origin, digest, opened, provenance
from lcopa_bayes.sampling.draws import Draws

Level = Literal["fitted", "zero"]
"""Offset of a response under a new drive: as in the fit records, or none."""
NAME, BANDS, DRIVES = "predict.json", "predict_bands.csv", "predict_drives.csv"
"""Files of a saved prediction; the tables are in `tables/`."""
_LEAD = 5
"""Sampling periods at rest before the first change of a drive that is given by its steps."""
_MOST = 100_000
"""Most samples of a prediction."""
_WEIGHTS = 100
"""Draws behind the median gain that weighs frequencies."""


@final
@dataclass(frozen=True, eq=False)
class Prediction(Result):
    """Bands of every response axis under one drive."""

    verb, file = "predict", NAME

    study: str
    """Name of the study that was fitted."""
    driven: Drive | Record
    """The drive, with the study's axes and time unit; a record where responses were measured too."""
    bands: tuple[Band, ...]
    """One per response axis."""
    outside: tuple[Outside, ...]
    """What lies outside the fitted range of amplitude, time and frequency."""
    grade: str
    """Grade of the fit."""
    grade_reason: str
    """Why it has this grade."""
    time_unit: str
    """Unit of every time."""
    seed: int
    """Seed of the noise and of the offsets that are drawn."""
    origin: Mapping[str, Any]
    """Provenance: command, seed, settings, hashes of records and draws, versions."""

    @property
    def verdict(self) -> str:
        """What was predicted and how far it can be trusted, in words."""
        axes, time = ", ".join(band.axis for band in self.bands), self.bands[0].time
        start = 0.0 if abs(time[0]) < 1e-9 * np.ptp(time) else float(time[0])  # rounding is no time
        parts = [
            f"Response of {axes} to {self.driven.name} from {start:.4g} to {time[-1]:.4g} {self.time_unit}."
        ]
        if isinstance(self.driven, Record):
            parts += [
                f"{band.axis}: RMSE {measured(band.rmse, band.unit)}, {100 * band.coverage(0.9):.0f} % "
                f"of the samples in the {POINTWISE} 90 % band."
                for band in self.bands
            ]
        parts += [one.sentence for one in self.outside] or ["The drive lies within the fitted range."]
        return " ".join(parts)

    @property
    def scores(self) -> list[dict[str, Any]]:
        """Error and coverage of every axis of a measured record, as a fit gives them; empty for a drive."""
        return [band.score() for band in self.bands] if isinstance(self.driven, Record) else []

    def table(self) -> pd.DataFrame:
        """One row per axis and time: ends of the bands by kind, plant alone and with noise [`unit`], and
        whether the time lies within the fitted range of amplitude and duration."""
        since = min((one.since for one in self.outside if one.since is not None), default=np.inf)
        frames = [band.table().assign(inside=band.time < since) for band in self.bands]
        return pd.concat(frames, ignore_index=True).drop(columns=["record", "held_out"])

    def drives(self) -> pd.DataFrame:
        """One row per drive axis and row of the drive: its value from there on [`unit`]."""
        axes = (
            [(axis.name, axis.unit) for axis in self.driven.drive_axes]
            if isinstance(self.driven, Record)
            else list(zip(self.driven.axes, self.driven.units, strict=True))
        )
        frames = [
            pd.DataFrame(
                {"axis": name, "unit": unit, "time": self.driven.time, "drive": self.driven.drive[:, k]}
            )
            for k, (name, unit) in enumerate(axes)
        ]
        return pd.concat(frames, ignore_index=True)

    def summary(self) -> pd.DataFrame:
        """One row per response axis: median and 90 % interval of the plant at the end, widest half widths of
        the 90 % bands by kind [`unit`], and the scores of a measured record."""
        rows = []
        for band in self.bands:
            row: dict[str, Any] = {
                "axis": band.axis,
                "unit": band.unit,
                "end": float(band.time[-1]),
                "value_at_end": float(band.plant[2, -1]),
                "lower": float(band.plant[0, -1]),
                "upper": float(band.plant[4, -1]),
                f"half_width_{POINTWISE}": float(np.max(band.plant[4] - band.plant[0]) / 2),
                f"half_width_{SIMULTANEOUS}": float(
                    np.max(band.plant_simultaneous[3] - band.plant_simultaneous[0]) / 2
                ),
                "half_width_noisy": float(np.max(band.noisy[4] - band.noisy[0]) / 2),
                "offset_from": band.offset_from,
                "grade": self.grade,
            }
            if isinstance(self.driven, Record):
                row |= {
                    "rmse": band.rmse,
                    "coverage_50": band.coverage(0.5),
                    "coverage_90": band.coverage(0.9),
                }
            rows.append(row)
        return pd.DataFrame(rows)

    def to_json(self) -> dict[str, Any]:
        """Plain values, without the bands, which `table` holds."""
        return plain(
            {
                "study": self.study,
                "drive": self.driven.name,
                **attributes(self, "verdict", "grade", "grade_reason", "time_unit", "seed"),
                "measured": isinstance(self.driven, Record),
                "kinds": [POINTWISE, SIMULTANEOUS],
                "levels": [0.5, 0.9],
                "axes": self.summary().to_dict("records"),
                "draws": min(band.draws for band in self.bands),
                "outside": [one.as_json() for one in self.outside],
                "scores": self.scores,
            }
        )

    def save(self, folder: Path | str) -> Path:
        """Write `predict.json` and the tables of bands and drives into a folder; returns the folder.

        InputError as `Result.save`.
        """
        with opened(folder, self.origin) as path:
            writable_folder(path / "tables")
            for name, table in ((BANDS, self.table()), (DRIVES, self.drives())):
                save_table(table, path / "tables" / name)
            save_json(self.to_json(), path / self.file)
            add_origin(path, self.verb, self.origin)
        return path


def predict(
    problem: Problem, draws: Draws, driven: Drive | Record | Path | str, *, offset: Level = "fitted"
) -> Prediction:
    """Bands for a drive, or for a record nobody has fitted, which is then scored too.

    A path is a record file; without responses it is a drive. `offset` "fitted" adds the offset of the fit
    records that rest alike to the response of a drive, each draw that of one of them; "zero" leaves the plant
    alone. InputError for other axes or units than the study's, for a drive that rests where no fit record
    did, for one too long, and for a record that a fit of the study would refuse.
    """
    study = problem.study
    if isinstance(driven, Path | str):
        columns = load_columns(Path(driven), responses=False)
        driven = (
            record_of(load_columns(Path(driven), study.time_unit)) if columns.measured else drive_of(columns)
        )
    if isinstance(driven, Record):
        driven, predicted = _recorded(problem, draws, driven)
    else:
        driven, predicted = _unmeasured(problem, draws, driven, offset)
    fitted, times = fitted_range(problem), predicted[0].time
    # squared gains of the paths, median over draws, weigh the drive's frequencies
    magnitude, _ = transfer_function(draws.table, draws.thinned(_WEIGHTS), fitted.centres(driven, times))
    squared, grade = np.median(magnitude, axis=2) ** 2, draws.grade
    return Prediction(
        study=study.name,
        driven=driven,
        bands=tuple(predicted),
        outside=fitted.outside(driven, times, squared),
        grade=grade.level,
        grade_reason=grade.reason,
        time_unit=study.time_unit,
        seed=study.seed,
        origin=plain(provenance(study, "predict") | {"draws_sha256": draws.sha256}),
    )


def fitted_range(problem: Problem) -> FittedRange:
    """What the fit records of a study cover."""
    study, scales = problem.study, problem.scales
    return FittedRange(study.fit, study.drive_axes, scales.span, scales.period, study.time_unit)


def _recorded(problem: Problem, draws: Draws, record: Record) -> tuple[Record, list[Band]]:
    """Bands of a held-out record: what a fit gives that had it from the start, whatever its name."""
    name, fitted = record.name, problem.study.fit
    while name in {one.name for one in fitted}:
        name += "-new"
    study = replace(problem.study, held_out=(replace(record, name=name),))
    same = [one.name for one in fitted if digest(one) == digest(study.held_out[0])]
    if same:
        raise InputError(
            f"record {record.name!r} is {same[0]!r} of the fit, where errors are not those of a prediction; "
            "give another record, or leave out its responses for bands under its drive"
        )
    if problems := obstacles(study):
        raise InputError(problems)
    (held,) = study.held_out
    samples, model = problem.simulated(study.held_out)
    noise = problem.posterior.noise
    shown = bands(draws, model, samples, noise, held_out=True, seed=problem.study.seed)
    return replace(held, name=record.name), [replace(band, record=record.name) for band in shown]


def _unmeasured(problem: Problem, draws: Draws, drive: Drive, level: Level) -> tuple[Drive, list[Band]]:
    """Bands of a drive that nobody has measured."""
    if level not in ("fitted", "zero"):
        raise InputError(f'`offset` must be "fitted" or "zero"; got {level!r}')
    study, scales, fitted = problem.study, problem.scales, fitted_range(problem)
    drive = drive.fitted_to(
        study.drive_axes, study.time_unit, tuple(fitted.usual_rest), _LEAD * scales.period
    )
    if problems := fitted.other_rest(drive.drive[0]):
        advice = "begin with a row at the study's resting value"
        raise InputError([f"drive {drive.name!r}: {problem}; {advice}" for problem in problems])
    times = _times(drive, scales.span, scales.period)
    gaps = np.concatenate(([1.0], np.diff(times) / scales.period))
    model = problem.driven(drive, times)
    values, plant = plant_draws(draws, model, study.seed)
    noise, out = problem.posterior.noise, []
    rng, alike = named_rng(study.seed, drive.name), fitted.resting_at(drive.drive[0])
    apart = disturbances(draws.table, model, values, plant, rng)
    for axis, declared in enumerate(study.response_axes):
        parameters = values[:, [draws.table.at(name, axis) for name in noise.names]]
        known = _level(draws, values, axis, level, alike, rng)
        noises = noise.draw(parameters, gaps, rng)
        if apart is not None:
            noises += apart[axis]
        nothing = np.full(times.size, np.nan)
        out.append(band_of((drive.name, declared, False), times, nothing, plant[axis], noises, (*known, 0)))
    return drive, out


def _times(drive: Drive, span: float, period: float) -> Vector:
    """Times to predict at: the rows where they are sampled as the records are, else a lattice of `period`."""
    if drive.until == drive.time[-1] and np.diff(drive.time).max(initial=0.0) <= 1.5 * period:
        return drive.time
    begin = first_change(drive)
    last = drive.time[-1] + span if drive.until is None else drive.until
    # the first change falls on the lattice, which lies between the first row and the end
    first = begin - np.floor((begin - drive.time[0]) / period + 1e-9) * period
    count = int(np.floor((last - first) / period + 1e-9)) + 1
    if count > _MOST:
        raise InputError(
            f"drive {drive.name!r}: lasts {count} sampling periods of the study, more than {_MOST}; end it "
            f"earlier than {drive.time[0] + _MOST * period:.6g} {drive.time_unit}"
        )
    return np.asarray(first + period * np.arange(max(count, 2)))


def _level(
    draws: Draws, values: Array, axis: int, level: Level, records: Sequence[int], rng: np.random.Generator
) -> tuple[Vector, str]:
    """Offset of a response axis under a new drive for each draw, and where it comes from.

    An offset per record is taken from one of `records`, those that rest as the drive does: of these the
    level at rest is measured, of others it hangs on a gain times the difference.
    """
    places = draws.table.offsets(axis)
    if level == "zero" or not places:
        return np.zeros(values.shape[0]), "no offset"
    if -1 in places:
        return values[:, places[-1]], "shared with the fit records"
    if len(records) == 1:
        return values[:, places[records[0]]], "that of the fit record that rests alike"
    chosen = np.array([places[r] for r in records])[rng.integers(len(records), size=values.shape[0])]
    picked = np.asarray(values[np.arange(values.shape[0]), chosen])
    return picked, f"in each draw that of one of the {len(records)} fit records that rest alike"
