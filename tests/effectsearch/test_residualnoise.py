"""Noise as the residual of a fit knows it."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats
from test_loop_noise import scales
from test_loop_unseen import SD, campaign, fitted

from lcopa_bayes.data.record import Axis
from lcopa_bayes.effectsearch.bandwidening import Widening
from lcopa_bayes.effectsearch.basefit import axis_pieces, fitted_scales
from lcopa_bayes.effectsearch.heldoutscores import _about_optimum
from lcopa_bayes.effectsearch.noise import joint_noise
from lcopa_bayes.effectsearch.noiselaw import Law, plausible, plausible_in_residual
from lcopa_bayes.effectsearch.residualnoise import BandScales, ResidualNoise, _tails
from lcopa_bayes.effectsearch.scores import fit_scores
from lcopa_bayes.inference.noise import AR1
from lcopa_bayes.inference.observations import Observed, PlausibleNoise

NO_SLOPES = np.empty((0, 0, 0))
SHAPES = np.array([[1.0, 0.0, 0.5], [0.6, 0.8, 0.7], [0.0, 1.0, 0.9], [0.0, 1.0, 0.98]])


def piece(values: np.ndarray, gaps: np.ndarray | None = None) -> Observed:
    return Observed(np.arange(values.size), values, np.ones(values.size) if gaps is None else gaps)


def test_a_level_of_each_piece_is_one_regressor_each(rng):
    """Levels by closed form, and as coefficients of which nothing is known besides."""
    pieces = [piece(rng.standard_normal(n), 0.5 + rng.random(n)) for n in (30, 50)]
    levels = np.repeat(np.eye(2), (30, 50), axis=0)
    pairs = [(pieces[0], levels[:30]), (pieces[1], levels[30:])]
    prior = np.log(np.arange(1.0, 5.0))
    by_level = PlausibleNoise.of(pieces, SHAPES, prior)
    by_fit = PlausibleNoise.of_residual(pairs, np.zeros((2, 2)), SHAPES, prior)
    assert by_fit.count == pytest.approx(by_level.count)
    np.testing.assert_allclose(by_fit.squares, by_level.squares, rtol=1e-10)
    np.testing.assert_allclose(by_fit.weights, by_level.weights, rtol=1e-8)


def test_coefficients_are_integrated_out_by_dense_algebra(rng):
    """Density of the samples under the covariance of noise and coefficients, at any shape."""
    n, columns = 40, rng.standard_normal((40, 3)).cumsum(axis=0)
    root = rng.standard_normal((3, 3))
    precision, values = root @ root.T, rng.standard_normal(n)
    found = PlausibleNoise.of_residual([(piece(values), columns)], precision, SHAPES, np.zeros(4))
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    expected = []
    for (white, correlated, rho), squares in zip(SHAPES, found.squares, strict=True):
        dense = white**2 * np.eye(n) + correlated**2 * rho**apart
        dense += columns @ np.linalg.solve(precision, columns.T)
        assert squares == pytest.approx(values @ np.linalg.solve(dense, values))
        expected.append(-0.5 * np.linalg.slogdet(dense)[1] - 0.5 * found.count * np.log(squares))
    np.testing.assert_allclose(np.diff(np.log(found.weights)), np.diff(expected), rtol=1e-9)
    assert n - 3 < found.count < n


def test_what_a_fit_takes_up_of_slow_noise_is_known():
    """Noise of correlation 0.9 and sd 1 beside a fitted line and a slow wave: by its residual alone it is
    smaller and shorter than it is, which a fit that knows its regressors undoes."""
    n, given = 300, scales(300)
    time = np.linspace(-1, 1, n)
    columns = np.column_stack([np.ones(n), time, np.sin(3 * time), np.cos(3 * time)])
    rng, none = np.random.default_rng(4), 1e-9 * np.eye(4)
    drawn = AR1().draw(np.tile([1.0, 0.9], (80, 1)), np.ones(n), rng)
    alone, beside = [], []
    for noise in drawn:
        left = [piece(noise - columns @ np.linalg.lstsq(columns, noise)[0])]
        known = joint_noise(left, Axis("x", "V"), "", given)
        alone.append(plausible(left, given).draw(400, rng)[:, :2])
        pairs = [(left[0], columns)]
        restricted = plausible_in_residual(pairs, none, given, known.posterior, known.dependence)
        beside.append(restricted.draw(400, rng)[:, :2])
    ranks = [np.mean(np.hypot(*np.moveaxis(np.array(each), -1, 0)) < 1.0, axis=1) for each in (alone, beside)]
    assert np.mean(ranks[0]) > 0.65
    assert stats.kstest(ranks[1], "uniform").pvalue > 0.01
    assert stats.kstest(ranks[0], "uniform").pvalue < 1e-3


@pytest.mark.parametrize("freedom", [3.0, 1e6])
def test_tails_and_scale_are_those_of_the_innovations(freedom):
    """The quartile drawn is as often below the true one as of a uniform rank, and degrees of freedom are near
    the true ones."""
    rng, ranks, nearest = np.random.default_rng(3), [], []
    quartile = stats.t.ppf(0.75, freedom)
    for _ in range(100):
        noise = rng.standard_t(freedom, 300)
        size = np.sqrt(np.mean(noise**2))
        found, scale = _tails(noise / size, 300.0, 400, rng)
        ranks.append(np.mean(scale * size * stats.t.ppf(0.75, found) < quartile))
        nearest.append(np.median(found))
    assert abs(np.mean(ranks) - 0.5) < 0.12  # four standard errors
    assert np.mean(np.abs(np.array(ranks) - 0.5) < 0.45) > 0.8
    assert np.median(nearest) == 3.0 if freedom == 3.0 else np.median(nearest) >= 20.0


def test_rare_large_innovations_do_not_decide_the_scale():
    """One sample of 40 standard deviations leaves the rest as large as they are."""
    rng = np.random.default_rng(5)
    noise = rng.standard_normal(300)
    noise[7] = 40.0
    size = np.sqrt(np.mean(noise**2))
    freedom, scale = _tails(noise / size, 300.0, 400, rng)
    assert size > 2.3
    assert 0.6 < np.median(scale * size) < 1.0
    assert freedom.max() < 1e6


@pytest.mark.parametrize("kind", ["white", "coloured"])
def test_what_a_fit_leaves_open_is_that_of_dense_algebra(kind):
    """Estimates weigh their samples alike; their covariance under a law is the sandwich of White (1982)."""
    study = campaign(kind, 1)
    _, state = fitted(study)
    found = ResidualNoise.of(state.model, state.optimum, state.whitening, 0, 5, np.random.default_rng(1))
    tangents, optimum = state.optimum.tangents, state.optimum
    n, sd = len(tangents), state.whitening.weighed[0].sd
    pieces, given = axis_pieces(state.model.plant, optimum.residual, 0), fitted_scales(state.model.plant)
    known = joint_noise(pieces, study.response_axes[0], "", given)
    besides = optimum.information - tangents.T @ tangents / sd**2
    rng = np.random.default_rng(1)
    pairs = [(pieces[0], tangents)]
    noise = plausible_in_residual(pairs, besides * sd**2, given, known.posterior, known.dependence)
    laws = noise.draw_shapes(5, rng)
    apart = np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    gain = np.linalg.solve(optimum.information, tangents.T / sd**2)
    prior = np.linalg.solve(optimum.information, np.linalg.solve(optimum.information, besides).T)
    inverse = np.linalg.inv(optimum.information)
    wide = np.trace(tangents @ inverse @ tangents.T)
    vars(state)["residual_noise"] = (found,)
    pairs = zip(laws, found.sd, found.freedom, found.widening, state.stretches, strict=True)
    for law, size, freedom, widening, stretch in pairs:
        larger = size**2 / (law[0] ** 2 + law[1] ** 2) * freedom / (freedom - 2)
        noise = larger * (law[0] ** 2 * np.eye(n) + law[1] ** 2 * law[2] ** apart)
        spread = gain @ noise @ gain.T + prior
        assert widening**2 == pytest.approx(np.trace(tangents @ spread @ tangents.T) / wide, rel=1e-6)
        sd = np.sqrt(np.diag(spread))
        np.testing.assert_allclose(stretch @ inverse @ stretch.T, spread, atol=1e-6 * np.outer(sd, sd).max())


@pytest.mark.parametrize("unit", [1e-9, 0.0, 1e12])
def test_what_noise_leaves_open_depends_on_no_unit(unit):
    """That of the gain is another, or nothing is known of it, so that its draws stay where they are."""
    _, state = fitted(campaign("coloured", 1))
    (noise,), to = state.residual_noise, np.diag([unit, *np.ones(state.optimum.x.size - 1)])
    optimum = replace(
        state.optimum,
        information=to @ state.optimum.information @ to,
        jacobian=state.optimum.jacobian @ to,
    )
    other = replace(state, optimum=optimum)
    vars(other)["residual_noise"] = (replace(noise, slopes=to @ noise.slopes @ to),)
    if unit:
        np.testing.assert_allclose(to @ other.stretches @ np.linalg.inv(to), state.stretches, atol=1e-5)
    else:
        np.testing.assert_array_equal(other.stretches[:, 0], 0.0)
        assert np.isfinite(other.stretches).all()


def test_draws_have_the_scale_the_memory_and_the_tails_of_each():
    """4000 records of equally and unequally spaced samples."""
    rng = np.random.default_rng(2)
    many = np.ones(4000)
    noise = ResidualNoise(SD * many, 0.8 * many, 1e6 * many, many, 0.5, NO_SLOPES)
    drawn = noise.draw(np.array([0.0, 0.5, 2.0]), rng)
    np.testing.assert_allclose(drawn.std(axis=0), SD, rtol=0.05)
    correlation = np.corrcoef(drawn.T)
    assert correlation[0, 1] == pytest.approx(0.8, abs=0.03)
    assert correlation[0, 2] == pytest.approx(0.8**4, abs=0.05)
    heavy = ResidualNoise(SD * many, 0.0 * many, 3.0 * many, many, 0.5, NO_SLOPES).draw(np.arange(3.0), rng)
    assert stats.kstest(heavy.ravel() / SD, "t", args=(3,)).pvalue > 0.01


@pytest.mark.parametrize("freedom", [3.0, 1e6])
def test_bands_hold_nine_tenths_of_what_is_plausible(freedom):
    """Noise and prediction of unequal laws, apart exactly, and together nearly."""
    rng, many = np.random.default_rng(6), np.ones(40)
    sd, widening = SD * np.geomspace(0.5, 4.0, 40), np.geomspace(3.0, 1.0, 40)
    scales = ResidualNoise(sd, 0.5 * many, freedom * many, widening, 0.5, NO_SLOPES).scales
    noise = sd[:, None] * rng.standard_t(freedom, (40, 5000))
    shift = SD * widening[:, None] * rng.standard_normal((40, 5000))
    alone, given, both = (
        scales.half_width(np.array([0.0])),
        BandScales(0.0, scales.prediction).half_width(np.array([SD**2])),
        scales.half_width(np.array([SD**2])),
    )
    assert np.mean(np.abs(noise) < alone) == pytest.approx(0.9, abs=0.004)
    assert np.mean(np.abs(shift) < given) == pytest.approx(0.9, abs=0.004)
    assert np.mean(np.abs(noise + shift) < both) == pytest.approx(0.9, abs=0.02)


def test_bands_of_draws_hold_their_own_noise():
    """Draws under noise that is half as large again as that of the residual."""
    _, state = fitted(campaign("white", 1))
    louder = replace(state.whitening, noise=(Law(1.5 * state.whitening.noise[0].sd),), dependence=(1.0,))
    sampled = _about_optimum(replace(state, whitening=louder), 1)
    (scales,) = replace(state, sampled=sampled).band_scales
    assert scales.noise == pytest.approx(1.5 * state.whitening.noise[0].sd, rel=0.02)
    assert scales.prediction == 1.0


@pytest.mark.parametrize("sampled", [False, True])
def test_bands_that_hold_what_remains_are_no_narrower(sampled: bool):
    """Of a residual that alone tells the noise they had its own scale, and held half of what they should."""
    _, state = fitted(campaign("coloured", 1))
    state = replace(state, whitening=replace(state.whitening, dependence=(1.0,)))
    excess = Widening.of(state.whitening.samples, state.optimum.residual, state.whitening.noise)
    drawn = _about_optimum(state, 1) if sampled else None
    plain, wide = state, replace(state, widening=excess, sampled=drawn)
    assert fit_scores(plain)[0].scales is not None
    for narrow, wider in zip(fit_scores(plain), fit_scores(wide), strict=True):
        assert (wider.half_width >= (1 - 1e-12) * narrow.half_width).all()
    np.testing.assert_array_equal(wide.stretches, plain.stretches)
