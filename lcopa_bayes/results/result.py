"""The manners every result has: table, plain values, folder, pages."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar, TypeAlias

import pandas as pd

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.results.runfolder import locked

PAGE = "report.html"
"""Page of a fit in its run folder."""
_SENTENCE = 30
"""Letters from which a cell is a sentence."""


class Result(ABC):
    """What a public function returns.

    Whether just computed or read back by `load_result`, it gives the same table, values and pages.
    """

    verb: ClassVar[str]
    """Name of the function and of the command."""
    file: ClassVar[str]
    """File of a run folder that holds `to_json()`."""

    @abstractmethod
    def summary(self) -> pd.DataFrame:
        """The result as a table."""

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """Every number as plain values; what is open, infinite or undefined is None."""

    @abstractmethod
    def save(self, folder: Path | str) -> Path:
        """Write the files of the result into a run folder; returns the folder.

        InputError when the folder holds another study's results, another run is writing there, or a file
        cannot be written.
        """

    @property
    @abstractmethod
    def verdict(self) -> str:
        """The result in a sentence or a few."""

    def report(self, folder: Path | str, *, jobs: int = 1) -> Path:
        """Write the page of the result into a run folder, saving the result there first if it is not there
        yet, in a process of its own where `jobs` allows one; returns the path of the page. InputError as
        `save`."""
        folder = Path(folder)
        if not self.is_in(folder):
            self.save(folder)
        with locked(folder):
            return self._write_page(folder, jobs)

    def _write_page(self, folder: Path, jobs: int) -> Path:
        with workers(None, jobs=min(jobs, 2), here=True) as crew:
            return next(crew.map(write_page, [(self.verb, folder)]))

    def is_in(self, folder: Path) -> bool:
        """Whether a run folder holds this very result."""
        try:
            stored = json.loads((folder / self.file).read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return False
        return bool(stored == plain(self.to_json()))

    def __str__(self) -> str:
        return f"{_text_table(self.summary())}\n\n{self.verdict}"

    def _repr_html_(self) -> str:
        from html import escape

        table = self.summary()
        return f"<p>{escape(self.verdict)}</p>" + (notebook_table(table) if len(table) else "")


Fresh: TypeAlias = tuple[Mapping[str, Any], Mapping[str, Matrix]]
"""Values of a fit and its draws by parameter, (ensembles, draws), as its run folder will hold them."""


def write_page(wanted: tuple[str, Path]) -> Path:
    """Write the page of a verb's result into its run folder; returns its path.

    Pages read results, and results import no page: it is looked up when wanted, and where a process of its
    own writes it this one need not load what draws figures.
    """
    page: Path = _pages().write_page_of(*wanted)
    return page


def write_fit_page(folder: Path, fresh: Fresh | None, *, jobs: int) -> Path:
    """Write the page of a fit into its run folder, also before its values and draws are there where these are
    given, the halves of its figures at the same time where `jobs` allow it; returns its path."""
    with workers((folder, fresh), jobs=min(jobs, 2), here=True) as crew:
        halves = list(crew.each(_drawn_half, (0, 1)))
        return next(crew.each(_composed, [halves]))


def _drawn_half(shared: tuple[Path, Fresh | None], half: int) -> Any:
    return _pages().drawn_half(*shared, half)


def _composed(shared: tuple[Path, Fresh | None], halves: Sequence[Any]) -> Path:
    page: Path = _pages().write_report(*shared, halves)
    return page


def _pages() -> ModuleType:
    return import_module("lcopa_bayes.report.pages")


def _text_table(table: pd.DataFrame) -> str:
    """A table as text: numbers and names on the right, sentences on the left."""
    table = table.copy()
    for name in table.select_dtypes(exclude="number"):
        cells = [shown(one) for one in table[name]]
        width = max(map(len, [str(name), *cells]))
        if width > _SENTENCE:
            table[name] = [one.ljust(width) for one in cells]
            table = table.rename(columns={name: str(name).ljust(width)})
    text: str = table.to_string(index=False, float_format=shown, na_rep="")
    return "\n".join(line.rstrip() for line in text.splitlines())


def notebook_table(table: pd.DataFrame) -> str:
    """A table as HTML for a notebook: numbers short and on the right, words on the left."""
    words = table.select_dtypes(exclude="number").columns
    left: list[Any] = [{"selector": "", "props": "text-align: left"}]
    style = table.style.hide(axis="index").format(shown, escape="html")
    return str(style.set_table_styles(dict.fromkeys(words, left)).to_html())


def shown(value: object) -> str:
    """A cell: four significant digits or two decimals, none from 1000 on; nothing for what is open or
    undefined."""
    if value is None or value != value:
        return ""
    if isinstance(value, float):
        places = ".4g" if abs(value) < 10 or not abs(value) < 1e6 else ".2f" if abs(value) < 1000 else ".0f"
        return format(value + 0.0, places)  # no negative zero
    return str(value)
