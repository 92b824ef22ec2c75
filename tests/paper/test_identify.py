"""The paper's identification: recovery, its two normalisations, the bias of the equation error, bad input."""

from __future__ import annotations

import json
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.linalg import solve_triangular
from small import ONE, TWO, path, record, study

from lcopa_bayes.bench.command import Command, prbs, step
from lcopa_bayes.bench.device import Bench, Device, truth
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.model.blockpulses import integration_matrix
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.paper.identify import identify, integer_orders, output_error_fit, results
from lcopa_bayes.paper.intervals import Candidates, Interval, Scan, decreasing
from lcopa_bayes.paper.paths import (
    MOST_BLOCKS,
    PathData,
    columns,
    equation_rmse,
    least_squares,
    output_rmse,
    path_data,
    responses,
)
from lcopa_bayes.paper.scan import evaluate, scan

PAPER_STEP = Path(__file__).parents[2] / "studies" / "paper-step"
U, Y = Axis("u", "V"), Axis("y", "rad")
ORDERS, ETAS, GAIN, DELAY = (1.6, 0.7), (3.0, 2.0), 0.2, 1.0
TRUE = TransferPath(GAIN, DELAY, ETAS, ORDERS, 1.0)
DEVICE = Device(
    ((path(GAIN, DELAY, [e ** (1 / a) for e, a in zip(ETAS, ORDERS, strict=True)], ORDERS),),),
    (U,),
    (Y,),
    (0.0,),
)
NARROW = Scan(orders=(Interval(1.4, 1.8), Interval(0.5, 0.9)), delay=Interval(0.8, 1.2))


def clean(camera: float = 0.1, name: str = "clean", command: Command | None = None) -> Record:
    command = command or step(1.0, at=1.0)
    return truth(DEVICE, Bench(camera=camera), command, duration=12.0, name=name)


def data_of(*records: Record, terms: int = 2, **model: float) -> PathData:
    return path_data(study(*records, terms=terms, **model))[0]


def blocks_of(data: PathData) -> list:
    return [each.blocks for each in data.records]


CLEAN = data_of(clean())


def table(times, drive, response, name="hand", **axes) -> Record:
    drive, response = (np.array(part, dtype=float) for part in (drive, response))
    drive, response = (part[:, None] if part.ndim == 1 else part for part in (drive, response))
    return Record(name, np.array(times, dtype=float), drive, response, axes.get("drives", (U,)), (Y,), "ms")


# -- records ---------------------------------------------------------------------------------------


def test_samples_before_the_drive_moves_give_the_level():
    shifted = record(device=ONE, command=step(2.0, at=3.0, rest=0.5), camera=0.2)
    data = path_data(study(shifted))[0]
    early = shifted.response[(shifted.time <= 3.0) & ~np.isnan(shifted.response[:, 0]), 0]
    assert early.size > 10
    assert data.records[0].level == pytest.approx(early.mean())
    assert data.records[0].level_from == f"the {early.size} samples before the drive moves"
    assert data.records[0].record.drive[-1, 0] == 1.5
    assert data.records[0].record.drive[0, 0] == 0.0


def test_else_the_first_samples_give_the_level():
    times = 0.1 * np.arange(101)
    ramp = 3.0 + 1e-3 * np.where(np.arange(101) % 2, 1, -1) + np.maximum(0.0, times - 0.65)
    data = data_of(table([-0.1, *times], [0.0, *np.ones(101)], [np.nan, *ramp]), terms=1)
    assert data.records[0].level_from == "the first 7 samples, which do not leave their mean"
    assert data.records[0].level == pytest.approx(ramp[:7].mean())


def test_equidistant_samples_are_blocks_around_them():
    data = CLEAN.records[0]
    grid = data.blocks.grid
    times = data.record.time[1:]
    later = times > 1.0
    middles = grid.start + grid.step * (np.arange(grid.n) + 0.5)
    assert grid.step == pytest.approx(0.1)
    assert_allclose(middles[-later.sum() :], times[later], atol=1e-12)
    assert_allclose(data.blocks.response[-later.sum() :], data.record.response[1:, 0][later], atol=1e-15)


