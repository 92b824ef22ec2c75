"""A claim of the paper, the evidence it may call on, and the verdict that follows from numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, TypeAlias, final

from lcopa_bayes.model.literature import Stated


@final
class Kind(Enum):
    """What became of a claim."""

    SUPPORTED = "supported"
    CONTRADICTED = "contradicted"
    UNDECIDED = "undecided"
    """Cannot be decided from the evidence at hand; the reason says what is missing."""

    @classmethod
    def of(cls, holds: bool) -> Kind:
        """A claim that its criterion decides."""
        return cls.SUPPORTED if holds else cls.CONTRADICTED


@final
@dataclass(frozen=True)
class Verdict:
    """Outcome of one test."""

    kind: Kind
    number: float | None
    """What decides, in `unit`; None when there is nothing to compute from."""
    unit: str
    how: str
    """The calculation in a sentence or two, its criterion included; for an undecided claim, the reason."""


def undecided(how: str, unit: str = "-") -> Verdict:
    """A verdict without a number, for this reason."""
    return Verdict(Kind.UNDECIDED, None, unit, how)


def waiting(stage: str, question: str) -> Verdict:
    """The verdict while no result of a stage is among the evidence, with what it has to answer."""
    return undecided(f"No {stage} is among the evidence; it has to answer: {question}")


@final
@dataclass(frozen=True, eq=False)
class Evidence:
    """What beyond the printed numbers a test may read: the results of other stages, absent until run."""

    audits: tuple[Mapping[str, Any], ...] = ()
    """Results of identifiability audits of records like the paper's; the first that can answer decides."""
    compare: Mapping[str, Any] | None = None
    """Results of a comparison of integer and fractional models."""


Test: TypeAlias = Callable[[Stated, Evidence], Verdict]
"""Computes a verdict from the stated numbers and the evidence alone."""


@final
@dataclass(frozen=True, eq=False)
class Claim:
    """A sentence of the paper and the test of it: a copy of `Stated` with another number can give another
    verdict."""

    id: str
    text: str
    source: str
    """Section or equation of Ta et al. 2026."""
    test: Test
