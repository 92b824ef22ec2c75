"""A delay in whole blocks: the change of the response and of a fit, against the bench and a refit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.optimize import least_squares

from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.numericsclaims import delay_costs, delay_rounding

SMALL = TransferPath(0.2, 1.005, (1.5,), (0.8,), 1.0)
TIMES = 0.1 * np.arange(1, 121)
XX, CAMERA = PAPER.plant.xx, 0.1 * np.arange(1, 251)


def test_a_whole_number_of_blocks_changes_nothing():
    made = delay_rounding(replace(SMALL, delay=1.0), TIMES, 1.0, 0.01)
    assert made.rounded == pytest.approx(1.0)
    assert made.loss < 1e-10
    assert made.largest_shift < 1e-5


def test_the_change_of_the_response_on_the_bench():
    made, _ = delay_costs()
    change = np.pi / 2 * (step_response(replace(XX, delay=3.0), CAMERA) - step_response(XX, CAMERA)) / 1.8e-4
    assert made.rounded == pytest.approx(3.0)
    assert made.delay == 3.027
    assert made.loss == pytest.approx(0.5 * change @ change, rel=0.005)


def test_the_shifts_are_those_of_a_fit_on_the_bench():
    made = delay_rounding(SMALL, TIMES, 1.0, 0.01)
    data = step_response(SMALL, TIMES)
    assert made.rounded == pytest.approx(1.0)

    def residual(x: np.ndarray) -> np.ndarray:
        gain, log_time, order = x
        path = TransferPath.of_times(gain, made.rounded, (np.exp(log_time),), (order,))
        return (step_response(path, TIMES) - data) / 0.01

    start = np.array([0.2, np.log(SMALL.times[0]), 0.8])
    fit = least_squares(residual, start, x_scale="jac", xtol=1e-12, ftol=1e-12)
    sd = np.sqrt(np.diag(np.linalg.inv(fit.jac.T @ fit.jac)))
    assert list(made.shifts) == ["gain", "time_1", "order_1"]
    assert_allclose(list(made.shifts.values()), (fit.x - start) / sd, rtol=0.05)
    assert made.largest_shift == max(map(abs, made.shifts.values()))


def test_half_a_block_is_the_worst():
    losses = [
        delay_rounding(replace(XX, delay=delay), CAMERA, np.pi / 2, 1.8e-4).loss
        for delay in (3.01, 3.03, 3.0499)
    ]
    assert losses[0] < losses[1] < losses[2]
    worst = delay_costs()[1]
    assert worst.delay == pytest.approx(3.05)
    assert worst.loss == pytest.approx(losses[2], rel=0.02)


def test_finer_blocks_round_less():
    costs = [delay_rounding(XX, 25.0 / n * np.arange(1, n + 1), 1.0, 1e-3 * n**0.5) for n in (64, 250, 2500)]
    assert all(
        abs(each.rounded - each.delay) <= 12.5 / n + 1e-12
        for each, n in zip(costs, (64, 250, 2500), strict=True)
    )
    assert costs[0].loss > costs[1].loss > costs[2].loss
