"""Campaigns: the records of the paper simulated again, and folders of records as a study."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from lcopa_bayes.bench.acquisition import PAPER_BENCH, Bench, simulate
from lcopa_bayes.bench.command import quiet, step, two_axis
from lcopa_bayes.bench.device import PAPER_DEVICE, Device
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.core.files import told_as, writable_folder, write_text
from lcopa_bayes.data.record import Record, save_record
from lcopa_bayes.model.literature import PAPER

PAPER_DURATION = 25.0
"""Length of a record of Ta et al. 2026, Figs. 13 to 17 [ms], read off the figures."""
PAPER_HELD_OUT = ("xy",)
"""Record of `paper_step_records` that is not for fitting: both axes at once, as in Fig. 17."""


def paper_step_records(
    rng: np.random.Generator, *, device: Device = PAPER_DEVICE, bench: Bench = PAPER_BENCH
) -> tuple[Record, ...]:
    """The step records of Ta et al. 2026, Section 5, each 25 ms long with its step at time 0.

    ``x_on`` 0 to pi/2 on x (Fig. 13), ``x_off`` from rest at pi/2 to 0 (Fig. 14), ``x_quarter`` and
    ``y_quarter`` pi/4 on one axis alone (Fig. 16), ``xy`` pi/3 on x with pi/5 on y (Fig. 17).
    """
    printed = PAPER.records
    alone = step(printed.single_axis_drive)
    commands = {
        "x_on": two_axis(step(printed.step_drive), quiet()),
        "x_off": two_axis(step(0.0, rest=printed.step_drive), quiet()),
        "x_quarter": two_axis(alone, quiet()),
        "y_quarter": two_axis(quiet(), alone),
        "xy": two_axis(*map(step, printed.two_axis_drive)),
    }
    return tuple(
        simulate(device, bench, command, duration=PAPER_DURATION, name=name, rng=rng)
        for name, command in commands.items()
    )


def write_campaign(
    folder: Path,
    records: Sequence[Record],
    *,
    held_out: Iterable[str] = (),
    name: str | None = None,
    seed: int | None = None,
    note: str = "",
    settings: str = "",
    overwrite: bool = False,
) -> tuple[Path, ...]:
    """Write one CSV per record and a ``study.toml`` that names them; return the paths, study last.

    Parameters: `held_out`, names of records not for fitting; `name` of the study, by default that of
    the folder; `seed` of the study, omitted when None; `note`, a comment at the head of the study;
    `settings`, further tables of the study file.
    Everything is written beside its place first and then renamed, the study last: a campaign cut
    short leaves no file half written and no new study without its records. Raises InputError when a file
    is there already (unless `overwrite`), names repeat or cannot be file names, time units differ, a
    held-out name is unknown, no record remains to fit, or the folder or a file in it cannot be written.
    """
    held_out = tuple(held_out)
    names = [record.name for record in records]
    fit = [each for each in names if each not in held_out]
    targets = [folder / f"{each}.csv" for each in names] + [folder / "study.toml"]
    problems = [
        f"record name {each!r} occurs {names.count(each)} times"
        for each in sorted({*names})
        if names.count(each) > 1
    ]
    problems += [
        f"record name {each!r} cannot be a file name; use letters, digits, '-' and '_'"
        for each in names
        if not each.replace("-", "").replace("_", "").isalnum()
    ]
    problems += [
        f"held_out names {each!r}, which is no record{nearest(each, names)}"
        for each in held_out
        if each not in names
    ]
    if not fit:
        problems.append("no record remains to fit; hold out fewer")
    if len({record.time_unit for record in records}) > 1:
        problems.append("all records of a study must have the same time unit")
    if folder.exists() and not folder.is_dir():
        problems.append(f"{folder} is not a folder")
    elif not overwrite:
        problems += [
            f"{path} is there already; choose another folder or allow to overwrite"
            for path in targets
            if path.exists()
        ]
    if problems:
        raise InputError(problems)

    lines = [f"# {line}".rstrip() for line in note.splitlines()]
    lines += ["[study]", f"name = {_toml(name or folder.resolve().name)}"]
    lines += [f"time_unit = {_toml(records[0].time_unit)}"]
    lines += [] if seed is None else [f"seed = {seed}"]
    lines += ["", "[records]", f"fit = {_toml([f'{each}.csv' for each in fit])}"]
    lines += (
        [f"held_out = {_toml([f'{each}.csv' for each in names if each in held_out])}"] if held_out else []
    )
    lines += ["", settings] if settings else []
    writable_folder(folder)
    with told_as(folder), tempfile.TemporaryDirectory(prefix=".campaign-", dir=folder) as beside:
        try:
            for record, target in zip(records, targets, strict=False):
                save_record(record, Path(beside) / target.name)
            write_text(Path(beside) / "study.toml", "\n".join(lines) + "\n")
        except InputError as error:  # name the file that was wanted
            raise InputError([p.replace(beside, str(folder)) for p in error.problems]) from error
        for target in targets:
            with told_as(target):
                os.replace(Path(beside) / target.name, target)
    return tuple(targets)


def _toml(value: str | list[str]) -> str:
    return json.dumps(value, ensure_ascii=False)
