"""The scan of Eqs. 62-64: every candidate of the intervals, then finer candidates around the best."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from tqdm import tqdm

from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.paper.equation import least_squares
from lcopa_bayes.paper.evaluation import evaluate
from lcopa_bayes.paper.intervals import Scan
from lcopa_bayes.paper.paths import Blocks


@final
@dataclass(frozen=True, eq=False)
class Scanned:
    """The best candidates of a scan."""

    model: TransferPath
    """Least output error among candidates with positive viscosities and stiffness, or among all when there
    is none (`TransferPath.physical` is False); as normalised in the scan, the fixed coefficient 1."""
    rmse: float
    """Its output error over the blocks [response unit]."""
    unconstrained_rmse: float
    """Least output error among candidates of any sign [response unit]."""
    candidates: int
    """Candidates tried [-]."""
    physical: int
    """Of these, with positive viscosities and stiffness [-]."""


def scan(
    records: Sequence[Blocks],
    terms: int,
    span: float,
    plan: Scan,
    *,
    normalisation: Normalisation = Normalisation.STIFFNESS,
    bar: tqdm[None] | None = None,
) -> Scanned:
    """Scan the intervals, then refine around the best candidate, the least output error winning.

    Parameters: terms [-]; span [time unit] of the shortest record. The unit of the delay is a block of
    the first record.
    """
    block = records[0].grid.step
    samples = sum(blocks.grid.n for blocks in records)
    candidates = plan.first_round(terms, span, block)
    best: tuple[tuple[bool, float], tuple[float, ...], float] | None = None
    tried = physical = 0
    unconstrained = np.inf
    for number in range(plan.rounds + 1):
        if best is not None:
            candidates = plan.next_round(best[1], best[2], number, span, block)
        if bar is not None and bar.total is not None:
            bar.total += candidates.size
            bar.refresh()
        evaluated = evaluate(records, candidates, normalisation, bar)
        tried, physical = tried + candidates.size, physical + int(evaluated.physical.sum())
        unconstrained = min(unconstrained, float(evaluated.squares.min()))
        at = evaluated.best()
        rank = (not evaluated.physical[at], float(evaluated.squares[at]))
        if best is None or rank < best[0]:
            best = (rank, *evaluated.of(at))
    assert best is not None
    (_, squares), orders, delay = best
    model = least_squares(records, orders, delay, normalisation=normalisation)
    rmse, unconstrained_rmse = (float(np.sqrt(value / samples)) for value in (squares, unconstrained))
    return Scanned(model, rmse, unconstrained_rmse, tried, physical)
