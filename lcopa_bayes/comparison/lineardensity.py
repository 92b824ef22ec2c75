"""Sequential densities with gains and levels integrated out exactly, sample by sample.

Given orders, times, delays and the noise, a record is linear in gains and levels: what is known of them from
other records is a normal law, and every sample of the predicted record sharpens it before the next is
predicted (recursive least squares). So a gain that only the predicted record determines costs a few nats,
as many as its prior is wide, and no draw of it has to come near.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lcopa_bayes.comparison.folds import Part
from lcopa_bayes.core.arrays import Array, Matrix
from lcopa_bayes.inference.noise import LOG_2PI, GaussianNoise
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.forward import ForwardModel


def applies(posterior: Posterior) -> bool:
    """Whether some parameter is linear, so that it can be integrated out."""
    return isinstance(posterior.noise, GaussianNoise) and bool(posterior.linear)


def linear_densities(
    known: Posterior, part: Part, samples: Samples, model: ForwardModel, values: Matrix, axis: int, first: int
) -> Matrix:
    """Log density of each predicted sample of an axis given all before it, (draws, predicted) [nat].

    `known` is the posterior without what is predicted; of `values` (draws, rows) linear parameters do not
    count. `model` simulates the record of `samples` alone; `first` is the first sample predicted. A level
    that no known record shares has the prior of the others'.
    """
    noise = known.noise
    assert isinstance(noise, GaussianNoise)
    observed = samples.axes[axis]
    last = int(np.count_nonzero(observed.index < part.until))
    units = known.responses(values)
    equations, _, _ = known.equations(axis, values, units)
    stacked, extra = _columns(known, part, samples, model, values, axis)
    white, _ = noise.whiten(stacked[..., :last], known.noise_parameters(values, axis), observed.gaps[:last])
    scales = np.broadcast_to(
        noise.log_scales(known.noise_parameters(values, axis), observed.gaps[:last]), (len(values), last)
    )
    size = equations.gram.shape[1]
    covariance = np.tile(np.eye(size + extra), (len(values), 1, 1))
    covariance[:, :size, :size] = np.linalg.inv(equations.gram)
    mean = np.zeros((len(values), size + extra))
    mean[:, :size] = equations.mean()
    out = np.full((len(values), last), np.nan)
    for k in range(first if part.known else 0, last):  # what is known of the record is in the equations
        slope = white[:, :-1, k]
        bent = np.einsum("bij,bj->bi", covariance, slope)
        variance = 1 + np.einsum("bi,bi->b", slope, bent)
        apart = white[:, -1, k] - np.einsum("bi,bi->b", slope, mean)
        out[:, k] = -0.5 * (apart**2 / variance + np.log(variance) + LOG_2PI) - scales[:, k]
        mean = mean + bent * (apart / variance)[:, None]
        covariance = covariance - bent[:, :, None] * (bent / variance[:, None])[:, None, :]
    return out[:, first:]


def _columns(
    known: Posterior, part: Part, samples: Samples, model: ForwardModel, values: Matrix, axis: int
) -> tuple[Array, int]:
    """What a prior standard deviation of every linear parameter adds to the record, and last what it leaves
    at their prior means, (draws, parameters + 1, n); and how many columns are no parameter of `known`."""
    r, posterior = part.record, known
    if part.kind == "held-out record":
        r = len(known.samples)
        posterior = replace(known, model=known.model.joined(model), samples=(*known.samples, samples))
    observed = samples.axes[axis]
    units = replace(posterior, model=model).responses(values)[0]
    mean, sd = known.scaled[axis]
    block = known.blocks[axis]
    centre = values.copy()
    centre[:, block] = mean
    acting = [posterior.column(k, axis, r, observed, units) for k in block]
    shape = (len(values), observed.values.size)
    columns = [
        np.zeros(shape) if column is None else np.broadcast_to(sd[p] * column, shape)
        for p, column in enumerate(acting)
    ]
    left = posterior.residual(axis, r, observed, centre, units)
    level = _level(known, part, axis)
    if level is not None:
        columns.append(np.full(shape, level[1]))
        left = left - level[0]
    return np.stack([*columns, left], axis=1), int(level is not None)


def _level(known: Posterior, part: Part, axis: int) -> tuple[float, float] | None:
    """Mean and standard deviation of the level of a held-out record; None where the model gives it none of
    its own."""
    rows = [known.table.rows[k] for k in known.table.of_kind("offset")]
    own = [row for row in rows if row.place.first == axis and row.place.second >= 0]
    if part.kind != "held-out record" or not own:
        return None
    prior = next((row.prior for row in own if row.prior is not None), None)
    if prior is None:  # every level is fixed: that of another record tells nothing
        return 0.0, float(np.ptp(known.samples[0].axes[axis].values)) * 10 or 1.0
    return float(prior.frozen.mean()), float(prior.frozen.std())