def test_other_samples_are_joined_by_straight_lines():
    rng = np.random.default_rng(2)
    times = np.sort(rng.uniform(0.05, 10.0, 60))
    values = np.sin(times)
    record_ = table([0.0, 0.01, *times], [0.0, *np.ones(61)], [0.0, np.nan, *values])
    blocks = data_of(record_, terms=1).records[0].blocks
    knots, heights = [0.01, *times], [0.0, *values]
    for k in (0, 7, blocks.grid.n - 1):
        a, b = blocks.grid.edges[k : k + 2]
        inside = [t for t in knots if a < t < b]
        mean = quad(lambda t: np.interp(t, knots, heights), a, b, points=inside or None)[0] / (b - a)
        assert blocks.response[k] == pytest.approx(mean, abs=1e-10)


def test_a_record_of_one_sample_is_a_straight_line_to_it():
    """Beside one of many samples, from which the path is identified."""
    lone = table([0.0, 1.0, 4.0], [0.0, 2.0, 2.0], [np.nan, np.nan, 0.3], name="lone")
    data = data_of(clean(), lone)
    blocks = data.records[1].blocks
    assert (blocks.grid.start, blocks.grid.edges[-1]) == (1.0, 4.0)
    assert_allclose(blocks.response, 0.0)  # its own level is all that is known of it
    assert np.isfinite(output_rmse(data.records, path(1.0, 0.5, (1.0, 2.0), (1.5, 0.5))))


def test_a_long_record_is_taken_in_block_means():
    times = 0.01 * np.arange(5001)
    record_ = table([-0.01, *times], [0.0, *np.ones(5001)], [np.nan, *(1 - np.exp(-times))])
    data = data_of(record_, terms=1)
    assert data.records[0].blocks.grid.n == MOST_BLOCKS
    found = least_squares(blocks_of(data), (1.0,), 0.0)
    assert_allclose(found.etas, [1.0], rtol=1e-3)
    assert found.steady == pytest.approx(1.0, rel=1e-3)


# -- equation --------------------------------------------------------------------------------------


def test_the_equation_holds_on_exact_data_to_second_order():
    errors = []
    for camera in (0.2, 0.1, 0.05):
        found = least_squares(blocks_of(data_of(clean(camera))), ORDERS, DELAY)
        errors.append(np.abs(np.array([*found.etas, found.gain]) / [*ETAS, GAIN] - 1))
    assert errors[-1].max() < 2e-4
    halved = errors[0] / errors[1], errors[1] / errors[2]
    assert_allclose(np.log2(halved), 2.0, atol=0.25)


def test_a_sample_with_an_exposure_stands_for_its_middle():
    exposed = truth(DEVICE, Bench(camera=0.1, exposure=0.1), step(1.0, at=1.0), duration=12.0, name="exposed")
    reported, untold = (data_of(exposed, exposure_ms=exposure) for exposure in (0.1, 0.0))
    found, late = (least_squares(blocks_of(data), ORDERS, DELAY) for data in (reported, untold))
    assert_allclose(found.etas, ETAS, rtol=0.01)
    assert np.abs(np.array(late.etas) / ETAS - 1).max() > 0.03
    assert output_rmse(reported.records, TRUE) < 0.2 * output_rmse(untold.records, TRUE)


def test_both_normalisations_agree_on_exact_data_and_convert():
    blocks = blocks_of(data_of(clean(0.025)))
    stiff = least_squares(blocks, ORDERS, DELAY)
    last = least_squares(blocks, ORDERS, DELAY, normalisation=Normalisation.LAST_ETA)
    assert last.etas[-1] == 1.0
    for normalisation in Normalisation:
        one, other = (model.normalised(normalisation, 5.57) for model in (stiff, last))
        assert_allclose([*one.etas, one.gain], [*other.etas, other.gain], rtol=2e-4)
    assert stiff.normalised(Normalisation.STIFFNESS, 5.57).stiffness == pytest.approx(5.57)
    assert last.normalised(Normalisation.LAST_ETA, 5.57).etas[-1] == pytest.approx(1.0)
    assert_allclose(
        responses(CLEAN.records, stiff)[0],
        responses(CLEAN.records, stiff.normalised(Normalisation.LAST_ETA))[0],
        atol=1e-12,
    )


