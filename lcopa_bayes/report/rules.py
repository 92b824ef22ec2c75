"""The rules of default priors as a page shows them: paragraphs, and tables of parameter, prior and reason."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import final

from lcopa_bayes.inference import defaultpriors

_RULE = re.compile(r"=+(?: +=+)+$")
"""Line that begins a table, ends its heads, or ends it."""


@final
@dataclass(frozen=True)
class Passage:
    """A paragraph, or the rows of a table."""

    text: str = ""
    rows: tuple[tuple[str, ...], ...] = ()
    """Without the heads."""


def rules() -> tuple[Passage, ...]:
    """Those of `inference.defaultpriors`, in its words."""
    return tuple(passages(inspect.cleandoc(defaultpriors.__doc__ or "")))


def passages(text: str) -> Iterator[Passage]:
    """Paragraphs and simple tables of reStructuredText."""
    for block in re.split(r"\n\s*\n", text):
        lines = block.splitlines()
        if _RULE.match(lines[0]):
            yield Passage(rows=_rows(lines))
        else:
            yield Passage(re.sub(r"``([^`]*)``", r"`\1`", " ".join(lines)))


def _rows(lines: Sequence[str]) -> tuple[tuple[str, ...], ...]:
    """Rows of a table; a line without a first cell goes on with the one before."""
    starts = [match.start() for match in re.finditer(r"=+", lines[0])]
    ends = [number for number, line in enumerate(lines) if _RULE.match(line)]
    columns = [slice(low, high) for low, high in pairwise([*starts, None])]
    rows: list[list[str]] = []
    for line in lines[ends[-2] + 1 : ends[-1]]:
        cells = [line[column].strip() for column in columns]
        if cells[0]:
            rows.append(cells)
        else:
            rows[-1] = [f"{one} {more}".strip() for one, more in zip(rows[-1], cells, strict=True)]
    return tuple(tuple(row) for row in rows)
