"""Words that messages and verdicts share: lists of names and clauses of a sentence."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

_SHOWN = 8


def listed(names: Sequence[str], most: int = _SHOWN) -> str:
    """The first few of some names, and how many more there are."""
    more = len(names) - most
    return ", ".join(names[:most]) + (f" and {more} more" if more > 0 else "")


def joined(clauses: Iterable[str]) -> str:
    """Clauses as one sentence, each once; empty without any."""
    text = "; ".join(dict.fromkeys(clauses))
    return f"{text[0].upper()}{text[1:]}." if text else ""
