"""The audit: symmetries named, curvature exact, profiles against closed forms, each verdict recognised."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2
from small import TRUTH, TWO, draws_of, problem, record, study, with_effect

from lcopa_bayes.bench.command import Command, step
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.identifiability.audit import _flat, _profiles, radial
from lcopa_bayes.identifiability.contraction import Tolerance, beliefs, prior_draws, prior_spread
from lcopa_bayes.identifiability.curvature import curvature, sensitivities
from lcopa_bayes.identifiability.profile import Freedom, Profile, _Path, profile
from lcopa_bayes.identifiability.symmetries import (
    DIFFERENCED,
    TOLERANCES,
    Structure,
    printed_form,
    printed_structure,
    structure,
)
from lcopa_bayes.identifiability.verdict import Finding, judged
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.likelihood import Landscape, Peak
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.posterior import Posterior

SHORT = record(camera=0.6)
KNOWN = {"time_1": TRUTH["time_1"], "order_1": TRUTH["order_1"], "delay": TRUTH["delay"]}
FLAT_GAIN = ("uniform", {"loc": 0.0, "scale": 10.0})


def points_of(posterior: Posterior, count: int = 24):
    landscape, rng = Landscape(posterior), np.random.default_rng(0)
    return [sensitivities(landscape, values) for values in posterior.table.draw(count, rng)]


def structure_of(posterior: Posterior) -> Structure:
    points = points_of(posterior)
    return structure(points[0].names, [p.relative() for p in points], [p.values for p in points])


def maximum(landscape: Landscape, seed: int = 3) -> Peak:
    optima = find_optima(landscape.posterior, np.random.default_rng(seed), starts=4)
    return max((landscape.maximise(o.values) for o in optima), key=lambda peak: peak.log_likelihood)


def profile_of(landscape: Landscape, name: str, peak: Peak) -> Profile:
    k = landscape.posterior.table.names.index(name)
    low, high = landscape.search(k)
    return profile(landscape, k, peak, np.empty((0, peak.values.size)), 0.02 * (high - low))


# -- structure -------------------------------------------------------------------------------------


def toy(formula, count: int = 6, *, error: float = 0.0, tolerances=TOLERANCES) -> Structure:
    """Structure of ``formula(p)`` (samples,) by complex steps with an error [of the largest], at random
    points."""
    rng, size = np.random.default_rng(1), formula.__code__.co_argcount
    names = formula.__code__.co_varnames[:size]
    slopes, values = [], []
    for _ in range(count):
        at = rng.uniform(0.5, 2.0, size)
        shifted = at * np.exp(1e-30j * np.eye(size))
        exact = np.array([formula(*row).imag / 1e-30 for row in shifted]).T
        slopes.append(exact + error * np.abs(exact).max(axis=0) * rng.standard_normal(exact.shape))
        values.append(at)
    return structure(names, slopes, values, tolerances=tolerances)


T = np.linspace(0.1, 3.0, 40)


@pytest.mark.parametrize(
    ("formula", "rank", "reported"),
    [
        (lambda a, b: a * np.exp(-b * T), 2, []),
        (lambda a, b, c: a * b / c * np.exp(-T) + c * 0, 1, ["only the product a b c^-1 acts"]),
        (lambda a, b, c: np.exp(-(a + 2 * b) * T) * c, 2, ["only the sum a + 2 b acts"]),
        (lambda a, b, c: a * T / (b + c * T), 2, ["a common factor on a, b, c has no effect"]),
        (
            lambda a, b, c, d: a * T / (b * T**2 + c + d),
            2,
            ["only the sum c + d acts", "a common factor on a, b, the sum c + d has no effect"],
        ),
        (
            lambda a, b, c: np.exp(-(a**2 + b) * T + 0 * c),
            1,
            ["c changes no sample: nothing excites it", "only one combination of a, b acts"],
        ),
    ],
)
def test_symmetries_are_found_and_named(formula, rank, reported):
    """By exact slopes, and by slopes that are good to 1e-6 as differences are."""
    for found in (toy(formula), toy(formula, error=1e-6, tolerances=DIFFERENCED)):
        assert found.rank == rank
        assert found.certain
        assert [one.sentence for one in found.symmetries] == reported


def test_the_normalised_path_has_no_symmetry_and_the_printed_one_has_six():
    posterior = problem(SHORT, terms=3, offset="none").posterior
    assert structure_of(posterior).symmetries == ()
    printed = printed_structure(points_of(posterior), np.random.default_rng(2))
    assert printed is not None
    assert printed.certain
    assert (printed.parameters, printed.rank) == (14, 8)  # j q x: 2, four springs: 3, common factor: 1
    assert [one.kind for one in printed.symmetries] == ["product", "sum", "scale"]
    assert printed.symmetries[1].parameters == ("k1", "k2", "k3", "k4")
    assert printed.partners("eta1") == (
        *("j", "q", "x", "eta2", "eta3"),
        *("k1", "k2", "k3", "k4"),
    )


def test_slopes_of_the_printed_form_are_those_of_finite_differences():
    gain, times, orders, delay = 0.02, np.array([3.0, 1.5]), np.array([1.7, 0.6]), 3.0
    form = printed_form(gain, times, orders, delay, np.random.default_rng(4))

    def normalised(values: Vector) -> Vector:
        reported = dict(zip(form.names, values, strict=True))
        k = sum(reported[f"k{i}"] for i in range(1, 5))
        lever = gain * form.values[-4:].sum() / (form.values[0] * form.values[1] / form.values[2])
        etas = np.array([reported["eta1"], reported["eta2"]])
        powers = np.array([reported["order_1"], reported["order_2"]])
        b = lever * reported["j"] * reported["q"] / reported["x"]
        return np.array([b / k, *(np.log(etas / k) / powers), *powers, reported["delay"]])

    assert_allclose(normalised(form.values), [gain, *np.log(times), *orders, delay], rtol=1e-12)
    h, columns = 1e-5, []
    for p in range(form.values.size):
        up, down = form.values.copy(), form.values.copy()
        up[p] *= np.exp(h)
        down[p] *= np.exp(-h)
        columns.append((normalised(up) - normalised(down)) / (2 * h))
    assert_allclose(form.slopes, np.array(columns).T, rtol=1e-6, atol=1e-9)


def test_terms_of_one_order_merge_into_a_sum():
    found = structure_of(problem(SHORT, orders=(1.6, 1.0, 1.0), terms=3).posterior)
    assert [one.sentence for one in found.symmetries] == ["only the sum time_2 + time_3 acts"]
    assert found.blind == {"time_2", "time_3"}


def test_a_drive_that_never_moves_leaves_its_paths_blind():
    lone = record(device=TWO, command=step((1.0, 0.0), at=0.35), camera=0.5)
    found = structure_of(problem(lone, share="all").posterior)
    assert found.blind == {"gain_x_y", "gain_y_y"}
    assert {one.kind for one in found.symmetries} == {"no effect"}


def test_drives_in_proportion_confound_their_gains():
    both = record(device=TWO, command=step((1.0, 0.5), at=0.35), camera=0.5)
    found = structure_of(problem(both, share="all").posterior)
    assert [one.sentence for one in found.symmetries] == [
        "only the sum gain_x_x + 0.5 gain_x_y acts",
        "only the sum gain_y_x + 0.5 gain_y_y acts",
    ]


def test_gains_confounded_by_the_drives_are_named_with_an_effect_too():
    """Slopes are differences there."""
    command = Command(np.array([0.35, 4.0]), np.array([[1.0, 0.5], [-0.6, -0.3]]), np.zeros(2))
    known = {"gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02}
    both = study(record(device=TWO, command=command, camera=0.5), share="all")
    made, truth = with_effect(both, ["odd_curvature"], known | {"coefficient": 0.4})
    landscape, rng = Landscape(problem_of(made).posterior), np.random.default_rng(1)
    points = [sensitivities(landscape, truth * (1 + 0.1 * rng.random(truth.size))) for _ in range(3)]
    slopes, values = [p.relative() for p in points], [p.values for p in points]
    found = structure(points[0].names, slopes, values, tolerances=DIFFERENCED)
    assert found.certain
    assert found.rank == found.parameters - 2
    assert [one.sentence for one in found.symmetries] == [
        "only the sum gain_x_x + 0.5 gain_x_y acts",
        "only the sum gain_y_x + 0.5 gain_y_y acts",
    ]


# -- curvature -------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", ["white", "ar1"])
def test_fisher_information_is_the_curvature_of_the_expected_log_likelihood(noise):
    """Data equal to the model: there the Hessian of the log likelihood is minus the information."""
    posterior = problem(SHORT, noise=noise, priors={"gain": FLAT_GAIN}).posterior
    landscape, rows = Landscape(posterior), posterior.table.rows
    reported = TRUTH | {"rho": 0.6}
    values = np.array([reported[row.name] for row in rows])
    found = curvature(landscape, values, np.ones(values.size))
    columns = landscape.least.columns
    left = landscape.least.residual(landscape.least.coordinates(values), values)[0][: posterior.size]
    assert not np.allclose(left, 0)

    def loss(x: Vector) -> float:  # with the residual at `values` taken off: data equal to the model
        moved = landscape.least.residual(x, values)[0][: posterior.size] - left
        return 0.5 * float(moved @ moved)

    x, h = landscape.least.coordinates(values), 1e-3
    hessian = np.empty((len(columns), len(columns)))
    for a in range(len(columns)):
        for b in range(len(columns)):
            signs = [
                p * q * loss(x + h * (p * np.eye(len(columns))[a] + q * np.eye(len(columns))[b]))
                for p in (1, -1)
                for q in (1, -1)
            ]
            hessian[a, b] = sum(signs) / (4 * h * h)
    assert_allclose(found.eigenvalues, np.linalg.eigvalsh(hessian)[::-1], rtol=2e-3)
    assert_allclose(found.sd, np.sqrt(np.diag(np.linalg.inv(hessian))), rtol=2e-3)


def test_a_singular_fisher_matrix_gives_infinite_sds_and_no_crash():
    posterior = problem(SHORT, orders=(1.6, 1.0, 1.0), terms=3).posterior
    landscape = Landscape(posterior)
    values = posterior.table.draw(1, np.random.default_rng(3))[0]
    found = curvature(landscape, values, np.ones(values.size))
    sd = dict(zip(found.names, found.sd, strict=True))
    assert np.isinf([sd["time_2"], sd["time_3"], found.collinearity]).all()
    assert np.isfinite([sd["gain"], sd["time_1"], sd["delay"], sd["offset"]]).all()
    assert found.as_json()["relative_sd"]["time_2"] is None
    assert set(found.spectrum()[-1]["direction"]) <= {"time_2", "time_3"}


# -- profiles --------------------------------------------------------------------------------------


def test_profile_of_a_gain_alone_is_the_parabola():
    known = KNOWN | {"gain": FLAT_GAIN, "sigma": TRUTH["sigma"]}
    posterior = problem(SHORT, priors=known).posterior
    landscape = Landscape(posterior)
    peak = landscape.maximise(np.array([TRUTH[name] for name in posterior.table.names]))
    made = profile_of(landscape, "gain", peak)
    found = curvature(landscape, peak.values, np.ones(peak.values.size)).at("gain")
    assert found is not None
    centre = peak.values[posterior.table.names.index("gain")]
    for level, (low, high) in made.intervals.items():
        half = np.sqrt(chi2.ppf(level, 1)) * found[0]
        assert_allclose([low, high], [centre - half, centre + half], atol=0.02 * half)
    assert made.parts == 1
    assert made.open_sides == ()


def test_a_profile_is_extended_from_an_end_that_is_inside():
    known = KNOWN | {"gain": FLAT_GAIN, "sigma": TRUTH["sigma"], "offset": TRUTH["offset"]}
    landscape = Landscape(problem(SHORT, priors=known).posterior)
    peak = landscape.maximise(np.array([TRUTH[name] for name in landscape.posterior.table.names]))
    k = landscape.posterior.table.names.index("gain")
    path = _Path(landscape, k, peak, np.empty((0, peak.values.size)))
    for u in (peak.values[k] - 1e-4, peak.values[k] + 1e-4):
        path.points[u] = path.solve(u, peak.values)
    path.extend_ends()
    outermost = [path.fall(path.points[end]) for end in (min(path.points), max(path.points))]
    assert min(outermost) > path.beyond


@pytest.mark.parametrize("error", [0.3, 3.0])
def test_a_surrogate_that_is_too_high_moves_no_profile(error, monkeypatch):
    """Heights are those of the posterior itself, that of the maximum among them."""
    known = KNOWN | {"gain": FLAT_GAIN, "sigma": TRUTH["sigma"]}
    plain = Landscape(problem(SHORT, priors=known).posterior)
    peak = plain.maximise(np.array([TRUTH[name] for name in plain.posterior.table.names]))
    near = peak.values + 0.01 * np.array([[-1.0], [1.0]])
    intervals = [profile(plain, k, peak, near, 1e-3).intervals[0.9] for k in plain.free]
    monkeypatch.setattr(Landscape, "exact", lambda self, values: plain.log_likelihood(values) - error)
    surrogate = replace(plain, precision=np.eye(2) / 0.01**2)
    found, best = _profiles(surrogate, peak, near, 1)
    assert best.log_likelihood == pytest.approx(peak.log_likelihood - error, abs=1e-3)
    for one, (low, high) in zip(found, intervals, strict=True):
        assert one.best == best.log_likelihood
        assert_allclose(one.intervals[0.9], (low, high), atol=0.02 * (high - low))


def test_a_profile_holds_a_maximum_that_another_one_has_found():
    """Else no point is within the interval of the highest level, and the interval has no ends."""
    u = np.linspace(-1.0, 1.0, 21)
    own = Profile("a", "-", u, u, -50 * u**2, 0.0, (), (-1.0, 1.0), (), np.zeros(1), Freedom(9, 1, True))
    assert own.holding(Peak(np.ones(1), -0.1), 0.35, 0.35) is own
    for at in (0.35, float(u[14])):
        held = own.holding(Peak(np.ones(1), 2.0), at, at)
        assert held.best == 2.0
        assert held.top == 1.0
        assert np.all(np.diff(held.coordinates) > 0)
        assert held.values[np.argmin(held.fall)] == at
        for low, high in held.intervals.values():
            assert low < at < high


def test_points_are_searched_again_from_the_neighbours_they_did_not_begin_at(monkeypatch):
    known = KNOWN | {"gain": FLAT_GAIN, "sigma": TRUTH["sigma"]}
    landscape = Landscape(problem(SHORT, priors=known).posterior)
    peak = landscape.maximise(np.array([TRUTH[name] for name in landscape.posterior.table.names]))
    k = landscape.posterior.table.names.index("gain")
    path = _Path(landscape, k, peak, np.empty((0, peak.values.size)))
    for side in (-1, 1):
        path.extend(path.start, side, 1e-3)
    at = sorted(path.points)
    again = list[tuple[float, float]]()
    monkeypatch.setattr(path, "improve", lambda u, start: again.append((u, float(start[k]))))
    path.from_neighbours()
    pairs = [sorted(pair, key=lambda one: abs(one - path.start)) for pair in pairwise(at)]
    wanted = {(inner, outer) for inner, outer in pairs}
    assert len(wanted) > 8
    assert {(u, min(at, key=lambda one: abs(one - start))) for u, start in again} == wanted


def test_profile_of_a_noise_scale_is_its_closed_form():
    posterior = problem(SHORT, priors=KNOWN | {"gain": FLAT_GAIN}).posterior
    landscape = Landscape(posterior)
    peak = maximum(landscape)
    made = profile_of(landscape, "sigma", peak)
    n, best = posterior.size, peak.values[posterior.table.names.index("sigma")]
    ratio = made.values / best
    near = made.fall < 6
    exact = 2 * n * np.log(ratio) + n * (1 / ratio**2 - 1)
    assert_allclose(made.fall[near], exact[near], atol=2e-3)


def test_a_flat_profile_is_open_and_the_radial_test_moves_along_it():
    posterior = problem(SHORT, orders=(0.8, 0.8), terms=2).posterior
    landscape = Landscape(posterior)
    peak = maximum(landscape)
    made = profile_of(landscape, "time_1", peak)
    lower, upper = made.intervals[0.9]
    assert lower is None
    assert upper is not None  # the two times add up (to the power of the order) to what the record shows
    assert made.as_json()["lower"] is None
    spread = prior_spread(landscape, prior_draws(landscape, np.random.default_rng(1)))
    weakest = curvature(landscape, peak.values, spread).directions[-1]
    moved = radial(landscape, peak, spread, weakest, 0.3)
    assert moved.fall < 0.1
    assert set(moved.moved) & {"time_1", "time_2"}


def test_every_level_is_nested_in_the_next():
    posterior = problem(SHORT).posterior
    landscape = Landscape(posterior)
    made = profile_of(landscape, "order_1", maximum(landscape))
    ends = list(made.intervals.values())
    for (a, b), (c, d) in pairwise(ends):
        assert c < a < b < d


def test_levels_are_exact_for_a_mean_with_unknown_scale_and_tend_to_chi_squared():
    rng, n, inside = np.random.default_rng(8), 6, 0
    freedom = Freedom(n, 1, scale_known=False)
    for sample in rng.standard_normal((4000, n)):
        fall = n * np.log(np.mean(sample**2) / sample.var())
        inside += fall <= freedom.fall_at(0.9)
    assert abs(inside / 4000 - 0.9) < 4 * np.sqrt(0.09 / 4000)
    assert Freedom(n, 1, scale_known=True).fall_at(0.95) == pytest.approx(3.841459, abs=1e-6)
    assert Freedom(10**7, 1, scale_known=False).fall_at(0.95) == pytest.approx(3.841459, abs=1e-5)


# -- verdicts --------------------------------------------------------------------------------------


def rough(landscape: Landscape, peak: Peak, rng: np.random.Generator) -> Matrix:
    """Rough draws: the prior's, weighted by the likelihood, with replacement; the peak where none is near."""
    drawn = landscape.posterior.table.draw(4000, rng)
    weights = np.exp(landscape.log_likelihood(drawn) - peak.log_likelihood)
    if weights.sum() ** 2 < 50 * (weights**2).sum():
        drawn, weights = np.concatenate([drawn, peak.values[None]]), np.append(weights, 20.0)
    return drawn[rng.choice(drawn.shape[0], 400, p=weights / weights.sum())]