@given(st.floats(0.1, 50.0))
@settings(max_examples=20, deadline=None)
def test_no_output_error_prefers_a_stiffness(k):
    noisy = data_of(record(device=DEVICE, command=step(1.0, at=1.0), camera=0.1, noise_sd=0.004))
    blocks = blocks_of(noisy)
    one, other = (least_squares(blocks, (1.7, 0.8), 0.9, known=value) for value in (1.0, k))
    assert_allclose([*other.etas, other.gain], k * np.array([*one.etas, one.gain]), rtol=1e-9)
    assert output_rmse(noisy.records, other) == pytest.approx(output_rmse(noisy.records, one), rel=1e-9)
    assert equation_rmse(blocks, other) == pytest.approx(equation_rmse(blocks, one), rel=1e-9)


def test_the_equation_error_of_a_hand_made_case():
    times = 0.1 * np.arange(1, 101)
    record_ = table([-0.1, 0.0, *times], [0.0, 1.0, *np.ones(100)], [0.0, 0.0, *np.ones(100)])
    blocks = data_of(record_, terms=1).records[0].blocks
    # 2 y + 3 I y - 5 I u by hand; in the block that holds the step y = 0 and u = 1/2
    model, step_ = TransferPath(5.0, 0.0, (2.0,), (1.0,), 3.0), 0.1
    k = np.arange(1, 101)
    expected = np.array([-5 * step_ / 4, *(2 + 3 * step_ * (k - 0.5) - 5 * step_ * k)])
    expected /= 2 + 3 * 101 * step_
    assert equation_rmse([blocks], model) == pytest.approx(np.sqrt(np.mean(expected**2)), rel=1e-9)


def test_responses_are_those_of_the_dense_system_for_any_sign():
    model = TransferPath(0.3, 0.83, (3.0, -0.4), ORDERS, 1.2)
    blocks = CLEAN.records[0].blocks
    n, h = blocks.grid.n, blocks.grid.step
    system = sum(
        eta * integration_matrix(1.6 - order, n, h)
        for eta, order in zip((3.0, -0.4, 1.2), (1.6, 0.7, 0.0), strict=True)
    )
    means = blocks.drive.block_means(blocks.grid.edges, np.array([0.83]))[0][0]
    dense = solve_triangular(system, 0.3 * integration_matrix(1.6, n, h) @ means, lower=True)
    later = CLEAN.records[0].record.time[1:] > 1.0
    found = responses(CLEAN.records, model, blocks=1)[0][later]
    parabola = dense[1:-1] * 26 / 24 - (dense[:-2] + dense[2:]) / 24  # how samples are read from block means
    assert_allclose(found[:-1], parabola[-later.sum() + 1 :], atol=1e-10)
    assert not model.physical
    assert TRUE.physical


# -- scan ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("normalisation", Normalisation)
@pytest.mark.parametrize("terms", [1, 2, 3])
def test_many_at_once_are_as_one_by_one(normalisation, terms):
    records = [
        record(k, device=DEVICE, command=command, camera=camera, noise_sd=0.003, name=f"r{k}")
        for k, (command, camera) in enumerate(
            [(step(1.0, at=1.0), 0.1), (step(0.0, at=0.5, rest=1.0), 0.1), (step(-1.0, at=1.0), 0.16)]
        )
    ]
    data = data_of(*records, terms=terms)
    blocks = blocks_of(data)
    values = [np.array([1.9, 1.6]), np.array([1.2, 0.7]), np.array([0.4, 0.2])][:terms]
    candidates = Candidates(decreasing(values), np.array([0.0, 0.73, 1.0]))
    made = evaluate(blocks, candidates, normalisation)
    assert made.squares.size == candidates.size == 3 * 2**terms
    for position in range(candidates.size):
        orders, delay = made.of(position)
        single = least_squares(blocks, orders, delay, normalisation=normalisation)
        found = made.coefficients[position]
        norms = [
            np.linalg.norm(np.concatenate(part))
            for part in zip(*_columns(blocks, orders, delay), strict=True)
        ]
        wanted = np.array([*single.etas, single.stiffness, single.gain])
        assert_allclose(found * norms, wanted * norms, atol=1e-6 * np.abs(wanted * norms).max())
        assert bool(made.physical[position]) == single.physical
        if single.physical:
            assert made.squares[position] == pytest.approx(_dense_squares(blocks, single), rel=1e-5)


def _columns(blocks, orders, delay):
    return [columns(each, orders, delay).T for each in blocks]


