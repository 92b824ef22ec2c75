"""Pairs of effects that together explain what neither of them explains alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import combinations

import numpy as np

from lcopa_bayes.effectsearch.acceptance import acceptable
from lcopa_bayes.effectsearch.refits import Refit, begun, ended, evidence_over, refit, under_one_noise
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import pair_evidence
from lcopa_bayes.effectsearch.trace import Trace
from lcopa_bayes.effectsearch.verdict import MARGIN

_PAIRED = 8
"""Single effects of which pairs are formed [-]."""
_PAIRS = 2
"""Pairs refitted [-]."""
_HALFWAY = 0.5
"""What a few evaluations of a pair are worth over the evidence to beat, below which it is left out [-]."""


def paired(start: State, state: State, seen: Trace) -> Refit | None:
    """The best pair of effects, when its evidence beats what was found one by one; else None.

    It is one of many, and its evidence pays for the choice.
    """
    named = [one for one in seen.traced if one.card.place != "generic" and one.signatures][:_PAIRED]
    ranked = sorted(
        combinations(named, 2),
        key=lambda pair: -pair_evidence(pair[0].signature, pair[1].signature, seen.residual),
    )
    have = {effect.name for effect in state.model.effects}
    choice = float(np.log(max(len(ranked), 1)))
    more = 2 - len(have) if len(have) < 2 else 0
    bar, best = evidence_over(start, state, seen.scale.quiet)[0] + (1 + more) * MARGIN, None
    for pair in ranked[:_PAIRS]:
        if {one.name for one in pair} <= have:
            continue
        columns = np.concatenate([one.signature.columns for one in pair], axis=1)
        inner = np.linalg.solve(np.eye(columns.shape[1]) + columns.T @ columns, columns.T @ seen.residual)
        sizes = np.split(inner, [pair[0].signature.columns.shape[1]])
        added = [(one.signature.effect, size) for one, size in zip(pair, sizes, strict=True)]
        try:
            candidate = begun(start.model, start.optimum, start.whitening, added, seen.scale.quiet)
            if candidate.worth < _HALFWAY * bar and not start.whitening.dependence:
                continue
            candidate = ended(candidate)
        except ArithmeticError:
            continue
        candidate = replace(under_one_noise([candidate])[0], choice=choice)
        if candidate.log_bayes_factor > bar and acceptable(candidate, seen, seen.threshold):
            bar, best = candidate.log_bayes_factor, candidate
    return best


def both(start: State, state: State, pair: Refit, better: Callable[[State, State], bool]) -> Refit | None:
    """A pair of which each effect predicts unseen records better beside the other; else the one of them that
    does as well alone, when its evidence beats what was found one by one."""
    alone = []
    for effect, size in pair.model.sizes(pair.optimum.x):
        others = [name for name in pair.added if name != effect.name]
        near = pair.without(others)[1]
        try:
            one = refit(start.model, start.optimum, start.whitening, [(effect, size)], pair.quiet, near)
        except ArithmeticError:
            continue
        if not better(pair.state, one.state):
            alone.append(one)
    if not alone:
        return pair
    best = max(alone, key=lambda one: one.log_bayes_factor)
    return best if best.log_bayes_factor > evidence_over(start, state, pair.quiet)[0] + MARGIN else None
