"""The base fit: noise measured first, then the plant's optimum from several starts, and whether it failed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.noise import AxisNoise, axis_noise, joint_noise, no_less
from lcopa_bayes.effectsearch.noiselaw import Law, plausible
from lcopa_bayes.effectsearch.regression import Optimum, Regression
from lcopa_bayes.effectsearch.whitening import Whitening, parts
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.noise import White
from lcopa_bayes.inference.observations import Observed
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.posterior import Posterior

STARTS = 4
"""Starts of the search for the optimum [-]."""
_DELAYS = tuple(factor - 1.0 for factor in (0.7, 0.85, 1.15, 1.3))
"""Shares of the fitted delays by which the descent is started again later: delays can jump [-]."""
_EXPLAINED = 0.5
"""Share of the response variance that a usable base fit explains at least [-]."""
_ROUNDS, _TURNS = 3, 8
"""Most times that noise and plant are found in turn, without effects and with them [-]."""
_OUT = 1.5
"""Mean square of a residual that is more than noise [variance of the noise]: where samples at rest know that
to 20 %, noise alone stays below."""
_SPARE = 3
"""Independent samples per parameter with which a residual can be judged at all [-]: with fewer the fit has
followed more than a third of the noise that it is judged by."""
_MOVED = 0.05
"""Change of the dead time from which the noise is measured anew [-]."""


@final
@dataclass(frozen=True, eq=False)
class BaseFit:
    """The plant alone at its optimum under the measured noise."""

    model: ExtendedModel
    noise: tuple[AxisNoise, ...]
    regression: Regression
    optimum: Optimum
    failed: str
    """Why no effect may be named from it; empty when it is usable."""
    caution: tuple[str, ...]
    """What limits the verdict."""

    @property
    def smooth(self) -> bool:
        """Whether the residual counts as too few independent samples to be judged: noise known from it alone
        holds what is missing too."""
        return self.optimum.converged and too_smooth(self.optimum)

    @property
    def stands_out(self) -> bool:
        """Whether more than noise is left: the plant lacks something, or the search ended beside."""
        if not self.optimum.converged:
            return True
        if not self.noise_known:
            return self.smooth
        return 2.0 * self.optimum.cost > _OUT * self.optimum.residual.size

    @property
    def noise_samples(self) -> tuple[int, ...]:
        """Samples that the noise of each axis is known from, 0 where it was fitted jointly [-]."""
        return tuple(one.samples if one.known else 0 for one in self.noise)

    def with_plant(self, model: ExtendedModel, x: Vector) -> BaseFit:
        """Another plant of the same records under the same noise, at the optimum from coordinates."""
        regression = Regression(model, self.regression.whitening)
        optimum = regression.descend(x)
        failed, caution = _failure(model, optimum), _cautions(self.noise, optimum)
        return BaseFit(model, self.noise, regression, optimum, failed, caution)

    @property
    def noise_known(self) -> bool:
        """Whether the noise of every axis was measured apart from the fit."""
        return all(one.known for one in self.noise)


def base_fit(
    model: ExtendedModel,
    rng: np.random.Generator,
    *,
    starts: int = STARTS,
    near: Sequence[Vector] = (),
    crew: Crew = ALONE,
) -> BaseFit:
    """The optimum of a fit's own search from so many starts, then noise, and the optimum under it; `near` are
    further coordinates to start from.

    Where an axis has too few quiet samples its noise is fitted to the residual in turn with the plant.
    """
    posterior = model.plant
    seeds = [model.values(x) for x in near]
    white = replace(posterior, noise=White())
    optima = find_optima(white, rng, starts=starts, near=seeds, crew=crew.sharing(white))
    # where no search ends inside the priors a draw of them is as good a start as any
    first = optima[0].values if optima else posterior.table.draw(1, rng)[0]
    x = model.coordinates(first)
    others = [model.delayed(x, share) for share in _DELAYS] if model.delays else []
    optimum = Regression(model, Whitening(posterior.samples, _guessed(posterior))).best([x, *others], crew)
    noise: tuple[AxisNoise, ...] = ()
    for _ in range(_ROUNDS):
        delay = model.dead_time(optimum.x)
        again = measured(posterior, optimum.residual, delay)
        if noise and all(_alike(a, b) for a, b in zip(noise, again, strict=True)):
            break
        noise = again
        regression = Regression(model, whitening(model, noise))
        optimum = regression.descend(optimum.x)
        if all(one.known for one in noise) and abs(model.dead_time(optimum.x) - delay) <= _MOVED * delay:
            break
    for _ in range(_ROUNDS):
        if optimum.converged:
            break
        optimum = regression.descend(optimum.x)  # out of evaluations: go on
    return BaseFit(model, noise, regression, optimum, _failure(model, optimum), _cautions(noise, optimum))


def _guessed(posterior: Posterior) -> tuple[Law, ...]:
    """White noise of a hundredth of each response's spread, to find the mode with."""
    axes = range(len(posterior.table.layout.responses))
    pooled = [np.concatenate([s.axes[axis].values for s in posterior.samples]) for axis in axes]
    return tuple(Law(0.01 * (float(values.std()) or 1.0)) for values in pooled)


