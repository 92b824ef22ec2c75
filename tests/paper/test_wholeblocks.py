"""A delay in whole blocks: the change of the response and of a fit, against independent roads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from lcopa_bayes.bench.device import PAPER_DEVICE
from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.wholeblocks import delay_rounding, delay_roundings

SMALL = TransferPath(0.2, 1.02, (1.5,), (0.8,), 1.0)
WORK = {"drive": 1.0, "span": 12.0, "period": 0.1, "noise_sd": 0.01}


def bench_step(path: TransferPath, times: np.ndarray, delay: float) -> np.ndarray:
    return step_response(replace(path, delay=delay), times)


def test_a_whole_number_of_blocks_changes_nothing():
    made = delay_rounding(SMALL, blocks=120, delay=1.0, **WORK)
    assert made.rounded == pytest.approx(1.0)
    assert made.largest < 1e-6
    assert made.loss < 1e-10
    assert made.largest_shift < 1e-5
    assert made.next_loss > 1.0


def test_the_change_of_the_response_on_the_bench():
    made = delay_rounding(blocks=250)
    times = 0.1 * np.arange(1, 251)
    xx = PAPER.plant.xx
    change = [
        np.pi / 2 * (bench_step(xx, times, to) - bench_step(xx, times, xx.delay)) / 1.8e-4
        for to in (3.0, 3.1)
    ]
    assert made.rounded == pytest.approx(3.0)
    assert made.largest == pytest.approx(np.abs(change[0]).max(), rel=0.005)
    assert made.rms == pytest.approx(np.sqrt(np.mean(change[0] ** 2)), rel=0.005)
    assert made.loss == pytest.approx(0.5 * change[0] @ change[0], rel=0.005)
    assert made.next_loss == pytest.approx(0.5 * change[1] @ change[1], rel=0.005)
    assert PAPER_DEVICE.paths[0][0].delay == made.delay == 3.027


def test_the_shifts_are_those_of_a_fit_on_the_bench():
    blocks = 480
    made = delay_rounding(SMALL, blocks=blocks, **WORK)
    times = 0.1 * np.arange(1, 121)
    data = bench_step(SMALL, times, SMALL.delay)
    assert made.rounded == pytest.approx(1.025)

    def residual(x: np.ndarray) -> np.ndarray:
        gain, log_time, order = x
        path = TransferPath(gain, 3.027, (np.exp(log_time) ** order,), (order,), 1.0)
        return (bench_step(path, times, made.rounded) - data) / 0.01

    start = np.array([0.2, np.log(1.5) / 0.8, 0.8])
    fit = least_squares(residual, start, x_scale="jac", xtol=1e-12, ftol=1e-12)
    moved = fit.x - start
    assert [shift.name for shift in made.shifts] == ["gain", "time_1", "order_1"]
    assert_allclose([shift.shift for shift in made.shifts], moved, rtol=0.05)
    sd = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    assert_allclose([shift.in_sd for shift in made.shifts], moved / sd, rtol=0.05)
    assert made.refitted_loss == pytest.approx(fit.cost, rel=0.1)
    assert all(abs(shift.in_free_sd) < abs(shift.in_sd) for shift in made.shifts)


def test_half_a_block_is_the_worst():
    losses = [delay_rounding(blocks=250, delay=delay).loss for delay in (3.01, 3.03, 3.0499)]
    assert losses[0] < losses[1] < losses[2]
    worst = delay_rounding(blocks=250, delay=3.0499)
    assert worst.next_loss == pytest.approx(worst.loss, rel=0.02)


def test_finer_blocks_round_less():
    made = delay_roundings((64, 250, 2500))
    assert [each.blocks for each in made] == [64, 250, 2500]
    assert all(abs(each.rounded - each.delay) <= 12.5 / each.blocks + 1e-12 for each in made)
    assert made[0].largest > made[1].largest > made[2].largest


@pytest.mark.parametrize(
    "bad",
    [{"blocks": 0}, {"span": 0.0}, {"period": 0.0}, {"noise_sd": 0.0}, {"delay": 30.0}, {"delay": -1.0}],
)
def test_bad_input(bad):
    with pytest.raises(InputError, match="delay rounding needs"):
        delay_rounding(**({"blocks": 250} | bad))
