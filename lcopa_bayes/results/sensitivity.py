"""How far the posterior follows the prior, and how far the likelihood, by power scaling."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal, final

import numpy as np
from arviz_stats.base import array_stats  # type: ignore[attr-defined]

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.convergence import Level
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.sampling.importanceweights import smoothed, usable_k

Diagnosis = Literal["prior-data conflict", "weak likelihood: the prior decides", "-", "not trusted"]

THRESHOLD = 0.05
"""Sensitivity from which it counts [-] (Kallioinen et al. 2024): of 2000 draws of a normal posterior, a
shift of the mean by about a quarter of a standard deviation per doubling of the power."""
ALPHAS = (0.99, 1.01)
"""Powers at which the posterior is compared with itself [-]."""
_STRETCHES = 10
"""Parts of all draws, about as many, that are left out in turn for the Monte Carlo error: it is then known to
a quarter."""
_FEWEST = 50
"""Draws without which there is no tail to fit."""
_MOST = 2000
"""Draws that are scaled: of more every k-th is, for resampled ones say little that others do not."""
_RANK: dict[Diagnosis, int] = {
    "prior-data conflict": 0,
    "weak likelihood: the prior decides": 0,
    "-": 1,
    "not trusted": 2,
}


@final
@dataclass(frozen=True)
class Sensitivity:
    """How fast one parameter's posterior moves with the power of the prior and of the likelihood."""

    parameter: str
    prior: float
    """Sensitivity to the prior of all free parameters [-]; NaN when not trusted."""
    prior_mcse: float
    """Its Monte Carlo standard error [-]."""
    likelihood: float
    """Sensitivity to the likelihood of all records [-]; NaN when not trusted."""
    likelihood_mcse: float
    """Its Monte Carlo standard error [-]."""
    prior_k: float
    """Larger Pareto k of the two sets of weights that scale the prior [-]; NaN when they are bounded."""
    likelihood_k: float
    """The same for the likelihood [-]."""
    grade: Level
    """Grade of the parameter's draws."""
    diagnosis: Diagnosis
    note: str
    """What limits the diagnosis; empty when nothing does."""

    def as_json(self) -> dict[str, Any]:
        """Plain values; what is not trusted is None."""
        return plain(asdict(self) | {"threshold": THRESHOLD})


def sensitivity(draws: Draws, posterior: Posterior) -> tuple[Sensitivity, ...]:
    """Sensitivity of every free parameter, the most affected by the prior first.

    The joint prior density of all free parameters and the full likelihood are raised to powers near 1.
    Densities and distances are taken on the scale on which a parameter is sampled: per natural logarithm
    of time constants and noise scales, so that a log-uniform prior is flat and not ``1/x`` over decades.
    Source: Kallioinen, Paananen, Buerkner and Vehtari 2024, Statistics and Computing 34, 57.
    """
    rows = [(k, row) for k, row in enumerate(posterior.table.rows) if row.free]
    values = draws.values[:, :: max(1, round(draws.log_density.size / _MOST))]
    shape, flat = values.shape[:2], values.reshape(-1, values.shape[2])
    log_prior = np.sum([row.log_density(row.coordinate(flat[:, k])) for k, row in rows], axis=0)
    log_likelihood = posterior.joint_log_likelihood(flat)
    scaled = [row.coordinate(values[..., k]) for k, row in rows]
    grades = {estimate.name: estimate.grade for estimate in draws.estimates()}
    names = [row.name for _, row in rows]
    return power_scaled(
        names,
        np.stack(scaled, axis=-1),
        log_prior.reshape(shape),
        log_likelihood.reshape(shape),
        [grades[name] for name in names],  # type: ignore[misc]
    )


def power_scaled(
    names: Sequence[str], values: Array, log_prior: Matrix, log_likelihood: Matrix, grades: Sequence[Level]
) -> tuple[Sensitivity, ...]:
    """Sensitivities from draws (ensembles, draws, parameters) and log densities (ensembles, draws) [nat].

    A sensitivity is the derivative of the cumulative Jensen-Shannon distance between the posterior and
    its power-scaled self with respect to the base-2 logarithm of the power, by importance weights.
    Accuracy: the Monte Carlo errors returned, from leaving out a stretch of an ensemble at a time; a
    distance is never negative, so near 0 it is too large by about its error.
    """
    prior, likelihood = (_scale(values, density) for density in (log_prior, log_likelihood))
    limit = usable_k(log_prior.size)
    out = []
    for k, (name, grade) in enumerate(zip(names, grades, strict=True)):
        (a, a_error), (b, b_error) = ((side.value[k], side.error[k]) for side in (prior, likelihood))
        bad = [
            f"the weights that scale the {word} have a Pareto k of {side.k:.2f}, above {limit:.2f}"
            if side.k > limit
            else f"{log_prior.size} draws are too few to scale the {word}"
            for word, side in (("prior", prior), ("likelihood", likelihood))
            if side.k > limit or np.isnan(side.value[k])
        ]
        note = (
            f"{'; '.join(bad)}: sample more steps" if bad else _note(a, a_error, b, b_error, flat=prior.flat)
        )
        said: Diagnosis = "not trusted" if bad else _diagnosis(a, b)
        a, a_error, b, b_error = np.full(4, np.nan) if bad else (a, a_error, b, b_error)
        out.append(
            Sensitivity(
                name,
                prior=float(a),
                prior_mcse=float(a_error),
                likelihood=float(b),
                likelihood_mcse=float(b_error),
                prior_k=prior.k,
                likelihood_k=likelihood.k,
                grade=grade,
                diagnosis=said,
                note=note,
            )
        )
    return tuple(sorted(out, key=lambda each: (_RANK[each.diagnosis], -np.nan_to_num(each.prior))))


