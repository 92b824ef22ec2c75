"""Whether numbers of double precision resolve the differences that a posterior is known by."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.units import measured
from lcopa_bayes.inference.posterior import Posterior

LEAST = -1e15
"""Log density of an optimum from which on 64 bits resolve a tenth of a nat [nat]."""


def refuse_unresolved(posterior: Posterior, values: Vector, log_density: float) -> None:
    """InputError where the best optimum of a posterior is so unlikely that rounding decides between plants;
    it names the record and response that table values, (rows,), follow least."""
    if log_density >= LEAST:
        return
    means = [
        [each.mean() if each.size else 0.0 for each in axes] for axes in posterior.pointwise(values[None])
    ]
    r, axis = np.unravel_index(np.argmin(means), np.shape(means))
    distance = np.sqrt(max(-2 * means[r][axis], 0.0))
    own = posterior.samples[r].record.response_axes[axis]
    seen = [one for one in posterior.samples if one.axes[axis].values.size]
    ranges = sorted((float(np.ptp(one.axes[axis].values)), one.record.name) for one in seen)
    least, most = (
        f"{measured(value, own.unit)} in record {name!r}" for value, name in (ranges[0], ranges[-1])
    )
    raise InputError(
        f"record {posterior.samples[r].record.name!r}: response {own.name!r} is about {distance:.2g} times "
        "the noise away from the plant that follows the records best, too far to calculate with; its range "
        f"is {least} and {most}: give every record the same units, or, if noise in motion is so much larger "
        "than samples at rest show, a wider prior of it under [priors]"
    )
