"""Diffusion in place of a lag: its response is that of the closed form, and records of it are recognised."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from inference.test_lagsum import tabulated
from small import U, Y

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.diffusion import KINDS, Kind, diffused, rises, series
from lcopa_bayes.inference.lagfits import best_of, lag_fits
from lcopa_bayes.inference.lagsum import lag_problem

SD, GAIN, TIME, DELAY = 0.01, 1.2, 3.0, 0.43
SLAB = {"wall": lambda p: 1 / np.cosh(np.sqrt(p)), "layer": lambda p: np.tanh(np.sqrt(p)) / np.sqrt(p)}
"""Transfer functions over the Laplace variable times ``c``."""


def inverted(kind: Kind, since: float, time: float) -> float:
    """Step response by numerical inversion on the contour of Talbot (Abate and Valkó 2004)."""
    c, count = time * np.pi**2 / 4, 24
    angle = np.arange(1, count) * np.pi / count
    cot = 1 / np.tan(angle)
    first = 2 * count / 5
    nodes = np.append(first, first * angle * (cot + 1j))
    factors = np.append(0.5 + 0j, 1 + 1j * angle * (1 + cot**2) - 1j * cot)
    p = nodes / since
    return float(0.4 / since * np.sum((factors * np.exp(nodes) * SLAB[kind](c * p) / p).real))


def records_of(kind: Kind, seed: int) -> Study:
    rng, records = np.random.default_rng(seed), []
    for k, height in enumerate((1.0, -0.5)):
        time = np.linspace(-2.0, 12.0, 150)
        drive = np.where(time >= 0, height, 0.0)[:, None]
        start = time[time >= 0][0]
        read = 0.3 * k + height * response(kind, time - start) + SD * rng.standard_normal(time.size)
        records.append(Record(f"r{k}", time, drive, read[:, None], (U,), (Y,), "s"))
    return Study("slab", None, "s", 0, tuple(records), (), noise={"kind": "white"})


def response(kind: Kind, time: Vector) -> Vector:
    """To a unit step at time 0."""
    since = np.maximum(time - DELAY, 1e-9)
    if kind == "lags":
        return -GAIN * np.expm1(-since / TIME)
    return np.array([GAIN * inverted(kind, one, TIME) if one > 1e-3 else 0.0 for one in since])


@pytest.mark.parametrize(("kind", "since"), [*product(SLAB, (0.02, 0.3, 1.0, 9.0))])
def test_the_series_is_the_response_of_the_slab(kind: Kind, since: float) -> None:
    own = float(rises(kind, np.array(since), np.array(TIME)))
    assert own == pytest.approx(inverted(kind, since, TIME), abs=2e-3 if since < 0.1 else 1e-7)


@pytest.mark.parametrize("kind", KINDS)
def test_weights_add_up_to_the_steady_response(kind: Kind) -> None:
    ratios, weights = series(kind)
    assert weights.sum() == pytest.approx(1.0)
    assert ratios[0] == 1.0
    assert (np.diff(ratios) < 0).all()


@pytest.mark.parametrize("kind", SLAB)
def test_tabulated_columns_are_the_simulated_response(kind: Kind) -> None:
    """Between the tabulated times too; a lag beside it is the lag that it was."""
    problem = lag_problem(records_of(kind, 0))
    lags = tabulated(problem, DELAY, DELAY + 0.32)
    table = diffused(lags, kind)
    scale = problem.scales.amplitude[0] / problem.scales.excursion[0]
    time = problem.study.fit[0].time
    at = np.array([[np.log(TIME), np.log(0.7), DELAY]])
    both = table.columns(at)[0]
    assert both[1] == pytest.approx(lags.columns(at)[0, 1], abs=1e-12)
    unit = scale * response(kind, time - time[time >= 0][0]) / GAIN
    expected = np.concatenate([height * (unit - unit.mean()) for height in (1.0, -0.5)])
    assert both[0] @ both[0] == pytest.approx(float(expected @ expected) / SD**2, rel=2e-3)
    weight = GAIN / scale
    left = table.target - weight * both[0]
    assert left @ left + table.remainder == pytest.approx(table.size, abs=5 * np.sqrt(2 * table.size))


@pytest.mark.parametrize(("kind", "seed"), [*product(KINDS, range(3))])
def test_bic_finds_the_kind_and_its_delay(kind: Kind, seed: int) -> None:
    """Of a slab a few lags need another delay; no slab follows one lag better."""
    table = tabulated(lag_problem(records_of(kind, seed)), 0.0, 1.5)
    best = {one: best_of(lag_fits(diffused(table, one))) for one in KINDS}
    assert min(best, key=lambda one: best[one].bic) == kind
    own = best[kind]
    assert own.lags == 1
    sd = float(np.sqrt(own.covariance[-1, -1]))
    assert abs(own.coordinates[-1] - DELAY) < 4 * sd
    assert np.exp(own.coordinates[0]) == pytest.approx(TIME, rel=0.1)
    if kind != "lags":
        lags = best["lags"].coordinates[-1]
        assert lags > DELAY if kind == "wall" else lags < DELAY
