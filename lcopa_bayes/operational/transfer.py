"""An element as a quotient of power series, with its exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.arrays import Matrix
from lcopa_bayes.operational.blockpulse import integration_weights, integration_weights_slope
from lcopa_bayes.operational.series import Circle, Spectrum


@final
@dataclass(frozen=True, eq=False)
class TransferSlopes:
    """Derivatives of a transfer function on the circle, one entry per viscous term."""

    log_times: tuple[Spectrum, ...]
    """In the logarithm of each time constant."""
    orders: tuple[Spectrum, ...]
    """In each order."""


def transfer(times: Matrix, orders: Matrix, circle: Circle, step: float) -> Spectrum:
    r"""``1 / (1 + sum_i (T_i s)^order_i)`` integrated order_1 times (Ta et al. 2026, Eqs. 59-61).

    :math:`P^{a_1} / (P^{a_1} + \sum_i T_i^{a_i} P^{a_1 - a_i})` with block-pulse integrals P^a,
    evaluated on the circle.

    Parameters: times and orders (batch, terms) [time unit], [-], orders decreasing along a row;
    step [time unit] block width. Returns: (batch, length // 2 + 1).
    Accuracy: the dense matrix quotient to 1e-9; the true response to O(step^2).
    """
    top, denominator, _ = _parts(times, orders, circle, step)
    return top / denominator


def transfer_slopes(
    times: Matrix, orders: Matrix, circle: Circle, step: float
) -> tuple[Spectrum, TransferSlopes]:
    """`transfer` and its exact derivatives in every log time constant and order."""
    top, denominator, integrals = _parts(times, orders, circle, step)
    value = top / denominator
    scale = (times**orders)[..., None]
    log_times = np.log(times)[..., None]

    def slope(order: Matrix) -> Spectrum:
        return circle.spectrum(integration_weights_slope(order, circle.n, step))

    by_time = tuple(
        -value * (orders[:, i, None] * scale[:, i]) * integral / denominator
        for i, integral in enumerate(integrals)
    )
    by_order = []
    leading = slope(orders[:, 0]) * (1.0 - value) - value * scale[:, 0] * log_times[:, 0]
    for i in range(1, times.shape[1]):
        bent = slope(orders[:, 0] - orders[:, i])
        leading = leading - value * scale[:, i] * bent
        by_order.append(-value * scale[:, i] * (log_times[:, i] * integrals[i] - bent) / denominator)
    return value, TransferSlopes(by_time, (leading / denominator, *by_order))


def _parts(
    times: Matrix, orders: Matrix, circle: Circle, step: float
) -> tuple[Spectrum, Spectrum, list[Spectrum]]:
    """P^a1, the denominator, and P^(a1 - ai) of every term (1 for the first)."""
    scale = (times**orders)[..., None]
    top = circle.spectrum(integration_weights(orders[:, 0], circle.n, step))
    denominator = top + scale[:, 0]
    integrals: list[Spectrum] = [np.ones((1, 1), dtype=complex)]
    for i in range(1, times.shape[1]):
        integral = circle.spectrum(integration_weights(orders[:, 0] - orders[:, i], circle.n, step))
        denominator += scale[:, i] * integral
        integrals.append(integral)
    return top, denominator, integrals