def _dense_squares(blocks, model: TransferPath) -> float:
    total = 0.0
    for each in blocks:
        stacked = columns(each, model.orders, model.delay)
        top, n, h = model.orders[0], each.grid.n, each.grid.step
        system = model.stiffness * integration_matrix(top, n, h)
        for eta, order in zip(model.etas, model.orders, strict=True):
            system += eta * integration_matrix(top - order, n, h)
        modelled = solve_triangular(system, -model.gain * stacked[:, -1], lower=True)
        total += float(((modelled - each.response) ** 2).sum())
    return total


@pytest.mark.parametrize("normalisation", Normalisation)
def test_a_scan_that_contains_the_truth_finds_it(normalisation):
    plan = replace(NARROW, rounds=0)
    found = scan(blocks_of(CLEAN), 2, CLEAN.span, plan, normalisation=normalisation)
    assert found.model.orders == ORDERS
    assert found.model.delay == pytest.approx(DELAY)
    assert found.candidates == 25 * 5
    assert_allclose(found.model.normalised(Normalisation.STIFFNESS, 1.0).etas, ETAS, rtol=2e-3)
    assert found.model.steady == pytest.approx(GAIN, rel=1e-3)


def test_refinement_does_not_lose_ground_and_delays_may_go_below_a_block():
    late = truth(DEVICE, Bench(camera=0.1), step(1.0, at=1.037), duration=12.0, name="late")
    data = data_of(late)
    blocks = blocks_of(data)
    plan = replace(NARROW, whole_blocks=False)
    found = [scan(blocks, 2, data.span, replace(plan, rounds=rounds)).rmse for rounds in range(4)]
    assert all(after <= before for before, after in pairwise(found))
    assert found[-1] < 0.9 * found[0]
    whole = scan(blocks, 2, data.span, replace(plan, whole_blocks=True)).model.delay / 0.1
    assert whole == pytest.approx(round(whole), abs=1e-9)


def test_the_scan_stays_within_its_intervals():
    plan = Scan(orders=(Interval(1.7, 1.9), Interval(0.8, 0.9)), delay=Interval(1.1, 1.3), rounds=4)
    found = scan(blocks_of(CLEAN), 2, CLEAN.span, plan)
    assert 1.7 <= found.model.orders[0] <= 1.9
    assert 0.8 <= found.model.orders[1] <= 0.9
    assert 1.1 - 1e-9 <= found.model.delay <= 1.3 + 1e-9


def test_a_winner_that_cannot_be_physical_is_reported():
    times = 0.1 * np.arange(1, 81)
    runaway = table([-0.1, 0.0, *times], [0.0, 1.0, *np.ones(80)], [0.0, 0.0, *np.expm1(0.4 * times)])
    found = scan(
        blocks_of(data_of(runaway, terms=1)), 1, 8.0, Scan(orders=(Interval(1, 1),), delay=Interval(0, 1))
    )
    assert found.physical == 0
    assert not found.model.physical
    assert found.rmse == found.unconstrained_rmse
    assert_allclose(found.model.etas[0], -1 / 0.4, rtol=0.02)


def test_a_hundred_thousand_candidates_in_a_minute():
    steps = load_study(PAPER_STEP)
    data = path_data(replace(steps, fit=steps.fit[:1] + steps.fit[3:]))[0]
    plan = Scan(delay=Interval(0.0, 9.0), rounds=0)
    begin = time.process_time()
    found = scan(blocks_of(data), 3, data.span, plan)
    assert data.records[0].blocks.grid.n == 250
    assert found.candidates > 100_000
    assert time.process_time() - begin < 60


# -- under noise -----------------------------------------------------------------------------------


@pytest.mark.parametrize("fitted", [16, pytest.param(48, marks=pytest.mark.slow)])
def test_the_equation_error_is_biased_and_the_output_error_is_not(fitted):
    """The output error is fitted to the first replicas alone, as a fit takes a hundred times as long."""
    replicas, wide = 48, np.full((48, 3, 3), np.nan)
    for seed in range(replicas):
        noisy = record(seed, device=DEVICE, command=step(1.0, at=3.0), camera=0.1, noise_sd=0.012)
        once = study(noisy, terms=2)
        data = path_data(once)[0]
        rough, last = (
            least_squares(blocks_of(data), ORDERS, DELAY, normalisation=each) for each in Normalisation
        )
        found = [rough, last]
        if seed < fitted:
            rng = np.random.default_rng(seed)
            fine = output_error_fit(once, data, rng, terms=2, orders=ORDERS, start=TRUE, starts=1)
            assert output_rmse(data.records, fine) <= output_rmse(data.records, rough)
            found.append(fine)
        forms = [model.normalised(Normalisation.STIFFNESS, 1.0) for model in found]
        wide[seed, : len(forms)] = [[*form.etas, form.gain] for form in forms]
    relative, count = wide / [*ETAS, GAIN] - 1, np.array([[replicas], [replicas], [fitted]])
    mean, error = np.nanmean(relative, axis=0), np.nanstd(relative, axis=0, ddof=1) / np.sqrt(count)
    assert mean[0, 0] < -4.5 * error[0, 0]  # attenuated, as a regressor with noise is
    assert (mean[1, 1:] > 4.5 * error[1, 1:]).all()
    assert (np.abs(mean[2]) < 3.5 * error[2] + 0.01).all()
    assert abs(mean[2, 0]) < abs(mean[0, 0]) / 2


