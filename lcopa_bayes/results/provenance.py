"""Where a result comes from: versions, seed, hashes of inputs, settings and command."""

from __future__ import annotations

import hashlib
import json
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import asdict, is_dataclass
from importlib.metadata import version
from typing import Any

import numpy as np

from lcopa_bayes.core.estimate import plain
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.sampling.sampler import SamplePlan

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
_COMMAND: ContextVar[tuple[str, ...]] = ContextVar("_COMMAND", default=())
"""The command line being executed; empty when a function was called from Python."""


def settings_of(study: Study) -> dict[str, Any]:
    """All settings of a study as plain values."""
    return {
        "name": study.name,
        "time_unit": study.time_unit,
        "seed": study.seed,
        "fit": [record.name for record in study.fit],
        "held_out": [record.name for record in study.held_out],
        "model": _flat(study.model),
        "priors": {name: _flat(prior) for name, prior in study.priors.items()},
        "noise": _flat(study.noise),
        "sampler": _flat(study.sampler),
        "effects": _flat(study.effects),
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


@contextmanager
def commanded(command: Sequence[str]) -> Iterator[None]:
    """Within it, results say that this command line asked for them."""
    token = _COMMAND.set(tuple(command))
    try:
        yield
    finally:
        _COMMAND.reset(token)


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
        "command": list(_COMMAND.get() or (f"lcopa_bayes.{verb}",)),
        **own,
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _PACKAGES},
    }


def _flat(settings: object) -> Any:
    assert is_dataclass(settings)
    fields = {name: getattr(settings, name) for name in settings.__dataclass_fields__}
    return plain({k: dict(v) if isinstance(v, Mapping) else v for k, v in fields.items()})
