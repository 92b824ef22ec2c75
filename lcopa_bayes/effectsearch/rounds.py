"""Rounds of the loop: trace, refit the leading candidates, add the best, until nothing is left to find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Self, final

import numpy as np

from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basefit import settled
from lcopa_bayes.effectsearch.candidates import refitted
from lcopa_bayes.effectsearch.refits import (
    SIGNIFICANT,
    Refit,
    log_bayes_factor,
    refit,
    under_one_noise,
    without,
)
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import (
    Projection,
    expected_margin,
    pair_evidence,
    signature_of,
)
from lcopa_bayes.effectsearch.trace import Trace, trace
from lcopa_bayes.effectsearch.verdict import FIRM, MARGIN
from lcopa_bayes.model.effects.effect import Effect

MOST = 3
"""Effects that are added at most [-]."""
SINGLE = 0.3
"""Share of the residual's power that an effect must take when a single record is all there is [-]."""
CLEAR = 1.5
"""Residual over noise from which a single record names anything: its noise may differ from level to level
[-]."""
_PAIRED = 8
"""Single effects of which pairs are formed [-]."""
_PAIRS = 2
"""Pairs refitted [-]."""


@final
@dataclass(frozen=True, eq=False)
class Round:
    """One look at a residual."""

    trace: Trace
    refits: tuple[Refit, ...] = ()
    """Leading candidates with everything free, by falling evidence; none before they are refitted."""
    failures: tuple[str, ...] = ()
    """Candidates that could not be refitted, and why."""
    chosen: Refit | None = None

    def refitted(self, state: State, crew: Crew, rival: float = -np.inf) -> Self:
        """With the candidates of the state refitted, those far below a `rival` [nat] not to the end."""
        if self.refits or self.failures:
            return self
        refits, failures = refitted(state, self.trace, crew, rival)
        return replace(self, refits=tuple(refits), failures=tuple(failures))

    @property
    def leading(self) -> Refit | None:
        """The single named effect of most evidence that would be accepted; None without any."""
        likely = accepted(self.refits, self.trace, self.trace.threshold)
        return next((one for one in likely if not one.dynamics), None)

    @property
    def largest(self) -> float:
        """Largest log Bayes factor of an effect that changes the response, of one that was refitted that of
        its refit, which the straight line of the trace only estimates [nat]; -inf without any."""
        known = {one.added[0]: one.log_bayes_factor for one in self.refits if len(one.added) == 1}
        changing = (one for one in self.trace.traced if not one.scatters)
        return max((known.get(one.name, one.log_bayes_factor) for one in changing), default=-np.inf)

    @property
    def alarmed(self) -> bool:
        """Whether that is above what chance gives."""
        return self.trace.alarmed and self.largest > self.trace.threshold


@final
@dataclass(frozen=True, eq=False)
class Search:
    """All rounds and the model they end with."""

    rounds: tuple[Round, ...]
    state: State
    groups: tuple[tuple[str, ...], ...]
    """For each effect of the state, the names it is confounded with, its own first."""
    gained: float
    """Log evidence of the final model over the base model [nat]."""
    share: float
    """Half the residual power that the effects took, over that and what the best class left would
    take [-]."""
    brought: float
    """Least log evidence that one of the effects brought, when it was added or beside the others [nat];
    infinite without any."""

    @property
    def apart(self) -> bool:
        """Whether every effect brought enough evidence for a firm name and is confounded with no other, and
        nothing that another name might explain too remains."""
        alone = all(len(each) == 1 for each in self.groups)
        return self.brought >= FIRM and alone and not self.rounds[-1].trace.alarmed

    @property
    def best(self) -> Refit | None:
        """The refit that was added last, or where none was the best one with a name; None without any."""
        added = (one.chosen for one in reversed(self.rounds) if one.chosen is not None)
        return next(added, next((one for one in self.rounds[0].refits if not one.dynamics), None))

    @property
    def settled(self) -> Self:
        """The same under the noise that its residual has, unless something stands out from the noise."""
        if self.rounds[-1].trace.alarmed:
            return self
        optimum, whitening = settled(self.state.model, self.state.optimum, self.state.whitening)
        return replace(self, state=replace(self.state, optimum=optimum, whitening=whitening))


