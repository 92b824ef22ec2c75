"""The maximum of the likelihood and the criteria that count parameters."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import log
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.inference.likelihood import Landscape, Peak
from lcopa_bayes.results.fit import Fit

_CLIMBED = 4
"""Draws the maximum is sought from."""


@final
@dataclass(frozen=True, eq=False)
class Criteria:
    """AIC and BIC, for those who want them: they know neither priors nor ridges."""

    values: Vector
    """Table values at the maximum, (rows,)."""
    log_likelihood: float
    """Maximum [nat]."""
    parameters: int
    """Free parameters, noise and offsets included [-]."""
    samples: int
    """Observed samples [-]."""

    @property
    def aic(self) -> float:
        """``2 k - 2 log L`` (Akaike 1974) [-]."""
        return 2 * self.parameters - 2 * self.log_likelihood

    @property
    def bic(self) -> float:
        """``k log n - 2 log L`` (Schwarz 1978) [-]; n counts samples as if they were independent."""
        return self.parameters * log(self.samples) - 2 * self.log_likelihood

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(
            {
                "max_log_likelihood": self.log_likelihood,
                "parameters": self.parameters,
                "samples": self.samples,
                "aic": self.aic,
                "bic": self.bic,
            }
        )


def criteria(fit: Fit, also: Sequence[Peak] = ()) -> Criteria:
    """From the highest of a few draws, climbed, and maxima `also` known."""
    landscape = Landscape(fit.problem.posterior)
    peak = max([highest(landscape, fit.draws.thinned(200)), *also], key=lambda one: one.log_likelihood)
    return Criteria(peak.values, peak.log_likelihood, len(landscape.free), fit.problem.posterior.size)


def highest(landscape: Landscape, values: Matrix) -> Peak:
    """The highest maximum of the likelihood reached from the best of some table values (n, rows)."""
    heights = landscape.log_likelihood(values)
    best = np.argsort(-heights)[:_CLIMBED]
    peaks = [landscape.maximise(values[k]) for k in best]
    return max([Peak(values[best[0]], float(heights[best[0]])), *peaks], key=lambda one: one.log_likelihood)
