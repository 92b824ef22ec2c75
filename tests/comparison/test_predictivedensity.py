"""What was left out: sequential densities, weights against refits and exact integrals, signs of weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm
from small import TRUTH, problem, record, study

from lcopa_bayes.comparison import predictivedensity, priorwidth
from lcopa_bayes.comparison.candidates import candidates_of
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.comparison.predictivedensity import left_out_weights, predictions
from lcopa_bayes.comparison.priorwidth import widths
from lcopa_bayes.comparison.sequentialdensity import (
    known_before,
    linear_densities,
    log_densities,
    parts_of,
    without,
)
from lcopa_bayes.data.settings import CandidateSettings
from lcopa_bayes.inference.noise import AR1, Student, White
from lcopa_bayes.inference.observations import Observed, Samples
from lcopa_bayes.results.fit import fit
from lcopa_bayes.results.sensitivity import _weights as power_weights
from lcopa_bayes.sampling.importanceweights import effective, smoothed

GAPS = np.array([1.0, 1.0, 2.0, 1.0, 0.5, 1.0, 1.0])


@pytest.fixture
def rng():
    return np.random.default_rng(11)


# -- sequential densities --------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [0.0, 0.8])
@pytest.mark.parametrize("known", [1, 3])
@pytest.mark.parametrize("own_level", [False, True])
def test_sequential_densities_are_factors_of_the_joint_normal(rng, rho, known, own_level):
    """A level under a flat prior is one with a very wide normal prior."""
    sigma, at = 0.7, np.cumsum(GAPS)
    covariance = sigma**2 * rho ** np.abs(at[:, None] - at)
    residual = rng.multivariate_normal(np.zeros(at.size), covariance) + 0.4
    reported = log_densities(
        AR1(), residual[None], np.array([[sigma, rho]]), GAPS, None if own_level else np.array([0.4]), known
    )[0]
    wide = covariance + (1e5 if own_level else 0.0)
    centred = residual - 0.4

    def joint(n: int) -> float:
        return float(multivariate_normal.logpdf(centred[:n], cov=wide[:n, :n]))

    exact = [joint(n + 1) - joint(n) for n in range(known, at.size)]
    assert_allclose(reported, exact, atol=1e-3 if own_level else 1e-9)
    assert reported.sum() == pytest.approx(joint(at.size) - joint(known), abs=2e-3)


def test_white_noise_is_that_of_no_memory(rng):
    residual = rng.normal(size=(3, GAPS.size))
    for level in (np.zeros(3), None):
        white = log_densities(White(), residual, np.full((3, 1), 0.7), GAPS, level, 2)
        none = log_densities(AR1(), residual, np.tile([0.7, 0.0], (3, 1)), GAPS, level, 2)
        assert_allclose(white, none, rtol=1e-12)


@pytest.mark.parametrize(
    ("nu", "shift"),
    [
        *((1.5, 0.0), (1e7, 0.0), (4.0, 40.0)),
        *(pytest.param(*both, marks=pytest.mark.slow) for both in ((4.0, 0.0), (1.5, 40.0))),
    ],
)
def test_a_level_under_student_noise_is_integrated(rng, nu, shift):
    """Against a dense even grid; with many degrees of freedom against Gaussian noise in closed form. What
    follows may stand far from what is known."""
    residual = 3.0 + 0.5 * rng.standard_t(3.0, size=(2, 12))
    residual[:, 5:] += shift
    parameters = np.tile([0.5, nu], (2, 1))
    reported = log_densities(Student(), residual, parameters, np.ones(12), None, 4)
    grid = np.linspace(-400.0, 400.0, 400_001)
    for row, values in zip(reported, residual, strict=True):
        copies = np.tile([0.5, nu], (grid.size, 1))
        each = Student().pointwise(values[None] - grid[:, None], copies, np.ones(12))
        joint = logsumexp(np.cumsum(each, axis=1), axis=0)
        assert_allclose(row, np.diff(joint)[3:], atol=0.02)
    if nu > 100:
        gauss = log_densities(White(), residual, parameters[:, :1], np.ones(12), None, 4)
        assert_allclose(reported, gauss, atol=0.02)


def test_a_level_of_its_own_needs_a_known_sample():
    with pytest.raises(ValueError, match="needs a known sample"):
        log_densities(White(), np.zeros((1, 3)), np.ones((1, 1)), np.ones(3), None, 0)


def test_what_is_known_of_a_record_depends_on_the_record_alone():
    one = problem(record(1, name="a"), record(2, name="b"))
    own = one.posterior.samples[0]
    part = parts_of(one.posterior, [])[0]
    moved = own.record.time[np.flatnonzero(own.record.drive[:, 0] != own.record.drive[0, 0])[0]]
    assert known_before(own, 0, part) == np.count_nonzero(own.times <= moved) > 1
    never = replace(own, record=replace(own.record, drive=np.zeros_like(own.record.drive)))
    assert known_before(never, 0, part) == 1


def first_known(posterior, part, count: int):
    """The posterior that knows all but the samples of a record from the `count`-th on."""
    samples = list(posterior.samples)
    own = samples[part.record]
    kept = tuple(Observed(axis.index[:count], axis.values[:count], axis.gaps[:count]) for axis in own.axes)
    samples[part.record] = Samples(own.record, own.times, kept)
    return replace(posterior, samples=tuple(samples))


@pytest.mark.parametrize("noise", ["white", "ar1", "white+ar1"])
@pytest.mark.parametrize("offset", ["record", "shared", "none"])
def test_gains_and_levels_are_integrated_out_of_a_sequence(rng, noise, offset):
    """The sum over samples is the ratio of two marginal likelihoods, which integrate them at once."""
    posterior = problem(*two(), noise=noise, offset=offset).posterior
    values = posterior.table.draw(5, rng)
    values[:, posterior.table.of_kind("sigma")] = 0.02
    for part in parts_of(posterior, []):
        target, own = without(posterior, part), posterior.samples[part.record]
        reported = linear_densities(target, part, own, _model(posterior, part), values, [3])[0]
        for upto in (4, own.times.size):
            whole = first_known(posterior, part, upto).log_likelihood(values)
            known = first_known(posterior, part, 3).log_likelihood(values)
            assert_allclose(reported[:, : upto - 3].sum(axis=1), whole - known, rtol=1e-7, atol=1e-6)


def test_a_held_out_record_is_predicted_as_one_that_is_left_out(rng):
    """The same record, fitted elsewhere or not at all, with the prior of its level that of the others."""
    both, alone = problem(*two()), problem(two()[0])
    part, held = parts_of(both.posterior, [])[1], parts_of(alone.posterior, ["b"])[0]
    values = both.posterior.table.draw(4, rng)
    values[:, both.posterior.table.of_kind("sigma")] = 0.02
    known, samples = without(both.posterior, part), both.posterior.samples[1]
    own = linear_densities(known, part, samples, _model(known, part), values, [3])[0]
    # the same priors: those of the pair look at both amplitudes
    names = {row.name: row for row in both.posterior.table.rows}
    names["offset"] = names["offset_a"]
    table = replace(alone.posterior.table, rows=tuple(names[row.name] for row in alone.posterior.table.rows))
    same = replace(alone.posterior, table=table)
    fewer = np.delete(values, both.posterior.table.names.index("offset_b"), axis=1)
    reported = linear_densities(same, held, samples, _model(known, part), fewer, [3])[0]
    assert_allclose(reported, own, rtol=1e-6)


# -- signs of weights ------------------------------------------------------------------------------


@pytest.mark.parametrize("power", [0.2, 0.5, 0.9])
def test_pareto_k_is_that_of_the_weights_and_not_of_their_inverse(power):
    """exp(power e), e exponential, has a Pareto tail of shape `power`; the inverse is bounded."""
    draws = np.random.default_rng(3).exponential(size=20_000)
    weights, k = smoothed(power * draws)
    assert k == pytest.approx(power, abs=0.1)
    assert smoothed(-power * draws)[1] < 0
    assert logsumexp(weights) == pytest.approx(0.0, abs=1e-12)
    assert np.argmax(weights) == np.argmax(draws)
    assert effective(np.full(40, -np.log(40))) == pytest.approx(40)
    assert np.isnan(smoothed(np.zeros(1000))[1])


def test_a_larger_power_has_the_tail_of_the_density_and_a_smaller_one_of_its_inverse(rng):
    """exp(0.01 * 60 e): of the two powers only the one below 1 gives weights with a tail, of shape 0.6."""
    density = -60.0 * rng.exponential(size=(4, 2_000))
    assert power_weights(density, 0.99)[1] == pytest.approx(0.6, abs=0.15)
    assert power_weights(density, 1.01)[1] < 0


FIXED = {"time_1": TRUTH["time_1"], "delay": TRUTH["delay"], "sigma": TRUTH["sigma"]}
LEVELS = {f"offset_{name}": ("norm", {"loc": 1.0, "scale": 10.0}) for name in "ab"}
GAIN = {"gain": ("norm", {"loc": 0.0, "scale": 10.0})}
PLAN = {"ensembles": 4, "walkers": 32, "target_ess": 400}


def two(**options):
    """Two records of 16 samples."""
    return [record(seed, name=name, camera=0.75, **options) for seed, name in ((1, "a"), (2, "b"))]


@pytest.fixture(scope="module")
def pair():
    """Only the order, the gain and two levels are free: integrals over the order are exact."""
    return fit(study(*two(), priors=FIXED | LEVELS | GAIN, sampler=PLAN))


def exact_elpd(fitted, part) -> float:
    """By quadrature over the order."""
    posterior = fitted.problem.posterior
    target = without(posterior, part)
    grid = np.linspace(0.3, 1.5, 241)[:, None]
    density = target.log_density(grid)
    kept = density > density.max() - 25
    z, weights = grid[kept], density[kept]
    values = target.complete(z, np.random.default_rng(1))
    scored = predictivedensity._Scored(fitted, part, posterior.samples[part.record], _model(posterior, part))
    found = scored(values, weights - logsumexp(weights), "exact", known=target)
    return float(found.log_density.sum())


def _model(posterior, part):
    return posterior.model.only(part.record)


@pytest.mark.parametrize("way", ["importance weights", "refit"])
def test_left_out_records_by_weights_and_by_refit_are_the_exact_integral(pair, monkeypatch, way):
    """Both ways against quadrature; never above in-sample. With the sign of the weights flipped the left-out
    record counts twice."""
    monkeypatch.setattr(predictivedensity, "usable_k", lambda draws: np.inf if way != "refit" else -np.inf)
    monkeypatch.setattr(predictivedensity, "FEWEST_EFFECTIVE", 10.0)
    for found in predictions(pair):
        assert found.method == way
        exact = exact_elpd(pair, found.part)
        total = float(found.log_density.sum())
        assert abs(total - exact) < 4 * found.error + 0.05
        assert found.in_sample - exact > 0.4  # far enough apart to be a test
        assert total < found.in_sample
        assert found.plausible


def test_weights_take_a_record_away(pair):
    """Mean and spread of the order against the posterior of the other record alone, by quadrature."""
    posterior = pair.problem.posterior
    values, order = pair.draws.flat, pair.draws.column("order_1")
    grid = np.linspace(0.3, 1.5, 2001)[:, None]
    for part in parts_of(posterior, []):
        target = without(posterior, part)
        weights, k = left_out_weights(posterior, target, values)
        density = np.exp(target.log_density(grid) - target.log_density(grid).max())
        mean = float(np.average(grid[:, 0], weights=density))
        sd = float(np.sqrt(np.average((grid[:, 0] - mean) ** 2, weights=density)))
        shares = np.exp(weights)
        error = sd / np.sqrt(min(effective(weights), pair.draws.ess))
        assert k > 0.1  # of the inverse weights it is negative
        assert abs(shares @ order - mean) < 4 * error
        assert shares @ (order - mean) ** 2 == pytest.approx(sd**2, rel=0.5)
        assert sd > 1.2 * order.std()


def test_a_wider_prior_by_weights_has_their_pareto_k(pair):
    """Half the width of the gain's prior; weights of draws from within are near 1, so k is small, whereas
    the evidence gains about log 2."""
    for one in widths(pair):
        if one.method == "importance weights":
            assert one.log_evidence - pair.evidence.value == pytest.approx(-np.log(one.factor), abs=0.1)


def test_pareto_k_of_another_width_is_that_of_new_over_old_density(pair, monkeypatch):
    """Only the gain has a prior to widen."""
    seen = []
    monkeypatch.setattr(priorwidth, "smoothed", lambda ratio: seen.append(ratio) or smoothed(ratio))
    gain = pair.draws.column("gain")
    for one, ratio in zip(widths(pair), seen, strict=True):
        wanted = norm.logpdf(gain, 0.0, 10.0 * one.factor) - norm.logpdf(gain, 0.0, 10.0)
        assert_allclose(ratio, wanted, rtol=1e-10)
        assert one.pareto_k == pytest.approx(smoothed(wanted)[1], rel=1e-6)


# -- candidates of different offsets ---------------------------------------------------------------

FEW = {"ensembles": 2, "walkers": 16, "steps": 400, "thin": 2, "target_ess": 100}


@pytest.mark.slow
def test_candidates_that_share_levels_differently_are_compared():
    """Scores have one length whatever a candidate takes its level from; each says from where."""
    reported_priors = FIXED | GAIN
    pieces = [CandidateSettings(kind, offset=kind) for kind in ("record", "shared", "none")]
    source = study(*two(), held_out=[record(3, name="c", camera=0.75)], priors=reported_priors, sampler=FEW)
    reported = compare(candidates_of(source, pieces, ["record", "shared", "none"]))
    rows = {row["name"]: row for row in reported["models"]}
    counts = {name: [one["samples"] for one in row["predictions"]] for name, row in rows.items()}
    assert counts["record"] == counts["shared"] == counts["none"]
    levels = {name: row["predictions"][0]["level_from"] for name, row in rows.items()}
    assert levels["record"] == ["its samples at rest, then each one as it has been predicted"]
    assert levels["shared"] == ["shared with the fitted records"]
    assert levels["none"] == ["no level in the model"]
    assert rows["none"]["elpd"] < rows["shared"]["elpd"] - 20  # the level is 15 noise scales
    assert rows["shared"]["elpd"] is not None


# -- two records, everything free ------------------------------------------------------------------


@pytest.mark.slow
def test_two_short_records_left_out_in_turn_are_those_of_separate_fits():
    """All parameters free, 16 samples each: a fit that never saw the record is the reference."""
    priors = GAIN | {
        "time_1": ("loguniform", {"a": 0.05, "b": 500.0}),
        "delay": ("uniform", {"loc": 0.0, "scale": 4.0}),
        "sigma": ("loguniform", {"a": 1e-4, "b": 4.0}),
    }
    a, b = two()
    made = fit(study(a, b, priors=priors | LEVELS, sampler=PLAN))
    own = priors | {"offset": ("norm", {"loc": 1.0, "scale": 10.0})}
    for found, left, known in zip(predictions(made), (a, b), (b, a), strict=True):
        (alone,) = predictions(
            fit(study(known, held_out=[left], priors=own, sampler=PLAN)), held_out_only=True
        )
        assert found.method == "refit"
        apart = float(found.log_density.sum() - alone.log_density.sum())
        assert abs(apart) < 4 * np.hypot(found.error, alone.error)
        assert found.log_density.sum() < found.in_sample


def test_a_known_normal_level_is_scored_by_its_prediction():
    """One known sample of white noise: the next is normal with variance 2 sigma^2, and so on."""
    residual = np.array([[0.3, -0.2, 0.5]])
    reported = log_densities(White(), residual, np.array([[0.4]]), np.ones(3), None, 1)[0]
    wanted = [norm.logpdf(-0.2, 0.3, 0.4 * np.sqrt(2)), norm.logpdf(0.5, 0.05, 0.4 * np.sqrt(1.5))]
    assert_allclose(reported, wanted, rtol=1e-12)
