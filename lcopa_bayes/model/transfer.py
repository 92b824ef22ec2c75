"""An element as a quotient of power series, with its exact derivatives.

Numerator and denominator are both multiplied by ``1 - z``, z one block of delay. The weights of an
integral of order above 1 grow; cut off after n blocks they would put zeros of the denominator inside
the circle and spoil up to four digits of every block. Their differences do not grow up to order 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.model.blockpulses import integration_weights, integration_weights_slope
from lcopa_bayes.model.powerseries import Circle, Spectrum


@final
@dataclass(frozen=True, eq=False)
class TransferSlopes:
    """Derivatives of a transfer function on the circle, one entry per viscous term."""

    log_times: tuple[Spectrum, ...]
    """In the logarithm of each time constant."""
    orders: tuple[Spectrum, ...]
    """In each order, where wanted."""


def denominator(times: Matrix, orders: Matrix, angular: Vector) -> Spectrum:
    """``1 + sum_i (i w T_i)^order_i``, (batch, frequencies), at angular frequencies w (frequencies,).

    Parameters: times [time unit] and orders [-], (batch, terms); angular [1 / time unit].
    Its terms have arguments within ``pi order / 2 <= pi``, so that it stays in one half plane: its principal
    argument is the continuous one.
    """
    out = np.ones((times.shape[0], angular.size), dtype=np.complex128)
    for time, order in zip(times.T, orders.T, strict=True):
        out += (1j * angular * time[:, None]) ** order[:, None]
    return out


def transfer(times: Array, orders: Matrix, circle: Circle, step: float) -> Spectrum:
    r"""``1 / (1 + sum_i (T_i s)^order_i)`` integrated order_1 times (Ta et al. 2026, Eqs. 59-61).

    :math:`P^{a_1} / (P^{a_1} + \sum_i T_i^{a_i} P^{a_1 - a_i})` with block-pulse integrals P^a,
    evaluated on the circle.

    Parameters: times (..., batch, terms) [time unit] and orders (batch, terms) [-], not increasing along a
    row; step [time unit] block width. Returns: (..., batch, length // 2 + 1).
    Accuracy: the dense matrix quotient to 2e-9 (typically 1e-12); the true response to O(step^2).
    Both are useless for an element whose time constants are all below about 0.3 step when its top
    order exceeds 1: the block-pulse scheme is then unstable and needs shorter blocks.
    """
    top, denominator, _ = _parts(times, orders, circle, step)
    return top / denominator


def transfer_slopes(
    times: Array, orders: Matrix, circle: Circle, step: float, *, in_orders: bool = True
) -> tuple[Spectrum, TransferSlopes]:
    """`transfer` and its exact derivatives in every log time constant and, unless `in_orders` is false, every
    order."""
    top, denominator, integrals = _parts(times, orders, circle, step)
    value = top / denominator
    scale = _scale(times, orders, step)

    def slope(order: Vector) -> Spectrum:
        return _differenced(integration_weights_slope(order, circle.n, 1.0), circle)

    by_time = tuple(
        -value * (orders[:, i, None] * scale[i]) * integral / denominator
        for i, integral in enumerate(integrals)
    )
    if not in_orders:
        return value, TransferSlopes(by_time, ())
    logs = np.log(times / step)
    log_times = [logs[..., i, None] for i in range(orders.shape[1])]
    by_order = []
    leading = slope(orders[:, 0]) * (1.0 - value) - value * scale[0] * log_times[0] * integrals[0]
    for i in range(1, orders.shape[1]):
        bent = slope(orders[:, 0] - orders[:, i])
        leading = leading - value * scale[i] * bent
        by_order.append(-value * scale[i] * (log_times[i] * integrals[i] - bent) / denominator)
    return value, TransferSlopes(by_time, (leading / denominator, *by_order))


def _parts(
    times: Array, orders: Matrix, circle: Circle, step: float
) -> tuple[Spectrum, Spectrum, list[Spectrum]]:
    """P^a1, the denominator, and P^(a1 - ai) of every term, all times ``1 - z``, in blocks of width 1."""
    scale = _scale(times, orders, step)
    integrated = np.concatenate((orders[:, :1], orders[:, :1] - orders[:, 1:]), axis=1)
    weights = integration_weights(integrated.ravel(), circle.n, 1.0)
    spectra = _differenced(weights, circle).reshape(*orders.shape, -1)
    integrals = [circle.difference[None], *(spectra[:, i] for i in range(1, orders.shape[1]))]
    denominator = spectra[:, 0] + scale[0] * integrals[0]
    for i in range(1, orders.shape[1]):
        denominator += scale[i] * integrals[i]
    return spectra[:, 0], denominator, integrals


def _scale(times: Array, orders: Matrix, step: float) -> list[Array]:
    """``(T / step)^order`` of every term, each (..., batch, 1) [-]."""
    powers = (times / step) ** orders
    return [powers[..., i, None] for i in range(orders.shape[1])]


def _differenced(weights: Matrix, circle: Circle) -> Spectrum:
    """``1 - z`` times the series of these weights, which are overwritten."""
    weights[:, 1:] -= weights[:, :-1]
    return circle.spectrum(weights)
