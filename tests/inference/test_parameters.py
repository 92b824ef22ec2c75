"""The parameter table: names, priors within domains, fixed values, orderings and exchange of terms."""

from __future__ import annotations

import itertools
import pickle
from math import factorial, log

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import integrate, stats
from small import TWO, problem, record, study

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.priors import Prior

TWO_TERMS = {"terms": 2}


def table(*fit, **options) -> ParameterTable:
    return problem(*fit, **options).posterior.table


def refusal(**options) -> tuple[str, ...]:
    with pytest.raises(InputError) as caught:
        problem_of(study(record(), **options))
    return caught.value.problems


def parameter(kind: str, dist: str, **parameters: float) -> Parameter:
    return Parameter("it", "-", kind, Place(0, 0), Prior(dist, parameters))


def test_names_and_units_of_one_path():
    rows = table(noise="ar1", terms=2).rows
    assert [(row.name, row.unit) for row in rows] == [
        ("gain", "rad/V"),
        ("time_1", "ms"),
        ("order_1", "-"),
        ("time_2", "ms"),
        ("order_2", "-"),
        ("delay", "ms"),
        ("offset", "rad"),
        ("sigma", "rad"),
        ("rho", "-"),
    ]


def test_names_of_two_axes():
    names = table(record(device=TWO), terms={"direct": 2, "cross": 1}, delay="element").names
    gains, delays = ("gain_x_x", "gain_x_y", "gain_y_x", "gain_y_y"), ("delay_direct", "delay_cross")
    direct = ("time_1_direct", "order_1_direct", "time_2_direct", "order_2_direct")
    rest = ("time_1_cross", "order_1_cross", *delays, "offset_x", "offset_y", "sigma_x", "sigma_y")
    assert names == (*gains, *direct, *rest)
    pair = (record(device=TWO, name="a"), record(device=TWO, name="b"))
    per_record = [name for name in table(*pair, share="all").names if name.startswith("offset")]
    assert per_record == ["offset_x_a", "offset_x_b", "offset_y_a", "offset_y_b"]
    assert [n for n in table(*pair, offset="shared").names if "offset" in n] == ["offset_x", "offset_y"]
    assert not any("offset" in name for name in table(*pair, offset="none").names)


@pytest.mark.parametrize(
    ("kind", "low", "high", "prior"),
    [
        ("time", 0, np.inf, ("norm", {"loc": 1.0, "scale": 2.0})),
        ("delay", 0, np.inf, ("norm", {"loc": -3.0, "scale": 1.0})),
        ("order", 0, 2, ("norm", {"loc": 1.7, "scale": 0.5})),
        ("order", 0, 2, ("lognorm", {"s": 0.4})),
        ("rho", 0, 1, ("uniform", {"loc": -1.0, "scale": 2.0})),
        ("sigma", 0, np.inf, ("lognorm", {"s": 1.0})),
    ],
)
def test_a_prior_is_normalised_within_its_domain(kind, low, high, prior):
    row = parameter(kind, prior[0], **prior[1])
    mass, _ = integrate.quad(
        lambda x: float(np.exp(row.log_prior(np.array([x])))[0]), low, high, epsabs=1e-10, epsrel=1e-10
    )
    assert mass == pytest.approx(1.0, abs=1e-7)
    outside = np.array([low - 1.0, *([high + 1.0] if np.isfinite(high) else [])])
    assert_array_equal(row.log_prior(outside), -np.inf)
    frozen = row.prior.frozen
    drawn = row.draw(4000, np.random.default_rng(0))
    start, share = frozen.cdf(low), frozen.cdf(high) - frozen.cdf(low)
    assert stats.kstest(drawn, lambda x: (frozen.cdf(x) - start) / share).pvalue > 1e-3
    p = np.array([1e-9, 0.1, 0.5, 0.9, 1 - 1e-9])
    assert_allclose((frozen.cdf(row.quantiles(p)) - start) / share, p, rtol=1e-6, atol=1e-12)
    ends = row.quantiles((0.0, 1.0))
    assert low < ends[0] < row.quantiles((0.0, 1e-12))[1]
    assert ends[1] < high


def test_a_correlation_of_one_and_orders_beyond_two_have_no_density():
    flat = parameter("rho", "uniform")
    assert_array_equal(flat.log_prior(np.array([1.0, 0.5])), [-np.inf, 0.0])
    assert np.isfinite(parameter("order", "uniform", scale=3.0).log_prior(np.array([2.0]))[0])


