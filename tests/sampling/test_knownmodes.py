"""Modes known from elsewhere: proposed by moves, in their share of the posterior whatever the starts."""

from __future__ import annotations

import numpy as np
import pytest
from small import Toy

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.sampling.knownmodes import around
from lcopa_bayes.sampling.run import SamplePlan
from lcopa_bayes.sampling.sampler import sample

WIDE, NARROW = (0.3, 0.08), (0.8, 2e-5)
"""Mean and standard deviation, in each of three coordinates, of a mode and of a needle."""
BOX = ("uniform", {"loc": 0.0, "scale": 1.0})


def two_modes(share: float) -> Toy:
    """A normal mode and a needle that holds `share` of the posterior; tempered populations miss it: it takes
    less than 1e-13 of the prior."""

    means, widths = np.array([WIDE, NARROW])[:, :, None, None].swapaxes(0, 1)
    weights = np.log([1 - share, share])[:, None]

    def log_likelihood(z):
        parts = -0.5 * ((z - means) / widths) ** 2 - np.log(widths * np.sqrt(2 * np.pi))
        return np.logaddexp(*(parts.sum(axis=2) + weights))

    return Toy(log_likelihood, dict.fromkeys("abc", BOX))


def share_of_the_needle(toy: Toy, starts, seed: int, *, longer: bool = False) -> float:
    plan = SamplePlan(2, 24, 400, 2, 200.0, seed) if longer else SamplePlan(2, 16, 200, 2, 100.0, seed)
    run = sample(toy, plan, starts=starts)
    kept = run.kept()[0].reshape(-1, 3)
    return float(np.mean(np.abs(kept - NARROW[0]).max(axis=1) < 0.01))


STARTS = np.full((1, 3), NARROW[0] + 1e-5)


def test_a_needle_is_met_only_when_it_is_known():
    toy = two_modes(0.9)
    assert share_of_the_needle(toy, None, 1) == 0.0
    assert share_of_the_needle(toy, STARTS, 1) > 0.8


@pytest.mark.parametrize(
    ("share", "seeds"),
    [*(pytest.param(share, 4, marks=pytest.mark.slow) for share in (0.5, 0.05)), (1e-6, 2)],
)
def test_known_modes_keep_their_share_of_the_posterior(share, seeds):
    """The posterior is invariant: starts on a mode do not make it larger than it is."""
    toy, longer = two_modes(share), seeds > 2
    found = np.array([share_of_the_needle(toy, STARTS, seed, longer=longer) for seed in range(seeds)])
    error = found.std(ddof=1) / np.sqrt(seeds) + 0.15 * share + 1e-4
    assert abs(found.mean() - share) < 4 * error
    assert share > 0.01 or found.max() < 0.01  # two that differ would leave any mean within their error


def test_starts_outside_the_prior_are_left_out_and_refused_when_there_are_no_others():
    toy = two_modes(0.5)
    outside = np.full((1, 3), 2.0)
    mixture = around(toy, np.concatenate([outside, STARTS]), 3)
    assert mixture.dimension == 3
    with pytest.raises(InputError, match="lies inside its prior"):
        around(toy, outside, 3)


def test_known_modes_are_deterministic():
    toy = two_modes(0.5)
    one, other = (around(toy, STARTS, 3) for _ in range(2))
    np.testing.assert_array_equal(one.means, other.means)
