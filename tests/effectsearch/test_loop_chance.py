"""What chance gives the loop: noise known from samples of it, and decisions that err as seldom as told."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import toeplitz
from scipy.stats import binom, chi2, kstest, norm
from scipy.stats import t as student

from lcopa_bayes.bench.acquisition import Bench, simulate
from lcopa_bayes.bench.command import on_off, staircase, step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.autoregression import Autoregression, unbroken
from lcopa_bayes.effectsearch.heldouteffects import Errors
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.noisepieces import NoisePieces
from lcopa_bayes.effectsearch.noiseposterior import NoisePosterior
from lcopa_bayes.effectsearch.noisesamples import FEWEST
from lcopa_bayes.effectsearch.refits import SIGNIFICANT, Refit
from lcopa_bayes.effectsearch.trace import threshold_of
from lcopa_bayes.effectsearch.whitening import Whitening
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.path import TransferPath

PARTIAL = st.lists(st.floats(-0.95, 0.95), max_size=5).map(np.array)
AXIS = (Axis("x", "rad"),)
NOISE, PERIOD = 5e-3, 0.2
"""Standard deviation of the noise over a step of 1 [-] and sampling period [ms] of the campaigns."""
ALARMED = (14, 18, 21, 23, 27, 39)
"""Of 40 seeds, those with which noise taken for known raises a firm alarm at correlation 0.9."""
LIBRARY = [
    catalogue()[name] for name in ("odd_curvature", "even_curvature", "gain_drift", "unmodelled_smooth")
]


def first_order(rho, sd=1.0):
    return Autoregression(np.array([rho]), sd * np.sqrt(1 - rho**2))


@given(PARTIAL, st.integers(1, 12))
@settings(max_examples=40, deadline=None)
def test_adjoint_is_that_of_whitening(partial, n):
    process, rng = Autoregression(partial, 0.3), np.random.default_rng(1)
    a, b = rng.normal(size=(2, n))
    assert process.whiten(a) @ b == pytest.approx(a @ process.adjoint(b), rel=1e-9)


@given(PARTIAL, st.integers(2, 40))
@settings(max_examples=40, deadline=None)
def test_samples_per_independent_one_are_those_of_a_sum_of_squares(partial, n):
    """The variance of a quadratic form of normal samples is twice the trace of its squared covariance."""
    process = Autoregression(partial, 2.0)
    covariance = toeplitz(process.autocovariance(n - 1))
    exact = np.trace(covariance @ covariance) / (n * process.sd**4)
    assert process.correlated(n - 1) == pytest.approx(exact, rel=1e-9)


def test_the_posterior_of_the_noise_is_that_of_a_grid():
    """24 samples admit orders 0 and 1: importance sampling against sums over a grid of the correlation."""
    pieces = NoisePieces.of(list(first_order(0.7).draw(2, 12, np.random.default_rng(2))))
    grid = np.tanh(np.linspace(-8, 8, 3001))
    weights = np.exp(-np.array([pieces.cost(np.array([kappa]))[0] for kappa in grid]) + pieces.modes[0].cost)
    weights *= np.gradient(np.arcsin(grid)) / np.pi
    drawn = NoisePosterior(pieces).draw(4000, np.random.default_rng(0))
    kappa = np.array([one.partial[0] for one in drawn if one.order == 1])
    exact = weights.sum() / (1 + weights.sum())
    assert kappa.size / 4000 == pytest.approx(exact, abs=0.03)
    for level in (0.1, 0.5, 0.9, 0.98):
        at = grid[np.searchsorted(np.cumsum(weights) / weights.sum(), level)]
        # 400 proposals; their weights leave more than half of them
        assert np.mean(kappa <= at) == pytest.approx(level, abs=4 * np.sqrt(level * (1 - level) / 200))


def samples_of(pieces):
    """Records without a drive that hold these samples of noise."""
    records = [
        Record(f"r{k}", np.arange(len(y)) * 1.0, np.zeros((len(y), 1)), y[:, None], AXIS, AXIS, "ms")
        for k, y in enumerate(pieces)
    ]
    return tuple(Samples.of(one, 1.0) for one in records)


def test_chance_beside_a_scale_that_is_estimated_is_student():
    """Ten samples admit order 0 alone: then a whitened sample is exactly Student with nine degrees."""
    rng = np.random.default_rng(3)
    known = NoisePosterior(NoisePieces.of([rng.normal(size=10)]))
    white = Whitening(samples_of([rng.normal(size=8)]), (known.pieces.estimate,), (), (known,))
    # four draws from each process share its scale: as many independent draws as processes
    drawn = np.concatenate([white.chance(1000, rng)[0, ::4] for _ in range(8)])
    assert kstest(drawn, student(9).cdf).pvalue > 1e-3
    assert binom.sf(np.count_nonzero(np.abs(drawn) > 3) - 1, 2000, 2 * norm.sf(3)) < 1e-6


def test_covariance_under_plausible_noise_is_that_of_its_draws():
    """Three ways to the same matrices: lag sums of the adjoint, many draws, and dense algebra."""
    rng = np.random.default_rng(4)
    pieces = [first_order(0.8).draw(1, n, rng)[0] for n in (40, 25)]
    known = NoisePosterior(NoisePieces.of([first_order(0.8).draw(1, 8000, rng)[0]]))
    white = Whitening(samples_of(pieces), (first_order(0.5),), (3.0,), (known,))
    columns = np.cumsum(rng.normal(size=(65, 2)), axis=0)
    found = white.covariances(columns, 200).mean(axis=0)
    drawn = np.cov(columns.T @ white.chance(8000, rng))
    error = 5 * np.sqrt(2 / 8000) + 0.03  # of 8000 draws, and of the mean of 200 processes
    np.testing.assert_allclose(drawn, found, atol=error * np.diag(found).max())
    process = known.draw(1, np.random.default_rng(7))[0]
    dense = np.zeros((65, 65))
    dense[:40, :40], dense[40:, 40:] = (toeplitz(process.autocovariance(n - 1)) for n in (40, 25))
    back = white.adjoint(columns.T)
    np.testing.assert_allclose(white.covariances(columns, 1)[0], back @ dense @ back.T, rtol=1e-8)


@pytest.mark.parametrize("rho", [0.0, 0.9, 0.98])
def test_errors_of_correlated_noise_are_missed_as_seldom_as_told(rho):
    """Of independent ones so many squares would lie beyond 5 standard deviations as good as never."""
    process = first_order(rho) if rho else Autoregression(np.empty(0), 1.0)
    drawn, count = process.draw(4000, 600, np.random.default_rng(5)), 600.0

    def p_values(noise):
        return np.array(
            [
                Errors(np.array([p]), np.array([count]), np.ones(1), np.zeros(1, int)).p_value(noise)
                for p in (drawn**2).sum(axis=1)
            ]
        )

    told = p_values([[process]])
    for level in (0.05, 0.005):
        beyond = np.count_nonzero(told < level)
        assert binom.sf(beyond - 1, 4000, 1.3 * level) > 1e-3  # a chi-squared of the right variance is near
        assert binom.cdf(beyond, 4000, level / 2) > 1e-3
    assert not (told < norm.sf(5.0)).any()
    alone = p_values([[Autoregression(np.empty(0), 1.0)]])
    assert (np.mean(alone < norm.sf(5.0)) > 0.01) == (rho > 0)


def test_significance_beside_coloured_noise_is_what_it_says():
    """Samples weighted alike: a tangent as slow as the noise scatters more than their number says."""
    rng, n = np.random.default_rng(6), 300
    known = NoisePosterior(NoisePieces.of([first_order(0.9).draw(1, 4000, rng)[0]]))
    dependence = known.pieces.estimate.correlated(n)
    white = Whitening(
        samples_of([rng.normal(size=n)]), (Autoregression(np.empty(0), 1.0),), (dependence,), (known,)
    )
    t = np.linspace(0, 1, n)
    tangents = white(np.stack([np.ones(n), 1 - np.exp(-t / 0.2), t, t**2])).T
    information = tangents.T @ tangents + 1e-6 * np.eye(4)
    old, new = [], []
    for noise in white(first_order(0.9).draw(150, n, rng)):
        x = np.linalg.solve(information, tangents.T @ noise)
        optimum = SimpleNamespace(
            x=x, stuck=np.zeros(4, bool), jacobian=tangents, information=information, covariance=None
        )
        seen = SimpleNamespace(optimum=optimum, whitening=white, places=lambda _: [3])
        new.append(Refit.wald(seen, "curve"))
        old.append(chi2.sf(x[3] ** 2 / np.linalg.inv(information)[3, 3], 1))
    for level in (0.2, 0.05, 0.01):
        beyond = np.count_nonzero(np.array(new) < level)
        assert binom.cdf(beyond, 150, level) > 1e-3
        assert binom.sf(beyond - 1, 150, level) > 1e-3
    assert np.mean(np.array(old) < SIGNIFICANT) > 4 * SIGNIFICANT


def test_a_threshold_tells_its_own_error():
    rng = np.random.default_rng(7)
    held = []
    for _ in range(300):
        threshold, low, high = threshold_of(rng.gumbel(size=1000))
        held.append(low <= -np.log(-np.log(0.99)) <= high)
        assert low <= threshold <= high
    assert binom.cdf(sum(held), 300, 0.95) > 1e-3


def test_samples_without_a_period_are_one_stretch():
    uneven = np.concatenate([[1.0], np.geomspace(0.2, 30.0, 40)])
    assert unbroken(uneven) == [slice(0, 41)]
    assert unbroken(np.array([1.0, 2, 2, 2])) == [slice(k, k + 1) for k in range(4)]


def commands(quiet):
    return [
        on_off(1.0, hold=12.0, at=quiet),
        on_off(-0.7, hold=9.0, at=quiet),
        staircase([0.4, 1.0, -0.5, 0.2], hold=6.3, start=quiet),
        step(0.5, at=quiet),
        staircase([-0.9, 0.8, 0.3], hold=7.1, start=quiet),
    ]


def noiseless(quiet):
    """Five records with `quiet` samples at rest in the first four together."""
    at = max((quiet // 4 - 4) * PERIOD - 0.1, 0.1)
    device = Device(((TransferPath(1.0, 1.0, (3.0**1.5,), (1.5,), 1.0),),), AXIS, AXIS, (0.0,))
    rng = np.random.default_rng(0)
    return [
        simulate(device, Bench(camera=PERIOD), one, duration=28.0 + at, name=f"r{k}", rng=rng)
        for k, one in enumerate(commands(at))
    ]


def campaign(records, seed, rho, curvature=0.0):
    """The records with noise of correlation `rho`; the last is held out."""
    rng = np.random.default_rng([seed, 5])
    process = first_order(rho, NOISE) if rho else Autoregression(np.empty(0), NOISE)
    out = []
    for one in records:
        response = one.response + curvature * one.response**3
        sampled = np.isfinite(response[:, 0])
        response[sampled, 0] += process.draw(1, int(sampled.sum()), rng)[0]
        out.append(replace(one, response=response))
    return Study("clean", None, "ms", seed, tuple(out[:4]), (out[4],), ModelSettings(offset="shared"))


def looped(study):
    return loop(study, library=LIBRARY, sample=False, quick=True, as_stated=True)


def test_a_clean_campaign_of_correlated_noise_stays_clean():
    """And a bend must be seen all the same."""
    records = noiseless(64)
    found = [looped(campaign(records, seed, 0.9)) for seed in ALARMED]
    assert sum(one.verdict.kind != "clean" for one in found) <= 1
    assert {one.verdict.confidence for one in found} == {"tentative"}
    assert all(one.base.noise[0].independent < FEWEST <= one.base.noise[0].samples for one in found)
    assert "independent ones" in found[0].cautions[0]
    bent = looped(campaign(records, 0, 0.0, curvature=0.06))
    assert [effect.name for effect in bent.effects] == ["odd_curvature"]
    assert bent.verdict.confidence == "firm"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("rho", "quiet"), [(0.0, 64), (0.6, 64), (0.9, 64), (0.9, 176), (0.95, 400), (0.9, 40)]
)
def test_clean_campaigns_are_called_clean(rho, quiet):
    """100 draws whose answer is known; an alarm by chance comes once in a hundred times."""
    records = noiseless(quiet)
    wrong = sum(looped(campaign(records, 1000 + seed, rho)).verdict.kind != "clean" for seed in range(100))
    assert binom.sf(wrong - 1, 100, 0.01) > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(("rho", "curvature"), [(0.0, 0.012), (0.6, 0.03), (0.9, 0.1)])
def test_bent_campaigns_are_not_called_clean(rho, curvature):
    """100 draws whose answer is known, from 400 quiet samples."""
    records = noiseless(400)
    wrong = sum(
        looped(campaign(records, seed, rho, curvature)).verdict.kind == "clean" for seed in range(100)
    )
    assert wrong <= 5