def test_scales():
    assert parameter("gain", "loguniform", a=1.0, b=9.0).log_scale
    assert not parameter("gain", "loguniform", a=1.0, b=9.0, loc=-5.0).log_scale
    assert not parameter("gain", "norm").log_scale
    for dist, reported in (("uniform", {}), ("loguniform", {"a": 0.01, "b": 0.99})):
        rho = parameter("rho", dist, **reported)
        assert rho.logit_scale
        assert not rho.log_scale


def test_problems_are_reported_all_at_once():
    priors = {
        "tiem_1": 3.0,
        "time_1": ("uniform", {"loc": -5.0, "scale": 4.0}),
        "order_1": 2.5,
        "delay": -1.0,
        "sigma": 0.0,
    }
    reported = refusal(priors=priors)
    assert len(reported) == 5
    assert "tiem_1" in reported[0]
    assert "did you mean 'time_1'?" in reported[0]
    assert all(
        name in line for name, line in zip(("time_1", "order_1", "delay", "sigma"), reported[1:], strict=True)
    )
    assert "uniform(loc=-5, scale=4) has no mass in (0, inf)" in reported[1]
    assert "must lie in (0, 2]" in reported[2]
    assert "must lie in [0, inf)" in reported[3]


def test_a_correlation_cannot_be_fixed_at_one():
    assert "must lie in [0, 1)" in refusal(noise="ar1", priors={"rho": 1.0})[0]
    assert table(noise="ar1", priors={"rho": 0.0}).rows[-1].value == 0.0


def test_a_far_tail_is_drawn_from_without_waiting_for_it():
    drawn = parameter("time", "norm", loc=-5.0).draw(1000, np.random.default_rng(0))
    assert drawn.min() > 0
    assert drawn.mean() == pytest.approx(stats.truncnorm(5, np.inf, loc=-5).mean(), rel=0.15)
    assert "no mass" in refusal(priors={"delay": ("norm", {"loc": -9.0})})[0]


def test_fixed_values_and_own_priors():
    own = table(priors={"delay": 0.0, "gain": ("lognorm", {"s": 1.0})}, orders=(1.0,), terms=1)
    rows = {row.name: row for row in own.rows}
    assert (rows["delay"].free, rows["delay"].value, rows["delay"].default) == (False, 0.0, False)
    assert (rows["gain"].free, rows["gain"].default) == (True, False)
    assert (rows["order_1"].free, rows["order_1"].value) == (False, 1.0)
    drawn = own.draw(50, np.random.default_rng(0))
    assert_array_equal(drawn[:, [own.at("delay", 0), own.at("order", 0, 0)]], [[0.0, 1.0]] * 50)


def test_orders_fixed_for_another_number_of_terms_are_refused():
    with pytest.raises(InputError, match="one order per term"):
        problem(record(device=TWO), terms={"direct": 2, "cross": 2}, orders=(1.0,))


def test_a_study_may_fix_equal_orders():
    made = table(orders=(2.0, 1.0, 1.0), terms=3)
    assert made.log_permutations == 0.0
    fast = made.rows[made.at("time", 0, 0)].mass_below(made.resolution)  # only order 2 can be an alias
    assert 0 < fast < 1
    assert made.log_support == pytest.approx(-log(1 - fast))
    assert made.supported(made.draw(20, np.random.default_rng(0))).all()


NARROW = {"order_1": ("norm", {"loc": 1.3, "scale": 0.2}), "order_2": ("norm", {"loc": 1.1, "scale": 0.3})}


def test_exchangeable_terms_count_their_permutations():
    three = table(terms=3)
    assert three.exchangeable == (True,)
    assert three.log_permutations == pytest.approx(log(factorial(3)))
    resolved = 1 - three.rows[three.at("time", 0, 0)].mass_below(three.resolution) / 2
    assert three.log_support == pytest.approx(log(factorial(3)) - 3 * log(resolved))
    own = table(terms=2, priors=NARROW)
    assert own.exchangeable == (False,)
    assert own.log_permutations == 0.0


def test_prior_mass_on_decreasing_orders_is_the_normal_probability():
    share = stats.norm.cdf((1.3 - 1.1) / np.hypot(0.2, 0.3))  # the cut at 0 and 2 moves it by less than 1e-3
    own = table(terms=2, priors=NARROW)
    assert np.exp(-own.log_support) == pytest.approx(share, abs=4 * np.sqrt(share * (1 - share) / 2e5) + 1e-3)
    drawn = own.draw(500, np.random.default_rng(0))
    assert own.supported(drawn).all()
    alike = dict(NARROW, order_2=NARROW["order_1"])
    assert table(terms=2, priors=alike).exchangeable == (True,)
    apart = alike | {"time_2": ("lognorm", {"s": 1.0})}
    half = table(terms=2, priors=apart)
    assert half.exchangeable == (False,)
    assert half.log_support == pytest.approx(log(2), abs=4 * 0.5 / np.sqrt(2e5) * 2)


