"""The prior's part in an evidence: what it would be under priors half and twice as wide."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from math import exp, log, sqrt
from typing import Any, Literal, final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.estimate import plain
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.results.fit import Fit
from lcopa_bayes.sampling.bridge import transferred
from lcopa_bayes.sampling.evidence import evidence
from lcopa_bayes.sampling.importanceweights import FEWEST_EFFECTIVE, smoothed, usable_k

FACTORS = (0.5, 2.0)
"""Widths tried, relative to the study's [-]."""
_WIDENED = frozenset({"gain", "time", "delay"})
"""Kinds whose priors are changed: orders and correlations have the ends of their domain, and offset and
noise scale are alike in all candidates."""


@final
@dataclass(frozen=True)
class Width:
    """Log evidence under other priors."""

    factor: float
    """Width of the priors relative to the study's [-]."""
    log_evidence: float | None
    """[nat]; None when it could not be had."""
    sd: float | None
    """Standard error [nat]."""
    method: Literal["importance weights", "refit", "undefined"]
    ess: float
    """Effective number of draws behind it [-]."""
    pareto_k: float
    """Of the importance weights [-]; NaN when all weights in use are equal or none were tried."""
    parameters: tuple[str, ...]
    """Whose priors changed."""

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(asdict(self))


def widths(fit: Fit) -> tuple[Width, ...]:
    """Log evidence under priors half and twice as wide, about the same centre on their own scale; times are
    widened upwards alone.

    ``Z' / Z = E[p'(theta) / p(theta)]`` over the draws where the new support lies inside the old one and
    the weights are usable; else walkers are moved to the new posterior and bridged anew (`evidence`).
    Empty when the fit has no evidence.
    """
    if fit.evidence is None:
        return ()
    return tuple(_width(fit, factor) for factor in FACTORS)


def _width(fit: Fit, factor: float) -> Width:
    posterior, weighed = fit.near, fit.evidence
    assert weighed is not None
    rows = tuple(_scaled(row, factor) for row in posterior.table.rows)
    changed = [
        (k, new)
        for k, (old, new) in enumerate(zip(posterior.table.rows, rows, strict=True))
        if new is not old
    ]
    names = tuple(new.name for _, new in changed)
    if not changed:
        return Width(factor, weighed.value, weighed.sd, "importance weights", fit.draws.ess, np.nan, ())
    flat = fit.draws.flat
    with np.errstate(invalid="ignore"):
        ratio = np.sum(
            [new.log_prior(flat[:, k]) - posterior.table.rows[k].log_prior(flat[:, k]) for k, new in changed],
            axis=0,
        )
    share = float(np.isfinite(ratio).mean())
    inside = all(_contains(posterior.table.rows[k], new) for k, new in changed)
    if inside and share > 0:
        k_hat = smoothed(ratio[np.isfinite(ratio)])[1]
        mean = float(logsumexp(ratio) - log(ratio.size))
        ess = float(np.exp(2 * logsumexp(ratio) - logsumexp(2 * ratio))) * fit.draws.ess / ratio.size
        if (np.isnan(k_hat) or k_hat <= usable_k(ratio.size)) and ess >= FEWEST_EFFECTIVE:
            weights = np.exp(ratio - mean)
            error = sqrt(float(np.var(weights)) / fit.draws.ess)
            sd = float(np.hypot(weighed.sd, error))
            return Width(factor, weighed.value + mean, sd, "importance weights", ess, k_hat, names)
    else:
        k_hat = np.nan
    target = replace(posterior, table=replace(posterior.table, rows=rows))
    undefined = Width(factor, None, None, "undefined", 0.0, k_hat, names)
    return _refit(target, fit, undefined)


def _refit(target: Posterior, fit: Fit, undefined: Width) -> Width:
    """From walkers moved to the new posterior: all draws that the new priors allow take part; `undefined`
    where those of an ensemble allow none, or where ensembles end too far apart."""
    coordinates = fit.run.kept()[0]
    shape = coordinates.shape
    allowed = np.isfinite(target.log_density(coordinates[:, :, -1].reshape(-1, shape[-1])))
    if not allowed.reshape(shape[:2]).any(axis=1).all():
        return undefined
    seed = fit.run.plan.seed + round(9_000 * undefined.factor)
    result = transferred(fit.near, target, coordinates[:, :, -1], seed, jump=True)
    again = result.evidence or evidence(target, result.coordinates, result.ess, seed)
    if again is None:
        return undefined
    return replace(undefined, log_evidence=again.value, sd=again.sd, method="refit", ess=result.ess)


def _contains(old: Parameter, new: Parameter) -> bool:
    return old.domain[0] <= new.domain[0] and new.domain[1] <= old.domain[1]


def _scaled(row: Parameter, factor: float) -> Parameter:
    """The parameter with a prior `factor` times as wide; itself where its prior stays."""
    if row.prior is None or row.kind not in _WIDENED:
        return row
    values = dict(row.prior.parameters)
    if row.prior.dist == "loguniform":
        ends, extra = (log(values["a"]), log(values["b"])), (factor - 1) * log(values["b"] / values["a"])
        # the lower end of a time is what sampling resolves: below it the model is not computed well
        low, high = (0.0, extra) if factor > 1 and row.kind == "time" else (-0.5 * extra, 0.5 * extra)
        values |= {"a": exp(ends[0] + low), "b": exp(ends[1] + high)}
    elif row.prior.dist == "lognorm":
        values["s"] *= factor
    else:
        low, high = row.prior.support
        begins = low == 0.0 if row.kind == "delay" else np.isfinite(low) and np.isinf(high)
        held = low if begins else float(row.prior.frozen.median())
        values |= {
            "loc": held + factor * (values.get("loc", 0.0) - held),
            "scale": values.get("scale", 1.0) * factor,
        }
    return replace(row, prior=Prior(row.prior.dist, values))
