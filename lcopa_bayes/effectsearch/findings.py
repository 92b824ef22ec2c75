"""What a search found, as a verdict takes it: errors before and after, and what remains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Self, final

import numpy as np

from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.explained import coordinates_of
from lcopa_bayes.effectsearch.heldouteffects import missed, share_beyond_noise, unseen_share
from lcopa_bayes.effectsearch.heldoutscores import given_their_records, unseen_scores
from lcopa_bayes.effectsearch.openeffects import odds
from lcopa_bayes.effectsearch.outliers import Outlying, without_outliers
from lcopa_bayes.effectsearch.rounds import Search
from lcopa_bayes.effectsearch.scores import (
    Score,
    State,
    apart,
    fit_scores,
    over_noise,
    pooled_rmse,
    risen,
)
from lcopa_bayes.effectsearch.verdict import ALONE, EXPLAINED, RISEN, Findings
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.noise import Noise
from lcopa_bayes.sampling.draws import Draws

CONFIRMED = 0.9
"""Share of the squared error beyond noise on unseen records that an effect beside others may leave [-]."""
_UNFOLLOWED = 5.0, 0.03
"""Error over noise, and over what the response varies, from which a model does not follow the records it was
fitted to [-]."""
_AWAY = 2.0
"""Distance of what draws predict from the prediction at the optimum beyond which they are elsewhere [sd of
the latter]."""


@final
@dataclass(frozen=True, eq=False)
class Side:
    """Model and errors before or after."""

    state: State
    fit: tuple[Score, ...]
    unseen: tuple[Score, ...]
    """On held-out records, or with each fit record left out in turn."""

    @classmethod
    def of(cls, problem: Problem, state: State) -> Self:
        """Those of a state."""
        return cls(state, tuple(fit_scores(state)), tuple(unseen_scores(state, problem)))

    @classmethod
    def drawn(cls, problem: Problem, state: State, sampled: tuple[Draws, Noise]) -> Self:
        """The same by draws of the explained study."""
        covariance = np.asarray(np.cov(coordinates_of(state.model, sampled[0]).T))
        return cls.of(problem, replace(state, spread=covariance, sampled=sampled))

    @property
    def said(self) -> str:
        """The errors in a few words."""
        where = "held out" if any(one.held_out for one in self.unseen) else "left out in turn"
        fitted, unseen = (over_noise(scores, scores, clear=False) for scores in (self.fit, self.unseen))
        return f"errors are {fitted:.2f} times the noise on fitted records, {unseen:.2f} on those {where}"


def predicts_better(problem: Problem, larger: State, smaller: State) -> bool:
    """Whether a model takes a part of the squared error beyond noise that one with fewer effects leaves on
    unseen records, where that leaves any."""
    was, now = (unseen_scores(state, problem) for state in (smaller, larger))
    return not share_beyond_noise(problem.study, was, now, larger) > CONFIRMED


def named_effects(state: State) -> tuple[str, ...]:
    """Effects of a model that have a name."""
    return tuple(effect.name for effect in state.model.effects if not effect.card.dynamics)


def findings_of(
    study: Study,
    searched: Search,
    before: Side,
    after: Side,
    *,
    outliers: Outlying | None,
    cautions: tuple[str, ...],
    alone: bool,
) -> Findings:
    """What a search found, `before` without its effects and `after` with them."""
    first, end = searched.rounds[0].trace, searched.rounds[-1]
    generic, added, names = first.generic, searched.state.model.effects, named_effects(searched.state)
    by_record = bool(added) and all(effect.card.per_record for effect in added)
    was, now, varying = before.unseen, after.unseen, tuple[str, ...]()
    # where something remains, what is free in every record takes up some of it in these too
    if study.held_out and not end.alarmed and not by_record:
        varying = tuple(effect.name for effect in added if effect.card.per_record)
        now = tuple(given_their_records(now, searched.state))
    if outliers is not None:  # a model of the rest is not judged by samples that the noise throws anywhere
        was, now = without_outliers(was, now)
    last, (remaining, what) = end.trace, end.strongest
    return Findings(
        cautions=cautions,
        alarmed=searched.rounds[0].alarmed or bool(added),
        largest=searched.rounds[0].largest,
        threshold=first.threshold,
        effects=names,
        dynamics=len(names) < len(added),
        apart=searched.apart,
        disturbances=tuple(effect.name for effect in added if effect.card.disturbance),
        gained=searched.gained,
        generic=generic.log_bayes_factor if generic else -np.inf,
        generic_name=generic.name if generic else "",
        remaining=remaining if end.alarmed else -np.inf,
        remaining_threshold=last.threshold,
        remaining_name=what,
        share=searched.share,
        excess=before.state.whitening.excess(before.state.optimum.residual),
        enough=ALONE if alone else EXPLAINED,
        scatter=first.scatter,
        missed=None if by_record else missed(study, after.fit, now, searched.state),
        unseen=unseen_share(study, was, now, searched.state) if study.held_out else np.nan,
        risen=np.nan if by_record else risen(was, now),
        reached=np.nan if by_record else over_noise(after.fit, now, clear=not end.alarmed),
        varying=varying,
        nothing=1 / (1 + sum(odds(last, one.log_bayes_factor) for one in last.traced if not one.scatters)),
    )


def unfollowed(fit: Sequence[Score]) -> str:
    """Why numbers of a model say nothing of the plant: the response that it follows least of the records it
    was fitted to, a clause without a full stop; empty where it follows all."""
    worst, said = 0.0, ""
    for axis in sorted({one.axis for one in fit}):
        own = [one for one in fit if one.axis == axis]
        error = pooled_rmse(own, axis)
        varied = np.concatenate([one.observed - one.observed.mean() for one in own])
        above, share = error / own[0].noise_sd, error / (float(np.sqrt(np.mean(varied**2))) or np.inf)
        if above > _UNFOLLOWED[0] and share > max(worst, _UNFOLLOWED[1]):
            worst = share
            said = (
                f"the model does not follow the records that it was fitted to: the error of {axis} is "
                f"{above:.3g} times the noise, {100 * share:.2g} % of what the response varies, and "
                "intervals of its numbers say nothing of the plant"
            )
    return said


def astray(optimum: Side, drawn: Side) -> bool:
    """Whether draws predict records held out worse than the optimum of the loop, and beyond what that leaves
    open: a mean of draws that are right is a part of a standard deviation off."""
    if not optimum.unseen[0].held_out or not risen(optimum.unseen, drawn.unseen) > RISEN:
        return False
    return not apart(optimum.unseen, drawn.unseen) <= _AWAY  # without a band nothing is known to be open
