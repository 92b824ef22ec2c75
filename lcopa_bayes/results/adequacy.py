"""Whether the model is adequate to its records: what else the intervals rest on than the sampling.

A grade by the sampling says how well a posterior is known, not whether its model is right. Checks of the
model against its records are limitations of every number: a residual that the noise model does not explain,
bands that hold too many or too few samples, held-out records that its bands do not hold, a residual far
above the scatter at rest, noise whose parameters are at the end of their priors, a resonance that the samples
do not resolve (`resonances`), records that contradict each other (`data.agreement`), and priors in conflict
with the data (`conflicts`).

Conflicts of priors with data: parameters that a prior far from the data pulls towards itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import exp, inf, isfinite, log, sqrt
from typing import final

import numpy as np
from scipy.stats import binom

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.results.bands import LEVELS
from lcopa_bayes.results.prediction import Band
from lcopa_bayes.results.residuals import WHITE_P, Residual
from lcopa_bayes.results.resonances import resonances
from lcopa_bayes.results.restbefore import rest_before
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.crosscheck import holm
from lcopa_bayes.sampling.draws import Draws

RARE = 2.7e-3
"""Probability under its own prior, below which an estimate is in conflict with it [-]: three standard
deviations of a normal one."""
PULLED = 0.25
"""Shift by the prior from which such a conflict biases a number [posterior sd]."""
_SIZE = 20_000
"""Draws of the prior that the estimate is held against [-]."""
_STEP = 0.05
"""Step of the differences that give the slope of a prior [posterior sd]."""
_LEAST = 0.05
"""Share of the information that the data must give for an estimate without the prior [-]."""


def conflicts(draws: Draws) -> Iterator[Limitation]:
    """A limitation of every parameter whose estimate without its prior is improbable under that prior and is
    shifted by it.

    To second order in the logarithms of the prior and the marginal posterior on the sampled scale: with slope
    g and curvature -c of the log prior, averaged over draws of variance s^2, the data alone have the variance
    ``v = 1 / (1 / s^2 - c)`` and the mean ``m - v g``; exact where both are normal. That estimate, with its
    error, is held against draws of the prior with the same error (Box 1980, J. R. Stat. Soc. A 143).
    """
    for k, row in enumerate(draws.table.rows):
        if not row.free:
            continue
        x = row.coordinate(draws.flat[:, k])
        mean, sd = float(x.mean()), float(x.std())
        if not (np.isfinite(sd) and sd > 0):
            continue
        slope, bend = _slopes(row, x, _STEP * sd)
        known = 1 + bend * sd**2
        if not (np.isfinite(slope) and known > _LEAST):
            continue
        variance = sd**2 / known
        shift = variance * slope
        if abs(shift) < PULLED * sd:
            continue
        rng = np.random.default_rng(k)
        prior = row.coordinate(row.draw(_SIZE, rng)) + np.sqrt(variance) * rng.standard_normal(_SIZE)
        alone = mean - shift
        beyond = min(np.mean(prior >= alone), np.mean(prior <= alone))
        if 2 * beyond < RARE:
            value = float(row.value_at(alone))
            yield Limitation(
                "tentative",
                f"the prior of {row.name} is in conflict with the data and shifts it by "
                f"{abs(shift) / sd:.1f} posterior sd: without it {row.name} would be about {value:.3g} "
                f"{row.unit}".rstrip(" -"),
                f"widen the prior of {row.name} under [priors], or correct it",
                (row.name,),
            )


def _slopes(row: Parameter, x: Vector, step: float) -> tuple[float, float]:
    """Mean first and second derivative of the log prior density in the sampled coordinate; NaN where no draw
    is inside the prior by a step."""
    below, here, above = (row.log_density(x + shift) for shift in (-step, 0.0, step))
    inside = np.isfinite(below) & np.isfinite(above)
    if not inside.any():
        return np.nan, np.nan
    first = (above - below)[inside].mean() / (2 * step)
    second = (above - 2 * here + below)[inside].mean() / step**2
    return float(first), float(second)


REST = 2.0
"""Residual over the largest scatter that samples at rest allow, from which a model lacks something [-]: the
default priors let noise in motion be twice that at rest."""
MEMORY = 0.1
"""Share of the record over which noise may be correlated [-]: with less than ten independent stretches it
cannot be distinguished from a response that the plant lacks."""
_END = 0.9
"""Noise parameters with half of their draws beyond this share of a bounded prior are at its end [-]."""
_REPLICAS = 400
"""Noise that is drawn to learn how coverage scatters."""
_CELLS = 4_000_000
_ADD = "add terms to the model, or let `loop` trace what it lacks"


def limitations(
    problem: Problem,
    draws: Draws,
    shown: Sequence[Band],
    remaining: Sequence[Residual],
    rng: np.random.Generator,
) -> tuple[Limitation, ...]:
    """Limitations of the numbers of a fit, from its bands and residuals."""
    fitted, posterior = [band for band in shown if not band.held_out], problem.posterior
    best = posterior.coordinates(draws.flat[[int(draws.log_density.argmax())]])
    return (
        *_disagreeing(problem.study),
        *_unexplained(
            [one for one in remaining if not one.held_out],
            [_coverage(problem, draws, b, rng) for b in fitted],
        ),
        *_unpredicted([band for band in shown if band.held_out]),
        *rest_before(problem, posterior.complete(best, None)[0]),
        *_above_rest(problem, fitted),
        *_ends(problem, draws),
        *resonances(problem, draws),
        *conflicts(draws),
    )


def _disagreeing(study: Study) -> Iterator[Limitation]:
    """Records that one plant cannot follow."""
    for one in study.disagreements:
        yield Limitation("unusable" if one.gross else "tentative", one.reason, one.remedy)


@final
@dataclass(frozen=True)
class Coverage:
    """Samples of one axis of one record inside the 90 % band."""

    record: str
    axis: str
    share: float
    """[-]."""
    p: float
    """Two-sided p-value under the noise model [-]."""


def _coverage(problem: Problem, draws: Draws, band: Band, rng: np.random.Generator) -> Coverage:
    """Coverage of a band beside that of noise about the median response.

    Coverage of correlated noise scatters as that of fewer independent samples: as many as give the variance
    between replicas.
    """
    noise, axes = problem.posterior.noise, [axis.name for axis in draws.table.layout.responses]
    size = band.time.size
    values = draws.thinned(max(50, min(_REPLICAS, _CELLS // size)))
    places = [draws.table.at(name, axes.index(band.axis)) for name in noise.names]
    gaps = np.concatenate(([1.0], np.diff(band.time) / problem.scales.period))
    low, high = band.noisy[0] - band.plant[2], band.noisy[4] - band.plant[2]
    replicas = noise.draw(values[:, places], gaps, rng)
    shares = np.mean((replicas >= low) & (replicas <= high), axis=1)
    due, spread = float(shares.mean()), float(shares.var())
    independent = size if spread == 0 else max(1, min(size, round(due * (1 - due) / spread)))
    share = band.coverage(LEVELS[1])
    law = binom(independent, due)
    above, below = law.sf(np.ceil(share * independent) - 1), law.cdf(np.floor(share * independent))
    return Coverage(band.record, band.axis, share, float(min(1.0, 2 * min(above, below))))


def _unexplained(remaining: Sequence[Residual], covered: Sequence[Coverage]) -> Iterator[Limitation]:
    """Residuals that are not white and bands that do not hold what is due, corrected for all that are
    tried."""
    adjusted = holm([one.p_white for one in remaining] + [one.p for one in covered])
    white, hold = adjusted[: len(remaining)], adjusted[len(remaining) :]
    count = f"corrected for {len(adjusted)} tests" if len(adjusted) > 1 else "one test"
    coloured = bool(white) and min(white) < WHITE_P
    if coloured:
        worst = remaining[int(np.argmin(white))]
        yield Limitation(
            "tentative",
            "intervals hold only if what the noise model does not explain is harmless: the residual of "
            f"{worst.record}, axis {worst.axis}, is not white ({_p(min(white))}, {count})",
            _ADD,
        )
    if hold and min(hold) < WHITE_P:
        off = covered[int(np.argmin(hold))]
        wide = off.share > LEVELS[1]
        noise = "wider" if wide else "narrower"
        yield Limitation(
            "tentative",
            f"intervals hold only if the noise is right, which is {noise} than the residual: bands hold "
            f"{100 * off.share:.0f} % of {off.record}, axis {off.axis}, where {100 * LEVELS[1]:.0f} % are "
            f"due ({_p(min(hold))}, {count})",
            "choose another [noise] kind" + ("" if coloured else f", {_ADD}"),  # said once
        )


def _unpredicted(held_out: Sequence[Band]) -> Iterator[Limitation]:
    """The held-out record with the fewest samples in its band, where the posterior does not allow so few,
    corrected for all that are tried: an error that fitted records hide in wrong parameters shows there."""
    adjusted = holm([band.p_inside for band in held_out])
    if held_out and min(adjusted) < WHITE_P:
        worst = held_out[int(np.argmin(adjusted))]
        yield Limitation(
            "tentative",
            f"intervals hold only if it is harmless that the model predicts {worst.record}, axis "
            f"{worst.axis}, worse than it claims: {100 * worst.coverage(LEVELS[1]):.0f} % of the samples of "
            f"this held-out record are in the {100 * LEVELS[1]:.0f} % band ({_p(min(adjusted))})",
            _ADD,
        )


def _p(p: float) -> str:
    return f"p = {p:.1g}" if p > 0 else "p < 1e-300"


def _above_rest(problem: Problem, fitted: Sequence[Band]) -> Iterator[Limitation]:
    """The axis whose residual is largest over the scatter at rest, where that is too large."""
    begins = {one.record.name: one.first_change for one in problem.posterior.samples}
    worst, largest = REST, None
    for axis, declared in enumerate(problem.posterior.table.layout.responses):
        quiet = problem.scales.quiet(axis)
        if quiet is None:
            continue
        most = float(np.hypot(quiet.sigma * exp(2 * quiet.log_sd), quiet.correlated))
        for band in fitted:
            moving = band.time > begins[band.record]
            if band.axis != declared.name or not moving.any():
                continue
            rms = sqrt(float(np.mean((band.observed - band.plant[2])[moving] ** 2)))
            if rms > worst * most:
                worst, largest = rms / most, (band, rms, most)
    if largest is not None:
        band, rms, most = largest
        yield Limitation(
            "tentative",
            "intervals hold only if noise grew with the first change of the drive: the residual of "
            f"{band.record}, axis {band.axis}, is {measured(rms, band.unit)}, at rest noise is at most "
            f"{measured(most, band.unit)}",
            _ADD,
        )


def _ends(problem: Problem, draws: Draws) -> Iterator[Limitation]:
    """Noise parameters at the end of their priors, and noise that is correlated over much of the record."""
    samples = problem.scales.span / problem.scales.period
    for row in draws.table.rows:
        if not (row.free and row.noise):
            continue
        column, (low, high) = draws.column(row.name), row.domain
        if row.kind == "rho":
            memory = -1 / log(float(np.median(column)))
            longest = -1 / log(high) if high < 1 else inf
            if memory > min(MEMORY * samples, _END * longest):
                yield Limitation(
                    "tentative",
                    f"intervals hold only if noise is correlated over {memory:.3g} samples of "
                    f"{samples:.0f} ({row.name} = {np.median(column):.4g}): noise that slow replaces what "
                    "the plant lacks",
                    _ADD,
                )
        elif isfinite(high) and np.median(column) > low + _END * (high - low):
            yield Limitation(
                "tentative",
                f"intervals hold only if {row.name} may not exceed {measured(high, row.unit)}, the end of "
                "its prior, near which it is",
                _ADD,
            )
