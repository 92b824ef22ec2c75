"""`chain.h5`: the ensembles of a run, so that a killed run is taken up where it stopped."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import h5py
import numpy as np

from lcopa_bayes.files import write_whole
from lcopa_bayes.inference.ensemble import Ensemble
from lcopa_bayes.problems import InputError

_ARRAYS = ("chain", "log_density", "position", "position_log_density", "accepted")


def save_chain(path: Path, ensembles: Sequence[Ensemble], fingerprint: str) -> None:
    """Write all ensembles; the file of the last save stays intact until this one is complete."""

    def write(beside: Path) -> None:
        with h5py.File(beside, "w") as file:
            file.attrs["fingerprint"] = fingerprint
            for number, ensemble in enumerate(ensembles):
                group = file.create_group(f"ensemble_{number}")
                for name in _ARRAYS:
                    group.create_dataset(name, data=getattr(ensemble, name))
                group.attrs["steps"] = ensemble.steps
                group.attrs["log_evidence"] = ensemble.log_evidence
                kind, keys, position, has_gauss, gauss = ensemble.random
                group.attrs["random_kind"] = kind
                group.create_dataset("random_keys", data=keys)
                group.attrs["random_rest"] = np.array([position, has_gauss, gauss], dtype=float)
                group.attrs["digest"] = _digest(ensemble)

    write_whole(path, write)


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
    chain, log_density, position, position_log_density, accepted = (group[name][()] for name in _ARRAYS)
    at, has_gauss, gauss = group.attrs["random_rest"]
    random = (group.attrs["random_kind"], group["random_keys"][()], int(at), int(has_gauss), float(gauss))
    steps, evidence = int(group.attrs["steps"]), float(group.attrs["log_evidence"])
    ensemble = Ensemble(chain, log_density, position, position_log_density, accepted, steps, random, evidence)
    if group.attrs["digest"] != _digest(ensemble):
        raise ValueError(f"{group.name} is not what was written")
    return ensemble


def _digest(ensemble: Ensemble) -> str:
    """Hash of all that an ensemble holds."""
    kind, keys, *rest = ensemble.random
    numbers = [float(number) for number in (*rest, ensemble.steps, ensemble.log_evidence)]
    held = hashlib.sha256(repr((kind, numbers)).encode())
    for array in (keys, *(getattr(ensemble, name) for name in _ARRAYS)):
        held.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()
