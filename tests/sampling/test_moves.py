"""Every move keeps the prior, whatever population it takes its steps from."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import emcee
import numpy as np
import pytest
from scipy import stats
from small import problem, record

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling import mixturemoves
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.mixturemoves import learned, parts
from lcopa_bayes.sampling.moves import DifferenceMove, PopulationMove
from lcopa_bayes.sampling.ridgemoves import moves

WALKERS, COSTLY, ROUNDS = 8_000, 3_000, 50
"""Of most moves, of those that follow a mixture, and moves of each [-]."""
LONG = 2.5
"""Times as many in the long form, and where an error must show beyond doubt [-]."""
NARROW, WIDE = 0.02, 0.15
"""Spreads of the two orders of the population, as on a ridge [-]."""
GAIN = ("gamma", {"a": 2.0, "scale": 1.0})
"""Neither integrated out nor sampled by its logarithm."""
KINDS = ("MixtureMove", "MixtureWalk", "DifferenceMove", "ShapeMove", "OrderSlide", "OrderRoam", "TermRedraw")


@cache
def posterior() -> Posterior:
    """Two terms with equal priors, sampled in any order."""
    times = {f"time_{k}": ("loguniform", {"a": 0.06, "b": 1165.0}) for k in (1, 2)}
    priors = {"gain": GAIN, "sigma": 0.1, "offset": 0.3, **times}  # stated ones need not be resolved
    return problem(record(camera=0.6), terms=2, priors=priors).posterior


def column(kind: str, first: int, second: int = 0) -> int:
    return posterior().sampled.index(posterior().table.at(kind, first, second))


def drawn(count: int, seed: int) -> Matrix:
    """Coordinates from the prior, terms by decreasing order."""
    return posterior().coordinates(posterior().table.draw(count, np.random.default_rng(seed)))


@cache
def planted() -> Matrix:
    """A population that is narrow in the larger order and wide in the smaller one."""
    population, rng = drawn(600, 1), np.random.default_rng(2)
    population[:, column("order", 0, 0)] = 1.4 + NARROW * rng.standard_normal(600)
    population[:, column("order", 0, 1)] = 0.7 + WIDE * rng.standard_normal(600)
    assert (population[:, column("order", 0, 0)] > population[:, column("order", 0, 1)]).all()
    return population


@cache
def mixture() -> Mixture:
    """Of narrow and wide components: it matters which one a step is taken with."""
    return learned(posterior(), [planted(), drawn(600, 4)], 3)


def made(name: str) -> PopulationMove:
    (found,) = (move for move, _ in moves(posterior(), mixture()) if type(move).__name__ == name)
    return found


def moved(
    move: PopulationMove, monkeypatch: pytest.MonkeyPatch, seed: int, walkers: int = WALKERS
) -> tuple[Matrix, float]:
    """Prior draws after many moves that take their steps from `planted`, and the share accepted."""
    proposal, random = move.proposal, np.random.RandomState(np.random.MT19937(seed))
    monkeypatch.setattr(move, "proposal", lambda here, _, random: proposal(here, planted(), random))
    model = SimpleNamespace(compute_log_prob_fn=lambda z: (posterior().log_prior(z), None), random=random)
    start, accepted = drawn(walkers, seed), 0.0
    state = emcee.State(start, log_prob=posterior().log_prior(start), random_state=random.get_state())
    for _ in range(ROUNDS):
        state, taken = move.propose(model, state)
        accepted += float(taken.mean()) / ROUNDS
    np.testing.assert_allclose(state.log_prob, posterior().log_prior(state.coords), rtol=1e-9, atol=1e-9)
    return move.terrain.sorted(state.coords), accepted


def surprises(coordinates: Matrix) -> dict[str, float]:
    """p-value of each parameter's values against its exact prior."""
    values, out = posterior().values(coordinates), {}
    for k in posterior().sampled:
        row = posterior().table.rows[k]
        assert row.prior is not None
        share = row.prior.frozen.cdf(values[:, k])
        if row.kind == "order":  # the larger and the smaller of two
            share = share**2 if row.place.second == 0 else 1 - (1 - share) ** 2
        out[row.name] = float(stats.kstest(share, "uniform").pvalue)
    return out


