"""Leading candidates refitted with everything free: what their evidence is worth beyond the linearisation."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import final

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.effectsearch.basefit import renewed
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.freedconstants import freed
from lcopa_bayes.effectsearch.leavingout import groups, log_scores
from lcopa_bayes.effectsearch.noise import quiet_samples
from lcopa_bayes.effectsearch.priorwidth import rarity, widened, with_room
from lcopa_bayes.effectsearch.regression import Glance, Optimum, Regression
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Scale
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.effects import Placed
from lcopa_bayes.model.effects.effect import Effect

SIGNIFICANT = 2.7e-3
"""Two-sided p-value of three standard deviations [-]."""
_PROCESSES = 400
"""Plausible noise processes over which a p-value is averaged [-]."""
_NEAR = 0.5
"""Expected gain of a step with which a descent by the plant's own tangents ends [nat]."""
_KEPT = 0.9
"""Share of what a linear estimate promises that shows a descent in the right place [-]."""
_SLIGHT = 1.0
"""Evidence that other constants of an effect would not mend [nat]."""
_DELAYS = (-0.25, -0.1)
"""Shares of a delay by which it is also started earlier, for effects that act on the drive or that a plant
without them has a longer delay for [-]."""


@final
@dataclass(frozen=True, eq=False)
class Refit:
    """The plant with a set of effects at its optimum."""

    model: ExtendedModel
    optimum: Optimum
    before: Optimum
    """That of the plant with the effects it had before."""
    whitening: Whitening
    """The noise both are judged under."""
    added: tuple[str, ...]
    """Names of the effects that are new."""
    quiet: float
    """Samples the noise scale is known from [-]."""
    choice: float = 0.0
    """What the evidence pays for a choice among pairs [nat]."""
    glances: tuple[Glance, ...] = ()
    """Where a few evaluations from its starts ended, the best of which stands for the optimum of a refit that
    was only begun; none of a refit at its optimum."""

    @cached_property
    def log_bayes_factor(self) -> float:
        """Laplace evidence over that of the plant before [nat]."""
        return log_bayes_factor(self.before, self.optimum, self.quiet) + self.paid

    @property
    def paid(self) -> float:
        """Evidence of signs that are known less that of the choice among what was tried [nat]."""
        return paid(self.model, self.added) - self.choice

    @cached_property
    def left_out(self) -> float:
        """Gain of the summed log predictive densities of records left out in turn [nat]."""
        apart = groups(self.whitening)
        now, was = (log_scores(optimum, apart) for optimum in (self.optimum, self.before))
        known = np.isfinite(now) | np.isfinite(was)  # what others determine for neither says nothing
        return float((now[known] - was[known]).sum())

    @property
    def worth(self) -> float:
        """What it takes off the squared residual, without what evidence pays for new coefficients [nat]."""
        return self.worth_at(self.optimum.cost)

    def worth_at(self, cost: float) -> float:
        """The same at another cost than that of its optimum [nat]."""
        freedom = self.whitening.effective - self.optimum.x.size
        known = Scale(self.quiet, freedom, np.array([2 * self.before.cost]))
        return float(known.gain(np.array([self.before.cost - cost]))[0])

    @property
    def state(self) -> State:
        """The model at its optimum."""
        return State(self.model, self.optimum, self.whitening)

    @property
    def dynamics(self) -> bool:
        """Whether it adds linear dynamics without a name."""
        return any(e.card.dynamics for e in self.model.effects if e.name in self.added)

    @property
    def unnamed(self) -> bool:
        """Whether linear dynamics without a name were there before."""
        return any(e.card.dynamics for e in self.model.effects if e.name not in self.added)

    @property
    def linear(self) -> bool:
        """Whether all it adds is linear and does not change with time."""
        return all(e.card.linear for e in self.model.effects if e.name in self.added)

    @property
    def taken(self) -> float:
        """Share of the residual's power that the new effects take [-]."""
        return 1.0 - self.optimum.cost / self.before.cost

    @property
    def excess(self) -> float:
        """Root mean square of the residual before over that of the noise [-]."""
        return self.whitening.excess(self.before.residual)

    def without(self, names: Sequence[str]) -> tuple[ExtendedModel, Vector]:
        """The model less these effects, and the coordinates that are left."""
        return without(self.model, self.optimum.x, names)

    @cached_property
    def resting(self) -> bool:
        """Whether new effects that go on where nothing moves make the residual there smaller.

        What only follows the drive may look like a vibration, but not before the first command.
        """
        names = [e.name for e in self.model.effects if e.card.resting and e.name in self.added]
        if not names:
            return True
        model, x = self.without(names)
        delay = model.dead_time(x)
        bare = self.whitening(self.whitening.observed - model.predict(x))
        drop = 0.0
        for part in self.whitening.parts:
            count = quiet_samples(part.samples, part.axis, delay)
            rows = slice(part.rows.start, part.rows.start + count)
            drop += float((bare[rows] ** 2 - self.optimum.white[rows] ** 2).sum())
        return drop >= 0.0

    def under(self, whitening: Whitening) -> Refit:
        """The same judged under another noise."""
        plain, _ = self.without(self.added)
        before = Regression(plain, whitening).descend(self.before.x, most=12, gain=_NEAR)
        optimum = Regression(self.model, whitening).descend(self.optimum.x, most=12, gain=_NEAR)
        optimum = _no_worse(self.model, whitening, optimum, before)
        model, optimum = with_room(self.model, optimum, whitening, self.added)
        return replace(self, model=model, optimum=optimum, before=before, whitening=whitening, glances=())

    def wald(self, name: str) -> float:
        """p-value of an effect's coefficients being zero, over all noise that is plausible [-]."""
        psi, count = self.optimum.x[self.places(name)], len(self.places(name))
        power = [psi @ np.linalg.solve(one, psi) for one in self._scatter(name)[1]]
        return float(np.mean(chi2.sf(power, count)))

    def ratio(self, name: str) -> float:
        """The same by the likelihood ratio of the plant with the one new effect and without [-].

        Of an effect whose slope fades with its size, as that of a loss which already limits, the coefficients
        are uncertain though the effect is not. Noise other than it was weighted makes the ratio larger by as
        much as it makes variances of the coefficients, at most.
        """
        naive, noise = self._scatter(name)
        twice = 2 * (self.before.cost - self.optimum.cost)
        larger = np.array([np.linalg.eigvals(np.linalg.solve(naive, one)).real.max() for one in noise])
        return float(np.mean(chi2.sf(twice / larger, len(naive))))

    def _scatter(self, name: str) -> tuple[Matrix, list[Matrix]]:
        """Covariance of an effect's coefficients under the noise as it was weighted, and under each of the
        plausible ones.

        That of the estimate under the noise as it is: larger where noise is as slow as the tangents (White
        1982, Econometrica 50). Other coordinates that an end of their support holds, or would hold if the
        coefficients vanished, stay where they are: a delay that cannot shrink is no alias.
        """
        where, x, information = self.places(name), self.optimum.x, self.optimum.information
        psi, own = x[where], np.isin(np.arange(x.size), where)
        low, high = self.model.bounds
        still = self.optimum.stuck & ~own
        while True:
            free = np.flatnonzero(~still)
            at = np.searchsorted(free, where)
            gain = covariance_of(information[np.ix_(free, free)])[:, at]
            there = x[free] - gain @ np.linalg.solve(gain[at], psi)
            beyond = ~own[free] & ((there < low[free]) | (there > high[free]))
            if not beyond.any():
                break
            still[free[beyond]] = True
        tangents = self.optimum.jacobian[:, free]
        held = information[np.ix_(free, free)] - tangents.T @ tangents  # what priors say
        noise = self.whitening.covariances(tangents @ gain, _PROCESSES)
        return np.asarray(gain[at]), [one + gain.T @ held @ gain for one in noise]

    def places(self, name: str) -> list[int]:
        """Coordinates of an effect's coefficients."""
        return places(self.model, name)

    @property
    def new(self) -> tuple[Placed, ...]:
        """Coefficients of the new effects."""
        placed, effects = self.model.effected.coefficients, self.model.effects
        return tuple(one for one in placed if effects[one.effect].name in self.added)

    @property
    def possible(self) -> bool:
        """Whether no share of a new effect is above the whole of it by three standard deviations."""
        size, sd = self.optimum.x[self.model.plant_size :], self.optimum.sd[self.model.plant_size :]
        placed = self.model.effected.coefficients
        over = [k for k, one in enumerate(placed) if one.coefficient.share and size[k] > 1 + 3 * sd[k]]
        return not {self.model.effects[placed[k].effect].name for k in over} & set(self.added)

    @cached_property
    def significant(self) -> bool:
        """Whether all new effects are three standard deviations or more away from zero, or a single one is by
        its likelihood ratio."""
        if all(self.wald(name) < SIGNIFICANT for name in self.added):
            return True
        return len(self.added) == 1 and self.ratio(self.added[0]) < SIGNIFICANT


