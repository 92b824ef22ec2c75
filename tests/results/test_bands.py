"""Simultaneous bands hold whole curves as often as they say; pointwise ones hold samples as often."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from lcopa_bayes.results.bands import LEVELS, pointwise, simultaneous

CURVES, FRESH, REPEATS = 400, 2000, 15


def onset(count: int, rng: np.random.Generator) -> np.ndarray:
    """Rises after a delay that differs: no draw departs at first, few do next, all do in the end."""
    time = np.linspace(0, 1, 120)
    delay, gain = 0.4 + 0.03 * rng.standard_normal((count, 1)), 1 + 0.05 * rng.standard_normal((count, 1))
    return gain * (1 - np.exp(-np.maximum(time - delay, 0) / 0.2))


PROCESSES = {
    "white": lambda count, rng: rng.standard_normal((count, 300)),
    "walk": lambda count, rng: np.cumsum(rng.standard_normal((count, 300)), axis=1),
    "skew": lambda count, rng: (
        rng.gamma(1.0, 1.0, (count, 1)) * np.linspace(0.1, 1, 60) + 0.05 * rng.standard_normal((count, 60))
    ),
    "onset": onset,
}


@pytest.mark.parametrize("process", PROCESSES)
def test_coverage_of_whole_curves_and_of_points(process, rng):
    draw, inside = PROCESSES[process], []
    for _ in range(REPEATS):
        curves = draw(CURVES, rng)
        quantiles = pointwise(curves)
        ends, fresh = simultaneous(curves, quantiles), draw(FRESH, rng)
        whole = [((fresh >= ends[k]) & (fresh <= ends[3 - k])).all(axis=1).mean() for k in (1, 0)]
        spot = [((fresh >= quantiles[k]) & (fresh <= quantiles[4 - k])).mean() for k in (1, 0)]
        inside.append(whole + spot)
    share = np.mean(inside, axis=0)
    # the order statistic of the sizing half scatters as a beta law; fresh curves add their binomial error
    for level, got in zip(LEVELS, share[:2], strict=True):
        error = np.sqrt(level * (1 - level) * (2 / CURVES + 1 / FRESH) / REPEATS)
        assert level - 4 * error < got < level + 4 * error + 2 / CURVES
    if process != "onset":  # where no draw has departed yet, all are in the band
        assert_allclose(share[2:], LEVELS, atol=0.02)


def test_a_band_of_one_point_is_the_interval(rng):
    curves = rng.standard_normal((20_000, 1))
    ends = simultaneous(curves, pointwise(curves))[:, 0]
    assert_allclose(ends, stats.norm.ppf([0.05, 0.25, 0.75, 0.95]), atol=0.05)


def test_independent_points_need_the_quantile_of_their_maximum(rng):
    curves = rng.standard_normal((8_000, 20))
    ends = simultaneous(curves, pointwise(curves))
    exact = stats.norm.ppf((1 + 0.9 ** (1 / 20)) / 2)
    assert_allclose(ends[3].mean(), exact, rtol=0.03)
    assert_allclose(ends[0].mean(), -exact, rtol=0.03)


def test_bands_contain_the_pointwise_ones_and_each_other(rng):
    curves = PROCESSES["walk"](40, rng)
    quantiles = pointwise(curves)
    ends = simultaneous(curves, quantiles)
    assert (ends[0] <= ends[1]).all()
    assert (ends[3] >= ends[2]).all()
    assert (ends[0] <= quantiles[0]).all()
    assert (ends[3] >= quantiles[4]).all()


def test_what_never_varies_has_no_width_and_few_draws_are_refused(rng):
    curves = np.hstack([np.full((40, 3), 2.0), rng.standard_normal((40, 2))])
    ends = simultaneous(curves, pointwise(curves))
    assert_allclose(ends[:, :3], 2.0)
    assert (ends[3, 3:] > ends[0, 3:]).all()
    with pytest.raises(ValueError, match="four draws"):
        simultaneous(curves[:3], pointwise(curves))
