"""Descents from several starts at once, against scipy's from one at a time."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import TWO, problem, record

from lcopa_bayes.inference import plantdescents
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import nearly_white
from lcopa_bayes.inference.plantdescents import PlantDescents
from lcopa_bayes.inference.posterior import Posterior

SHORT = record(camera=0.6)
NOISE = {"sigma": 0.01}
CASES = {
    "one path": {"terms": 2, "priors": NOISE},
    "a gain on a log scale": {
        "priors": {"gain": ("loguniform", {"a": 0.1, "b": 9.0}), "offset": 0.3, **NOISE}
    },
    "a normal prior that pulls": {
        "priors": {"delay": ("norm", {"loc": 0.9, "scale": 0.02}), **NOISE},
    },
    "fixed orders": {"terms": 2, "orders": (1.0, 0.5), "priors": NOISE},
    "correlated noise": {"noise": "ar1", "priors": {"rho": 0.5, **NOISE}},
}


def small(name: str) -> Posterior:
    return problem(SHORT, **CASES[name]).posterior


def starts(posterior: Posterior, count: int) -> np.ndarray:
    drawn = posterior.table.draw(200, np.random.default_rng(3))
    best = np.argsort(-posterior.log_likelihood(drawn), kind="stable")[:count]
    return posterior.complete(posterior.coordinates(drawn[best]), None)


def squares(posterior: Posterior, values: np.ndarray) -> np.ndarray:
    """Half the sums of squares, gains and offsets at their best [nat]."""
    problem_ = LeastSquares(posterior)
    values = posterior.complete(posterior.coordinates(values), None)
    residuals = [problem_.residual(problem_.coordinates(one), one)[0] for one in values]
    return np.array([0.5 * one @ one for one in residuals])


@pytest.mark.parametrize("name", CASES)
def test_descents_end_where_those_of_scipy_do(name):
    posterior = small(name)
    begun = starts(posterior, 5)
    alone = [LeastSquares(posterior).solve(one, evaluations=400, enough=1e-12)[0] for one in begun]
    together = PlantDescents(posterior).solve(begun, steps=200, enough=1e-6)
    least = squares(posterior, np.array(alone)).min()
    reached = squares(posterior, together)
    # the normalisation of what is eliminated counts too, and moves the optimum by a fraction of a nat
    assert reached.min() == pytest.approx(least, abs=0.2)
    assert (reached <= squares(posterior, begun) + 0.2).all()
    near = together[reached < reached.min() + 40]
    further = [LeastSquares(posterior).solve(one, evaluations=400, enough=1e-12)[0] for one in near]
    assert_allclose(squares(posterior, near), squares(posterior, np.array(further)), atol=0.2)


def test_student_noise_ends_at_its_likeliest_plant():
    posterior = problem(SHORT, noise="student", priors={"sigma": 0.05, "nu": 4.0}).posterior
    reached = PlantDescents(posterior).solve(starts(posterior, 3), steps=200, enough=1e-7)
    best = reached[posterior.log_likelihood(reached).argmax()]
    level = posterior.log_likelihood(best[None])[0]
    for k in posterior.sampled:
        for step in (-0.02, 0.02):
            moved = best.copy()
            moved[k] += step * abs(best[k])
            assert posterior.log_likelihood(moved[None])[0] < level


def test_a_start_ends_in_a_batch_where_it_ends_alone():
    posterior = problem(record(device=TWO, camera=0.5), share="all", terms=2).posterior
    begun = nearly_white(posterior, starts(posterior, 4))
    together = PlantDescents(posterior).solve(begun, steps=3, enough=1e-3)
    for one, end in zip(begun, together, strict=True):
        assert_allclose(PlantDescents(posterior).solve(one[None], steps=3, enough=1e-3)[0], end, rtol=1e-6)


def test_values_stay_inside_the_support():
    priors = {
        "delay": ("uniform", {"loc": 0.0, "scale": 0.2}),
        "gain": ("loguniform", {"a": 0.1, "b": 0.5}),
        **NOISE,
    }
    posterior = problem(SHORT, priors=priors).posterior
    reached = PlantDescents(posterior).solve(starts(posterior, 3), steps=50, enough=1e-6)
    assert np.isfinite(posterior.log_prior(posterior.coordinates(reached))).all()
    # the device is later and larger than these allow
    delay, gain = (posterior.table.of_kind(kind)[0] for kind in ("delay", "gain"))
    assert_allclose(reached[:, gain], 0.5, rtol=1e-3)
    assert (reached[:, delay] < 0.2).all()


def test_a_start_that_cannot_come_near_the_best_costs_little(monkeypatch):
    """The others end where they end alone, and that one stays as far below."""
    posterior, sizes, whole = small("one path"), [], plantdescents.expanded
    monkeypatch.setattr(
        plantdescents, "expanded", lambda of, at, k: sizes.append(len(at)) or whole(of, at, k)
    )
    drawn = posterior.table.draw(40, np.random.default_rng(3))
    begun = posterior.complete(posterior.coordinates(drawn), None)
    together = PlantDescents(posterior).solve(begun, steps=40, enough=1e-5)
    used = sum(sizes)
    alone = np.array([PlantDescents(posterior).solve(one[None], steps=40, enough=1e-5)[0] for one in begun])
    level, own = posterior.log_likelihood(together), posterior.log_likelihood(alone)
    near = own > own.max() - 50.0
    assert 3 < near.sum() < 37
    assert_allclose(level[near], own[near], rtol=1e-6)
    assert (level[~near] < level.max() - 50.0).all()
    assert used < 0.9 * (sum(sizes) - used)
