"""Ensembles that begin around optima: the right distribution, a bounded number of steps, and said so."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import problem, record

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling import sampler
from lcopa_bayes.sampling.chainfile import Chain, load_chain, save_chain
from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.run import Run, SamplePlan
from lcopa_bayes.sampling.sampler import sample
from lcopa_bayes.sampling.tempering import surroundings, temper

POSTERIOR = problem(record(camera=0.6)).posterior


@cache
def optima() -> tuple[Optimum, ...]:
    return find_optima(POSTERIOR, np.random.default_rng(1), starts=4)


def generator() -> tuple[Any, ...]:
    return tuple(np.random.RandomState(np.random.MT19937(1)).get_state())


def test_after_its_time_the_temperature_rises_at_once():
    """A few walkers survive, and what is returned is a population at the density it says."""
    rng = np.random.default_rng(2)
    late, _ = temper(POSTERIOR, 20, 80, rng, generator(), seconds=0.0)
    patient, _ = temper(POSTERIOR, 20, 80, rng, generator())
    assert late.moves == 20  # one block of five of four times as many walkers
    assert patient.moves > 10 * late.moves
    assert_allclose(late.log_density, POSTERIOR.log_density(late.position))
    assert patient.log_density.mean() > late.log_density.mean()


def test_walkers_in_corners_of_the_prior_have_a_mixture_too():
    """Where they are the chart has no place: nothing is learned of them, and nothing fails."""
    centre = POSTERIOR.coordinates(optima()[0].values[None])
    order = POSTERIOR.sampled.index(POSTERIOR.table.names.index("order_1"))
    centre[:, order] = POSTERIOR.table.rows[POSTERIOR.sampled[order]].sampled_domain[1]
    mixture = learned(POSTERIOR, [np.repeat(centre[None], 30, axis=0)], 1)
    assert np.isfinite(mixture.log_density(np.zeros((1, POSTERIOR.dimension)))).all()


def run(monkeypatch: pytest.MonkeyPatch, target: float, seed: int = 3, **limits: Any) -> Run:
    """Of a posterior that is taken for one that no search can map."""
    monkeypatch.setattr(sampler, "_MAPPED", 0)
    plan = SamplePlan.of(POSTERIOR.dimension, seed=seed, target_ess=target, method="auto", **limits)
    return sample(POSTERIOR, plan, optima=optima())


def sampled(posterior: Posterior, own: Run) -> tuple[Matrix, float]:
    draws = gather(posterior, own)
    return draws.flat[:, posterior.sampled], draws.ess


@pytest.mark.slow
def test_they_agree_with_importance_draws_of_the_whole_prior(monkeypatch):
    """Means to four of their errors, spreads to a tenth: two methods that share the density alone."""
    plan = SamplePlan.of(POSTERIOR.dimension, seed=3, target_ess=1000, method="auto")
    searched = sample(POSTERIOR, plan)
    assert searched.weighted is not None
    around = run(monkeypatch, 300)
    assert around.weighted is None
    assert all(one.near for one in around.ensembles)
    (expected, worth), (found, ess) = sampled(POSTERIOR, searched), sampled(POSTERIOR, around)
    sd = expected.std(axis=0)
    assert (abs(found.mean(axis=0) - expected.mean(axis=0)) < 4 * sd * np.sqrt(1 / worth + 1 / ess)).all()
    np.testing.assert_allclose(found.std(axis=0), sd, rtol=0.1)


def test_they_end_after_so_many_rounds_and_say_what_they_may_miss(monkeypatch):
    monkeypatch.setattr(sampler, "_NEAR_ROUNDS", 2)
    own = run(monkeypatch, 1e9, ensembles=2)
    assert own.ensembles[0].steps == 2 * sampler._ROUND * sampler._NEAR_THIN
    draws = gather(POSTERIOR, own)
    assert draws.grade.level != "reliable"
    (limitation,) = draws.limitations
    assert "began around its least-squares optima" in limitation.reason
    assert 'method = "ensembles"' in limitation.remedy


def test_a_budget_of_time_takes_the_place_of_the_most_rounds(monkeypatch):
    monkeypatch.setattr(sampler, "_NEAR_ROUNDS", 2)
    assert run(monkeypatch, 1e9, seconds=1e9, steps=120, ensembles=2).ensembles[0].steps == 120


def test_a_stored_run_remembers_that_it_began_there(monkeypatch, tmp_path):
    monkeypatch.setattr(sampler, "_NEAR_ROUNDS", 2)
    own, path = run(monkeypatch, 1e9, ensembles=2), tmp_path / "chain.h5"
    save_chain(path, Chain(own.ensembles), "it")
    assert all(one.near for one in load_chain(path, "it").ensembles)


def test_points_about_an_optimum_in_a_corner_of_the_prior_are_inside(rng):
    """Half of every normal distribution lies outside there; all of its mass is folded back."""
    (best, *_) = optima()
    at = POSTERIOR.sampled.index(POSTERIOR.table.at("order", 0, 0))
    values = best.values.copy()
    values[POSTERIOR.sampled[at]] = POSTERIOR.table.rows[POSTERIOR.sampled[at]].domain[1] - 1e-9
    wide = best.covariance * 0.0 + np.diag(np.where(np.arange(POSTERIOR.dimension) == at, 0.01, 1e-8))
    z = surroundings(POSTERIOR, [Optimum(values, wide, best.log_density)], 4000, rng)
    assert np.isfinite(POSTERIOR.log_prior(z)).all()
    depth = POSTERIOR.table.rows[POSTERIOR.sampled[at]].domain[1] - z[:, at]
    assert depth.mean() == pytest.approx(0.1 * np.sqrt(2 / np.pi), rel=0.1)  # half-normal
