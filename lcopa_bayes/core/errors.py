"""What is wrong with the user's input, all at once."""

from __future__ import annotations

import difflib
import errno
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import final

from lcopa_bayes.core.wording import listed

ELSEWHERE = "or choose another folder with --out"
REMEDIES = {
    errno.ENOSPC: "free some space and give the same command again",
    errno.EDQUOT: "free some of your quota and give the same command again",
    errno.EFBIG: f"raise the limit on the size of files (ulimit -f) {ELSEWHERE}",
    errno.EACCES: f"allow writing there {ELSEWHERE}",
    errno.EPERM: f"allow writing there {ELSEWHERE}",
    errno.EROFS: f"allow writing there {ELSEWHERE}",
    errno.ENAMETOOLONG: "give a shorter name",
}
"""What to do about what the system refuses, by its error number."""
_LONGEST = 100
"""Letters of a file's name that a message shows."""
_LISTED = 40
"""Known words that a message lists."""


class InputError(ValueError):
    """Input that cannot be used; with every problem, one sentence each.

    The command line prints the problems and exits with code 2.
    """

    def __init__(self, problems: str | Sequence[str]) -> None:
        self.problems: tuple[str, ...] = (problems,) if isinstance(problems, str) else tuple(problems)
        super().__init__("\n".join(self.problems))


@final
class UntrustedError(InputError):
    """Input that would run code of its author's."""


def refusal_of(error: BaseException) -> str | None:
    """What the system refused, where and why, with a remedy if one is known; None for another error."""
    if not (isinstance(error, OSError) and error.errno in REMEDIES):
        return None
    where = f"{shortened(str(error.filename))}: " if error.filename else ""
    return f"{where}{os.strerror(error.errno)}; {REMEDIES[error.errno]}"


def shortened(name: str) -> str:
    """A name as messages show it: one that no system can hold by its beginning."""
    return name if len(name) <= _LONGEST else f"{name[:_LONGEST]}..."


def refuse_if(problems: Sequence[str]) -> None:
    """Raise InputError when there are problems."""
    if problems:
        raise InputError(problems)


@contextmanager
def gathered(problems: list[str], where: str = "") -> Iterator[None]:
    """What is refused within joins the problems, each after `where`."""
    try:
        yield
    except InputError as error:
        problems += [f"{where}{problem}" for problem in error.problems]


def nearest(word: str, known: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the known word closest to `word`, or the list of all known words."""
    words = sorted(set(known))
    close = difflib.get_close_matches(word, words, n=1, cutoff=0.5)
    if close:
        return f"; did you mean {close[0]!r}?"
    return f"; known: {listed(words, _LISTED)}" if words else ""