def test_all_moves_are_tried():
    assert tuple(type(move).__name__ for move, _ in moves(posterior(), mixture())) == KINDS
    assert sum(often for _, often in moves(posterior(), mixture())) == pytest.approx(1.0)


def test_prior_draws_are_not_surprising():
    assert min(surprises(drawn(WALKERS, 5)).values()) > 1e-3


@pytest.mark.parametrize("name", ["ShapeMove", "OrderSlide", "OrderRoam"])
def test_a_walker_with_two_terms_alike_stays_for_other_moves(name: str):
    """Ratios do not fix its times: the volume that they span is 0, at both ends where a proposal is void."""
    here, others, random = drawn(200, 6), drawn(200, 7), np.random.RandomState(np.random.MT19937(1))
    for kind in ("time", "order"):
        here[:100, column(kind, 0, 1)] = here[:100, column(kind, 0, 0)]
    found = [made(name).proposal(here, others, random)[1] for _ in range(20)]
    assert any(np.isneginf(factor[:100]).any() for factor in found)
    assert not any(np.isnan(factor).any() or np.isposinf(factor).any() for factor in found)
    assert all(np.isfinite(factor[100:]).any() for factor in found)


@pytest.mark.parametrize("name", ["MixtureMove", "MixtureWalk"])
def test_a_walker_at_an_end_of_a_range_has_no_chart(name: str):
    """It stays for other moves; that was a warning of numpy, and ended a comparison in the tests."""
    here = drawn(50, 6)
    at = column("order", 0, 0)
    others, random = drawn(50, 7), np.random.RandomState(np.random.MT19937(1))
    here[3, at] = posterior().table.rows[posterior().sampled[at]].sampled_domain[1]
    _, factor = made(name).proposal(here, others, random)
    assert factor[3] == -np.inf
    assert np.isfinite(np.delete(factor, 3)).mean() > 0.2  # others move


@pytest.mark.parametrize("seed", [5, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (6, 7, 8))])
@pytest.mark.parametrize("name", KINDS)
def test_a_move_keeps_the_prior_beside_a_population_on_a_ridge(name, seed, monkeypatch):
    """A walker's terms cross, its population's do not: a step must be as likely as its way back.

    All walkers together must look like independent prior draws, not one by one alone: what they have in
    common (frequencies, an element) may favour no part of the prior.
    """
    walkers = COSTLY if name.startswith("Mixture") else WALKERS
    end, accepted = moved(made(name), monkeypatch, seed, walkers if seed == 5 else round(LONG * walkers))
    assert accepted > (0.002 if name == "MixtureMove" else 0.1)
    found = surprises(end)
    assert min(found.values()) > 1e-5, (name, found)


@pytest.mark.parametrize("name", ["MixtureMove", "MixtureWalk"])
def test_a_move_in_groups_of_coordinates_keeps_the_prior(name, monkeypatch):
    monkeypatch.setattr(mixturemoves, "_JOINTLY", 1)
    every = parts(posterior(), mixture())
    assert len(every) > 2
    assert set(np.concatenate([own for own, _ in every])) == set(range(posterior().dimension))
    end, accepted = moved(made(name), monkeypatch, 5, COSTLY)
    assert accepted > 0.02
    found = surprises(end)
    assert min(found.values()) > 1e-5, (name, found)


def test_the_prior_is_lost_when_terms_may_cross_in_a_difference(monkeypatch):
    """Steps between sorted points do not lead back where they came from across a crossing."""
    monkeypatch.setattr(DifferenceMove, "crosses", True)
    found = surprises(moved(made("DifferenceMove"), monkeypatch, 5, round(LONG * WALKERS))[0])
    assert min(found["order_1"], found["order_2"]) < 1e-12
