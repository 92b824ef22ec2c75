"""Conflicts of priors with data: parameters that a prior far from the data pulls towards itself."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.sampling.convergence import Limitation
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
