"""The folder that runs leave: whose results it holds, where each comes from, and who is writing there.

Where a result comes from: versions, seed, hashes of inputs, settings and command.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from dataclasses import asdict, is_dataclass
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any, overload

import numpy as np

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.files import (
    command_line,
    read_json,
    remove_unfinished,
    save_json,
    writable_folder,
    writing,
)
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.sampling.run import SamplePlan

try:
    import fcntl
except ImportError:  # pragma: no cover - a system without file locks
    fcntl = None  # type: ignore[assignment]

ORIGINS = "provenance.json"
"""File that says where the result of each verb comes from."""
LOCK = ".lock"
"""File that the run which writes into the folder holds."""
_OTHER = "choose another folder with --out, or remove this one"
_held: dict[Path, int] = {}
"""Folders this process has locked, and how many times."""


@overload
def opened(folder: Path | str, origin: Mapping[str, Any]) -> AbstractContextManager[Path]: ...
@overload
def opened(folder: Path | str | None, origin: Mapping[str, Any]) -> AbstractContextManager[Path | None]: ...
@contextmanager
def opened(folder: Path | str | None, origin: Mapping[str, Any]) -> Iterator[Any]:
    """A run folder, made if need be, that no other run writes into meanwhile; `origin` is the provenance of
    what is to be written. None stands for none: nothing is opened.

    InputError when it cannot be written to, another run is writing there, or it holds results of other
    records.
    """
    if folder is None:
        yield None
        return
    path = Path(folder)
    refuse_other(path, origin)  # before anything is made
    missing = [one for one in (path, *path.parents) if not one.exists()]
    try:
        with locked(writable_folder(path)):
            yield path
    except BaseException:
        for one in missing:  # what was refused leaves no folder
            if one.is_dir() and not any(one.iterdir()):
                one.rmdir()
        raise


def refuse_other(folder: Path, origin: Mapping[str, Any]) -> None:
    """InputError when a folder holds results of a study of another name or of other fit records."""
    for verb, known in origins(folder).items():
        if known.get("study") != origin["study"]:
            raise InputError(
                f"{folder}: holds the result of `{verb}` for the study {known.get('study')!r}, not for "
                f"{origin['study']!r}; {_OTHER}"
            )
        if known.get("records_sha256") != origin["records_sha256"]:
            raise InputError(
                f"{folder}: holds the result of `{verb}` for other records of the study {origin['study']!r}; "
                f"{_OTHER}"
            )


def origins(folder: Path) -> dict[str, Mapping[str, Any]]:
    """Provenance of each verb whose result a folder holds, the last one last; InputError when it cannot be
    read."""
    path = folder / ORIGINS
    if not path.exists():
        return {}
    values = read_json(path, _OTHER)
    if not all(isinstance(one, dict) for one in values.values()):
        raise InputError(f"{path}: was written by another version of lcopa-bayes; {_OTHER}")
    return values


def add_origin(folder: Path, verb: str, origin: Mapping[str, Any]) -> None:
    """Write where the result of a verb comes from, beside those of other verbs."""
    known = {name: one for name, one in origins(folder).items() if name != verb}
    save_json({**known, verb: origin}, folder / ORIGINS)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """The lock of a folder, which ends with the process that holds it; what a killed one or its workers were
    about to write is removed. InputError when another process holds it."""
    place = folder.resolve()
    if place in _held or fcntl is None:
        _held[place] = _held.get(place, 0) + 1
        try:
            yield
        finally:
            _held[place] -= 1
            if not _held[place]:
                del _held[place]
        return
    path = place / LOCK
    with writing(path):
        file = _exclusive(path, folder)
    with file:
        _held[place] = 1
        try:
            yield
        except BaseException:
            remove_unfinished(folder)  # a worker may have been killed
            raise
        finally:
            del _held[place]
            path.unlink(missing_ok=True)


def _exclusive(path: Path, folder: Path) -> IO[str]:
    """The lock file, held by this process; InputError when another holds it."""
    while True:
        file = path.open("a+")
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.seek(0)
            holder = file.read().strip()
            file.close()
            who = f" (process {holder})" if holder else ""
            raise InputError(
                f"{folder}: another run is writing there{who}; wait until it ends, or choose another folder "
                "with --out"
            ) from None
        except OSError:  # a file system without locks
            return file
        if path.exists() and os.fstat(file.fileno()).st_ino == path.stat().st_ino:
            file.seek(0)
            if file.read():  # whoever held it did not remove it
                remove_unfinished(folder)
            file.truncate(0)
            file.write(f"{os.getpid()}")
            file.flush()
            return file
        file.close()  # the run that held it has removed it meanwhile


_PACKAGES = (
    "lcopa-bayes",
    "numpy",
    "scipy",
    "emcee",
    "dynesty",
    "arviz-base",
    "arviz-stats",
    "pandas",
    "xarray",
)


def settings_of(study: Study) -> dict[str, Any]:
    """All settings of a study as plain values."""
    return {
        **attributes(study, "name", "time_unit", "seed"),
        "fit": [record.name for record in study.fit],
        "held_out": [record.name for record in study.held_out],
        "model": flat(study.model),
        "priors": {name: flat(prior) for name, prior in study.priors.items()},
        "noise": flat(study.noise),
        "sampler": flat(study.sampler),
        "effects": flat(study.effects),
    }


def fingerprint(study: Study, plan: SamplePlan) -> str:
    """Hash of everything the draws depend on: inputs, settings, plan and this package's version; not the
    budget of time, so that a run may be resumed with another."""
    settings, planned = settings_of(study), asdict(plan) | {"seconds": None}
    settings["sampler"] |= {"seconds": None}
    basis = {
        "inputs": dict(study.inputs),
        "records": [digest(record) for record in study.fit],
        "settings": settings,
        "plan": planned,
        "version": version("lcopa-bayes"),
    }
    return hashlib.sha256(json.dumps(basis, sort_keys=True, default=str).encode()).hexdigest()


def digest(record: Record) -> str:
    """Hash of what a record holds: a study made in Python names no input files."""
    held = hashlib.sha256(repr((record.drive_axes, record.response_axes, record.time_unit)).encode())
    for array in (record.time, record.drive, record.response):
        held.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()


def provenance(study: Study | None, verb: str) -> dict[str, Any]:
    """What another person needs to get the same numbers: command line, or the function that was called, seed,
    settings, hashes of records and input files, versions. Without a study, of the paper's printed numbers."""
    own: dict[str, Any] = {"study": "Ta et al. 2026", "records_sha256": {}}
    if study is not None:
        own = {
            "study": study.name,
            "seed": study.seed,
            "settings": settings_of(study),
            "records_sha256": {record.name: digest(record) for record in study.fit},
            "inputs_sha256": dict(study.inputs),
        }
    return {
        "command": list(command_line() or (f"lcopa_bayes.{verb}",)),
        **own,
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _PACKAGES},
    }


def flat(settings: object) -> Any:
    """A table of settings as plain values."""
    assert is_dataclass(settings)
    fields = {name: getattr(settings, name) for name in settings.__dataclass_fields__}
    return plain({k: dict(v) if isinstance(v, Mapping) else v for k, v in fields.items()})