def places(model: ExtendedModel, name: str) -> list[int]:
    """Coordinates of the coefficients of an effect of a model."""
    placed = enumerate(model.effected.coefficients)
    return [model.plant_size + k for k, one in placed if model.effects[one.effect].name == name]


def without(model: ExtendedModel, x: Vector, names: Sequence[str]) -> tuple[ExtendedModel, Vector]:
    """A model less some effects, and the coordinates that are left."""
    gone = [k for name in names for k in places(model, name)]
    kept = (e for e in model.effects if e.name not in names)
    return model.having(*kept), np.delete(x, gone)


def refit(
    model: ExtendedModel,
    before: Optimum,
    whitening: Whitening,
    added: Sequence[tuple[Effect, Vector]],
    quiet: float,
    near: Vector | None = None,
) -> Refit:
    """With effects added to those of `model`, at the optimum; arguments and errors as of `begun`."""
    return ended(begun(model, before, whitening, added, quiet, near))


def begun(
    model: ExtendedModel,
    before: Optimum,
    whitening: Whitening,
    added: Sequence[tuple[Effect, Vector]],
    quiet: float,
    near: Vector | None = None,
    promised: float = np.inf,
) -> Refit:
    """With effects added to those of `model`, after a few evaluations from zero and from its linear estimate
    each, by the plant's own tangents.

    `added` holds each effect with its coefficients over their prior sd; `quiet` [-] are the samples the
    noise scale is known from (`Scale`). The evidence pays for the choice among the instances that were
    tried. `near` are coordinates to start from first. Where the first start takes nearly as much off half
    the squared residual as a linear estimate has `promised`, there is no other.
    ArithmeticError when no start has a bounded response.
    """
    extended = model.having(*model.effects, *(effect for effect, _ in added))
    size = sum(psi.size for _, psi in added)
    linear = np.concatenate([psi for _, psi in added]) * extended.scale[-size:]
    extended = widened(extended, added)
    low, high = extended.bounds
    starts = [np.concatenate([before.x, factor * linear]) for factor in (1.0, 0.3, 0.0)]
    if any(effect.card.place == "drive" or effect.card.delays for effect, _ in added):
        starts += [model.delayed(starts[0], share) for share in _DELAYS]
    starts = [near, *starts] if near is not None else starts
    starts = [np.clip(start, low, high) for start in starts]  # starts only
    first = Regression(replace(extended, exact=False), whitening)
    glances = first.glanced(starts, gain=_NEAR, enough=before.cost - _KEPT * promised)
    names, optimum = tuple(effect.name for effect, _ in added), first.at(glances[0].x)
    return Refit(extended, optimum, before, whitening, names, quiet, glances=glances[:2])