def found_of(name: str, seed: int, **options: object) -> Finding:
    fast = str(options.pop("fast", ""))
    made = problem(options.pop("record_of")(seed), **options)  # type: ignore[operator]
    posterior = made.posterior
    landscape, rng = Landscape(posterior), np.random.default_rng(seed)
    peak = maximum(landscape)
    prior = prior_draws(landscape, rng)
    spread = prior_spread(landscape, prior)
    draws = draws_of(posterior.table, rough(landscape, peak, rng))
    belief = next(b for b in beliefs(landscape, draws, spread, ()) if b.parameter == name)
    row = posterior.table.rows[posterior.table.names.index(name)]
    return judged(
        profile_of(landscape, name, peak),
        belief,
        structure_of(posterior),
        curvature(landscape, peak.values, spread),
        _flat(row),
        Tolerance.of(row, made.scales),
        fast,
    )


def plain(seed: int):
    return record(seed, camera=0.6)


CASES = {
    "structurally unidentifiable": ("time_2", {"orders": (1.0, 1.0), "terms": 2, "record_of": plain}),
    "identified": ("delay", {"record_of": plain, "priors": {"gain": FLAT_GAIN}}),
    "prior-dominated": (
        "gain",
        {
            "record_of": plain,
            "noise": "white",
            "priors": KNOWN | {"offset": TRUTH["offset"], "gain": ("norm", {"loc": 2.0, "scale": 1e-3})},
        },
    ),
    "one-sided": ("time_2", {"record_of": plain, "orders": (0.8, 0.3), "terms": 2}),
    "practically unidentifiable": (
        "time_2",
        {"record_of": plain, "terms": 2, "priors": {"time_2": ("loguniform", {"a": 1e-4, "b": 2e-3})}},
    ),
}


