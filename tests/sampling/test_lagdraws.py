"""Draws of sums of lags are those of their density, and hold what made the records."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from inference.test_diffusion import DELAY as SLAB_DELAY
from inference.test_diffusion import records_of
from inference.test_lagsum import DELAY, GAINS, SD, lags, made
from small import U, Y

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference import lagsum
from lcopa_bayes.inference.diffusion import rises
from lcopa_bayes.inference.lagsearch import LagSearch, likely
from lcopa_bayes.inference.lagsum import lag_problem
from lcopa_bayes.sampling import lagdraws
from lcopa_bayes.sampling.lagdraws import LagDraws, LagMixture, _begun, _walked, _weighted, lag_draws

ENDS = np.array([[0.0, 1.0]])


def drawn(seed: int = 0, spare: int = 1) -> LagDraws:
    search = searched(seed)
    return lag_draws(search, search.best.lags + spare, seed)


def searched(seed: int = 0, ends: Matrix = ENDS) -> LagSearch:
    (one,) = LagSearch.over(lag_problem(made(seed)), 0, [0], np.array([SD]), ends, ["lags"])
    return one


@pytest.mark.parametrize("sampled", [_weighted, _walked])
def test_draws_agree_with_quadrature(sampled: Callable[..., tuple[Matrix, float]]) -> None:
    """Of one lag and a spare one: three coordinates on a grid."""
    search = LagSearch(lag_problem(made()), 0, (0,), np.array([20 * SD]), ENDS, np.array([[0.1, 0.9]]))
    table = search.table
    assert search.best.lags == 1
    rng = np.random.default_rng(1)
    draws, ess = sampled(search, _begun(search, 2, rng), rng)
    assert ess >= 160
    low, high = table.ends(2)
    axes = [np.linspace(low[k], high[k], 41)[:-1] + (high[k] - low[k]) / 80 for k in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    level = np.concatenate([table.log_density(part) for part in np.array_split(grid, 40)])
    weight = np.exp(level - level.max())
    weight /= weight.sum()
    for of in (lambda x: x[:, 2], lambda x: x[:, :2].max(axis=1), lambda x: x[:, :2].min(axis=1)):
        values = of(grid)
        mean = float(weight @ values)
        sd = float(np.sqrt(weight @ (values - mean) ** 2))
        own = of(draws)
        assert own.mean() == pytest.approx(mean, abs=4 * sd / np.sqrt(ess))
        assert own.std() == pytest.approx(sd, rel=0.25)


def test_the_draws_that_are_kept_of_a_walk_are_worth_no_more_than_their_number(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(lagdraws, "_ess", lambda *_: 1e9)
    monkeypatch.setattr(lagdraws, "_STEPS", 20)
    search = LagSearch(lag_problem(made()), 0, (0,), np.array([20 * SD]), ENDS, np.array([[0.1, 0.9]]))
    rng = np.random.default_rng(1)
    draws, ess = _walked(search, _begun(search, 1, rng), rng)
    assert ess == pytest.approx(len(draws))


@pytest.mark.parametrize("spare", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_intervals_hold_what_made_the_records(spare: int) -> None:
    held = []
    for seed in range(4):
        one = drawn(seed, spare)
        assert one.times.shape[2] == len(GAINS) + spare
        for values, true in (
            (one.gains[:, 0], sum(GAINS)),
            (one.delays[:, 0], DELAY),
            (
                one.response(0, np.array([12.0]))[:, 0],
                float(lags(np.array([12.0]), GAINS, (0.6, 3.0), DELAY)[0]),
            ),
        ):
            low, high = np.quantile(values, (0.01, 0.99))
            held.append(low <= true <= high)
    assert sum(held) >= 10  # of 12 at 98 %: fewer once in 700 times


def test_the_same_seed_gives_the_same_draws() -> None:
    one, two, other = drawn(1), drawn(1), lag_draws(searched(1), 3, 2)
    assert (one.times == two.times).all()
    assert (one.weights == two.weights).all()
    assert not (one.times == other.times).all()


def test_a_delay_at_the_end_of_the_first_table_is_followed() -> None:
    one = lag_draws(searched(ends=np.array([[0.0, 4.0]])), 3, 0)
    assert np.median(one.delays) == pytest.approx(DELAY, abs=0.1)


def test_the_response_is_the_sum_of_its_lags() -> None:
    one = drawn()
    time = np.array([0.1, 0.5, 1.0, 10.0, 1e4])
    expected = np.array(
        [
            lags(time, tuple(weights), tuple(times), float(delay))
            for weights, times, delay in zip(
                one.weights[:5, 0], one.times[:5, 0], one.delays[:5, 0], strict=True
            )
        ]
    )
    assert one.response(0, time)[:5] == pytest.approx(expected, abs=1e-12)
    assert one.response(0, time)[:, -1] == pytest.approx(one.gains[:, 0], rel=1e-9, abs=1e-9)


def slab(seed: int) -> tuple[LagSearch, ...]:
    return LagSearch.over(
        lag_problem(records_of("wall", seed)), 0, [0], np.array([SD]), np.array([[0.0, 1.5]])
    )


@pytest.mark.slow
def test_a_wall_is_drawn_where_it_follows_the_records_best() -> None:
    """Its delay, which draws of lags alone put further away."""
    searches = slab(0)
    chosen = likely(searches)
    assert chosen[0].kind == "wall"
    assert all(one.best.bic < chosen[0].best.bic + 10.0 for one in chosen)
    assert {one.kind for one in chosen} < {one.kind for one in searches}
    held, off = 0, dict.fromkeys(("wall", "lags"), 0.0)
    for seed in range(4):
        for one in slab(seed):
            if one.kind in off:
                delays = lag_draws(one, one.lags[-1], seed).delays[:, 0]
                low, middle, high = np.quantile(delays, (0.01, 0.5, 0.99))
                held += one.kind == "wall" and low <= SLAB_DELAY <= high
                off[one.kind] += abs(middle - SLAB_DELAY)
    assert held >= 3  # of 4 at 98 %: fewer once in 400 times
    assert off["wall"] < off["lags"]


def test_the_response_of_a_wall_is_that_of_its_series_and_lags() -> None:
    (search,) = [one for one in slab(0) if one.kind == "wall"]
    one = lag_draws(search, search.lags[-1], 0)
    assert one.kind == "wall"
    time = np.array([0.1, 0.5, 1.0, 10.0, 1e4])
    since = np.maximum(time - one.delays[3, 0], 0.0)
    expected = one.weights[3, 0, 0] * rises("wall", since, one.times[3, 0, 0])
    expected += lags(since, tuple(one.weights[3, 0, 1:]), tuple(one.times[3, 0, 1:]), 0.0)
    assert one.response(0, time)[3] == pytest.approx(expected, abs=1e-12)
    assert one.response(0, time)[:, -1] == pytest.approx(one.gains[:, 0], rel=1e-6, abs=1e-6)


@pytest.mark.slow
def test_kinds_and_numbers_of_lags_have_equal_parts_in_a_mixture() -> None:
    searches = slab(0)[:2]
    both = LagMixture.of(searches, 3)
    every = [(one, lags) for one in searches for lags in (one.best.lags, one.best.lags + 1)]
    apart = [lag_draws(one, lags, 3, 50.0) for one, lags in every]
    ends = [set(one.delays[:, 0]) for one in apart]
    counts = [sum(value in own for value in both.delays[:, 0]) for own in ends]
    assert counts == [len(both.delays) / 4] * 4
    assert both.ess == pytest.approx(4 * min(one.ess for one in apart))
    time = np.array([5.0])
    source = apart[next(k for k, own in enumerate(ends) if both.delays[0, 0] in own)]
    place = int(np.flatnonzero(source.delays[:, 0] == both.delays[0, 0])[0])
    assert both.response(0, time)[0] == pytest.approx(source.response(0, time)[place])
    assert both.gains[0] == pytest.approx(source.gains[place])


def chains(seed: int) -> Study:
    """Two drives of one response, each with three lags one behind the other: short ones look like a delay."""
    rng = np.random.default_rng(seed)
    times = np.array([0.3, 0.1, 0.05])
    shares = np.array([np.prod([one / (one - other) for other in times if other != one]) for one in times])
    time, records = np.linspace(0.0, 3.0, 300), []
    for k in range(2):
        drive = np.zeros((time.size, 2))
        drive[time >= 0.5, k] = 20.0
        start = time[time >= 0.5][0]
        response = (0.8, -0.3)[k] * 20.0 * lags(time, tuple(shares), tuple(times), start + 0.01)
        read = response + 0.05 * rng.standard_normal(time.size)
        records.append(Record(f"r{k}", time, drive, read[:, None], (U, replace(U, name="v")), (Y,), "s"))
    return Study("chains", None, "s", 0, tuple(records), (), noise={"kind": "white"})


@pytest.mark.slow
def test_walkers_of_several_paths_leave_where_they_began() -> None:
    """Moves of all ten coordinates at once leave hardly more than one effective draw a walker, which is the
    one that it began with."""
    ends = np.array([[0.0, 0.2]] * 2)
    (search,) = LagSearch.over(lag_problem(chains(0)), 0, [0, 1], np.array([0.05]), ends, ["lags"])
    rng = np.random.default_rng(1)
    draws, ess = _walked(search, _begun(search, search.lags[-1], rng), rng)
    assert draws.shape[1] >= 8
    assert ess >= 1 / (1 / 200 + 1 / len(draws))  # the walk gave 200, of which draws are picked at random


def test_more_lags_than_the_best_and_one_are_begun_too() -> None:
    """Tabulated elsewhere a search may have another best than the one that a number of lags was asked for."""
    search = searched()
    for count in range(1, 5):
        begun = _begun(search, count, np.random.default_rng(0))
        assert begun.dimension == count + 1
        assert (begun.draw(50, np.random.default_rng(1))[:, :-1] < 30.0).all()


@pytest.mark.parametrize(("weight", "seeds", "least"), [(1.0, 3, 0.2), (lagsum.WEIGHT, 10, 0.078)])
def test_the_first_mixture_is_where_everything_else_settles_beside_a_spare_lag(
    monkeypatch, weight, seeds, least
) -> None:
    """By what its draws are worth: without settling, or with masses of another sign, a sixth or more less;
    0.087 of the second, whose weights are as wide as they are, then 0.047, 0.063 or 0.069."""
    monkeypatch.setattr(lagsum, "WEIGHT", weight)
    search, shares = searched(), []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        begun = _begun(search, search.best.lags + 1, rng)
        drawn = begun.draw(6_000, rng)
        log_times = search.table.parts(drawn)[0]
        density = search.table.log_density(drawn) - begun.log_density(drawn)
        density[(np.diff(log_times, axis=2) < 0).any(axis=(1, 2))] = -np.inf
        weight = np.exp(density - density.max())
        shares.append(weight.sum() ** 2 / (weight**2).sum() / len(drawn))
    assert np.mean(shares) > least
