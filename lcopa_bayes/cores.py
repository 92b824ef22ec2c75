"""How many processes this one may run."""

from __future__ import annotations

import os


def cores() -> int:
    """Processors available to this process, at least 1."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
