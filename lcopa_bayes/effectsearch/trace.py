"""Signatures of every effect of a library held against the residual of a fit."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.special import logsumexp
from scipy.stats import binom

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.effectsearch.noise import scatter_evidence
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Projection, Scale, Signature, signature_of
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.model.effects.effect import Card, Effect, ScatterEffect

LEAST = 3.0
"""Log Bayes factor that an effect needs at least [nat]."""
QUANTILE = 0.99
LEVEL = 0.5
"""Difference of log evidence up to which instances of an effect are level [nat]."""
_DRAWS = 2000
"""Chance residuals at most: the probability beyond the threshold is known to 0.002 [-]."""
_CLEAR = 2.0
"""Distance of the largest evidence from the interval of the threshold at which no more are drawn [nat]."""
_TAIL = 0.05
"""Probability outside the interval of a threshold [-]."""
_BATCH = 400
"""Chance residuals drawn at once [-]: with so many the threshold is known to about half a nat."""
_NONE = 0.5
"""Prior probability that nothing is missing [-]; the effects share the rest evenly."""
MOST_COMMANDS = 400
"""Commands per record up to which effects are traced that follow each by itself [-]."""
SEEN = 0.1
"""Below this survival the records cannot see an effect [-]."""


def worth(log_bayes_factor: float, threshold: float) -> float:
    """Evidence in what chance gives: where that is more than under known noise, by as much less [nat]."""
    return log_bayes_factor * LEAST / threshold


@final
@dataclass(frozen=True, eq=False)
class Traced:
    """An effect with all its instances against one residual."""

    card: Card
    signatures: tuple[Signature, ...]
    log_bayes_factor: float
    """Against no effect, averaged over the instances [nat]."""
    best: int
    """First instance within 0.5 nat of the largest evidence: effects list likely constants first."""
    failed: str = ""
    """Why it could not be simulated."""

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.card.name

    @property
    def signature(self) -> Signature:
        """That of its best instance."""
        return self.signatures[self.best]

    @property
    def scatters(self) -> bool:
        """Whether it changes the distribution of the noise alone."""
        return not self.signatures and not self.failed

    @property
    def survival(self) -> float:
        """Largest share of an instance's signature that is left [-]; NaN for one that changes only the
        noise."""
        return max((one.survival for one in self.signatures), default=np.nan)


@final
@dataclass(frozen=True, eq=False)
class Trace:
    """All effects against one residual, and what chance alone gives."""

    traced: tuple[Traced, ...]
    """By falling evidence."""
    threshold: float
    """Largest of 3 and the 99 % quantile of the largest log Bayes factor by chance [nat]."""
    between: tuple[float, float]
    """95 % interval of that quantile: so many draws do not give it better [nat]."""
    p_value: float
    """Share of chance maxima at or above `largest`, no less than 1 / (draws + 1) [-]."""
    draws: int
    """Chance maxima drawn [-]: more where the largest evidence is close to the threshold."""
    residual: Vector
    """Whitened, projected residual, (n,) [-]."""
    scale: Scale
    """What is known of the noise scale."""

    @property
    def leader(self) -> Traced | None:
        """The effect of largest evidence among those that change the response; None without any."""
        return next((one for one in self.traced if not one.scatters), None)

    @property
    def largest(self) -> float:
        """Its log Bayes factor [nat]; -inf without any."""
        return self.leader.log_bayes_factor if self.leader else -np.inf

    @property
    def alarmed(self) -> bool:
        """Whether any effect that changes the response is above the threshold."""
        return self.largest > self.threshold

    @property
    def generic(self) -> Traced | None:
        """The generic class of most evidence; None without any."""
        classes = (one for one in self.traced if one.card.place == "generic")
        return max(classes, key=lambda one: one.log_bayes_factor, default=None)

    @property
    def scatter(self) -> float:
        """Evidence that the noise is not normal [nat]; -inf where that was not asked."""
        return max((one.log_bayes_factor for one in self.traced if one.scatters), default=-np.inf)

    @cached_property
    def probabilities(self) -> dict[str, float]:
        """Posterior probability of each effect and of "none", if exactly one of them is there, by what their
        evidence is worth [-]."""
        share = np.log((1 - _NONE) / max(len(self.traced), 1))
        logs = np.array(
            [np.log(_NONE), *(worth(one.log_bayes_factor, self.threshold) + share for one in self.traced)]
        )
        chances = np.exp(logs - logsumexp(logs))
        return dict(zip(("none", *(one.name for one in self.traced)), chances.tolist(), strict=True))

    def alone(self, signature: Signature) -> float:
        """Log Bayes factor of one instance [nat]."""
        return float(signature.evidence(signature.span.T @ self.residual[:, None], self.scale)[0])

    def of(self, name: str) -> Traced:
        """The effect of that name; KeyError when it was not traced."""
        return {one.name: one for one in self.traced}[name]


def trace(
    state: State,
    library: Sequence[type[Effect]],
    rng: np.random.Generator,
    *,
    noise_samples: Sequence[int] = (),
    draws: int = _DRAWS,
    crew: Crew = ALONE,
) -> Trace:
    """Evidence of every effect of `library` in the residual of a model, and the threshold of chance.

    `noise_samples`: samples each axis' noise was known from; the scale of a chance residual is uncertain by
    as much. Effects the model already has are left out.
    """
    model, optimum, whitening = state.model, state.optimum, state.whitening
    project = Projection(optimum.moving * model.spread)
    residual = project(optimum.settled)
    quiet = float(whitening.size if whitening.least else sum(noise_samples))
    freedom = whitening.effective - optimum.x.size
    scale = Scale(quiet, freedom, np.array([residual @ residual]))
    present = {effect.name for effect in model.effects}
    layout = model.plant.table.layout
    kinds = [one for one in library if one.card.name not in present and one.applies(layout)]
    longest = sorted(
        kinds, key=lambda kind: -len(kind.grid(model.effected.ranges))
    )  # first: none waits for it
    known = crew.sharing((state, project, residual, scale))
    done = dict(zip(longest, known.each(_traced, longest), strict=True))
    effects = [done[kind] for kind in kinds]
    effects.sort(key=lambda one: -one.log_bayes_factor)
    return against_chance(
        Trace(tuple(effects), LEAST, (LEAST, LEAST), np.nan, 0, residual, scale),
        lambda count: _chance(project, whitening, effects, rng, count, scale, crew),
        draws,
    )


def against_chance(seen: Trace, chance: Callable[[int], Vector], most: int) -> Trace:
    """The trace with its threshold: `chance` draws so many maxima [nat], at most `most` where it is close."""
    maxima = np.zeros(0)
    while maxima.size < most and not _clear(seen):
        maxima = np.concatenate((maxima, chance(min(_BATCH, most - maxima.size))))
        threshold, low, high = threshold_of(maxima)
        beaten = int(np.count_nonzero(maxima >= seen.largest))
        seen = replace(
            seen,
            threshold=threshold,
            between=(low, high),
            p_value=(beaten + 1) / (maxima.size + 1),
            draws=maxima.size,
        )
    return seen


def _clear(seen: Trace) -> bool:
    """Whether more chance residuals could not bring the threshold to the largest evidence."""
    low, high = seen.between
    return seen.draws > 0 and not low - _CLEAR < seen.largest < high + _CLEAR


def threshold_of(maxima: Vector) -> tuple[float, float, float]:
    """Threshold from chance maxima, and the ends of the 95 % interval of their quantile [nat].

    The ends are order statistics: the number of draws below a quantile is binomial. None is below 3 nat.
    """
    if not maxima.size:
        return LEAST, LEAST, LEAST
    ordered = np.sort(maxima)
    ranks = np.array([binom.ppf(p, maxima.size, QUANTILE) for p in (_TAIL / 2, 1 - _TAIL / 2)], dtype=int)
    low, high = ordered[np.clip(ranks - [1, 0], 0, maxima.size - 1)]
    return max(LEAST, float(np.quantile(ordered, QUANTILE))), max(LEAST, low), max(LEAST, high)


def commands_of(drive: Matrix) -> int:
    """Instants at which any drive changes [-]."""
    return int((np.diff(drive, axis=0) != 0).any(axis=1).sum())


def _traced(known: tuple[State, Projection, Vector, Scale], kind: type[Effect]) -> Traced:
    state, project, residual, scale = known
    whitening = state.whitening
    if issubclass(kind, ScatterEffect):
        unknown = "the noise is known from the residual alone" if whitening.dependence else ""
        unknown = "there is no noise" if whitening.least else unknown
        scatter = -np.inf if unknown else scatter_evidence(state.optimum.white)
        return Traced(kind.card, (), scatter, 0, unknown)
    commands = max(commands_of(one.record.drive) for one in whitening.samples) if kind.per_command else 0
    if commands > MOST_COMMANDS:
        why = f"it follows every command by itself, and a record has {commands} (at most {MOST_COMMANDS})"
        return Traced(kind.card, (), -np.inf, 0, why)
    signatures, evidence, failed = [], [], ""
    for instance in kind.grid(state.model.effected.ranges):
        try:
            signatures.append(signature_of(state.model, state.optimum.x, whitening, project, instance))
        except ArithmeticError as error:
            failed = str(error)
            continue
        evidence.append(float(signatures[-1].evidence(signatures[-1].span.T @ residual[:, None], scale)[0]))
    if not signatures:
        return Traced(kind.card, (), -np.inf, 0, failed or "it cannot be simulated")
    mean = float(logsumexp(evidence) - np.log(len(evidence)))
    best = int(np.argmax(np.array(evidence) > max(evidence) - LEVEL))
    return Traced(kind.card, tuple(signatures), mean, best, failed)


def _chance(
    project: Projection,
    whitening: Whitening,
    effects: Sequence[Traced],
    rng: np.random.Generator,
    draws: int,
    scale: Scale,
    crew: Crew = ALONE,
) -> Vector:
    """Largest log Bayes factor of each of `draws` residuals of the base model alone, (draws,) [nat]."""
    listed = [one for traced in effects for one in traced.signatures]
    if not listed:
        return np.zeros(draws)
    spans = [one.span for one in listed]
    edges = np.cumsum([0, *(span.shape[1] for span in spans)])
    every = np.concatenate(spans, axis=1).T
    z = whitening.chance(draws, rng)
    scattered = any(one.scatters for one in effects)
    scatter = crew.map(_scatter_evidence, [z.T] if scattered else [])  # meanwhile
    left = project(z)
    inner = (every @ left.astype(np.float32)).astype(float)
    known = Scale(scale.quiet, scale.freedom, np.einsum("nd,nd->d", left, left))
    evidence = [
        one.evidence(inner[a:b], known) for one, a, b in zip(listed, edges[:-1], edges[1:], strict=True)
    ]
    start, by_effect = 0, []
    for traced in effects:
        count = len(traced.signatures)
        if count:
            by_effect.append(logsumexp(evidence[start : start + count], axis=0) - np.log(count))
        start += count
    by_effect += scatter
    return np.asarray(np.max(by_effect, axis=0))


def _scatter_evidence(white: Matrix) -> Vector:
    """That of each residual (draws, n), (draws,) [nat]."""
    return np.array([scatter_evidence(one) for one in white])
