"""Effects that records neither show nor exclude, and what they leave open of the numbers of a loop.

A loop ends with one model. With one more effect, whose evidence chance could give, or with a rival in place
of one that it named, gains and delays are elsewhere, and the records say little against it: numbers are over
all of these, weighted by evidence. One more effect is one linear step away: with whitened residual r and
tangents J at the optimum, information H and signatures S over the prior sd of their coefficients psi,
``psi ~ N(V S' r, V)``, ``1 / V = I + S' S - S' J G``, and coordinates move by ``-G psi``, ``G = H^-1 J' S``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of, root_of
from lcopa_bayes.effectsearch.rounds import Round
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Signature
from lcopa_bayes.effectsearch.trace import LEAST as CHANCE
from lcopa_bayes.effectsearch.trace import Trace

LEAST = 3e-3
"""Weight beside that of the final model below which an alternative is left out [-]."""
_DRAWS = 4000
"""Draws of all models together [-]."""
_SEED = 23


@final
@dataclass(frozen=True, eq=False)
class Alternative:
    """One more effect beside those of a final model, or one in place of the last."""

    name: str
    weight: float
    """Beside 1 of the final model [-]."""
    shift: Vector
    """Of its coordinates, those of the plant alone where an effect is replaced, (k,)."""
    root: Matrix
    """Factor of the covariance of that, (k, m)."""
    instead: bool
    """Whether it stands in place of the last effect, whose coordinates it does not have."""

    def draws(self, own: Matrix, middle: Vector, rng: np.random.Generator) -> Matrix:
        """Coordinates, (draws, k), from draws of the final model about its optimum `middle`."""
        k = self.shift.size
        scatter = rng.standard_normal((len(own), self.root.shape[1])) @ self.root.T
        return np.asarray((middle[:k] if self.instead else own) + self.shift + scatter)


def alternatives(state: State, rounds: Sequence[Round]) -> tuple[Alternative, ...]:
    """Those of a final model that its last trace, of which no effect stands out, and the refits of the round
    that chose its last effect leave a weight."""
    return (*_beside(state, rounds[-1].trace), *_instead(state, rounds))


def mixture(state: State, own: Matrix | None, found: Sequence[Alternative]) -> tuple[list[Matrix], Vector]:
    """Draws of the final model, from `own` where there are any, and of each alternative, inside the support
    of the coordinates; and their weights, which add up to 1."""
    rng = np.random.default_rng(_SEED)
    x, (low, high) = state.optimum.x, state.model.bounds
    if own is None:
        own = x + rng.standard_normal((_DRAWS, x.size)) @ root_of(state.covariance).T
    parts, weights = [own], [1.0]
    for one in found:
        drawn = one.draws(own[rng.integers(len(own), size=_DRAWS)], x, rng)
        k = one.shift.size
        inside = ((drawn >= low[:k]) & (drawn <= high[:k])).all(axis=1)
        if inside.any():
            parts.append(drawn[inside])
            weights.append(one.weight * float(inside.mean()))
    return parts, np.array(weights) / sum(weights)


def pooled(values: Sequence[Vector], weights: Vector) -> Vector:
    """Equally probable values of a mixture whose parts are given by equally probable values."""
    counts = np.round(_DRAWS * weights).astype(int)
    pairs = zip(values, counts, strict=True)
    return np.concatenate([np.quantile(one, (np.arange(n) + 0.5) / n) for one, n in pairs if n])


def odds(seen: Trace, log_bayes_factor: float) -> float:
    """Of one more effect against none [-]: as probable beforehand as any other, and all together as none.

    Its evidence counts in what chance gives: where that is more than under noise that is known, by as much
    less. Infinite where a float does not hold it.
    """
    with np.errstate(over="ignore"):
        return float(np.exp(log_bayes_factor * CHANCE / seen.threshold)) / len(seen.traced)


def _beside(state: State, seen: Trace) -> list[Alternative]:
    """One more effect beside those of the final model."""
    out = []
    for traced in seen.traced:
        for signature in traced.signatures:
            weight = odds(seen, seen.alone(signature)) / len(traced.signatures)
            if weight > LEAST:
                shift, root = _step(state, signature, seen)
                out.append(Alternative(traced.name, weight, shift, root, instead=False))
    return out


def _step(state: State, signature: Signature, seen: Trace) -> tuple[Vector, Matrix]:
    """What an instance of an effect moves coordinates by, and a factor of its covariance."""
    optimum, free = state.optimum, ~state.optimum.stuck
    raw, _ = state.model.signature(optimum.x, signature.effect)
    columns = state.whitening(raw.T).T * signature.width(seen.residual, seen.scale)
    tangents = optimum.jacobian[:, free]
    cross = tangents.T @ columns
    gain = np.zeros((free.size, columns.shape[1]))
    gain[free] = covariance_of(optimum.information[np.ix_(free, free)]) @ cross
    inverse = np.eye(columns.shape[1]) + columns.T @ columns - cross.T @ gain[free]
    covariance = np.asarray(np.linalg.inv(inverse), dtype=float)
    return -gain @ (covariance @ (columns.T @ optimum.settled)), -gain @ root_of(covariance)


def _instead(state: State, rounds: Sequence[Round]) -> list[Alternative]:
    """Rivals of the effect that was added last, as they were refitted."""
    last = next((one for one in reversed(rounds) if one.chosen), None)
    names = {effect.name for effect in state.model.effects}
    if last is None or last.chosen is None or {e.name for e in last.chosen.model.effects} != names:
        return []
    out, size = [], state.model.plant_size
    for one in last.refits:
        weight = float(np.exp(min(one.log_bayes_factor - last.chosen.log_bayes_factor, 0.0)))
        if one is last.chosen or weight <= LEAST:
            continue
        shift = one.optimum.x[:size] - state.optimum.x[:size]
        root = root_of(one.optimum.covariance[:size, :size])
        out.append(Alternative(one.added[0], weight, shift, root, instead=True))
    return out
