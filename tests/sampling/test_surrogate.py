"""The surrogate of a posterior with effects: near its optimum it is the posterior."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import logsumexp
from small import record, study, with_effect

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import Optimum, find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.inference.surrogate import Surrogate
from lcopa_bayes.results.fit import plan_of
from lcopa_bayes.sampling import weightedrun
from lcopa_bayes.sampling.importance import _PORTION, Effort, ImportancePlan, importance
from lcopa_bayes.sampling.importanceweights import LARGEST_K, effective
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.weighted import BATCHES, Weighted, tail_smoothed
from lcopa_bayes.sampling.weightedrun import weighted_run

TRUTH = {
    "gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02, "coefficient": 0.4,
}  # fmt: skip


@pytest.fixture(scope="module")
def stiff() -> tuple[Posterior, Optimum]:
    commands = [staircase([a, -0.7 * a, 0.4 * a, 0.0], hold=3.0, start=0.55) for a in (1.0, 0.5)]
    made = [record(k, command=c, camera=0.2, duration=15.0, name=f"r{k}") for k, c in enumerate(commands)]
    stated, _ = with_effect(study(*made, noise="white", seed=4), ["cubic_stiffness"], TRUTH)
    posterior = problem_of(stated).posterior
    return posterior, find_optima(posterior, np.random.default_rng(1), starts=2)[0]


def test_it_is_exact_for_a_response_that_is_quadratic(stiff: tuple[Posterior, Optimum]):
    """Responses replaced by squares of one coordinate come back to rounding."""
    posterior, optimum = stiff

    def bent(values: np.ndarray) -> list:
        reported = posterior.simulation(values[:1])  # type: ignore[misc]
        z = posterior.coordinates(values)[:, 1]
        level = 0.3 + 0.2 * z - 0.1 * z**2
        return [
            one._replace(
                base=np.broadcast_to(level[:, None], (1, z.size, one.base.shape[2])).copy(),
                bounded=np.ones(z.size, dtype=bool),
            )
            for one in reported
        ]

    made = Surrogate.of(replace(posterior, surrogate=bent), optimum, np.random.default_rng(2))
    assert made is not None
    values = posterior.values(posterior.coordinates(optimum.values[None]) + 0.01)
    assert_allclose(made(values)[0].base, bent(values)[0].base, rtol=1e-9)


def test_near_the_optimum_it_has_the_density_of_the_posterior(stiff: tuple[Posterior, Optimum]):
    posterior, optimum = stiff
    made = Surrogate.of(posterior, optimum, np.random.default_rng(2))
    near = replace(posterior, surrogate=made)
    rng = np.random.default_rng(3)
    z = rng.multivariate_normal(posterior.coordinates(optimum.values[None])[0], optimum.covariance, size=200)
    exact = posterior.log_density(z)
    inside = np.isfinite(exact)
    apart = (near.log_density(z) - exact)[inside]
    assert inside.mean() > 0.8
    assert np.std(exact[inside]) > 1.0  # what is approximated varies much more
    assert np.std(apart) < 0.3


@pytest.mark.slow
def test_weights_make_up_for_a_surrogate_that_is_wrong(stiff: tuple[Posterior, Optimum], monkeypatch):
    """Evidence and stiffness by weighted draws of a surrogate, and by those of the posterior itself."""
    posterior, _ = stiff
    plan = SamplePlan.of(posterior.dimension, seed=3, target_ess=400)
    first = weighted_run(posterior, plan, quick=True)
    monkeypatch.setattr(weightedrun.Surrogate, "of", lambda *given: None)
    other = weighted_run(posterior, plan, quick=True)
    assert first is not None
    assert other is not None
    weighted = [run.weighted for run, _ in (first, other)]
    evidence = [one.log_evidence for one in weighted]
    errors = np.hypot(*(one.log_evidence_sd for one in weighted))
    assert abs(evidence[0] - evidence[1]) < 4 * errors + 1e-3
    columns = [draws.column("cubic_stiffness.c") for _, draws in (first, other)]
    error = np.hypot(
        *(one.std() / np.sqrt(draws.ess) for one, (_, draws) in zip(columns, (first, other), strict=True))
    )
    assert abs(columns[0].mean() - columns[1].mean()) < 4 * error
    assert columns[0].std() == pytest.approx(columns[1].std(), rel=0.15)


@pytest.fixture(scope="module")
def weighted(stiff: tuple[Posterior, Optimum]) -> tuple[Posterior, Weighted]:
    """A surrogate's posterior and weighted draws of it."""
    posterior, optimum = stiff
    near = replace(posterior, surrogate=Surrogate.of(posterior, optimum, np.random.default_rng(2)))
    return near, importance(near, [optimum], np.random.default_rng(3)).weighted