def measured(posterior: Posterior, residual: Vector, delay: float) -> tuple[AxisNoise, ...]:
    """Noise of every axis; from the stacked `residual` [response unit] where nothing else gives it, or where
    that is hardly more than what rounding leaves."""
    out = []
    scales = fitted_scales(posterior)
    for axis, response in enumerate(posterior.table.layout.responses):
        own = axis_pieces(posterior, residual, axis)
        noise = axis_noise(posterior.samples, axis, delay, response, scales)
        noise = no_less(noise, own, response, scales.least_noise(axis))
        out.append(joint_noise(own, response, noise, scales) if isinstance(noise, str) else noise)
    return tuple(out)


def whitening(model: ExtendedModel, noise: Sequence[AxisNoise]) -> Whitening:
    """The whitening operator of the fit records."""
    laws = tuple(one.law for one in noise)
    known = tuple(one.posterior for one in noise)
    dependence = () if all(one.known for one in noise) else tuple(one.dependence for one in noise)
    least = all(one.least for one in noise)
    return Whitening(model.plant.samples, laws, dependence, known, least)


def renewed(model: ExtendedModel, optimum: Optimum, known: Whitening) -> Whitening:
    """The noise as the residual of another optimum gives it, where it had to be fitted jointly."""
    if not known.dependence:
        return known
    delay = model.dead_time(optimum.x)
    return whitening(model, measured(model.plant, optimum.residual, delay))


def in_turn(model: ExtendedModel, optimum: Optimum, known: Whitening) -> tuple[Optimum, Whitening]:
    """Optimum and noise, each as the other gives it, where the noise had to be fitted jointly."""
    for _ in range(_TURNS):
        white = renewed(model, optimum, known)
        pairs = zip(white.noise, known.noise, strict=True)
        if white is known or all(_near(one, other) for one, other in pairs):
            break
        known, optimum = white, Regression(model, white).descend(optimum.x)
    return optimum, known


def settled(model: ExtendedModel, optimum: Optimum, known: Whitening) -> tuple[Optimum, Whitening]:
    """Optimum and noise where nothing stands out from the noise that was measured: then all of the residual
    is noise, and knows it better than samples at rest do. Where there is none to speak of they stay."""
    if known.least:
        return optimum, known
    posterior = model.plant
    scales = fitted_scales(posterior)
    pieces = (axis_pieces(posterior, optimum.residual, axis) for axis in range(len(known.noise)))
    seen = tuple(plausible(own, scales) for own in pieces)
    white = replace(known, noise=tuple(map(Law.of, seen)), posterior=seen)
    return Regression(model, white).descend(optimum.x), white


def fitted_scales(posterior: Posterior) -> Scales:
    """Scales of the fit records."""
    return Scales.of([one.record for one in posterior.samples])


def axis_pieces(posterior: Posterior, stacked: Vector, axis: int) -> list[Observed]:
    """Stacked values of one axis, record by record."""
    own = parts(posterior.samples, axis)
    return [replace(part.observed, values=stacked[part.rows]) for part in own]


def _alike(one: AxisNoise, other: AxisNoise) -> bool:
    return one.samples == other.samples and _near(one.law, other.law)


def _near(one: Law, other: Law) -> bool:
    return abs(one.sd / other.sd - 1) < 0.01


def too_smooth(optimum: Optimum) -> bool:
    """Whether a residual counts as fewer than three independent samples per parameter."""
    return optimum.effective < _SPARE * optimum.x.size


def _failure(model: ExtendedModel, optimum: Optimum) -> str:
    if not optimum.converged:
        return "the base fit did not converge within its steps"
    if too_smooth(optimum):
        return (
            f"the residual of the base fit is so smooth that its samples count as {optimum.effective:.0f} "
            f"independent ones, too few beside {optimum.x.size} parameters"
        )
    responses = model.plant.table.layout.responses
    for axis, response in enumerate(responses):
        own = [part.rows for part in parts(model.plant.samples, axis)]
        seen = [model.observed[rows] for rows in own]
        spread = sum(float(((values - values.mean()) ** 2).sum()) for values in seen)
        missed = sum(float((optimum.residual[rows] ** 2).sum()) for rows in own)
        if missed > (1 - _EXPLAINED) * spread > 0 and len(responses) == 1:
            return f"the base model explains less than half of the variance of {response.name}"
    return ""


def _cautions(noise: Sequence[AxisNoise], optimum: Optimum) -> tuple[str, ...]:
    out = [one.caution for one in noise if one.caution]
    if optimum.at_bound:
        out.append(
            f"{', '.join(optimum.at_bound)} at the end of the prior in the base fit; widen the "
            "prior "
            "or take the parameter out: what a bound takes away may look like an effect"
        )
    return tuple(out)
