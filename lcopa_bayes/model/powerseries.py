"""An element as a quotient of power series, with its exact derivatives.

Numerator and denominator are both multiplied by ``1 - z``, z one block of delay. The weights of an
integral of order above 1 grow; cut off after n blocks they would put zeros of the denominator inside
the circle and spoil up to four digits of every block. Their differences do not grow up to order 2.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.special import zeta

from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.model.blockpulses import (
    Circle,
    Spectrum,
    integration_weights,
    integration_weights_and_slopes,
)

_NUDGE = 1e-4
"""Step of a central difference in an order [-]."""


def denominator(times: Matrix, orders: Matrix, angular: Vector) -> Spectrum:
    """``1 + sum_i (i w T_i)^order_i``, (batch, frequencies), at angular frequencies w >= 0 (frequencies,).

    Parameters: times [time unit] and orders [-], (batch, terms); angular [1 / time unit].
    Its terms have arguments within ``pi order / 2 <= pi``, so that it stays in one half plane: its principal
    argument is the continuous one.
    """
    out = np.ones((times.shape[0], angular.size), dtype=np.complex128)
    for time, order in zip(times.T, orders.T, strict=True):
        turned = np.exp(0.5j * np.pi * order)  # i^order
        out += turned[:, None] * (angular * time[:, None]) ** order[:, None]
    return out


@final
@dataclass(frozen=True, eq=False)
class Integrals:
    """Block-pulse integrals of what a batch of elements integrates, times ``1 - z``, on blocks of width 1:
    the same for blocks of every width, whose times are counted in them."""

    orders: Matrix
    """Orders of the elements, not increasing along a row, (batch, terms) [-]."""
    n: int
    """Blocks at most."""
    in_orders: bool = False
    """Whether derivatives in the orders will be asked for: weights are then calculated with theirs."""

    @cached_property
    def integrated(self) -> Matrix:
        """How many times the drive and each term but the first are integrated, (batch, terms) [-]."""
        return np.concatenate((self.orders[:, :1], self.orders[:, :1] - self.orders[:, 1:]), axis=1)

    @cached_property
    def _differences(self) -> tuple[Array, ...]:
        """Weights of ``1 - z`` times each integral, and where wanted their derivatives in `integrated`, each
        (batch, terms, n)."""
        orders = self.integrated.ravel()
        if self.in_orders:
            rows: tuple[Matrix, ...] = integration_weights_and_slopes(orders, self.n, 1.0)
        else:
            rows = (integration_weights(orders, self.n, 1.0),)
        for row in rows:
            row[:, 1:] -= row[:, :-1]
        return tuple(row.reshape(*self.orders.shape, -1) for row in rows)

    @cached_property
    def leftover(self) -> Matrix:
        """`leftover` of `integrated`, (batch, terms) [-]."""
        return leftover(self.integrated)

    @cached_property
    def leftover_slopes(self) -> Matrix:
        """Its derivatives to 1e-8, (batch, terms) [-]."""
        late, early = (leftover(self.integrated + nudge) for nudge in (_NUDGE, -_NUDGE))
        return (late - early) / (2 * _NUDGE)

    def on(self, circle: Circle) -> Spectrum:
        """On a circle of at most n blocks, (batch, terms, length // 2 + 1)."""
        return circle.spectrum(self._differences[0][..., : circle.n])

    def slopes_on(self, circle: Circle) -> Spectrum:
        """Their derivatives in `integrated`, the same shape, where these are calculated (`in_orders`)."""
        return circle.spectrum(self._differences[1][..., : circle.n])


def leftover(orders: Matrix) -> Matrix:
    r"""``zeta(-a - 1) / Gamma(a + 2)`` of orders a, same shape [-].

    With z = exp(-x), P^a is ``x^-a (1 + x^2 / 12 + leftover x^(2 + a) + O(x^(3 + a)) + O(x^4))`` on blocks of
    width 1, from the expansion of the polylogarithm about z = 1; at a = 0 both cancel. By the reflection of
    zeta it is ``-2 (2 pi)^(-a - 2) cos(pi a / 2) zeta(a + 2)``.
    """
    powers = (2 * np.pi) ** (-orders - 2)
    return np.asarray(-2 * powers * np.cos(np.pi * orders / 2) * zeta(orders + 2))


def transfer(times: Array, integrals: Integrals, circle: Circle, *, corrected: bool = False) -> Spectrum:
    r"""``1 / (1 + sum_i (T_i s)^order_i)`` integrated order_1 times (Ta et al. 2026, Eqs. 59-61).

    :math:`P^{a_1} / (P^{a_1} + \sum_i T_i^{a_i} P^{a_1 - a_i})` with block-pulse integrals P^a,
    evaluated on the circle. `corrected`: the response is integrated without the two leading errors of P^a
    (`leftover`); the drive, constant from the first edge on, by P^a, which is exact for constants.

    Parameters: times (..., batch, terms) [blocks]; `integrals` of the elements' orders. Returns: (...,
    batch, length // 2 + 1).
    Accuracy: the dense matrix quotient to 4e-9 of its largest (typically 1e-12); the true response to O(h^2)
    in the width h of a block, corrected to O(h^3) or better for orders above 0.8, and below to typically a
    fifth. Useless for an element whose time constants are all below about 0.3 blocks (corrected and
    undamped, of order 2, below 3 blocks) when its top order exceeds 1: the block-pulse scheme is then
    unstable and needs shorter blocks.
    """
    top, denominator, *_ = _parts(times, integrals, circle, corrected)
    inverse = np.divide(1.0, denominator, out=denominator)
    return np.multiply(top, inverse, out=inverse)  # to the last bit as in `transfer_slopes`


def transfer_slopes(
    times: Array, integrals: Integrals, circle: Circle, *, corrected: bool = False
) -> Spectrum:
    """`transfer` and its exact derivatives in every log time constant and, where the integrals have theirs
    (`in_orders`), every order: rows of one array, (1 + terms or 1 + 2 terms, ..., batch, length // 2 + 1)."""
    top, denominator, parts, scale = _parts(times, integrals, circle, corrected)
    terms, in_orders = len(parts), integrals.in_orders
    out = np.empty((1 + terms * (1 + in_orders), *denominator.shape), dtype=np.complex128)
    inverse = np.divide(1.0, denominator, out=denominator)
    value = np.multiply(top, inverse, out=out[0])
    falling = -value
    falling *= inverse  # the derivative of the quotient in its denominator
    by_time, by_order = out[1 : 1 + terms], out[1 + terms :]
    for i, integral in enumerate(parts):
        part = np.multiply(falling, integral, out=by_time[i])
        part *= scale[i]
        if in_orders:
            np.multiply(part, np.log(times[..., i, None]), out=by_order[i])
        part *= integrals.orders[:, i, None]
    if not in_orders:
        return out
    slopes = integrals.slopes_on(circle)
    driven = slopes[:, 0]
    if corrected:
        driven = driven * circle.smoothing
        slopes -= integrals.leftover_slopes[..., None] * circle.bend
    leading = np.broadcast_to(slopes[:, 0], value.shape).copy()
    for i in range(1, terms):
        bent = scale[i] * slopes[:, i]
        leading += bent
        bent *= falling
        by_order[i] -= bent
    by_order[0] += np.multiply(leading, falling, out=leading)
    by_order[0] += np.multiply(driven, inverse, out=inverse)
    return out


def _parts(
    times: Array, integrals: Integrals, circle: Circle, corrected: bool
) -> tuple[Spectrum, Spectrum, list[Spectrum], list[Array]]:
    """P^a1, the denominator, and P^(a1 - ai) of every term, all times ``1 - z``; `corrected` all are
    multiplied by `Circle.smoothing` too. Last ``T^order`` of every term, each (..., batch, 1) [-]."""
    powers = times**integrals.orders
    scale = [powers[..., i, None] for i in range(powers.shape[-1])]
    spectra = integrals.on(circle)
    top, same = spectra[:, 0], circle.difference
    if corrected:
        top, same = top * circle.smoothing, circle.smoothed
        spectra -= integrals.leftover[..., None] * circle.bend
    parts = [same, *(spectra[:, i] for i in range(1, powers.shape[-1]))]
    denominator = np.asarray(scale[0] * same)
    denominator += spectra[:, 0]
    for factor, integral in zip(scale[1:], parts[1:], strict=True):
        denominator += factor * integral
    return top, denominator, parts, scale
