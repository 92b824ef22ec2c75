"""Contours of pairs: the share of draws that they hold, against the closed form of a normal law."""

import numpy as np

from lcopa_bayes.report.sections.pairs import levels_of


def test_levels_hold_their_shares_of_a_normal_law():
    """``exp(-r^2 / 2)`` holds the share s above the level ``1 - s``."""
    x = np.linspace(-6, 6, 601)
    density = np.exp(-0.5 * (x[:, None] ** 2 + x**2))
    np.testing.assert_allclose(levels_of(density, (0.5, 0.9)), [0.5, 0.1], atol=2e-3)
