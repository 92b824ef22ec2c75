"""`chain.h5`: the ensembles of a run, so that a killed run is taken up where it stopped."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import final

import h5py
import numpy as np

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import write_whole
from lcopa_bayes.sampling.ensemble import Ensemble
from lcopa_bayes.sampling.weighted import Weighted

_WEIGHTED = ("coordinates", "log_density", "raw", "log_weights", "sampled")
_ARRAYS = ("chain", "log_density", "position", "position_log_density", "accepted", "trail")


@final
@dataclass(frozen=True, eq=False)
class Chain:
    """Progress of a run."""

    ensembles: tuple[Ensemble, ...] = ()
    weighted: Weighted | None = None
    """Importance draws, the result of a run that has them."""


def save_chain(path: Path, chain: Chain, fingerprint: str) -> None:
    """Write a run as far as it has come; the file of the last save stays intact until this one is complete.

    InputError when the file cannot be written, saying whether the rounds before this one are kept.
    """

    def write(beside: Path) -> None:
        image = BytesIO()  # HDF5 does not survive a failed write
        with h5py.File(image, "w") as file:
            file.attrs["fingerprint"] = fingerprint
            if chain.weighted is not None:
                _write_weighted(file.create_group("weighted"), chain.weighted)
            for number, ensemble in enumerate(chain.ensembles):
                group = file.create_group(f"ensemble_{number}")
                for name in _ARRAYS:
                    group.create_dataset(name, data=getattr(ensemble, name))
                group.attrs["steps"] = ensemble.steps
                group.attrs["way"], group.attrs["near"] = ensemble.tempering_moves, ensemble.near
                kind, keys, position, has_gauss, gauss = ensemble.random
                group.attrs["random_kind"] = kind
                group.create_dataset("random_keys", data=keys)
                group.attrs["random_rest"] = np.array([position, has_gauss, gauss], dtype=float)
                group.attrs["digest"] = _digest(ensemble)
        beside.write_bytes(image.getbuffer())

    try:
        write_whole(path, write)
    except InputError as error:
        if any(ensemble.steps for ensemble in chain.ensembles) and path.exists():  # not the first save
            kept = "; the rounds before it are kept: the same command with --resume continues from them"
            raise InputError([problem + kept for problem in error.problems]) from error
        raise


def load_chain(path: Path, fingerprint: str) -> Chain:
    """What an earlier run of the same study and settings has; empty when there is no file.

    InputError when the file is damaged or belongs to another study, settings or seed.
    """
    if not path.exists():
        return Chain()
    advice = "leave out --resume to start anew, or choose another --out"
    try:
        with h5py.File(path, "r") as file:
            own = file.attrs["fingerprint"] == fingerprint
            count = len(file) - ("weighted" in file)
            chain = Chain(
                tuple(_ensemble(file[f"ensemble_{number}"]) for number in range(count)),
                _read_weighted(file["weighted"]) if "weighted" in file else None,
            )
    except Exception as error:  # whatever a damaged file leads the library to
        raise InputError(f"{path}: not a chain this program wrote, or damaged ({error}); {advice}") from None
    if not own:
        raise InputError(f"{path}: written with other records, settings or seed; {advice}")
    return chain


def _write_weighted(group: h5py.Group, weighted: Weighted) -> None:
    for name in _WEIGHTED:
        group.create_dataset(name, data=getattr(weighted, name))
    group.attrs["pareto_k"], group.attrs["count"] = weighted.pareto_k, weighted.count
    group.attrs["log_evidence"] = [weighted.log_evidence, weighted.log_evidence_sd]
    group.attrs["logarithmic"] = weighted.logarithmic
    group.attrs["digest"] = _weighted_digest(weighted)


def _read_weighted(group: h5py.Group) -> Weighted:
    coordinates, log_density, raw, log_weights, sampled = (group[name][()] for name in _WEIGHTED)
    weighted = Weighted(
        coordinates,
        log_density,
        raw,
        log_weights,
        float(group.attrs["pareto_k"]),
        int(group.attrs["count"]),
        float(group.attrs["log_evidence"][0]),
        float(group.attrs["log_evidence"][1]),
        sampled,
        tuple(bool(logarithmic) for logarithmic in group.attrs["logarithmic"]),
    )
    if group.attrs["digest"] != _weighted_digest(weighted):
        raise ValueError(f"{group.name} is not what was written")
    return weighted


def _weighted_digest(weighted: Weighted) -> str:
    numbers = [weighted.pareto_k, weighted.log_evidence, weighted.log_evidence_sd]
    held = hashlib.sha256(repr((numbers, weighted.count, weighted.logarithmic)).encode())
    for name in _WEIGHTED:
        array = getattr(weighted, name)
        held.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()


def _ensemble(group: h5py.Group) -> Ensemble:
    chain, log_density, position, position_log_density, accepted, trail = (
        group[name][()] for name in _ARRAYS
    )
    at, has_gauss, gauss = group.attrs["random_rest"]
    random = (group.attrs["random_kind"], group["random_keys"][()], int(at), int(has_gauss), float(gauss))
    steps, tempering_moves = int(group.attrs["steps"]), int(group.attrs["way"])
    begun = trail, tempering_moves, bool(group.attrs["near"])
    ensemble = Ensemble(chain, log_density, position, position_log_density, accepted, steps, random, *begun)
    if group.attrs["digest"] != _digest(ensemble):
        raise ValueError(f"{group.name} is not what was written")
    return ensemble


def _digest(ensemble: Ensemble) -> str:
    """Hash of all that an ensemble holds."""
    kind, keys, *rest = ensemble.random
    numbers = [float(number) for number in (*rest, ensemble.steps, ensemble.tempering_moves, ensemble.near)]
    held = hashlib.sha256(repr((kind, numbers)).encode())
    for array in (keys, *(getattr(ensemble, name) for name in _ARRAYS)):
        held.update(repr(array.shape).encode() + np.ascontiguousarray(array).tobytes())
    return held.hexdigest()