def search(
    start: State,
    library: Sequence[type[Effect]],
    rng: np.random.Generator,
    *,
    noise_samples: Sequence[int],
    draws: int,
    alone: bool = False,
    first: Round | None = None,
    crew: Crew = ALONE,
) -> Search:
    """Add effects one at a time, up to three, while evidence, records left out and significance all speak
    for it, from a record that is `alone` only large ones; then try pairs where something remains, and
    take back what is no longer significant. The `first` look may be known already."""
    state, rounds = start, []
    groups: dict[str, tuple[str, ...]] = {}
    for number in range(MOST + 1):
        look = first if first is not None and not number else None
        if look is None:
            look = Round(trace(state, library, rng, noise_samples=noise_samples, draws=draws, crew=crew))
        seen = look.trace
        if not (seen.alarmed or state.whitening.dependence) or number == MOST:
            rounds.append(Round(seen))
            break
        beside = f" beside {', '.join(one.name for one in state.model.effects)}" if number else ""
        crew.stage(f"refitting with each effect that comes into question{beside}")
        look = look.refitted(state, crew)
        refits = look.refits
        # what one refit leaves is not noise alone: a further effect must stand out from it
        bar = seen.threshold + (MARGIN if number else 0.0)
        likely = [one for one in accepted(refits, seen, bar) if not alone or _large(one)]
        chosen = _leader(_beside_dynamics(likely, [one for one in refits if one.dynamics]))
        if chosen is not None and chosen.dynamics and groups:
            chosen = None  # beside a named effect they are what remains, which the verdict weighs
        rounds.append(replace(look, chosen=chosen))
        if chosen is None:
            break
        if not chosen.dynamics:
            groups[chosen.added[0]] = group(state, chosen, refits, seen)
        state = _kept(chosen)
    unnamed = any(effect.card.dynamics for effect in state.model.effects)
    if rounds[-1].trace.alarmed and rounds[0].trace.alarmed and not (alone or unnamed):
        paired = _paired(start, state, rounds[0].trace)
        if paired is not None:
            state = paired.state
            seen = trace(state, library, rng, noise_samples=noise_samples, draws=draws, crew=crew)
            rounds += [Round(rounds[0].trace, (paired,), chosen=paired), Round(seen)]
    names = [effect.name for effect in state.model.effects]
    confounded = tuple(groups.get(name, (name,)) for name in names)
    gained, dropped = _gained(start, state, float(sum(noise_samples)))
    last = rounds[-1].trace
    left = last.scale.drop(last.largest) if last.alarmed else 0.0
    share = dropped / (dropped + left) if dropped > 0 else float(left <= 0)
    worth = [one.chosen.log_bayes_factor for one in rounds if one.chosen]
    worth += _beside_others(state, float(sum(noise_samples)))
    return Search(tuple(rounds), state, confounded, gained, share, min(worth, default=np.inf))


def _beside_others(state: State, quiet: float) -> list[float]:
    """Log evidence that each of several effects brings beside the others [nat]: one of a pair may bring
    all."""
    worth = []
    for effect in state.model.effects if len(state.model.effects) > 1 else ():
        model, x = without(state.model, state.optimum.x, [effect.name])
        fewer = Regression(model, state.whitening).descend(x, most=12, gain=0.02)
        worth.append(log_bayes_factor(fewer, state.optimum, quiet))
    return worth


def _gained(start: State, state: State, quiet: float) -> tuple[float, float]:
    """Log evidence over the base model's under one whitening, that of the final noise [nat], and the drop of
    half the residual power [-]."""
    if not state.model.effects:
        return 0.0, 0.0
    plain = start.optimum
    if state.whitening is not start.whitening:
        plain = Regression(start.model, state.whitening).descend(start.optimum.x)
    sides = sum(one.coefficient.one_signed for one in state.model.effected.coefficients)
    gained = log_bayes_factor(plain, state.optimum, quiet) + sides * float(np.log(2.0))
    return gained, plain.cost - state.optimum.cost


def accepted(refits: Sequence[Refit], seen: Trace, bar: float) -> list[Refit]:
    """Refits that may be kept, by falling evidence.

    What linear dynamics without a name explain as well is no evidence of a name: a zero, a further lag, or
    paths that differ in what the model lets them share look like many effects.
    """
    linear = max((one.log_bayes_factor for one in refits if one.dynamics), default=-np.inf)
    ahead = (one for one in refits if one.dynamics or one.log_bayes_factor > linear + MARGIN)
    # beside such dynamics a linear effect is one more of them
    ahead = (one for one in ahead if one.dynamics or not (one.linear and one.unnamed))
    return [one for one in ahead if _accepted(one, seen, bar)]


def _beside_dynamics(likely: Sequence[Refit], dynamics: Sequence[Refit]) -> list[Refit]:
    """Accepted refits from the first on that linear `dynamics` leave something to explain.

    A linear effect is one of the dynamics; it must remain beside those of no more coefficients, and beats
    the others by its few. Any other effect must remain beside each of them.
    """
    for number, one in enumerate(likely):
        rivals = [each for each in dynamics if not (one.linear and len(each.new) > len(one.new))]
        if one.dynamics or all(_remains(rival, one) for rival in rivals):
            return list(likely[number:])
    return []