def test_output_error_fit_of_exact_data_with_a_delay_between_blocks():
    late = truth(DEVICE, Bench(camera=0.05), step(1.0, at=1.037), duration=12.0, name="late")
    once = study(late, terms=2)
    data = path_data(once)[0]
    found = output_error_fit(once, data, np.random.default_rng(1), terms=2, starts=3)
    assert found.delay == pytest.approx(DELAY, abs=0.003)
    assert_allclose(found.orders, ORDERS, atol=0.01)
    assert_allclose(found.etas, ETAS, rtol=0.02)
    assert found.steady == pytest.approx(GAIN, rel=5e-3)


# -- the verb --------------------------------------------------------------------------------------

FEW = Scan(
    orders=(Interval(1.7, 1.9), Interval(0.8, 1.0), Interval(0.5, 0.7)),
    delay=Interval(2.8, 3.2),
    rounds=1,
    stiffness=(5.57, 1.0),
)


@pytest.fixture(scope="module")
def identified():
    whole = load_study(PAPER_STEP)
    once = replace(whole, fit=(whole.fit[0], whole.fit[3]))
    return once, identify(once, plan=FEW)


def test_every_path_of_the_bundled_study(identified):
    _, found = identified
    assert [each.data.name for each in found] == ["x_x", "x_y", "y_x", "y_y"]
    assert [len(each.scan.model.orders) for each in found] == [3, 2, 2, 3]
    for each in found:
        assert each.integer.model.orders == (2.0, 1.0)
        assert each.output_error.output_rmse <= each.scan.output_rmse * (1 + 1e-6)
        assert each.integer_output_error.output_rmse <= each.integer.output_rmse * (1 + 1e-6)
        rmse = [value for _, value in each.stiffness]
        assert max(rmse) - min(rmse) < 1e-6 * max(rmse)
    direct = found[0]
    assert direct.output_error.output_rmse == pytest.approx(1.8e-4, rel=0.1)
    assert direct.scan.output_rmse < 2.2e-4
    assert direct.output_error.model.steady == pytest.approx(0.100008 / 5.57, rel=0.1)
    assert direct.output_error.model.delay == pytest.approx(3.027, abs=0.1)


def test_results_are_plain_and_convert(identified):
    once, found = identified
    reported = json.loads(json.dumps(results(once, found, FEW), allow_nan=False))
    assert [path_["path"] for path_ in reported["paths"]] == ["x_x", "x_y", "y_x", "y_y"]
    model = reported["paths"][0]["models"][0]
    given, last = (model["coefficients"][normalisation.value] for normalisation in Normalisation)
    assert given["stiffness"] == 5.57
    assert last["etas"][-1] == 1.0
    assert given["gain"] / last["gain"] == pytest.approx(given["stiffness"] / last["stiffness"])
    assert model["equation_rmse"] > 0
    assert model["delay_unit"] == reported["time_unit"] == "ms"
    methods = [each["method"] for each in reported["paths"][0]["models"]]
    assert len(set(methods)) == 5


def test_fixed_orders_are_kept_and_equal_ones_merged():
    found = identify(study(clean(), terms=3, orders=(1.6, 0.7, 0.7)), plan=None)[0]
    assert found.scan.model.orders == ORDERS
    assert found.output_error.model.orders == ORDERS
    assert_allclose(found.output_error.model.etas, ETAS, rtol=0.02)