def test_orders_that_cannot_decrease_are_refused():
    crossed = {
        "order_1": ("norm", {"loc": 0.5, "scale": 0.01}),
        "order_2": ("norm", {"loc": 1.5, "scale": 0.01}),
    }
    (reported,) = refusal(terms=2, priors=crossed)
    assert "order_1 > order_2" in reported


@given(st.permutations(range(3)), st.integers(0, 1000))
def test_canonical_does_not_depend_on_the_order_of_terms(rank, seed):
    made = THREE
    values = made.draw(4, np.random.default_rng(seed))
    mixed = values.copy()
    for kind in ("time", "order"):
        columns = np.array([made.at(kind, 0, k) for k in range(3)])
        mixed[:, columns] = values[:, columns[list(rank)]]
    sorted_, source = made.sorted_with_source(mixed)
    assert_array_equal(sorted_, values)
    assert_array_equal(made.canonical(mixed), values)
    assert_array_equal(np.take_along_axis(sorted_, source, axis=1), mixed)
    assert made.supported(values).all()


THREE = table(terms=3)


def test_draws_follow_the_ordered_prior():
    times = ("loguniform", {"a": 1.0, "b": 100.0})
    own = table(terms=3, priors={f"time_{k}": times for k in (1, 2, 3)})
    drawn = own.draw(4000, np.random.default_rng(2))
    for k in range(3):  # the k-th largest of three uniform numbers
        order = drawn[:, own.at("order", 0, k)] / 2
        assert stats.kstest(order, stats.beta(3 - k, 1 + k).cdf).pvalue > 1e-3
        time = drawn[:, own.at("time", 0, k)]
        assert stats.kstest(time, own.rows[own.at("time", 0, k)].prior.frozen.cdf).pvalue > 1e-3


def test_default_priors_hold_no_alias():
    """A term of order above 1 resonates below the Nyquist frequency, unless its study says otherwise."""
    nyquist = np.pi / 0.2  # of samples every 0.2
    for terms, narrow in ((1, {}), (3, {}), (2, {"order_2": ("uniform", {"loc": 0.2, "scale": 1.5})})):
        made = table(terms=terms, priors=narrow)
        drawn = made.draw(4000, np.random.default_rng(3))
        assert made.supported(drawn).all()
        fast = drawn.copy()
        fast[:, made.at("time", 0, 0)] = 0.99 / nyquist
        resonates = fast[:, made.at("order", 0, 0)] > 1
        assert 0 < resonates.mean() < 1
        assert_array_equal(made.supported(fast), ~resonates)
        assert (1 / drawn[drawn[:, made.at("order", 0, 0)] > 1, made.at("time", 0, 0)] <= nyquist).all()
    own = table(terms=1, priors={"time_1": ("loguniform", {"a": 0.001, "b": 1.0})})
    assert own.log_support == 0.0
    assert own.draw(4000, np.random.default_rng(4))[:, own.at("time", 0, 0)].min() < 0.01


def test_views_of_values():
    two = table(record(device=TWO), terms={"direct": 2, "cross": 1})
    values = two.draw(3, np.random.default_rng(0))
    gains = two.gains(values)
    for i, j in itertools.product(range(2), range(2)):
        assert_array_equal(gains[:, i, j], values[:, two.names.index(f"gain_{'xy'[i]}_{'xy'[j]}")])
    dynamics = two.dynamics(values)
    assert [part.shape for part in dynamics.times] == [(3, 2), (3, 1)]
    assert_array_equal(dynamics.orders[1][:, 0], values[:, two.names.index("order_1_cross")])
    assert_array_equal(two.offset(values, 1, 0), values[:, two.names.index("offset_y")])
    assert_allclose(table(offset="none").offset(np.ones((2, 5)), 0, 0), 0.0)


def test_a_table_goes_to_another_process_unchanged():
    copy = pickle.loads(pickle.dumps(THREE))
    assert repr(copy.rows) == repr(THREE.rows)  # a value that is not fixed is NaN
    assert [row.prior for row in copy.rows] == [row.prior for row in THREE.rows]
    assert copy.exchangeable == THREE.exchangeable