def test_walkers_end_as_soon_as_they_agree(weighted: tuple[Posterior, Weighted], monkeypatch):
    """Walks to a number of effective draws that the scatter of four ensembles hardly ever shows took all
    rounds: ten times what the weights cost."""
    rounds = []
    advanced = weightedrun._advanced
    monkeypatch.setattr(weightedrun, "_advanced", lambda task: rounds.append(1) or advanced(task))
    near, first = weighted
    walk = weightedrun._walked(near, first, np.random.default_rng(5), map, lambda: False)
    assert walk.agree
    assert len(rounds) <= 3 * BATCHES
    assert walk.moved < weightedrun._MOVED
    # the walkers' mean is that of the weights, by the errors of both
    mean, sd = np.exp(first.log_weights) @ first.coordinates, walk.chain.std(axis=(0, 1, 2))
    error = sd * np.sqrt(1 / walk.worth + 1 / first.centre_ess)
    assert np.all(np.abs(walk.chain.mean(axis=(0, 1, 2)) - mean) < 4 * error)


@pytest.fixture(scope="module")
def missing(weighted: tuple[Posterior, Weighted]) -> Weighted:
    """Weights that leave out half of the posterior."""
    _, first = weighted
    column = first.coordinates[:, 1]
    lower = column < np.exp(first.log_weights) @ column
    log_weights = np.where(lower, first.log_weights, -40.0)
    return replace(first, log_weights=log_weights - logsumexp(log_weights))


def test_walkers_leave_weights_that_miss_a_part(weighted: tuple[Posterior, Weighted], missing: Weighted):
    near, first = weighted
    column, whole = first.coordinates[:, 1], np.exp(first.log_weights)
    mean = whole @ column
    walk = weightedrun._walked(near, missing, np.random.default_rng(5), map, lambda: False)
    assert walk.moved > weightedrun._MOVED
    z, about = walk.draws(400, np.random.default_rng(6))
    assert len(z) >= 300
    assert_allclose(about, near.log_density(z))
    sd = np.sqrt(whole @ (column - mean) ** 2)
    assert abs(z[:, 1].mean() - mean) < 4 * sd / np.sqrt(0.9 * len(z))


def test_walkers_end_with_the_time_for_them(weighted: tuple[Posterior, Weighted], missing: Weighted):
    """A loop's draws of at most 75 s took 530 s; on their way ensembles that set out together may agree."""
    near, _ = weighted
    rounds: list[int] = []

    def mapped(function: Callable[..., object], tasks: Sequence[object]) -> Iterator[object]:
        rounds.append(len(tasks))
        return map(function, tasks)

    walk = weightedrun._walked(near, missing, np.random.default_rng(5), mapped, lambda: len(rounds) == 1)
    assert rounds == [BATCHES]
    assert not walk.agree


def test_draws_of_a_walk_count_as_the_independent_ones_they_are_taken_for(rng: np.random.Generator):
    """Of AR(1) walkers: the variance of a mean of as many draws as are taken, over that of independent ones.

    Draws chosen at random, as many as the chain is worth, have twice that.
    """
    correlation, walkers, count, repeats = 0.9, 16, 120, 400
    chain = np.empty((4, walkers, count, repeats))
    chain[:, :, 0] = rng.standard_normal((4, walkers, repeats))
    for k in range(1, count):
        fresh = np.sqrt(1 - correlation**2) * rng.standard_normal((4, walkers, repeats))
        chain[:, :, k] = correlation * chain[:, :, k - 1] + fresh
    worth = chain[..., 0].size * (1 - correlation) / (1 + correlation)
    walk = weightedrun._Walk(chain, chain[..., 0], worth, True, 0.0)
    z, about = walk.draws(10_000, rng)
    assert_allclose(about, z[:, 0])
    assert len(z) > 0.6 * worth
    ratio = len(z) * z.mean(axis=0).var()
    assert ratio == pytest.approx(1 / 0.9, abs=4 * np.sqrt(2 / repeats))
    assert len(walk.draws(40, rng)[0]) == 40


def test_the_posterior_itself_is_asked_for_as_much_as_is_wanted(
    stiff: tuple[Posterior, Optimum], monkeypatch
):
    """Beside the points of the surrogate: enough for the draws wanted, not for a fixed number of them."""
    asked, spread = [], weightedrun.spread

    def counted(posterior: Posterior, z: np.ndarray, mapped) -> np.ndarray:
        asked.append(len(z))
        assert posterior.surrogate is None
        return spread(posterior, z, mapped)

    monkeypatch.setattr(weightedrun, "spread", counted)
    posterior, optimum = stiff
    plan = SamplePlan.of(posterior.dimension, seed=3, target_ess=400)
    found = weighted_run(posterior, plan, optima=[optimum])
    assert found is not None
    assert found[1].grade.level == "reliable", found[1].grade.reason
    assert sum(asked) < 5 * plan.target_ess


