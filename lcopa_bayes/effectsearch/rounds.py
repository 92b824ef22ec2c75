"""Rounds of the loop: trace, refit the leading candidates, add the best, until nothing is left to find."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Self, final

import numpy as np

from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.effectsearch.acceptance import accepted, beside_dynamics, group, large, leader
from lcopa_bayes.effectsearch.basefit import in_turn, settled
from lcopa_bayes.effectsearch.candidates import followed, refitted, rough
from lcopa_bayes.effectsearch.effectpairs import both, paired
from lcopa_bayes.effectsearch.refits import (
    SIGNIFICANT,
    Refit,
    beside_others,
    evidence_over,
    log_bayes_factor,
    paid,
)
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.trace import Trace, trace
from lcopa_bayes.effectsearch.verdict import AHEAD, FIRM, MARGIN
from lcopa_bayes.model.effects.effect import Effect

MOST = 3
"""Effects that are added at most [-]."""
_STEPS = 3
"""Steps to deflections that a plant fitted with them has [-]: where one was wrong by a fifth each leaves a
third of the error."""
_PART = 0.2
"""Share of what remains from which that is for the width of the blocks to explain [-]."""
_SLIGHT = 0.1
"""Squared change of a response that moves no parameter by more than a third of its sd [variance of the
noise]."""


@final
@dataclass(frozen=True, eq=False)
class Round:
    """One look at the residual of a model."""

    state: State
    """What it looks at."""
    trace: Trace
    refits: tuple[Refit, ...] = ()
    """Leading candidates with everything free, by falling evidence; none before they are refitted."""
    failures: tuple[str, ...] = ()
    """Candidates that could not be refitted, and why."""
    chosen: Refit | None = None

    def refitted(self, crew: Crew, rival: float = -np.inf) -> Self:
        """With its candidates refitted, those far below a `rival` [nat] not to the end."""
        if self.refits or self.failures:
            return self
        refits, failures = refitted(self.state, self.trace, crew, rival)
        return replace(self, refits=tuple(refits), failures=tuple(failures))

    def followed(self, crew: Crew) -> Self:
        """With all of its refits at their optima."""
        refits, failures = followed(self.state, self.refits, crew)
        return replace(self, refits=tuple(refits), failures=(*self.failures, *failures))

    @property
    def leading(self) -> Refit | None:
        """The single named effect of most evidence that would be accepted; None without any."""
        likely = accepted(self.refits, self.trace, self.trace.threshold)
        return next((one for one in likely if not one.dynamics), None)

    @property
    def strongest(self) -> tuple[float, str]:
        """Largest log Bayes factor of an effect that changes the response, of one that was refitted that of
        its refit, which the straight line of the trace only estimates [nat], and its name; -inf without
        any."""
        known = {one.added[0]: one.log_bayes_factor for one in self.refits if len(one.added) == 1}
        changing = (one for one in self.trace.traced if not one.scatters)
        each = ((known.get(one.name, one.log_bayes_factor), one.name) for one in changing)
        return max(each, default=(-np.inf, ""))

    @property
    def largest(self) -> float:
        """That evidence [nat]."""
        return self.strongest[0]

    @property
    def alarmed(self) -> bool:
        """Whether that is above what chance gives."""
        return self.trace.alarmed and self.largest > self.trace.threshold

    @property
    def ahead(self) -> float:
        """Log evidence of what was chosen over every other effect with a name in its place [nat]; infinite
        where nothing was, or in place of several at once."""
        if self.chosen is None:
            return np.inf
        others = [one for one in self.refits if one.added != self.chosen.added and not one.dynamics]
        return self.chosen.log_bayes_factor - max((one.log_bayes_factor for one in others), default=-np.inf)


@final
@dataclass(frozen=True, eq=False)
class Search:
    """All rounds and the model they end with."""

    rounds: tuple[Round, ...]
    state: State
    confounded: Callable[[], Mapping[str, tuple[str, ...]]]
    """Works out the names that each effect is confounded with: of several that were added at once it takes as
    long as their search, and only who names them has to know."""
    gained: float
    """Log evidence of the final model over the base model [nat]."""
    dropped: float
    """Half the residual power that the effects took [-]."""
    left: float
    """What the best class that is left would take of it; 0 where nothing significant remains [-]."""
    brought: float
    """Least log evidence that one of the effects brought, when it was added or beside the others [nat];
    infinite without any."""

    @classmethod
    def ending(cls, rounds: Sequence[Round], confounded: Callable[[], Mapping[str, tuple[str, ...]]]) -> Self:
        """With what the last round looked at."""
        start, state, last = rounds[0].state, rounds[-1].state, rounds[-1]
        scale = last.trace.scale
        gained, dropped = evidence_over(start, state, scale.quiet)
        left = scale.drop(last.largest) if last.alarmed else 0.0
        present = {effect.name for effect in state.model.effects}
        added = (one.chosen for one in rounds if one.chosen is not None)
        worth = [one.log_bayes_factor for one in added if present.issuperset(one.added)]
        worth += _beside_others(state, scale.quiet)
        least = min(worth, default=np.inf)
        return cls(tuple(rounds), state, confounded, gained, dropped, left, least)

    @property
    def share(self) -> float:
        """What the effects took of the residual power, over that and what is left [-]."""
        return self.dropped / (self.dropped + self.left) if self.dropped > 0 else float(self.left <= 0)

    def left_by_blocks(self, narrower: State) -> bool:
        """Whether a part of what is left comes from blocks that are wide: so much the residual changes on
        `narrower` ones, at the optimum there."""
        return abs(self.state.optimum.cost - narrower.optimum.cost) > _PART * self.left > 0.0

    @cached_property
    def groups(self) -> tuple[tuple[str, ...], ...]:
        """For each effect of the state, the names it is confounded with, its own first."""
        known = self.confounded()
        return tuple(known.get(effect.name, (effect.name,)) for effect in self.state.model.effects)

    @property
    def apart(self) -> bool:
        """Whether every effect brought enough evidence for a firm name and is confounded with no other, nor
        nearly, and nothing that another name might explain too remains."""
        ahead = min(one.ahead for one in self.rounds)
        clear = self.brought >= FIRM and ahead >= AHEAD and not self.rounds[-1].alarmed
        return clear and all(len(each) == 1 for each in self.groups)

    @property
    def best(self) -> Refit | None:
        """The refit that was added last, or where none was the best one with a name; None without any."""
        added = (one.chosen for one in reversed(self.rounds) if one.chosen is not None)
        return next(added, next((one for one in self.rounds[0].refits if not one.dynamics), None))

    @property
    def settled(self) -> Self:
        """The same under the noise that its residual has, unless something stands out from the noise; where
        that was fitted jointly it is found in turn with the model."""
        state = self.state
        if self.rounds[-1].trace.alarmed:
            return self
        again = in_turn if state.whitening.dependence else settled
        optimum, whitening = again(state.model, state.optimum, state.whitening)
        return replace(self, state=replace(state, optimum=optimum, whitening=whitening))


def search(
    start: State,
    library: Sequence[type[Effect]],
    rng: np.random.Generator,
    *,
    noise_samples: Sequence[int],
    draws: int,
    alone: bool = False,
    first: Round | None = None,
    better: Callable[[State, State], bool] = lambda larger, smaller: True,
    crew: Crew = ALONE,
) -> Search:
    """Add effects one at a time, up to three, while evidence, records left out and significance all speak
    for it, from a record that is `alone` only large ones; then try pairs where something remains, and
    take back what is no longer significant. The `first` look may be known already.

    Where something remains, each of several effects has to predict unseen records `better` than without it:
    what remains is no noise, and one more effect takes up some of it whether or not it is there.
    """

    def looking(state: State) -> Round:
        seen = trace(state, library, rng, noise_samples=noise_samples, draws=draws, crew=crew)
        return Round(state, seen)

    rounds = _one_by_one(first or looking(start), looking, crew, alone=alone)
    if rounds[-1].alarmed and not alone:
        rounds = _past_generic(rounds, looking, crew)
    while rounds[-1].alarmed and len(rounds) > 1 and rounds[-2].state.model.effects:
        if better(rounds[-1].state, rounds[-2].state):
            break
        rounds[-2:] = [replace(rounds[-2], chosen=None)]
    unnamed = any(effect.card.dynamics for effect in rounds[-1].state.model.effects)
    if rounds[-1].trace.alarmed and rounds[0].trace.alarmed and not (alone or unnamed):
        pair = _pair(rounds[0], rounds[-1].state, looking, better)
        if pair is not None:
            kept, look = pair
            added = replace(rounds[0], refits=(kept,), failures=(), chosen=kept)
            return Search.ending([*rounds, added, look], lambda: _groups(kept, looking, crew))
    return Search.ending(rounds, lambda: _groups_one_by_one(rounds))


def _one_by_one(
    first: Round,
    looking: Callable[[State], Round],
    crew: Crew,
    *,
    alone: bool,
    before: Sequence[Round] = (),
    generic: bool = True,
) -> list[Round]:
    """Rounds `before` and those that each add an effect but the last; only effects ahead of any `generic`
    class, unless that is no rival.

    Where two effects leave far more than the noise no third is looked for: one of a device that no two of the
    catalogue describe was searched for most of an hour, for a name that the verdict refused.
    """
    look, rounds = first, list(before)
    while True:
        seen, state, number = look.trace, look.state, len(rounds)
        beyond = len(state.model.effects) > 1 and rough(seen)
        if not (seen.alarmed or state.whitening.dependence) or number == MOST or beyond:
            return [*rounds, Round(state, seen)]
        beside = f" beside {', '.join(one.name for one in state.model.effects)}" if number else ""
        crew.stage(f"refitting with each effect that comes into question{beside}")
        look = look.refitted(crew)
        # what one refit leaves is not noise alone: a further effect must stand out from it
        choice = partial(
            _choice, bar=seen.threshold + (MARGIN if number else 0.0), alone=alone, generic=generic
        )
        chosen = choice(look)
        if chosen is not None and chosen.glances:  # none of those that were far ahead is accepted
            look = look.followed(crew)
            chosen = choice(look)
        named = any(not effect.card.dynamics for effect in state.model.effects)
        if chosen is not None and chosen.dynamics and (named or before):
            chosen = None  # beside a named effect they are what remains, which the verdict weighs
        rounds.append(replace(look, chosen=chosen))
        if chosen is None:
            return rounds
        look = looking(in_proportion(_kept(chosen)))


def _choice(look: Round, *, bar: float, alone: bool, generic: bool) -> Refit | None:
    """The refit of a round to add, of more evidence than a `bar` [nat]; None where none is accepted."""
    allowed = accepted(look.refits, look.trace, bar, generic=generic)
    likely = [one for one in allowed if not alone or large(one)]
    return leader(beside_dynamics(likely, [one for one in look.refits if one.dynamics]))


def _past_generic(rounds: list[Round], looking: Callable[[State], Round], crew: Crew) -> list[Round]:
    """Rounds that go on where a generic class was ahead of every effect, if the effects they add have more
    evidence than that class together; else the same `rounds`.

    A generic class describes what several effects leave better than any one of them does.
    """
    last = rounds[-1]
    further = _one_by_one(last, looking, crew, alone=False, before=rounds[:-1], generic=False)
    if len(further) == len(rounds):
        return rounds
    gained, _ = evidence_over(last.state, further[-1].state, last.trace.scale.quiet)
    ahead = last.trace.generic is None or gained > last.trace.generic.log_bayes_factor + MARGIN
    return further if ahead else rounds


def _groups_one_by_one(rounds: Sequence[Round]) -> dict[str, tuple[str, ...]]:
    """Names that each effect which was added by itself is confounded with."""
    added = ((one, one.chosen) for one in rounds if one.chosen is not None and not one.chosen.dynamics)
    return {chosen.added[0]: group(one.state, chosen, one.refits, one.trace) for one, chosen in added}


def _pair(
    first: Round, state: State, looking: Callable[[State], Round], better: Callable[[State, State], bool]
) -> tuple[Refit, Round] | None:
    """A pair of effects added at once to what the `first` round looked at, or the one of them that does as
    well alone, and the look at what it leaves, where that beats a `state` with effects that were found one by
    one; else None."""
    pair = paired(first.state, state, first.trace)
    if pair is None:
        return None
    look = looking(in_proportion(pair.state))
    kept = both(first.state, state, pair, better) if look.alarmed else pair
    if kept is None:
        return None
    if kept is not pair:
        look = looking(in_proportion(kept.state))
    return kept, look


def _groups(chosen: Refit, looking: Callable[[State], Round], crew: Crew) -> dict[str, tuple[str, ...]]:
    """Names that each of several effects which were added at once is confounded with beside the others."""
    groups, white = {}, chosen.whitening
    for name in chosen.added:
        alone = beside_others(chosen.state, name, chosen.quiet)
        crew.stage(f"refitting with each effect that may stand for {name}")
        fewer = State(alone.without([name])[0], alone.before, white)
        look = looking(fewer).refitted(crew, alone.log_bayes_factor)
        refits = [one.under(white) for one in look.refits] if white.dependence else look.refits
        groups[name] = group(fewer, alone, refits, look.trace)
    return groups


def _beside_others(state: State, quiet: float) -> list[float]:
    """Log evidence that each of several effects brings beside the others [nat]: one of a pair may bring
    all."""
    several = state.model.effects if len(state.model.effects) > 1 else ()
    return [beside_others(state, effect.name, quiet).log_bayes_factor for effect in several]


def _kept(candidate: Refit) -> State:
    """Without effects that are no longer significant beside the new one, and not missed when they go."""
    idle = [
        effect.name
        for effect in candidate.model.effects
        if effect.name not in candidate.added and candidate.wald(effect.name) > SIGNIFICANT
    ]
    if not idle:
        return candidate.state
    model, x = candidate.without(idle)
    optimum = Regression(model, candidate.whitening).descend(x, most=12, gain=0.02)
    worth = log_bayes_factor(optimum, candidate.optimum, candidate.quiet) + paid(candidate.model, idle)
    if worth > MARGIN:
        return candidate.state
    return State(model, optimum, candidate.whitening)


def in_proportion(state: State) -> State:
    """With deflections of the axes in proportion to those of its own plant, not of the one that the search
    began with, where that follows the records better; itself where it hardly moves a response."""
    for _ in range(_STEPS):
        model, x, white = state.model.in_proportion(state.optimum.x), state.optimum.x, state.whitening
        try:
            moved = white(model.predict(x) - state.fitted)
            if moved @ moved < _SLIGHT:
                break
            optimum = Regression(model, white).descend(x, most=12, gain=0.02)
        except ArithmeticError:
            break
        if optimum.cost >= state.optimum.cost:
            break
        state = replace(state, model=model, optimum=optimum)
    return state