def _remains(linear: Refit, candidate: Refit) -> bool:
    """Whether the effects of a refit are worth naming beside linear dynamics.

    They are where they are ahead by more than the coefficients of these can cost.
    """
    if candidate.log_bayes_factor - linear.log_bayes_factor > MARGIN * (1 + len(linear.new)):
        return True
    kept = {e.name for e in linear.model.effects}
    sizes = candidate.model.sizes(candidate.optimum.x)
    added = [(effect, size) for effect, size in sizes if effect.name not in kept]
    try:
        both = refit(linear.model, linear.optimum, linear.whitening, added, linear.quiet)
    except ArithmeticError:
        return False
    return both.log_bayes_factor > MARGIN and both.significant


def _accepted(candidate: Refit, seen: Trace, bar: float) -> bool:
    generics = (g for g in seen.traced if g.card.place == "generic")
    others = (g for g in generics if not (candidate.dynamics and g.card.dynamics))
    generic = max((g.log_bayes_factor for g in others), default=-np.inf)
    ahead = candidate.log_bayes_factor > generic + MARGIN
    return (
        candidate.log_bayes_factor > bar
        and ahead
        and candidate.left_out > 0
        and candidate.significant
        and candidate.resting
        and candidate.possible
    )


def _large(candidate: Refit) -> bool:
    return candidate.taken > SINGLE and candidate.excess > CLEAR


def _leader(accepted: Sequence[Refit]) -> Refit | None:
    """The refit of largest evidence; of those level with it the first whose coefficients all records share,
    since one of a single record predicts no other."""
    level = [one for one in accepted if one.log_bayes_factor > accepted[0].log_bayes_factor - MARGIN]
    shared = (one for one in level if not any(c.record is not None for c in one.new))
    return next(shared, accepted[0] if accepted else None)


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
    if log_bayes_factor(optimum, candidate.optimum, candidate.quiet) > MARGIN:
        return candidate.state
    return State(model, optimum, candidate.whitening)


def _paired(start: State, state: State, seen: Trace) -> Refit | None:
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
    bar, best = _gained(start, state, seen.scale.quiet)[0] + (1 + more) * MARGIN, None
    for pair in ranked[:_PAIRS]:
        if {one.name for one in pair} <= have:
            continue
        columns = np.concatenate([one.signature.columns for one in pair], axis=1)
        inner = np.linalg.solve(np.eye(columns.shape[1]) + columns.T @ columns, columns.T @ seen.residual)
        sizes = np.split(inner, [pair[0].signature.columns.shape[1]])
        added = [(one.signature.effect, size) for one, size in zip(pair, sizes, strict=True)]
        try:
            candidate = refit(start.model, start.optimum, start.whitening, added, seen.scale.quiet)
        except ArithmeticError:
            continue
        candidate = replace(under_one_noise([candidate])[0], paid=candidate.paid - choice)
        if candidate.log_bayes_factor > bar and _accepted(candidate, seen, seen.threshold):
            bar, best = candidate.log_bayes_factor, candidate
    return best


def group(state: State, chosen: Refit, refits: Sequence[Refit], seen: Trace) -> tuple[str, ...]:
    """Names that these records confound with the chosen one, its own first.

    A rival that was refitted belongs to the group when it lost by less than 3 nat; one that was not, when the
    margin expected at the fitted size, which the angle between projected signatures sets, is below 3 nat.
    Where noise was fitted jointly that margin would count the effect as noise, and only refits say.
    """
    name = chosen.added[0]
    project = Projection(state.optimum.moving * state.model.spread)
    (effect,) = [one for one in chosen.model.effects if one.name == name]
    own = signature_of(state.model, state.optimum.x, state.whitening, project, effect)
    where = chosen.places(name)
    amplitude = chosen.optimum.x[where] / chosen.model.spread[where]
    out = [name]
    fitted = {one.added[0]: one for one in refits}
    for one in seen.traced:
        if one.name == name or one.card.place == "generic" or not one.signatures:
            continue
        if one.name in fitted:
            if chosen.log_bayes_factor - fitted[one.name].log_bayes_factor < MARGIN:
                out.append(one.name)
            continue
        if chosen.whitening.dependence:
            continue
        margin = min(expected_margin(own, amplitude, rival, seen.scale) for rival in one.signatures)
        if margin < MARGIN:
            out.append(one.name)
    return tuple(out)


def single_record(study: Study) -> tuple[str, ...]:
    """What a single record leaves open."""
    if len(study.fit) > 1:
        return ()
    said = "an effect of the device and a peculiarity of a single record are confounded"
    if not study.held_out:
        said += (
            f": an effect is named only where the residual is {CLEAR:g} times the noise and it takes "
            f"{100 * SINGLE:.0f} % of its power"
        )
    return (f"{said}; fit a second record",)
