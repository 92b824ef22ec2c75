"""Candidates of a round: named effects within reach of the best, refitted with everything free.

Far from the base fit the plant bends to imitate what is missing (an order above 1 imitates overdrive), and
the best frame, level or frequency beside that bent plant is not the best beside the plant as it is: there
instances are chosen by descents of the whole model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import zip_longest
from typing import TypeAlias

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.parallel import Workers
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.refits import Refit, begun, ended, under_one_noise
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Signature
from lcopa_bayes.effectsearch.trace import SEEN, Trace, Traced
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.effects.effect import Effect, ForceEffect

_CANDIDATES = 4
_NAMED = 8
"""Named effects that are ranked [-]."""
NEAR = 0.7
"""Candidates reach this share of the best log Bayes factor [-]."""
_RIVAL = 0.2
"""Share of the best log Bayes factor from which linear dynamics without a name are refitted [-]."""
ROUGH = 5.0
"""Residual over noise beyond which the linear evidence is too rough to choose by [-]."""
_INSTANCES = 16
"""Instances descended from, those of largest evidence [-]."""
_FORCED = 3
"""The same beside a force that is already there, and of linear dynamics [-]."""
_REACH = 0.5
"""Share of the evidence of a rival below which a refit is not taken to its end [-]: the rest does not double
it."""
_BEHIND, _FAR_BEHIND = 0.3, 30.0
"""What a few evaluations are worth over the best one's [-], and how far behind that [nat], below which a
refit is not taken to its end: in 13 searches the rest added a third of the best at most."""
_OTHER = 0.9
"""Cosine between signatures below which an instance of an effect is another [-]."""
_GLANCE, _FOLLOWED, _STEPS = 3, 8, 12
"""Evaluations from every start, starts that are followed further, and evaluations from these [-]: about half
as many as all from every start, and of five sets of records the same refits."""
_SIZES = (1.0, -1.0)
"""Coefficients from which a single one is also started, with fitted and with integer orders [prior sd]."""
Start: TypeAlias = tuple[float, Effect, Vector]
"""Cost of the whole model [nat], the effect and the coordinates."""
_TEMPERATURES = ("K", "degC", "mK", "degF")


def offered(study: Study) -> list[type[Effect]]:
    """Effects of the catalogue that can occur where a study measures: temperatures are responses of a thermal
    plant, anything else may be of any."""
    known = catalogue(study.effects.add, study.folder).values()
    if not all(axis.unit in _TEMPERATURES for axis in study.response_axes):
        return list(known)
    return [kind for kind in known if not kind.card.fields or "thermal" in kind.card.fields]


def refitted(
    state: State, seen: Trace, crew: Crew = ALONE, rival: float = -np.inf
) -> tuple[list[Refit], list[str]]:
    """Refits of what may be named, by falling evidence; what could not be refitted and why.

    Candidates come near the best of all. Effects of the reading that the base model imitates to first order,
    or has a longer delay in place of, are tried too, from the size of their prior. So are the classes of
    linear dynamics, which a name must beat, if any name reaches a `rival` [nat]. What a few evaluations leave
    far below that, or below the best candidate, is not refitted to the end: its evidence is a lower bound.
    """
    named = [one for one in seen.traced if one.card.place != "generic" and one.signatures][:_NAMED]
    worth = {one.name: one.signature for one in named if one.log_bayes_factor > 0}
    reached = {name: seen.alone(signature) for name, signature in worth.items()}
    ranked = sorted(reached, key=lambda name: -reached[name])
    # noise fitted jointly holds the misfit too: only a refit shows what an effect is worth
    least = -np.inf if not seen.alarmed else NEAR * max(reached.values(), default=0.0)
    near = [name for name in ranked if reached[name] > least][:_CANDIDATES]
    far = rough(seen)
    near = ranked if far else near
    sizes = {name: worth[name].amplitude(seen.residual, seen.scale) for name in near}
    if seen.alarmed and near:
        blind = [one for one in _blind(seen) if one.name not in near]
        worth |= {one.name: one.signature for one in blind}
        sizes |= {one.name: np.ones(worth[one.name].columns.shape[1]) for one in blind}
    worthy = _RIVAL * max(reached.values(), default=0.0)
    for one in seen.traced if sizes or seen.alarmed else ():
        if one.card.dynamics and one.signatures and one.log_bayes_factor >= worthy:
            worth[one.name] = one.signature
            sizes[one.name] = worth[one.name].amplitude(seen.residual, seen.scale)
    known = crew.sharing((state, least if seen.alarmed else np.inf, far))
    # of the trace a task needs one effect
    tasks = {name: (replace(seen, traced=(seen.of(name),)), size) for name, size in sizes.items()}
    several = [name for name in tasks if not seen.of(name).card.dynamics]
    dynamics = [name for name in tasks if name not in several]
    if rival == -np.inf or state.whitening.dependence:
        several, dynamics = several + dynamics, []
    ends = _raced(known, {name: tasks[name] for name in several}, _REACH * rival)
    if any(isinstance(end, Refit) and end.log_bayes_factor >= rival for end in ends.values()):
        ends |= _raced(known, {name: tasks[name] for name in dynamics}, _REACH * rival)
    return _parted(state, ends)


def _raced(
    known: Workers[tuple[State, float, bool]], tasks: Mapping[str, tuple[Trace, Vector]], least: float
) -> dict[str, Refit | str]:
    """The refit of each effect, to the end where a few evaluations leave it near the best and above a `least`
    evidence [nat], or why there is none."""
    starts = dict(zip(tasks, known.each(_begun, list(tasks.values())), strict=True))
    several = (own for own in starts.values() if not isinstance(own, str))
    best = max((one.worth for own in several for one in own), default=0.0)
    bar = max(least, min(_BEHIND * best, best - _FAR_BEHIND))
    return dict(zip(starts, known.each(_ended, [(own, bar) for own in starts.values()]), strict=True))


def followed(state: State, refits: Sequence[Refit], crew: Crew = ALONE) -> tuple[list[Refit], list[str]]:
    """These refits of a state at their optima, by falling evidence; what has none and why."""
    names = [", ".join(one.added) for one in refits]
    ends = crew.sharing((state, np.inf, False)).each(_ended, [([one], -np.inf) for one in refits])
    return _parted(state, dict(zip(names, ends, strict=True)))


def _parted(state: State, ends: Mapping[str, Refit | str]) -> tuple[list[Refit], list[str]]:
    """Refits of a state by falling evidence, and why there are no others."""
    done = [_beside(state, end) for end in ends.values() if isinstance(end, Refit)]
    failures = [f"{name}: {end}" for name, end in ends.items() if not isinstance(end, Refit)]
    return under_one_noise(done), failures


def _begun(known: tuple[State, float, bool], task: tuple[Trace, Vector]) -> list[Refit] | str:
    """Refits of the only effect of a trace, one of each instance that comes into question, which are only
    begun, or why there is none."""
    (state, least, far), (seen, amplitude) = known, task
    (traced,) = seen.traced
    effect, reached_at = traced.signature.effect, None
    base, quiet = (state.model, state.optimum, state.whitening), seen.scale.quiet
    try:
        if (far or traced.card.dynamics) and movable(traced):
            effect, reached_at = descended(state, seen, traced)
            amplitude = reached_at[-amplitude.size :] / state.model.having(effect).scale
        promised = np.inf if _misjudged(traced) else traced.signature.drop(seen.residual, seen.scale)
        starts = [(effect, amplitude, promised)]
        settled = reached_at is not None or traced.card.dynamics
        other = None if settled else other_instance(seen, traced, least)
        if other is not None:
            against = (seen.residual, seen.scale)
            starts.append((other.effect, other.amplitude(*against), other.drop(*against)))
        return [
            begun(*base, [(one, size)], quiet, near=reached_at, promised=worth) for one, size, worth in starts
        ]
    except ArithmeticError as error:
        return str(error)


def _ended(known: tuple[State, float, bool], task: tuple[list[Refit] | str, float]) -> Refit | str:
    """The best of the refits of an effect, at its optimum where it is worth as much as a bar [nat] or noise
    is fitted jointly."""
    (state, *_), (starts, bar) = known, task
    if isinstance(starts, str):
        return starts
    ends = [_beside(state, one) for one in starts]
    near = [one for one in ends if one.worth >= bar or state.whitening.dependence]
    try:
        return min([ended(one) for one in near] or ends, key=lambda end: end.optimum.cost)
    except ArithmeticError as error:
        return str(error)


def _beside(state: State, end: Refit) -> Refit:
    """A refit, perhaps of another process, on the very plant and noise that it was started from."""
    model = replace(end.model, plant=state.model.plant, scaled=state.model.having(*end.model.effects).scaled)
    return replace(end, model=model, before=state.optimum, whitening=state.whitening)


def other_instance(seen: Trace, traced: Traced, least: float) -> Signature | None:
    """The best instance of an effect that is another than its best one, of an evidence of `least` or more;
    None without any.

    The plant bends towards what is missing: of two frames of a pulse that explain the rest alike the
    better one beside that plant need not be the better one beside the plant as it is.
    """
    likely = [one for one in traced.signatures if seen.alone(one) > least]
    apart = [one for one in likely if one.cosine(traced.signature) < _OTHER]
    return max(apart, key=seen.alone, default=None)


def _blind(seen: Trace) -> list[Traced]:
    """Effects of the reading that only a refit may show (`_misjudged`)."""
    return [
        one
        for one in seen.traced
        if one.card.place == "output" and len(one.signatures) == 1 and one.survival > 0 and _misjudged(one)
    ]


def _misjudged(traced: Traced) -> bool:
    """Whether a linear estimate says nothing of an effect: the plant imitates it to first order, or has a
    longer delay in its place."""
    return traced.signature.survival < SEEN or traced.card.delays


def rough(seen: Trace) -> bool:
    """Whether a residual is far above the noise."""
    return float(np.mean(seen.residual**2)) > ROUGH**2


def movable(traced: Traced) -> bool:
    """Whether there are instances to choose from that take no iteration to simulate: a refit has several
    starts of its own."""
    return len(traced.signatures) > 1 and not isinstance(traced.signatures[0].effect, ForceEffect)


def descended(state: State, seen: Trace, traced: Traced) -> tuple[Effect, Vector]:
    """The instance with the lowest cost after a short descent, and the coordinates it reached; its constants
    are freed in the refit.

    ArithmeticError when no instance has a bounded response.
    """
    dynamics = traced.card.dynamics
    forced = dynamics or any(isinstance(effect, ForceEffect) for effect in state.model.effects)
    listed = sorted(traced.signatures, key=lambda one: -seen.alone(one))
    most, exact = (_STEPS, False) if forced else (_GLANCE, True)
    instances = [
        _reached(state, one.effect, _starts(state, one, seen, forced=forced), most, exact=exact)
        for one in listed[: _FORCED if forced else _INSTANCES]
    ]
    ends = by_turns(instances)
    if not forced:
        further = ends[:_FOLLOWED]
        ends = [end for _, effect, x in further for end in _reached(state, effect, [x], _STEPS)]
    if not ends:
        raise FloatingPointError(f"{traced.name}: no instance has a bounded response")
    return min(ends, key=_cost)[1:]


def by_turns(instances: Sequence[Sequence[Start]]) -> list[Start]:
    """Starts of several instances: the lowest of each, by rising cost, then the second of each, and so on.

    The starts of one instance mostly lead to one minimum: the eight lowest of all were those of three frames
    of a pulse, and the frame that explains the record was a fourth.
    """
    turns = zip_longest(*(sorted(starts, key=_cost) for starts in instances))
    return [start for turn in turns for start in sorted(filter(None, turn), key=_cost)]


def _cost(start: Start) -> float:
    return start[0]


def _reached(
    state: State, effect: Effect, starts: Sequence[Vector], most: int, *, exact: bool = True
) -> list[Start]:
    """Cost after so many evaluations [nat], the effect and coordinates, of each start with a bounded
    response."""
    model, out = replace(state.model.having(*state.model.effects, effect), exact=exact), []
    fit = Regression(model, state.whitening)
    for start in starts:
        try:
            x, _ = fit.reached(np.clip(start, *model.bounds), most=most, gain=1.0)  # a start only
        except ArithmeticError:
            continue
        out.append((fit.cost(x), effect, x))
    return out


def _starts(state: State, signature: Signature, seen: Trace, *, forced: bool) -> list[Vector]:
    """Coordinates to descend from: the linear estimate, and a prior sd to either side of none, there also
    with every order at the nearest integer."""
    model = state.model.having(*state.model.effects, signature.effect)
    linear = signature.amplitude(seen.residual, seen.scale)
    unit = model.scale[-linear.size :]
    rows = model.posterior.table.rows
    straight = state.optimum.x.copy()
    for position, k in enumerate(state.model.columns):
        if rows[k].kind == "order":
            straight[position] = max(np.round(straight[position]), 1.0)
    if signature.effect.card.dynamics:
        sizes = [(state.optimum.x, linear), (straight, linear), (straight, np.ones_like(linear))]
        return [np.concatenate([x, size * unit]) for x, size in sizes]
    starts = [np.concatenate([state.optimum.x, size * unit]) for size in (linear, 0.3 * linear)]
    if linear.size == 1 and not forced:
        starts += [np.append(x, size * unit) for x in (state.optimum.x, straight) for size in _SIZES]
    return starts