def ended(one: Refit) -> Refit:
    """A refit at its optimum: it goes on by the plant's own tangents, then frees the effects' internal
    constants too (`freed`), and ends with the tangents of the whole."""
    if not one.glances:
        return one
    model, before, white, names = one.model, one.before, one.whitening, one.added
    first = Regression(replace(model, exact=False), white)
    start, _ = first.followed(one.glances, gain=_NEAR)
    if (
        one.worth_at(first.cost(start)) > _SLIGHT or white.dependence
    ):  # noise known from residuals alone holds the effect too
        model, start = freed(model, start, white, names)
    exact = Regression(model, white)
    optimum = exact.descend(start, most=12, gain=0.02)
    if any(effect.card.delays for effect in model.effects if effect.name in names):
        optimum = min([optimum, *_earlier(exact, optimum)], key=lambda other: other.cost)
    model, optimum = with_room(model, _no_worse(model, white, optimum, before), white, names)
    return replace(one, model=model, optimum=optimum, glances=())


def _earlier(regression: Regression, optimum: Optimum) -> Iterator[Optimum]:
    """Optima from shorter delays than that of another: as much of an effect as the delay in its place had
    left over may be an optimum of its own, by tens of nat above the best."""
    for share in _DELAYS:
        try:
            yield regression.descend(regression.model.delayed(optimum.x, share), most=12, gain=0.02)
        except ArithmeticError:  # no bounded response there
            continue


