"""Sums of lags: their tabulated likelihood is the exact one, least squares gives back what made a record."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from small import U, Y

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.descents import descended
from lcopa_bayes.inference.lagfits import LagDescents, lag_fits
from lcopa_bayes.inference.lagsum import WEIGHT, LagTable, lag_problem, lag_table

SD = 0.01
GAINS, TIMES, DELAY = (0.7, 0.5), (0.6, 3.0), 0.43
HEIGHTS = (1.0, -0.5)


def lags(time: Vector, gains: tuple[float, ...], times: tuple[float, ...], delay: float) -> Vector:
    since = np.maximum(time - delay, 0.0)
    return sum(-gain * np.expm1(-since / one) for gain, one in zip(gains, times, strict=True))  # type: ignore[return-value]


def made(seed: int = 0, sd: float = SD, count: int = 150) -> Study:
    rng = np.random.default_rng(seed)
    records = []
    for k, height in enumerate(HEIGHTS):
        time = np.linspace(-2.0, 12.0, count)
        time -= time[int(np.abs(time).argmin())]
        drive = np.where(time >= 0, height, 0.0)[:, None]
        read = 0.3 * k + height * lags(time, GAINS, TIMES, DELAY) + sd * rng.standard_normal(count)
        records.append(Record(f"r{k}", time, drive, read[:, None], (U,), (Y,), "s"))
    return Study("lags", None, "s", 0, tuple(records), (), noise={"kind": "white"})


def tabulated(problem: Problem, low: float = 0.2, high: float = 0.7) -> LagTable:
    return lag_table(problem, 0, [0], np.array([SD]), np.linspace(low, high, 33)[None])


def exact_log_marginal(problem: Problem, coordinates: Vector) -> float:
    """Weights integrated out of the closed form, offsets under a prior without an end."""
    scale = problem.scales.amplitude[0] / problem.scales.excursion[0]
    columns, target = [], []
    offsets = np.eye(len(HEIGHTS))
    times, delay = np.exp(coordinates[:-1]), float(coordinates[-1])
    for k, record in enumerate(problem.study.fit):
        one = [HEIGHTS[k] * scale * lags(record.time, (1.0,), (time,), delay) for time in times]
        columns.append(np.stack([*one, *np.outer(offsets[k], np.ones(record.time.size))]) / SD)
        target.append(record.response[:, 0] / SD)
    whole, y = np.concatenate(columns, axis=1), np.concatenate(target)
    prior = np.diag([*np.full(times.size, WEIGHT**-2.0), 0.0, 0.0])
    precision = whole @ whole.T + prior
    mean = np.linalg.solve(precision, whole @ y)
    offset_part = np.linalg.slogdet(whole[-2:] @ whole[-2:].T)[1]
    half = 0.5 * (np.linalg.slogdet(precision)[1] - offset_part)
    return float(0.5 * (mean @ whole @ y - y @ y) - half - times.size * np.log(WEIGHT))


@pytest.mark.parametrize("times", [(0.6,), (0.55, 3.3), (0.2, 1.1, 7.0)])
def test_the_tabulated_likelihood_is_that_of_the_closed_form(times: tuple[float, ...]) -> None:
    problem = lag_problem(made())
    table = tabulated(problem)
    first = np.array([*np.log(times), 0.45])
    places = np.array([first, [*np.log(times), table.delays[0, 10]], [*np.log(times), table.delays[0, 20]]])
    exact = np.array([exact_log_marginal(problem, one) for one in places])
    own = table.log_density(places)
    assert own[1:] == pytest.approx(exact[1:], abs=0.1, rel=1e-3)
    assert own[0] == pytest.approx(exact[0], abs=2.0, rel=1e-3)  # between delays the onset is interpolated


def test_outside_what_is_tabulated_nothing_is_likely() -> None:
    table = tabulated(lag_problem(made()))
    low, high = table.ends(1)
    outside = np.array([[low[0] - 0.1, 0.4], [high[0] + 0.1, 0.4], [0.0, 0.1], [0.0, 0.8]])
    assert np.isneginf(table.log_density(outside)).all()
    assert np.isfinite(table.log_density(np.array([[0.0, 0.4]]))).all()


def test_the_cost_of_a_search_is_the_square_of_the_likelihood() -> None:
    table = tabulated(lag_problem(made()))
    at = np.array([np.log(0.5), np.log(2.0), 0.5])
    conditional = table.conditional(at[None])
    square = conditional.square - float(conditional.bent[0] @ conditional.bent[0])
    assert float(np.sum(table.residuals(at[None]) ** 2)) + table.remainder == pytest.approx(square, rel=1e-9)


def test_least_squares_gives_back_what_made_the_records() -> None:
    study = made(sd=1e-6)
    table = tabulated(lag_problem(study), DELAY - 0.1, DELAY + 0.1)
    two = lag_fits(table)[1]
    assert np.sort(np.exp(two.coordinates[:-1])) == pytest.approx(TIMES, rel=2e-3)
    assert two.coordinates[-1] == pytest.approx(DELAY, abs=2e-3)


def test_bic_finds_the_number_of_lags_and_more_never_fit_worse() -> None:
    found = [lag_fits(tabulated(lag_problem(made(seed)))) for seed in range(3)]
    assert [min(fits, key=lambda one: one.bic).lags for fits in found] == [2, 2, 2]
    for fits in found:
        squares = [one.square for one in fits]
        assert all(later <= earlier + 0.5 for earlier, later in pairwise(squares))
        assert fits[1].bic == pytest.approx(fits[1].square + 5 * np.log(fits[1].size))
        # chi-square of the residual and of two weights of the size of the range
        assert abs(fits[1].square - fits[1].size) < 5 * np.sqrt(2 * fits[1].size)


def test_akaikes_criterion_is_of_the_residual_alone() -> None:
    """Second method: what the most probable weights leave of the record, and their own square. Weights of two
    lags that are hardly apart are many ranges of the record large."""
    for seed in range(2):
        table = tabulated(lag_problem(made(seed)))
        two = lag_fits(table)[1]
        columns = table.columns(two.coordinates[None])[0]
        weights = np.linalg.solve(columns @ columns.T + np.eye(2) / WEIGHT**2, columns @ table.target)
        left = float(np.sum((table.target - weights @ columns) ** 2)) + table.remainder
        assert two.misfit == pytest.approx(left, rel=1e-9)
        assert two.weights == pytest.approx(float(weights @ weights) / WEIGHT**2, rel=1e-6)
        assert two.aic == pytest.approx(left + 2 * 5)


@pytest.mark.parametrize("times", [(4.0, 2.0), (7.0, 3.0, 1.2), (5.0, 2.0, 0.8)])
def test_the_prior_of_weights_says_little_against_a_product_of_lags(times) -> None:
    """Less than half a nat against the partial fractions of unit gain."""
    own = np.array(times)
    residues = [t ** (own.size - 1) / np.prod(t - own[own != t]) for t in own]
    assert np.sum(residues) == pytest.approx(1.0)
    assert 0.5 * float(np.sum(np.square(residues))) / WEIGHT**2 < 0.5


def test_records_of_twice_the_noise_have_a_quarter_of_the_square() -> None:
    problem = lag_problem(made())
    nodes = np.linspace(0.2, 0.7, 33)[None]
    one, two = (lag_table(problem, 0, [0], np.array([sd]), nodes) for sd in (SD, 2 * SD))
    squares = [float(table.target @ table.target) + table.remainder for table in (one, two)]
    assert squares[1] == pytest.approx(squares[0] / 4, rel=1e-9)


def test_a_record_whose_drive_is_still_tells_nothing_of_the_lags() -> None:
    moved = made().fit[0]
    still = replace(moved, name="still", drive=np.zeros_like(moved.drive))
    both, alone = (lag_problem(replace(made(), fit=records)) for records in ((moved, still), (moved,)))
    places = np.array([[np.log(time), delay] for time in (0.4, 1.0, 3.0) for delay in (0.3, 0.5)])
    levels = [tabulated(problem).log_density(places) for problem in (both, alone)]
    assert np.ptp(levels[0] - levels[1]) < 1e-3 * np.ptp(levels[1])


def test_a_record_whose_drive_is_still_has_no_span() -> None:
    moved = made().fit[0]
    still = replace(moved, name="still", drive=np.zeros_like(moved.drive))
    end = moved.time[-1] - moved.time[np.flatnonzero(moved.drive[:, 0])[0]]
    assert Scales.of([moved, still]).span == pytest.approx(end)
    assert Scales.of([still]).span == pytest.approx(moved.time[-1] - moved.time[0])


def test_every_other_sample_keeps_the_time_between_samples() -> None:
    whole = lag_problem(made()).posterior.samples[0].axes[0]
    gaps = np.arange(1.0, whole.values.size + 1)
    half = replace(whole, gaps=gaps).every(2)
    assert (half.values == whole.values[::2]).all()
    assert half.gaps[0] == 1.0
    assert half.gaps[1:] == pytest.approx(gaps[1:-1:2] + gaps[2::2])


def test_of_many_samples_some_are_used_and_the_answer_stays() -> None:
    few, many = (lag_problem(made(count=count)) for count in (1_500, 6_000))
    assert few.posterior.size == 3_000
    assert 1_500 < many.posterior.size <= 4_000
    times = [np.sort(np.exp(lag_fits(tabulated(one))[1].coordinates[:-1])) for one in (few, many)]
    assert times[0] == pytest.approx(TIMES, rel=0.1)
    assert times[1] == pytest.approx(TIMES, rel=0.1)


def two_drives(seed: int, paths: tuple[tuple[tuple[float, float], float], ...]) -> Study:
    """Products of two lags behind a delay, on two drives that move in every record."""
    rng, time, records = np.random.default_rng(seed), np.linspace(0.0, 60.0, 300), []
    for name in "ab":
        drive, read = np.zeros((time.size, 2)), 2 * SD * rng.standard_normal(time.size)
        for k, (times, delay) in enumerate(paths):
            at = time[np.sort(rng.choice(np.arange(20, 250), 3, replace=False))]
            drive[:, k] = np.append(0.0, rng.uniform(-1, 1, 3))[np.searchsorted(at, time, side="right")]
            shares = np.array(times) / (np.array(times) - np.array(times[::-1]))
            for start, jump in zip(
                at, np.diff(drive[np.searchsorted(time, at), k], prepend=0.0), strict=True
            ):
                read += (1.0, -0.5)[k] * jump * lags(time, tuple(shares), times, start + delay)
        records.append(Record(name, time, drive, read[:, None], (U, replace(U, name="v")), (Y,), "s"))
    return Study("both", None, "s", 0, tuple(records), (), noise={"kind": "white"})


PATHS = (((3.2, 0.92), 2.85), ((10.5, 4.1), 1.27))


@pytest.mark.parametrize(
    ("seed", "paths"),
    [
        (1, PATHS),
        (9, (((8.4, 4.7), 2.33), ((1.74, 1.1), 2.75))),
        (14, (((7.6, 4.7), 2.58), ((2.13, 1.24), 1.65))),
    ],
)
def test_least_squares_of_two_paths_leave_no_more_than_what_made_the_records(
    seed: int, paths: tuple[tuple[tuple[float, float], float], ...]
) -> None:
    delays = np.linspace([0.0, 0.0], [6.0, 6.0], 33).T
    table = lag_table(lag_problem(two_drives(seed, paths)), 0, [0, 1], np.array([2 * SD]), delays)
    (first, early), (second, late) = paths
    truth = np.array([*np.log(first), *np.log(second), early, late])
    square = float((table.residuals(truth[None]) ** 2).sum()) + table.remainder
    assert square < table.size + 5 * np.sqrt(2 * table.size)  # noise alone
    assert lag_fits(table)[1].square <= square + 0.1


def test_what_drives_are_at_rest_is_part_of_the_responses() -> None:
    """Where records share an offset: each at a rest of its own."""
    study = made()
    rests = (0.4, -0.3)
    fit = tuple(
        replace(one, drive=one.drive + rest, response=one.response - 0.3 * k + sum(GAINS) * rest)
        for k, (one, rest) in enumerate(zip(study.fit, rests, strict=True))
    )
    shared = replace(study, fit=fit, model=replace(study.model, offset="shared"))
    best = lag_fits(tabulated(lag_problem(shared)))[1]
    assert best.square < best.size + 5 * np.sqrt(2 * best.size)


def test_slopes_of_a_descent_are_those_of_its_level() -> None:
    delays = np.linspace([0.0, 0.0], [6.0, 6.0], 33).T
    table = lag_table(lag_problem(two_drives(1, PATHS)), 0, [0, 1], np.array([2 * SD]), delays)
    moving = np.array([0, 2, 4])
    landscape = LagDescents(table, moving)
    point = np.array([[1.6, 0.2, 2.5, 1.3, 2.2, 1.4]])
    at = landscape.at(point)
    assert at.level == pytest.approx(-0.5 * (table.residuals(point) ** 2).sum(axis=1))
    for position, k in enumerate(moving):
        step = np.zeros(point.shape)
        step[0, k] = 1e-4
        up, down = (landscape.at(point + sign * step).level[0] for sign in (1, -1))
        assert at.gradient[0, position] == pytest.approx((up - down) / 2e-4, rel=1e-3)
    ends = descended(landscape, point, steps=20, least=1e-6)
    still = np.setdiff1d(np.arange(6), moving)
    assert (ends.points[:, still] == point[:, still]).all()
    assert ends.level > at.level + 1


def test_a_table_of_one_response_is_that_of_a_study_without_the_others() -> None:
    alone = two_drives(1, PATHS)
    other = Axis("z", "rad")
    fit = tuple(
        replace(
            one,
            response=np.concatenate([0.1 * one.drive[:, :1], one.response], axis=1),
            response_axes=(other, *one.response_axes),
        )
        for one in alone.fit
    )
    delays, noise = np.linspace([0.0, 1.0], [3.0, 6.0], 9).T, np.array([2 * SD])
    single = lag_table(lag_problem(alone), 0, [0, 1], noise, delays)
    both = lag_table(lag_problem(replace(alone, fit=fit)), 1, [0, 1], noise, delays)
    places = np.random.default_rng(0).uniform(*single.ends(2), (20, 6))
    assert both.log_density(places) == pytest.approx(single.log_density(places), abs=1e-6)


def test_samples_may_lie_anywhere_along_what_they_are_open_to() -> None:
    """The response to a shorter lag, say, in any amount: the likelihood is the same, and without it not."""
    study = made()
    noise, delays = np.array([SD]), np.linspace(0.2, 0.7, 9)[None]
    along = [lags(one.time, (1.0,), (0.2,), 0.1) for one in study.fit]
    problem = lag_problem(study)
    moved = []
    for samples, each in zip(problem.posterior.samples, along, strict=True):
        (axis,) = samples.axes
        moved.append(replace(samples, axes=(replace(axis, values=axis.values + 0.3 * each),)))
    other = replace(problem, posterior=replace(problem.posterior, samples=tuple(moved)))
    open_to = tuple(each[None] for each in along)
    coordinates = np.array([[*np.log(TIMES), DELAY], [0.0, 1.0, 0.5]])
    one, two = (lag_table(each, 0, [0], noise, delays, open_to) for each in (problem, other))
    assert two.log_density(coordinates) == pytest.approx(one.log_density(coordinates), abs=1e-6)
    closed = lag_table(other, 0, [0], noise, delays)
    assert np.abs(closed.log_density(coordinates) - one.log_density(coordinates)).min() > 1.0


def test_lags_that_are_alike_leave_what_one_leaves_under_noise_of_nearly_nothing() -> None:
    """The prior of their weights tells them apart, and is rounded away in their products."""
    table = tabulated(lag_problem(made()))
    clear = replace(table, responses=1e9 * table.responses, target=1e9 * table.target)
    one, both = np.array([[np.log(0.6), 0.43]]), np.array([[np.log(0.6), np.log(0.6), 0.43]])
    left, again = (clear.residuals(each)[0, : table.target.size] for each in (one, both))
    assert np.linalg.norm(left) > 1e6
    assert np.allclose(again, left, rtol=0, atol=1e-5 * np.linalg.norm(left))
    assert np.isfinite(clear.conditional(both).log_marginal).all()
