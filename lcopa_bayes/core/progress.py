"""Progress of long work: a bar on a terminal, plain lines now and then where there is none."""

from __future__ import annotations

import sys
import time
from typing import Any, final

from tqdm import tqdm

_LINES = 10.0
"""Least time between two lines of one task in a log [s]."""
_LINE = "{desc}: {n_fmt}/{total_fmt} {unit}s, {elapsed} so far, {remaining} left{postfix}"
_COUNT = "{desc}: {n_fmt} {unit}s, {elapsed} so far{postfix}"


@final
class Progress(tqdm):  # type: ignore[type-arg]
    """`tqdm` that writes lines a log can hold where standard error is no terminal.

    Takes what `tqdm` takes; `quiet` shows nothing. A new description, and the end, are shown at once.
    """

    def __init__(self, *args: Any, quiet: bool = False, **options: Any) -> None:
        self._plain = not sys.stderr.isatty()
        self._last, self._due = "", 0.0
        if self._plain:
            line = _LINE if options.get("total") else _COUNT
            options = {"mininterval": _LINES, "bar_format": line} | options
        super().__init__(*args, disable=quiet, **options)  # type: ignore[call-overload]

    def display(self, msg: str | None = None, pos: int | None = None) -> None:
        """Show the bar, or a line where there is no terminal and the last one is old enough."""
        if not self._plain:
            super().display(msg, pos)
        elif time.monotonic() >= self._due:
            self._write(str(self) if msg is None else msg)

    def set_description(self, desc: str | None = None, refresh: bool | None = True) -> None:
        """Name what is being done."""
        if not self._plain:
            super().set_description(desc, refresh)
        elif not self.disable and desc != self.desc:  # the line has a colon of its own
            self._due = 0.0
            self.set_description_str(desc, refresh)

    def close(self) -> None:
        """End with a last line."""
        if self._plain and not self.disable:
            self._write(str(self))
            self._due, self.leave = float("inf"), False
        super().close()

    def _write(self, text: str) -> None:
        if text != self._last:
            print(text, file=sys.stderr, flush=True)
            self._last, self._due = text, time.monotonic() + _LINES
