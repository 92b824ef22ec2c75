"""Finished replicas on disk, one small file each, so that a killed calibration goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from lcopa_bayes.calibration.replica import Outcome, Replication
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import writable_folder, write_text
from lcopa_bayes.results.provenance import fingerprint

_ADVICE = "leave out --resume to start anew, or choose another --out"


def store_fingerprint(replication: Replication) -> str:
    """Hash of everything an outcome depends on besides its number."""
    values = (
        fingerprint(replication.problem.study, replication.plan),
        replication.truths.digest,
        replication.engine,
        [list(quantity) for quantity in replication.quantities],
    )
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()


@dataclass(frozen=True)
class Store:
    """Folder of outcomes that share a fingerprint."""

    folder: Path
    fingerprint: str

    @classmethod
    def within(cls, folder: Path, replication: Replication) -> Store:
        """The store of a calibration whose results go to `folder`; InputError when it cannot be written."""
        return cls(writable_folder(writable_folder(folder) / "replicas"), store_fingerprint(replication))

    def save(self, outcome: Outcome) -> None:
        """Write an outcome whole or not at all; InputError when there is no room for it."""
        text = json.dumps({"fingerprint": self.fingerprint} | asdict(outcome), allow_nan=False)
        try:
            write_text(self._path(outcome.replica), text + "\n")
        except InputError as error:
            problems = [*error.problems, "what was stored before is intact; go on with --resume"]
            raise InputError(problems) from error

    def load(self, replicas: int) -> dict[int, Outcome]:
        """Outcomes stored of the first replicas; InputError when one is damaged or of another study."""
        paths = {number: self._path(number) for number in range(replicas)}
        return {number: self._outcome(path) for number, path in paths.items() if path.exists()}

    def clear(self) -> None:
        """Remove every outcome."""
        for path in self.folder.glob("[0-9]*.json"):
            path.unlink()

    def _path(self, number: int) -> Path:
        return self.folder / f"{number:05d}.json"

    def _outcome(self, path: Path) -> Outcome:
        try:
            values: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            own = values.pop("fingerprint") == self.fingerprint
            if own:
                tuples = {"truths": tuple(values["truths"]), "ranks": tuple(values["ranks"])}
                return Outcome(**values | tuples | {"inside": tuple(tuple(row) for row in values["inside"])})
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise InputError(
                f"{path}: not a replica this program wrote, or damaged ({error}); {_ADVICE}"
            ) from None
        raise InputError(f"{path}: made from other records, settings, truths or seed; {_ADVICE}")
