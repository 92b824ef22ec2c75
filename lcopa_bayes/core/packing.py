"""Work for other processes as bytes: the one place of the package that pickles, and it opens no file."""

from __future__ import annotations

import pickle
from typing import Any

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