@pytest.mark.parametrize("verdict", CASES)
def test_each_verdict_is_recognised(verdict):
    name, options = CASES[verdict]
    assert found_of(name, 0, **options).verdict == verdict


def test_an_interval_that_spans_more_than_a_factor_of_two_is_weakly_identified():
    """The same gain from a quiet and from a loud record, everything else known."""
    known = {"priors": KNOWN | {"offset": TRUTH["offset"], "gain": FLAT_GAIN}, "noise": "white"}
    verdicts = []
    for noise_sd in (0.02, 2.5):
        found = found_of(
            "gain", 1, record_of=lambda s, sd=noise_sd: record(s, camera=0.6, noise_sd=sd), **known
        )
        low, high = found.profile.intervals[0.9]
        assert (found.verdict == "weakly identified") == (high > 2 * low)
        verdicts.append(found.verdict)
    assert verdicts == ["identified", "weakly identified"]
    assert "a factor of" in found.reason


def test_what_resonates_faster_than_the_samples_is_never_identified():
    found = found_of("delay", 1, record_of=plain, priors={"gain": FLAT_GAIN}, fast="a periodic disturbance")
    assert (found.verdict, found.reason) == ("unresolved", "a periodic disturbance")


def row_of(kind: str) -> Parameter:
    return Parameter(kind, "-", kind, Place(0, 0), None)


