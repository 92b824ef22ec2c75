"""Results that are plain values and texts, the same whether just computed or read from a run folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import read_json, save_json, writable_folder, write_text
from lcopa_bayes.results.datatree import POSTERIOR
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.results.result import PAGE, Result
from lcopa_bayes.results.runfolder import add_origin, opened, origins, provenance
from lcopa_bayes.results.savedfit import NAME, load_fit

R = TypeVar("R", bound="StoredResult")


@dataclass(frozen=True, eq=False)
class StoredResult(Result):
    """Values of one verb, where they come from, and the fit they rest on."""

    values: Mapping[str, Any]
    """What `to_json` gives."""
    origin: Mapping[str, Any]
    """Provenance: command, seed, settings, hashes of records and files, versions."""
    texts: Mapping[str, str] = field(default_factory=dict)
    """Further files of the result, by name inside the run folder."""
    fit: Predictive | None = None
    """The fit that the result rests on; None for results that rest on none, or that were published without
    its draws."""

    rests_on_fit: ClassVar[bool] = False
    """Whether the result is of one fit."""
    beside: ClassVar[tuple[str, ...]] = ()
    """Patterns of the further files."""

    @property
    def verdict(self) -> str:
        """The result in a sentence or a few."""
        return str(self.values["verdict"])

    def to_json(self) -> dict[str, Any]:
        """Every number as plain values; what is open, infinite or undefined is None."""
        return dict(self.values)

    def save(self, folder: Path | str) -> Path:
        """Write the result, and the fit it rests on, into a run folder; returns the folder.

        InputError when the folder holds results of another study, another run is writing there, or a file
        cannot be written.
        """
        with opened(folder, self.origin) as path:
            if self.fit is not None and not self.fit.is_in(path):
                self.fit.save(path)
            for name, text in self.texts.items():
                writable_folder((path / name).parent)
                if not ((path / name).is_file() and (path / name).read_text(encoding="utf-8") == text):
                    write_text(path / name, text)
            save_json(self.values, path / self.file)
            add_origin(path, self.verb, self.origin)
        return path

    def kept(self: R, folder: Path | str | None) -> R:
        """The result, saved where a folder is given."""
        if folder is not None:
            self.save(folder)
        return self

    def report(self, folder: Path | str, *, jobs: int = 1) -> Path:
        """Write the page of the result into a run folder, and that of the fit it rests on where it is not
        there yet, saving both there first where they are not, in a process of its own where `jobs` allows
        one; returns the path of the page. InputError as `save`."""
        if self.fit is not None and not ((Path(folder) / PAGE).is_file() and self.fit.is_in(Path(folder))):
            self.fit.report(folder, jobs=jobs)
        return super().report(folder, jobs=jobs)

    @classmethod
    def load(cls: type[R], folder: Path) -> R:
        """The result in a run folder; InputError when it is not there, cannot be read, or rests on another
        fit than the one there, or on one that is cut short."""
        path, origin = folder / cls.file, origins(folder).get(cls.verb)
        if origin is None:
            raise InputError(f"{folder}: holds no result of `{cls.verb}`; run it to write one")
        values = read_json(path, f"run `{cls.verb}` again")
        names = sorted(one for pattern in cls.beside for one in folder.glob(pattern) if one.is_file())
        try:
            texts = {str(one.relative_to(folder)): one.read_text(encoding="utf-8") for one in names}
        except (OSError, ValueError) as error:
            raise InputError(f"{folder}: cannot be read ({error}); run `{cls.verb}` again") from None
        kept = any((folder / one).exists() for one in (NAME, POSTERIOR))
        fit = load_fit(folder) if cls.rests_on_fit and kept else None
        if fit is not None and origin.get("draws_sha256") != fit.draws.sha256:
            raise InputError(f"{path}: rests on another fit than the one beside it; run `{cls.verb}` again")
        return cls(values, origin, texts, fit)


def origin_of(fit: Predictive, verb: str) -> dict[str, Any]:
    """Provenance of a result that rests on a fit."""
    return plain(provenance(fit.study, verb) | {"draws_sha256": fit.draws.sha256})


def stored_values(
    folder: Path, verb: str, needs: Sequence[str], *, file: str | None = None
) -> Mapping[str, Any]:
    """Values that `verb` wrote to a run folder; InputError when they cannot be read or lack any of `needs`.

    They are in `file`, by default the one named after the verb.
    """
    path = folder / (file or f"{verb}.json")
    values = read_json(path, f"give the run folder that `{verb}` wrote")
    absent = [key for key in needs if key not in values]
    if absent:
        raise InputError(f"{path}: lacks {', '.join(absent)}; run `{verb}` again")
    return values
