"""Effects that records neither show nor exclude, and what they leave open of the numbers of a loop.

A loop ends with one model. With one more effect, whose evidence chance could give, or with a rival in place
of one that it named, gains and delays are elsewhere, and the records say little against it: numbers are over
all of these, weighted by evidence. One more effect is one linear step away: with whitened residual r and
tangents J at the optimum, information H and signatures S over the prior sd of their coefficients psi,
``psi ~ N(V S' r, V)``, cut off at 0 where psi has one sign, ``1 / V = I + S' S - S' J G``, and coordinates
move by ``-G psi``, ``G = H^-1 J' S``. What every reading has, an exposure and a lag of the sensor, looks like
a delay: together they are as probable beforehand as none, and so are all other effects.
Internal constants may have optima elsewhere, which no linear step reaches: the final model is fitted again
from other instances of its effects.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, final

import numpy as np
from scipy.stats import truncnorm

from lcopa_bayes.core.arrays import Flags, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of, root_of
from lcopa_bayes.core.estimate import Estimate, plain, quantile
from lcopa_bayes.effectsearch.drawsabout import draws_about
from lcopa_bayes.effectsearch.freedconstants import loosened
from lcopa_bayes.effectsearch.refits import log_bayes_factor, places, without
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.rounds import Round
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Projection, Scale, Signature, signature_of
from lcopa_bayes.effectsearch.trace import Trace, worth
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.effects.effect import Effect, ForceEffect, Ranges
from lcopa_bayes.results.averages import parts_of_sd, pooled, pooled_parts
from lcopa_bayes.results.stepcurves import curves_of
from lcopa_bayes.results.steps import metrics_of

LEAST = 3e-3
"""Weight beside that of the final model below which an alternative is left out [-]."""
_ALWAYS = 0.5
"""Odds beforehand of each of the two effects that every reading has [-]."""
_CERTAIN = 300.0
"""Evidence beyond which odds do not grow [nat]."""
_DRAWS = 4000
"""Draws of all models together [-]."""
_FOLLOWING, _SIMULATED = 1000, 250
"""Draws about an optimum whose likelihood is computed, and where effects act before the reading [-]: of the
ends of 90 % intervals so few leave 0.13 standard deviations open."""
_RESPONSES = 400
"""Step responses of all models together [-]."""
_FEWEST = 10
"""Step responses of one of them [-]."""
_SEED = 23
_MOST, _FORCED = 6, 2
"""Instances of an effect that the final model is fitted again from, and beside forces [-]."""
_STEPS, _SLIGHT = 15, 0.05
"""Most responses of such a descent [-], and gain of its last step [nat]."""
_FAR = 12.0
"""Cost above that of the final model from which it is not followed to its end [nat]."""
_DISTINCT = 0.5
"""Descents that end closer than this in every coordinate found one optimum [sd]."""


@final
@dataclass(frozen=True, eq=False)
class Alternative:
    """One more effect beside those of a final model, one in place of the last, or another instance of one."""

    name: str
    weight: float
    """Beside 1 of the final model [-]."""
    shift: Vector
    """Of its coordinates, those of the plant with what belongs to its response where an effect is replaced,
    (k,)."""
    root: Matrix
    """Factor of the covariance of that, (k, m)."""
    least: float = -np.inf
    """Where the coefficient of one more effect has one sign, the least of the standard normal that draws it
    [-]."""
    instead: str = ""
    """Name of the effect that it stands in place of, whose coordinates it has if it is an instance of the
    same; empty for one more effect."""
    instance: Effect | None = None
    """That instance."""

    @property
    def rival(self) -> bool:
        """Whether it has another effect in place of one of the final model."""
        return bool(self.instead) and self.instance is None

    def within(self, table: ParameterTable) -> bool:
        """Whether it is an instance that the free constants of a table reach."""
        for key, value in self.instance.constants.items() if self.instance else ():
            row = table.rows[table.names.index(f"{self.instead}.{key}")]
            low, high = row.domain if row.free else (row.value, row.value)
            if not low <= float(value) <= high:
                return False
        return self.instance is not None

    def draws(self, own: Matrix, middle: Vector, rng: np.random.Generator) -> Matrix:
        """Coordinates, (draws, k), from draws of the final model about its optimum `middle`."""
        k = self.shift.size
        shape = len(own), self.root.shape[1]
        if np.isfinite(self.least):
            normal = truncnorm.rvs(self.least, np.inf, size=shape, random_state=rng)
        else:
            normal = rng.standard_normal(shape)
        scatter = normal @ self.root.T
        return np.asarray((middle[:k] if self.instead else own) + self.shift + scatter)


def alternatives(state: State, rounds: Sequence[Round], known: str = "") -> tuple[Alternative, ...]:
    """Those of a final model that its last trace, of which no effect stands out, the refits of the round that
    chose its last effect, and refits of other instances of its effects leave a weight. The size of the effect
    `known` by name is stated with the records, as an exposure may be."""
    seen = rounds[-1].trace
    return (*_beside(state, seen, known), *_instead(state, rounds), *_elsewhere(state, seen.scale))


@final
class Mixture(NamedTuple):
    """Draws of a final model and of what is open to it."""

    parts: Sequence[Matrix]
    """Coordinates of each, (draws, k), those of the final model first."""
    weights: Vector
    """Of the parts; they add up to 1."""
    rivals: tuple[int, ...] = ()
    """Parts that have another effect in place of one of the final model."""

    def only(self, places: Sequence[int]) -> Mixture:
        """Its parts at these places."""
        weights = self.weights[list(places)]
        rivals = tuple(new for new, old in enumerate(places) if old in self.rivals)
        return Mixture([self.parts[one] for one in places], weights / weights.sum(), rivals)


def mixture(state: State, own: Matrix | None, found: Sequence[Alternative]) -> Mixture:
    """Draws of the final model, `own` or else those about its optimum that follow the records, and of each
    alternative, inside the support of the coordinates.

    What stands in place of an effect may have one more beside it too, with the odds that the final model has.
    """
    rng = np.random.default_rng(_SEED)
    x, (low, high) = state.optimum.x, state.model.bounds

    def within(drawn: Matrix) -> Flags:
        k = drawn.shape[1]  # another effect in place of the last has fewer coordinates
        return np.asarray(((drawn >= low[:k]) & (drawn <= high[:k])).all(axis=1))

    if own is None:
        own = draws_about(state, rng, _SIMULATED if state.model.upstream else _FOLLOWING)
    parts, weights, rivals = [own], [1.0], []
    with_others = 1.0 + sum(one.weight for one in found if not one.instead)
    for one in found:
        drawn = one.draws(own[rng.integers(len(own), size=_DRAWS)], x, rng)
        inside = within(drawn)
        if inside.any():
            rivals += [len(parts)] if one.rival else []
            parts.append(drawn[inside])
            weights.append(one.weight * (with_others if one.instead else 1.0) * float(inside.mean()))
    return Mixture(parts, np.array(weights) / sum(weights), tuple(rivals))


@final
@dataclass(frozen=True, eq=False)
class Weighed:
    """One number over a final model and all that is open to it."""

    name: str
    unit: str
    parts: Sequence[Vector]
    """Equally probable values, those of the final model first [`unit`]."""
    weights: Vector
    """Of the parts; they add up to 1."""
    note: str = ""
    rivals: tuple[int, ...] = ()
    """Parts that have another effect in place of one of the final model."""

    @property
    def values(self) -> Vector:
        """Equally probable values over all [`unit`]."""
        return pooled(self.parts, self.weights)

    def beside(self, others: Sequence[Vector], weight: float) -> Weighed:
        """Over further parts too, with the effects of the final model, which have this weight together beside
        the others with these effects."""
        if not others:
            return self
        rival = np.isin(np.arange(len(self.parts)), self.rivals)
        left = np.where(rival, self.weights, (1 - weight) * self.weights)
        theirs = weight * float(self.weights[~rival].sum()) / len(others)
        shares = np.concatenate((left, np.full(len(others), theirs)))
        return replace(self, parts=[*self.parts, *others], weights=shares)

    def as_json(self, *, ess: float, grade: str, interval: str) -> dict[str, Any]:
        """Median and 90 % interval, the standard deviations by noise and by structure, and lower end, median
        and upper end under the final model `alone`."""
        estimate = Estimate.of(self.name, self.unit, self.values, ess=ess, grade=grade, note=self.note)
        noise, structure = parts_of_sd(*pooled_parts(self.parts, self.weights))
        tail = (1 - estimate.level) / 2
        alone = [float(quantile(self.parts[0], at)) for at in (tail, 0.5, 1 - tail)]
        more = {"interval": interval, "sd_noise": noise, "sd_structure": structure, "alone": alone}
        return plain(estimate.as_json() | more)


def step_figures(state: State, drawn: Mixture, *, span: float, time_unit: str) -> tuple[Weighed, ...]:
    """Figures of the plant's response to a unit step over `span` [time unit], its effects aside but for
    linear dynamics without a name, over the draws of a mixture; none where no draw of the final model is a
    plant."""
    model, columns = state.model.responding
    table = model.posterior.table
    values = []
    for part, weight in zip(drawn.parts, drawn.weights, strict=True):
        count = min(max(round(_RESPONSES * weight), _FEWEST), len(part))
        chosen = part[np.linspace(0, len(part) - 1, count).astype(int)][:, columns]
        values.append(model.tabulated(chosen[model.supported(chosen)]))
    if not len(values[0]):
        return ()
    kept = [number for number, one in enumerate(values) if len(one)]
    every, ends = np.concatenate(values), np.cumsum([len(values[number]) for number in kept])[:-1]
    _, weights, rivals = drawn.only(kept)
    found = metrics_of(table, curves_of(table, every, span), time_unit=time_unit)
    return tuple(
        Weighed(one.name, one.unit, np.split(one.values, ends), weights, one.note, rivals) for one in found
    )


def odds(seen: Trace, log_bayes_factor: float, beforehand: float | None = None) -> float:
    """Of one more effect against none [-]: by default as probable `beforehand` as any other, and all together
    as none.

    By what its evidence is worth, of more than `_CERTAIN` nat as of these, so that weights can be added up.
    """
    exponent = min(worth(log_bayes_factor, seen.threshold), _CERTAIN)
    return float(np.exp(exponent)) * (1 / len(seen.traced) if beforehand is None else beforehand)


def _beside(state: State, seen: Trace, known: str) -> list[Alternative]:
    """One more effect beside those of the final model."""
    out = []
    for traced in seen.traced:
        beforehand = _ALWAYS if traced.card.always and traced.name != known else None
        for signature in traced.signatures:
            weight = odds(seen, seen.alone(signature), beforehand) / len(traced.signatures)
            if weight > LEAST:
                out.append(Alternative(traced.name, weight, *_step(state, signature, seen)))
    return out


def _step(state: State, signature: Signature, seen: Trace) -> tuple[Vector, Matrix, float]:
    """What an instance of an effect moves coordinates by, a factor of its covariance, and the least of the
    standard normal behind it."""
    optimum, free = state.optimum, ~state.optimum.stuck
    raw, _ = state.model.signature(optimum.x, signature.effect)
    columns = state.whitening(raw.T).T * signature.width(seen.residual, seen.scale)
    tangents = optimum.jacobian[:, free]
    cross = tangents.T @ columns
    gain = np.zeros((free.size, columns.shape[1]))
    gain[free] = covariance_of(optimum.information[np.ix_(free, free)]) @ cross
    left, moved = columns - optimum.jacobian @ gain, gain / state.model.spread[:, None]
    # equal to I + S' S - S' J G, whose difference may be lost in rounding
    covariance = covariance_of(np.eye(columns.shape[1]) + left.T @ left + moved.T @ moved)
    psi, root = covariance @ (columns.T @ optimum.settled), root_of(covariance)
    least = -float(psi[0] / root[0, 0]) if signature.one_signed and psi.size == 1 else -np.inf
    return -gain @ psi, -gain @ root, least


def _instead(state: State, rounds: Sequence[Round]) -> list[Alternative]:
    """Rivals of the effect that was added last, as they were refitted."""
    last = next((one for one in reversed(rounds) if one.chosen), None)
    names = {effect.name for effect in state.model.effects}
    if last is None or last.chosen is None or {e.name for e in last.chosen.model.effects} != names:
        return []
    out, size = [], len(state.model.responding[1])  # effects with a name come last
    for one in last.refits:
        weight = float(np.exp(min(one.log_bayes_factor - last.chosen.log_bayes_factor, 0.0)))
        if one is last.chosen or weight <= LEAST:
            continue
        shift = one.optimum.x[:size] - state.optimum.x[:size]
        root = root_of(one.optimum.covariance[:size, :size])
        out.append(Alternative(one.added[0], weight, shift, root, instead=last.chosen.added[0]))
    return out


def _elsewhere(state: State, scale: Scale) -> list[Alternative]:
    """The final model with the internal constants of one of its effects at other optima."""
    model, whitening, out = state.model, state.whitening, list[Alternative]()
    if not any(_movable(effect, model.effected.ranges) for effect in model.effects):
        return out
    names = [effect.name for effect in model.effects if not effect.timed]
    wide = loosened(model, names)
    own = np.isin(wide.names, model.names)
    here = Regression(wide, whitening).at(wide.coordinates(model.values(state.optimum.x)))
    known = [here]
    for place, effect in enumerate(model.effects):
        for instance, start in _instances(state, place, scale):
            moved = model.having(*(instance if k == place else one for k, one in enumerate(model.effects)))
            tried = loosened(moved, names)
            try:
                quick = Regression(replace(tried, exact=False), whitening)
                begun, _ = quick.reached(tried.coordinates(moved.values(start)), most=_STEPS, gain=_SLIGHT)
                if quick.cost(begun) > here.cost + _FAR:
                    continue
                there = Regression(tried, whitening).descend(begun, most=_STEPS, gain=_SLIGHT)
            except ArithmeticError:
                continue
            weight = float(np.exp(min(log_bayes_factor(here, there, scale.quiet), _CERTAIN)))
            if weight > LEAST and not any(_same(there, one) for one in known):
                known.append(there)
                found = tried.held(there.x)[0].effects[place]
                constants = (f"{key} {value:.3g}" for key, value in found.constants.items())
                name, shift = f"{effect.name} with {', '.join(constants)}", there.x[own] - state.optimum.x
                root = root_of(there.covariance[np.ix_(own, own)])
                out.append(Alternative(name, weight, shift, root, instead=effect.name, instance=found))
    return out


def _same(one: Optimum, other: Optimum) -> bool:
    """Whether two descents ended in one optimum."""
    return bool((np.abs(one.x - other.x) < _DISTINCT * np.maximum(one.sd, other.sd)).all())


def _movable(effect: Effect, ranges: Ranges) -> bool:
    """Whether an effect of the plant has instances to choose from."""
    return not effect.card.disturbance and len(effect.grid(ranges)) > 1


def _instances(state: State, place: int, scale: Scale) -> list[tuple[Effect, Vector]]:
    """Instances of one of the effects of a final model, those of most evidence in its place, and coordinates
    of the model with each."""
    model, optimum = state.model, state.optimum
    effect, ranges = model.effects[place], model.effected.ranges
    if not _movable(effect, ranges):
        return []
    where = places(model, effect.name)
    bare, x = without(model, optimum.x, [effect.name])
    others = np.delete(np.arange(optimum.x.size), where)
    project = Projection(optimum.moving[:, others] * model.spread[others])
    rest = project(optimum.settled + optimum.jacobian[:, where] @ optimum.x[where])
    known = replace(scale, power=np.array([rest @ rest]))
    units = np.array([one.coefficient.scale for one in model.effected.coefficients if one.effect == place])
    found: list[tuple[float, Effect, Vector]] = []
    for instance in effect.grid(ranges):
        try:
            signature = signature_of(bare, x, state.whitening, project, instance)
        except ArithmeticError:
            continue
        start = optimum.x.copy()
        start[where] = units * signature.amplitude(rest, known)
        evidence = float(signature.evidence(signature.span.T @ rest[:, None], known)[0])
        found.append((evidence, instance, np.clip(start, *model.bounds)))
    forced = any(isinstance(one, ForceEffect) for one in model.effects)
    return _apart([one[1:] for one in sorted(found, key=lambda one: -one[0])], _FORCED if forced else _MOST)


def _apart(ranked: Sequence[tuple[Effect, Vector]], most: int) -> list[tuple[Effect, Vector]]:
    """So many of the first instances at most; of a long list none beside another in every constant: they lead
    to one optimum."""
    rows = np.array([[float(v) for v in one.constants.values()] for one, _ in ranked])
    step = [2 if isinstance(value, bool) else 1 for value in ranked[0][0].constants.values()]
    place = np.stack([np.unique(column, return_inverse=True)[1] for column in rows.T], axis=1) * step
    kept: list[int] = []
    for k in range(len(ranked)):
        if len(ranked) <= _MOST or not any(np.abs(place[k] - place[one]).max() <= 1 for one in kept):
            kept.append(k)
    return [ranked[k] for k in kept[:most]]
