"""`chain.h5`: the ensembles of a run, so that a killed run is taken up where it stopped."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import enduring, write_whole
from lcopa_bayes.sampling.ensemble import Ensemble

_ARRAYS = ("chain", "log_density", "position", "position_log_density", "accepted", "trail")


def save_chain(path: Path, ensembles: Sequence[Ensemble], fingerprint: str) -> None:
    """Write all ensembles; the file of the last save stays intact until this one is complete.

    InputError when the file cannot be written, saying whether the rounds before this one are kept.
    """

    def write(beside: Path) -> None:
        with enduring(beside) as raw, h5py.File(raw, "w") as file:
            file.attrs["fingerprint"] = fingerprint
            for number, ensemble in enumerate(ensembles):
                group = file.create_group(f"ensemble_{number}")
                for name in _ARRAYS:
                    group.create_dataset(name, data=getattr(ensemble, name))
                group.attrs["steps"] = ensemble.steps
                group.attrs["way"] = ensemble.way
                kind, keys, position, has_gauss, gauss = ensemble.random
                group.attrs["random_kind"] = kind
                group.create_dataset("random_keys", data=keys)
                group.attrs["random_rest"] = np.array([position, has_gauss, gauss], dtype=float)
                group.attrs["digest"] = _digest(ensemble)

    try:
        write_whole(path, write)
    except InputError as error:
        if any(ensemble.steps for ensemble in ensembles) and path.exists():  # not the first save
            kept = "; the rounds before it are kept: the same command with --resume goes on from them"
            raise InputError([problem + kept for problem in error.problems]) from error
        raise


def load_chain(path: Path, fingerprint: str) -> tuple[Ensemble, ...]:
    """Ensembles of an earlier run of the same study and settings; empty when there is no file.

    InputError when the file is damaged or belongs to another study, settings or seed.
    """
    if not path.exists():
        return ()
    advice = "leave out --resume to start anew, or choose another --out"
    try:
        with h5py.File(path, "r") as file:
            own = file.attrs["fingerprint"] == fingerprint
            ensembles = tuple(_ensemble(file[f"ensemble_{number}"]) for number in range(len(file)))
    except (OSError, KeyError, TypeError, ValueError, RuntimeError) as error:  # as h5py meets damage
        raise InputError(f"{path}: not a chain this program wrote, or damaged ({error}); {advice}") from None
    if not own:
        raise InputError(f"{path}: made from other records, settings or seed; {advice}")
    return ensembles


def _ensemble(group: h5py.Group) -> Ensemble:
    chain, log_density, position, position_log_density, accepted, trail = (
        group[name][()] for name in _ARRAYS
    )
    at, has_gauss, gauss = group.attrs["random_rest"]
    random = (group.attrs["random_kind"], group["random_keys"][()], int(at), int(has_gauss), float(gauss))
    steps, way = int(group.attrs["steps"]), int(group.attrs["way"])
    ensemble = Ensemble(
        chain, log_density, position, position_log_density, accepted, steps, random, trail, way
    )
    if group.attrs["digest"] != _digest(ensemble):
        raise ValueError(f"{group.name} is not what was written")
    return ensemble


def _digest(ensemble: Ensemble) -> str:
    """Hash of all that an ensemble holds."""
    kind, keys, *rest = ensemble.random
    numbers = [float(number) for number in (*rest, ensemble.steps, ensemble.way)]
    held = hashlib.sha256(repr((kind, numbers)).encode())
    for array in (keys, *(getattr(ensemble, name) for name in _ARRAYS)):
        held.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()
