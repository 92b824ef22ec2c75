"""Weights of candidates, by evidence and by prediction."""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.arrays import Matrix, Vector

_ROUNDS = 2_000
_SETTLED = 1e-10
_SIMULATED = 4_000


def stacking_weights(log_density: Matrix) -> Vector:
    """Weights of the mixture of candidates that predicts best, (candidates,) [-].

    ``max_w sum_i log sum_k w_k p_k(y_i)`` (Yao et al. 2018, Bayesian Analysis 13), a concave problem, by
    expectation maximisation. `log_density` is (samples, candidates).
    """
    weights = np.full(log_density.shape[1], 1.0 / log_density.shape[1])
    before = -np.inf
    for _ in range(_ROUNDS):
        with np.errstate(divide="ignore"):
            joint = log_density + np.log(weights)
        total = logsumexp(joint, axis=1)
        weights = np.exp(joint - total[:, None]).mean(axis=0)
        if total.sum() - before < _SETTLED * abs(total.sum()):
            break
        before = float(total.sum())
    return np.asarray(weights / weights.sum())


def probabilities(log_evidence: Vector, sd: Vector, rng: np.random.Generator) -> tuple[Vector, Vector]:
    """Posterior probabilities of candidates that were equally likely before, and their Monte Carlo error.

    Both (candidates,) [-]; the error is the spread when log evidences err normally by `sd` [nat].
    """
    weights = np.exp(log_evidence - logsumexp(log_evidence))
    drawn = log_evidence + sd * rng.standard_normal((_SIMULATED, log_evidence.size))
    spread = np.exp(drawn - logsumexp(drawn, axis=1, keepdims=True)).std(axis=0)
    return np.asarray(weights), np.asarray(spread)