def _no_worse(model: ExtendedModel, whitening: Whitening, reached: Optimum, before: Optimum) -> Optimum:
    """An optimum of `model`; where it is less likely than that `before` its last effects were added, which
    the model contains at their vanishing, the one reached from there."""
    if reached.cost <= before.cost:
        return reached
    vanishing = np.zeros(reached.x.size - before.x.size)
    start = np.concatenate([before.x, vanishing])
    other = Regression(model, whitening).descend(start, most=12, gain=0.02)
    return min(reached, other, key=lambda one: one.cost)


def under_one_noise(candidates: Sequence[Refit]) -> list[Refit]:
    """Refits of one residual, by falling evidence.

    Where noise is known from residuals alone it holds the misfit too: then all are judged under that of the
    refit that leaves least.
    """
    if candidates and candidates[0].whitening.dependence:
        least = max(candidates, key=lambda one: one.taken)
        noise = renewed(least.model, least.optimum, least.whitening)
        candidates = [one.under(noise) for one in candidates]
    return sorted(candidates, key=lambda one: -one.log_bayes_factor)


def paid(model: ExtendedModel, names: Collection[str] | None = None) -> float:
    """Evidence of known signs of coefficients of effects `names` of a model, by default of all, less that of
    the choice among their instances and of priors wider than the default ones [nat]."""
    names = [effect.name for effect in model.effects] if names is None else names
    out = -rarity(model, names)
    for effect in model.effects:
        if effect.name in names:
            out -= float(np.log(len(effect.grid(model.effected.ranges))))
    for one in model.effected.coefficients:
        if model.effects[one.effect].name in names and one.coefficient.one_signed:
            out += float(np.log(2.0))
    return out


def log_bayes_factor(before: Optimum, after: Optimum, quiet: float) -> float:
    """Laplace evidence of one model over another's under the same whitening, noise scale integrated out
    [nat]."""
    volume = (after.log_evidence + after.cost) - (before.log_evidence + before.cost)
    known = Scale(quiet, after.effective - after.x.size, np.array([2 * before.cost]))
    return float(volume + known.gain(np.array([before.cost - after.cost]))[0])


def evidence_over(start: State, state: State, quiet: float) -> tuple[float, float]:
    """Log evidence over the base model's under one whitening, that of the final noise [nat], and the drop of
    half the residual power [-]."""
    if not state.model.effects:
        return 0.0, 0.0
    plain = start.optimum
    if state.whitening is not start.whitening:
        plain = Regression(start.model, state.whitening).descend(start.optimum.x)
    gained = log_bayes_factor(plain, state.optimum, quiet) + paid(state.model) - paid(start.model)
    return gained, plain.cost - state.optimum.cost


def beside_others(state: State, name: str, quiet: float) -> Refit:
    """One effect of a model as the last that was added: against the model refitted without it."""
    model, x = without(state.model, state.optimum.x, [name])
    fewer = Regression(model, state.whitening).descend(x, most=12, gain=0.02)
    return Refit(state.model, state.optimum, fewer, state.whitening, (name,), quiet)
