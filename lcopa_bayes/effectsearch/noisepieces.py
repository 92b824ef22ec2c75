"""Pieces of noise, and the autoregression that makes them most likely."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.optimize import minimize

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.autoregression import Autoregression

_LARGEST_ORDER = 8
_PER_COEFFICIENT = 15
"""Samples that one coefficient needs at least [-]."""
_PATIENCE = 3
"""Orders tried beyond the best so far [-]."""


@final
@dataclass(frozen=True, eq=False)
class Mode:
    """Most likely autoregression of one order."""

    partial: Vector
    """Partial autocorrelations [-], (order,)."""
    cost: float
    """Negative restricted log likelihood at the best innovation sd [nat]."""
    innovation_sd: float
    """[response unit]."""
    criterion: float
    """Corrected Akaike criterion [-]."""


@final
@dataclass(frozen=True, eq=False)
class NoisePieces:
    """Pieces of noise, each about a level of its own that is integrated out under a flat prior."""

    pieces: tuple[Vector, ...]
    """Each (n,), n > 1 [response unit]."""

    @classmethod
    def of(cls, pieces: Sequence[Vector]) -> NoisePieces:
        """Pieces of two samples and more; ValueError with fewer than three samples beyond their number."""
        kept = tuple(piece for piece in pieces if piece.size > 1)
        total = sum(piece.size for piece in kept)
        if total - len(kept) < 3:
            raise ValueError(f"{total} samples in {len(kept)} pieces cannot give the scale of the noise")
        return cls(kept)

    @cached_property
    def freedom(self) -> int:
        """Samples beyond the levels [-]."""
        return sum(piece.size - 1 for piece in self.pieces)

    @cached_property
    def _alike(self) -> list[Matrix]:
        """Pieces by length."""
        return [
            np.array([p for p in self.pieces if p.size == n]) for n in sorted({p.size for p in self.pieces})
        ]

    def cost(self, partial: Vector) -> tuple[float, float]:
        """Negative restricted log likelihood at the best innovation sd [nat], and that sd.

        With the sd integrated out under ``1 / sd`` it is the same up to a constant.
        """
        unit = Autoregression(np.clip(partial, -1 + 1e-9, 1 - 1e-9), 1.0)
        squares, levels, scales = 0.0, 0.0, 0.0
        for pieces in self._alike:
            number, n = pieces.shape
            white, ones = unit.whiten(pieces), unit.whiten(np.ones(n))
            power = float(ones @ ones)
            squares += float((white**2).sum()) - float(((white @ ones) ** 2).sum()) / power
            levels += 0.5 * number * np.log(power)
            scales += number * unit.log_scale(n)
        sd = float(np.sqrt(max(squares, 1e-300) / self.freedom))
        return self.freedom * np.log(sd) + scales + levels, sd

    def _stretched(self, x: Vector) -> float:
        """Cost of the inverse hyperbolic tangents of partial autocorrelations."""
        return self.cost(np.tanh(x))[0]

    @cached_property
    def modes(self) -> tuple[Mode, ...]:
        """The mode of every order from 0 to three beyond that of the least criterion, at most 8."""
        total, longest = sum(p.size for p in self.pieces), max(p.size for p in self.pieces)
        start, out, best = np.empty(0), [], 0
        for order in range(min(_LARGEST_ORDER, longest - 2, total // _PER_COEFFICIENT) + 1):
            if order:
                found = minimize(
                    self._stretched,
                    np.concatenate([start, [0.0]]),
                    method="BFGS",
                    options={"gtol": 1e-4, "maxiter": 60},
                )
                start = np.clip(
                    found.x, -6.0, 6.0
                )  # a start for the next order; 6 is a correlation of 0.99999
            cost, sd = self.cost(np.tanh(start))
            count = order + 1
            criterion = 2 * cost + 2 * count * total / max(total - count - 1, 1)
            out.append(Mode(np.tanh(start), cost, sd, criterion))
            if criterion < out[best].criterion - 1e-9:
                best = order
            elif order >= best + _PATIENCE:
                break
        return tuple(out)

    @property
    def estimate(self) -> Autoregression:
        """Restricted maximum likelihood, order by the corrected Akaike criterion: an order too small costs
        false alarms, one too large next to nothing."""
        best = min(self.modes, key=lambda one: one.criterion)
        return Autoregression(best.partial, best.innovation_sd)


def estimated(pieces: Sequence[Vector]) -> Autoregression:
    """Order and scale from pieces of noise (`NoisePieces`)."""
    return NoisePieces.of(pieces).estimate