@pytest.mark.parametrize("rough", [0.0, 0.3])
def test_draws_of_a_surrogate_stand_for_the_posterior_where_their_weights_are_even(
    stiff: tuple[Posterior, Optimum], monkeypatch, rough: float
):
    """A factor on the density moves the evidence alone; ripples of it ask for weights."""
    asked, spread, higher = [], weightedrun.spread, 0.0

    def rippled(posterior: Posterior, z: np.ndarray, mapped) -> np.ndarray:
        asked.append(len(z))
        return spread(posterior, z, mapped) + higher + rough * np.sin(1e3 * z[:, 0])

    monkeypatch.setattr(weightedrun, "spread", rippled)
    posterior, optimum = stiff
    plan = SamplePlan.of(posterior.dimension, seed=3, target_ess=400)
    first = weighted_run(posterior, plan, optima=[optimum])
    once, higher = list(asked), 0.5
    second = weighted_run(posterior, plan, optima=[optimum])
    assert first is not None
    assert second is not None
    assert (once == [weightedrun._TRIED]) == (rough == 0.0)
    runs = [run.weighted for run, _ in (first, second)]
    assert runs[1].log_evidence - runs[0].log_evidence == pytest.approx(0.5)
    assert_allclose(runs[1].batch_evidence - runs[0].batch_evidence, 0.5)
    assert_allclose(runs[1].coordinates, runs[0].coordinates)


def test_optima_of_one_mode_have_one_surrogate(stiff: tuple[Posterior, Optimum]):
    """A descent that stopped on its way is no mode of its own."""
    posterior, best = stiff

    def moved(by: float) -> Optimum:
        z = posterior.coordinates(best.values[None])
        z[0, 0] += by * np.sqrt(best.covariance[0, 0])
        return replace(best, values=posterior.complete(z, None)[0])

    assert weightedrun._together(posterior, [best, moved(0.5)])
    assert not weightedrun._together(posterior, [best, moved(2.0)])
    plan = SamplePlan.of(posterior.dimension, seed=3, target_ess=400)
    found = weighted_run(posterior, plan, quick=True, optima=[best, moved(0.5)])
    assert found is not None
    assert found[0].surrogate is not None


def test_even_weights_are_used_whatever_their_tail():
    """A surrogate that is right to 0.01 nat but at one draw was discarded by the Pareto k of its weights."""
    rng = np.random.default_rng(1)
    raw = 1e-3 * rng.standard_normal(1000)
    raw[::100] += np.geomspace(0.01, 1.0, 10)
    log_weights, k = tail_smoothed(raw)
    assert k > LARGEST_K
    assert weightedrun.usable(SimpleNamespace(pareto_k=k, ess=effective(log_weights), count=1000))
    few = SimpleNamespace(pareto_k=k, ess=800.0, count=1000)
    assert not weightedrun.usable(few)


def test_a_run_is_reproducible():
    commands = [staircase([1.0, -0.7, 0.4, 0.0], hold=3.0, start=0.55)]
    made = study(record(1, command=commands[0], camera=0.3, duration=15.0), noise="white", seed=4)
    found = problem_of(with_effect(made, ["odd_curvature"], TRUTH | {"coefficient": 0.1})[0])
    plan = plan_of(found, quick=False)
    one, other = (weighted_run(found.posterior, plan, quick=True) for _ in range(2))
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one[1].values, other[1].values)


def test_a_budget_ends_importance_draws(stiff: tuple[Posterior, Optimum]):
    """What was drawn by then is delivered with what it lacks."""
    posterior, optimum = stiff
    plan = SamplePlan.of(posterior.dimension, seed=3, target_ess=1_500)
    whole = weighted_run(posterior, plan, optima=[optimum])
    short = weighted_run(posterior, replace(plan, seconds=1e-9), optima=[optimum])
    assert whole is not None
    assert short is not None
    assert whole[0].stopped_after is None
    assert short[0].stopped_after is not None
    assert 2 * short[1].ess < whole[1].ess
    assert any("budget" in one.reason for one in short[1].limitations)


def test_a_budget_ends_a_round_of_responses_with_effects(stiff: tuple[Posterior, Optimum]):
    """A round of them may take minutes: it is late within the first, and the last proposal has a portion."""
    posterior, optimum = stiff
    plan = ImportancePlan((Effort(2_000, 1_000, 4),))
    asked = []
    short = importance(
        posterior, [optimum], np.random.default_rng(3), plan, late=lambda: len(asked.append(0) or asked) > 1
    )
    assert short is not None
    assert short.evaluations == 3 * _PORTION  # late after the second portion of the first round
    near = replace(posterior, surrogate=Surrogate.of(posterior, optimum, np.random.default_rng(2)))
    cheap = importance(near, [optimum], np.random.default_rng(3), plan, late=lambda: True)
    assert cheap is not None
    assert cheap.evaluations == 2_000  # rounds of a surrogate take no time