def _diagnosis(prior: float, likelihood: float) -> Diagnosis:
    if prior < THRESHOLD:
        return "-"
    return "prior-data conflict" if likelihood >= THRESHOLD else "weak likelihood: the prior decides"


def _note(prior: float, prior_error: float, likelihood: float, likelihood_error: float, flat: bool) -> str:
    """What a reader must know beside the diagnosis."""
    words = [
        f"the {word}'s is within two Monte Carlo errors of {THRESHOLD:g}"
        for word, value, error in (
            ("prior", prior, prior_error),
            ("likelihood", likelihood, likelihood_error),
        )
        if abs(value - THRESHOLD) < 2 * error
    ]
    if prior < THRESHOLD and likelihood < THRESHOLD:
        words.append("neither prior density nor data move it: only the bounds of the priors remain")
    elif flat:
        words.append("a flat prior has no power to scale: what its bounds do is not seen")
    return "; ".join(words)


@final
@dataclass(frozen=True, eq=False)
class _Scale:
    """Sensitivity of all parameters to one density."""

    value: Vector
    """(parameters,) [-]."""
    error: Vector
    """Monte Carlo standard errors, (parameters,) [-]."""
    k: float
    """Largest Pareto k [-]; NaN when the weights are bounded by many equal ones."""
    flat: bool
    """Whether the density is the same for all draws, so that nothing can move."""


def _scale(values: Array, log_density: Matrix) -> _Scale:
    """Sensitivity to one density, with what leaving out stretches of draws makes of it."""
    count = values.shape[-1]
    if log_density.size < _FEWEST:
        return _Scale(np.full(count, np.nan), np.full(count, np.nan), np.nan, flat=False)
    centred = log_density - log_density.max()
    if np.ptp(centred) <= 1e-9 * max(1.0, float(np.abs(log_density).max())):
        return _Scale(np.zeros(count), np.zeros(count), np.nan, flat=True)
    weights, k = zip(*(_weights(centred, alpha) for alpha in ALPHAS), strict=True)
    whole = _distances(values, *weights)
    ensembles, draws = log_density.shape
    parts = np.array_split(np.arange(draws), -(-_STRETCHES // ensembles))
    stretches = [(e, part) for e in range(ensembles) for part in parts]
    without = []
    for e, part in stretches:
        keep = np.ones(log_density.shape, dtype=bool)
        keep[e, part] = False
        without.append(_distances(values[keep][None], *(w[keep][None] for w in weights)))
    spread = np.var(without, axis=0) * (len(without) - 1)  # jackknife: (n - 1) / n times the sum of squares
    finite = [one for one in k if np.isfinite(one)]
    return _Scale(whole, np.sqrt(spread), max(finite, default=np.nan), flat=False)


def _weights(log_density: Matrix, alpha: float) -> tuple[Matrix, float]:
    """Normalised weights that raise a density to the power alpha, smoothed, and their Pareto k."""
    r_eff = float(array_stats.ess(log_density, method="tail", prob=(0.05, 0.95), relative=True))  # type: ignore[no-untyped-call]
    log_weights, k = smoothed((alpha - 1) * log_density.ravel(), r_eff=r_eff)
    if np.isnan(k):  # many equal largest weights, as of a density with a plateau
        return np.exp(log_weights).reshape(log_density.shape), k
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):  # no finite tail: k is far above 1
        log_scaled = array_stats.power_scale_lw(log_density, alpha=alpha, axis=(0, 1))  # type: ignore[no-untyped-call]
    weights = np.exp(log_scaled if np.isfinite(log_scaled).all() else log_weights.reshape(log_density.shape))
    return weights / weights.sum(), k


def _distances(values: Array, lower: Matrix, upper: Matrix) -> Vector:
    """Sensitivity of each parameter given the weights at both powers, (parameters,); NaN of one that has
    not moved."""
    moved = np.ptp(values, axis=(0, 1)) > 0
    return np.array(
        [
            float(
                array_stats.power_scale_sense(  # type: ignore[no-untyped-call]
                    values[..., k], lower, upper, lower_alpha=ALPHAS[0], upper_alpha=ALPHAS[1]
                )
            )
            if moved[k]
            else np.nan
            for k in range(values.shape[-1])
        ]
    )