@pytest.mark.parametrize(
    ("kind", "lower", "upper", "wide"),
    [
        ("gain", 0.0177, 0.0397, True),
        ("gain", 0.0177, 0.0350, False),
        ("gain", -0.0350, -0.0177, False),
        ("gain", -0.0397, -0.0177, True),
        ("gain", -0.001, 0.001, True),
        ("time", 1.0, 2.1, True),
        ("time", 1.0, 1.9, False),
        ("order", 0.6, 1.2, True),
        ("order", 0.6, 1.0, False),
        ("delay", 0.0, 0.9, False),  # a sampling period is 1
        ("delay", 0.1, 1.3, True),
        ("delay", 10.0, 15.0, False),
        ("offset", -0.5, 0.4, False),  # the response ranges over 2
        ("offset", -0.6, 0.5, True),
        ("rho", 0.3, 0.7, False),
        ("rho", 0.3, 0.9, True),
        ("sigma", 0.01, 0.019, False),
    ],
)
def test_the_tolerance_of_each_kind(kind, lower, upper, wide):
    scales = SimpleNamespace(period=1.0, amplitude=np.array([2.0]))
    assert bool(Tolerance.of(row_of(kind), scales).exceeded(lower, upper)) == wide


@pytest.mark.slow
@pytest.mark.parametrize("verdict", CASES)
def test_each_verdict_is_recognised_in_95_of_100_noise_draws(verdict):
    name, options = CASES[verdict]
    recognised = [found_of(name, seed, **options).verdict for seed in range(100)]
    assert recognised.count(verdict) >= 95


@pytest.mark.slow
def test_profiles_cover_the_truth_at_their_level():
    inside = 0
    for seed in range(100):
        landscape = Landscape(problem(plain(seed), priors={"gain": FLAT_GAIN}).posterior)
        low, high = profile_of(landscape, "delay", maximum(landscape)).intervals[0.9]
        inside += low <= TRUTH["delay"] <= high
    assert 82 <= inside <= 97  # 99 % of binomials with 100 and 0.9