@pytest.mark.slow
def test_nothing_is_printed_unless_asked(capsys):
    once, plan = study(clean(0.2), terms=2), replace(NARROW, rounds=0, delay=Interval(1, 1))
    identify(once, plan=plan)
    assert capsys.readouterr() == ("", "")
    identify(once, plan=plan, quiet=False)
    reported = capsys.readouterr()
    assert reported.out == ""
    assert "candidate" in reported.err


@pytest.mark.slow
def test_any_number_of_jobs_gives_the_same(identified):
    once, found = identified
    assert results(once, identify(once, plan=FEW, jobs=2), FEW) == results(once, found, FEW)


def test_integer_orders():
    assert [integer_orders(terms) for terms in (1, 2, 3)] == [(1.0,), (2.0, 1.0), (2.0, 1.0)]


# -- bad input -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"orders": (Interval(1.8, 1.2),)}, "alpha is empty"),
        ({"orders": (Interval(1.2, 2.1),)}, r"within \(0, 2\]"),
        ({"orders": (Interval(0.0, 1.0),)}, r"within \(0, 2\]"),
        ({"orders": (Interval(float("nan"), 1.0),)}, "alpha is empty"),
        ({"orders": ()}, "one order or more"),
        ({"orders": (Interval(0.5, 0.9), Interval(1.0, 1.8))}, "alpha the largest"),
        ({"order_step": 0.0}, "order_step"),
        ({"delay": Interval(2.0, 1.0)}, "the delay is empty"),
        ({"delay": Interval(-1.0, 1.0)}, "not be negative"),
        ({"stiffness": (1.0, 0.0)}, "positive values of k"),
        ({"stiffness": ()}, "positive values of k"),
        ({"rounds": -1}, "rounds"),
    ],
)
def test_bad_scans(fields, said):
    with pytest.raises(InputError, match=said):
        Scan(**fields)


def test_all_that_is_wrong_with_a_scan_is_reported_together():
    with pytest.raises(InputError) as reported:
        Scan(orders=(Interval(1.8, 1.2),), delay=Interval(2, 1), order_step=-1)
    assert len(reported.value.problems) == 3


@pytest.mark.parametrize(
    ("plan", "said"),
    [
        (Scan(orders=(Interval(1.0, 1.0), Interval(1.0, 1.0))), "decreasing orders"),
        (Scan(delay=Interval(0.0, 11.5)), "lasts only"),
        (Scan(delay=Interval(1.01, 1.09)), "no whole number of blocks"),
        (Scan(orders=(Interval(1.0, 1.5),)), r"1 order interval"),
    ],
)
def test_scans_that_do_not_fit_a_study(plan, said):
    with pytest.raises(InputError, match=said):
        identify(study(clean(), terms=2), plan=plan)


def test_too_many_terms():
    with pytest.raises(InputError, match="up to 3"):
        identify(study(clean(), terms=4))


def test_several_drives_at_once():
    both = record(device=TWO, camera=0.5, name="both")
    with pytest.raises(InputError, match="'both' several drives move at once") as reported:
        path_data(study(both))
    assert len(reported.value.problems) == 2
    rng = np.random.default_rng(4)
    alone = [
        record(
            device=TWO, command=_only(axis, prbs(0.0, 1.0, hold=2.0, duration=12.0, rng=rng)), name=f"d{axis}"
        )
        for axis in (0, 1)
    ]
    assert len(path_data(study(both, *alone))) == 4


def _only(axis: int, command: Command) -> Command:
    values = np.zeros((command.times.size, 2))
    values[:, axis] = command.values[:, 0]
    return Command(command.times, values, np.zeros(2))


def test_too_few_samples_and_a_response_that_never_moves():
    short = table([-0.1, 0, 1, 2, 3], [0, 1, 1, 1, 1], [0.0, 0.0, 0.1, 0.2, 0.3])
    with pytest.raises(InputError, match="3 response samples after the drive moves cannot determine 6"):
        path_data(study(short, terms=2))
    times = np.arange(12.0)
    still = table(times, times > 0.5, np.full(12, 0.7))
    with pytest.raises(InputError, match="never moves"):
        path_data(study(still, terms=2))


def test_the_study_is_left_as_it_was(identified):
    once, _ = identified
    assert isinstance(once, Study)
    assert np.isnan(once.fit[0].response[0]).all()


def test_a_study_with_effects_is_refused():
    made = study(clean())
    with pytest.raises(InputError, match="uses odd_curvature, and the paper's model has no effects"):
        identify(replace(made, effects=replace(made.effects, use=("odd_curvature",))))
