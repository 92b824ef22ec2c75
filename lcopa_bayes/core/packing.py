"""Work for other processes as bytes: the one place of the package that pickles, and it opens no file."""

from __future__ import annotations

import pickle
from functools import lru_cache
from threading import local
from typing import Any, final

_SCRIPT = b"__main__"
"""Where the main script keeps what it defines, which no worker imports."""


def packed(value: object) -> bytes | None:
    """A pickle; None where another process could not read it."""
    try:
        out = pickle.dumps(value, pickle.HIGHEST_PROTOCOL)
    except (pickle.PicklingError, AttributeError, TypeError):
        return None
    return None if _SCRIPT in out else out


def unpacked(sent: bytes) -> Any:
    """What `packed` was given, in a process of its own; nothing else is read so."""
    return pickle.loads(sent)


@final
class Latest(local):
    """Unpacks what several tasks need once, for each thread its own, with what that caches; keeps as many as
    stated, the latest."""

    def __init__(self, count: int) -> None:
        """None is kept yet; every thread begins so."""
        self.kept = lru_cache(count)(unpacked)

    def __call__(self, sent: bytes) -> Any:
        """What `packed` was given."""
        return self.kept(sent)
