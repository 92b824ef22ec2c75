"""Given orders, delays and noise, a plant's posterior is close to a Gaussian in the right coordinates.

A path is ``gain exp(-delay s) / D(s)``, ``D(s) = 1 + sum_i c_i s^order_i`` with ``c_i = T_i^order_i``. Its
reciprocal is linear in ``1 / gain`` and ``c_i / gain`` (Levy 1959, IRE Trans. Autom. Control 4), and changes
of these that a record allows hardly bend its response. The coordinates are therefore, of each element, the
shares ``f_i = c_i / D(s_0)`` at a fixed frequency s_0, of each sampled gain ``gain / D(s_0)``, and offsets
themselves. In them least squares converges in a few steps from almost anywhere, and a second-order expansion
of the log likelihood holds over all that the posterior allows at these orders, delays and this noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.core.covariance import covariance_of
from lcopa_bayes.inference.descents import solve_with_held
from lcopa_bayes.inference.expansion import expanded
from lcopa_bayes.inference.posterior import Posterior

_COMPUTABLE = 1e100
"""Largest time constant, and inverse of the smallest, whose response is computed [time unit]."""
_SHRINK = 0.1
"""Least factor by which a share changes in one step of the descent [-]."""
_DAMPING = (1e-2, 1e-9, 1e6)
"""Damping of the descent at the start, least and most, relative to the curvature [-]."""
_GAIN, _FREE = 0.02, 1.0
"""Gain that a step promises below which there is no further one [nat], and largest damping at which that
shows an optimum [-]."""
_FASTER, _HOPELESS = 10.0, 50.0
"""How many times faster than a step promises a descent may go on, and how far below the best of its batch it
then stays where it cannot matter [-, nat]."""
_QUARTERS = (0.1587, 0.8413)
"""Quantiles of a prior one standard deviation apart from the middle, were it normal."""


@final
class Element(NamedTuple):
    """An element of the plant among the coordinates."""

    orders: tuple[int, ...]
    """Table rows."""
    times: tuple[int, ...]
    """Table rows."""
    free: tuple[int, ...]
    """Terms whose time is sampled."""
    first: int
    """Coordinate of the first of them; the others follow."""

    @property
    def part(self) -> slice:
        """Coordinates."""
        return slice(self.first, self.first + len(self.free))


@final
class Expanded(NamedTuple):
    """Expansions of the log likelihood about points, (batch, ...)."""

    values: Matrix
    """Table values of the points, (batch, rows)."""
    x: Matrix
    """Coordinates of the points, (batch, size)."""
    log_likelihood: Vector
    gradient: Matrix
    """In the coordinates, (batch, size)."""
    information: Array
    """(batch, size, size)."""
    steepness: Array
    """Derivatives of the natural coordinates in the coordinates, (batch, size, size)."""


@final
@dataclass(frozen=True, eq=False)
class Conditional:
    """Coordinates of what a posterior has beside orders, delays and noise."""

    posterior: Posterior
    delays: bool = False
    """Whether delays are among the coordinates: a likelihood may have several modes in them."""

    @cached_property
    def given(self) -> tuple[int, ...]:
        """Table rows of the sampled parameters that are no coordinates."""
        rows = self.posterior.table.rows
        kinds = ("order",) if self.delays else ("order", "delay")
        return tuple(k for k in self.posterior.sampled if rows[k].kind in kinds or rows[k].noise)

    @cached_property
    def columns(self) -> tuple[int, ...]:
        """Table rows of the coordinates: sampled times by element, sampled gains, others."""
        rows, sampled = self.posterior.table.rows, self.posterior.sampled
        times = [element.times[i] for element in self.elements for i in element.free]
        gains = [k for k in sampled if rows[k].kind == "gain"]
        return (*times, *gains, *(k for k in sampled if k not in (*times, *gains, *self.given)))

    @cached_property
    def elements(self) -> tuple[Element, ...]:
        """All elements."""
        table, sampled, out, first = self.posterior.table, self.posterior.sampled, [], 0
        for times, orders in table.terms:
            free = tuple(i for i, time in enumerate(times) if time in sampled)
            out.append(Element(tuple(orders), tuple(times), free, first))
            first += len(free)
        return tuple(out)

    @cached_property
    def gains(self) -> tuple[tuple[int, int], ...]:
        """Coordinate and element of each sampled gain."""
        table = self.posterior.table
        places = [(position, table.rows[k]) for position, k in enumerate(self.columns)]
        return tuple(
            (position, table.layout.element_of[row.place.first][row.place.second])
            for position, row in places
            if row.kind == "gain"
        )

    @cached_property
    def frequency(self) -> float:
        """s_0 [1 / time unit]: the lowest that the records resolve."""
        return 0.5 / max(e.mesh.grid.n * e.mesh.grid.step for e in self.posterior.model.experiments)

    @cached_property
    def _priors(self) -> tuple[Vector, Vector]:
        """Middle and width of the prior of each column in its natural coordinate."""
        middle, width = [], []
        for k in self.columns:
            row = self.posterior.table.rows[k]
            low, mid, high = row.quantiles((_QUARTERS[0], 0.5, _QUARTERS[1]))
            if row.kind == "time":
                low, mid, high = np.log((low, mid, high))
            middle.append(mid)
            width.append(0.5 * (high - low))
        return np.array(middle), np.array(width)

    @property
    def widths(self) -> Vector:
        """Width of the prior of each column in its natural coordinate."""
        return self._priors[1]

    def natural(self, values: Matrix) -> Matrix:
        """Logarithms of times, values of the rest, (batch, size)."""
        out = values[:, self.columns].copy()
        for element in self.elements:
            out[:, element.part] = np.log(out[:, element.part])
        return out

    def powers(self, element: Element, values: Matrix) -> Matrix:
        """``s_0^order`` of the terms of an element, (batch, terms)."""
        return np.asarray(self.frequency ** values[:, element.orders])

    @staticmethod
    def strengths(element: Element, values: Matrix) -> Matrix:
        """``c_i`` of the terms of an element, (batch, terms)."""
        return np.asarray(values[:, element.times] ** values[:, element.orders])

    def rest(self, element: Element, values: Matrix) -> Vector:
        """D(s_0) without the terms whose times are sampled, (batch,)."""
        fixed = [i for i in range(len(element.times)) if i not in element.free]
        terms = self.powers(element, values) * self.strengths(element, values)
        return np.asarray(1.0 + terms[:, fixed].sum(axis=1))

    def level(self, element: Element, values: Matrix) -> Vector:
        """D(s_0), (batch,)."""
        return np.asarray(1.0 + (self.powers(element, values) * self.strengths(element, values)).sum(axis=1))

    def left(self, element: Element, values: Matrix) -> Vector:
        """Part of D(s_0) that the terms whose times are sampled leave, (batch,): 1 less their shares, which
        rounds to 0 where they are nearly all of it."""
        return self.rest(element, values) / self.level(element, values)

    def x(self, values: Matrix) -> Matrix:
        """Coordinates of table values, (batch, size)."""
        out = values[:, self.columns].copy()
        levels = [self.level(element, values) for element in self.elements]
        for element, level in zip(self.elements, levels, strict=True):
            out[:, element.part] = self.strengths(element, values)[:, element.free] / level[:, None]
        for position, e in self.gains:
            out[:, position] /= levels[e]
        return out

    def inverse_level(self, element: Element, shares: Matrix, values: Matrix) -> Vector:
        """1 / D(s_0) of shares (batch, free); not positive where there is no such element."""
        powers = self.powers(element, values)[:, element.free]
        return np.asarray((1.0 - (powers * shares).sum(axis=1)) / self.rest(element, values))

    def values(self, x: Matrix, template: Matrix) -> tuple[Matrix, Flags]:
        """Table values of coordinates, the rest from `template` (batch, rows); and whether they exist."""
        out = template.copy()
        out[:, self.columns] = x
        exists: Flags = np.asarray(np.isfinite(x).all(axis=1))
        inverse = []
        for element in self.elements:
            shares = x[:, element.part]
            level = self.inverse_level(element, shares, template)
            exists &= (shares > 0).all(axis=1) & (level > 0)
            inverse.append(level)
        for element, level in zip(self.elements, inverse, strict=True):
            shares = np.where(
                exists[:, None], x[:, element.part] / np.where(exists, level, 1.0)[:, None], 1.0
            )
            orders = template[:, element.orders][:, element.free]
            with np.errstate(over="ignore", under="ignore"):
                times = shares ** (1 / orders)
            exists &= ((times > 1 / _COMPUTABLE) & (times < _COMPUTABLE)).all(axis=1)
            out[:, [element.times[i] for i in element.free]] = times
        for position, e in self.gains:
            out[:, self.columns[position]] = x[:, position] / np.where(exists, inverse[e], 1.0)
        return out, exists

    def steepness(self, values: Matrix) -> Array:
        """Derivatives of the natural coordinates in x, (batch, size, size)."""
        size = len(self.columns)
        x = self.x(values)
        out = np.tile(np.eye(size), (len(values), 1, 1))
        for e, element in enumerate(self.elements):
            powers = self.powers(element, values)[:, element.free]
            orders = values[:, element.orders][:, element.free]
            shares, part = x[:, element.part], element.part
            left = self.left(element, values)
            own = powers[:, None, :] / left[:, None, None] + np.eye(len(element.free)) / shares[:, :, None]
            out[:, part, part] = own / orders[:, :, None]
            for position, of in self.gains:
                if of == e:
                    gain = values[:, self.columns[position]]
                    out[:, position, part] = (gain / left)[:, None] * powers
                    out[:, position, position] = gain / x[:, position]
        return out

    def expanded(self, values: Matrix) -> Expanded:
        """Expansions about table values."""
        expansion = expanded(self.posterior, values, self.columns)
        steep = self.steepness(values)
        return Expanded(
            values=values,
            x=self.x(values),
            log_likelihood=expansion.log_likelihood,
            gradient=(steep.swapaxes(1, 2) @ expansion.gradient[..., None])[..., 0],
            information=steep.swapaxes(1, 2) @ expansion.information @ steep,
            steepness=steep,
        )

    def _objective(self, at: Expanded) -> tuple[Vector, Matrix, Array]:
        """Log likelihood with normal priors of the widths of the priors; gradient and information."""
        middle, width = self._priors
        apart = (self.natural(at.values) - middle) / width
        steep = at.steepness / width[:, None]
        return (
            at.log_likelihood - 0.5 * (apart**2).sum(axis=1),
            at.gradient - (steep.swapaxes(1, 2) @ apart[..., None])[..., 0],
            at.information + steep.swapaxes(1, 2) @ steep,
        )

    def descended(self, values: Matrix, steps: int) -> tuple[Expanded, Vector]:
        """Expansions about the optima near table values, after Levenberg and Marquardt's steps, so many at
        most and until one gains nothing, or those that remain too little to come near the best of the batch;
        and what they maximise: log likelihood and normal priors as wide as the priors, (batch,) [nat]."""
        at = self.expanded(values)
        level, gradient, information = self._objective(at)
        damping, moving = np.full(len(values), _DAMPING[0]), np.arange(len(values))
        for remaining in range(steps, 0, -1):
            here, slope = Expanded(*(part[moving] for part in at)), gradient[moving]
            x = self._stepped(here, slope, information[moving], damping[moving])
            gain = np.abs(slope * (x - here.x)).sum(axis=1)
            hopeless = level[moving] + _FASTER * remaining * gain + _HOPELESS < level.max()
            ends = ((gain < _GAIN) | hopeless) & (damping[moving] <= _FREE)
            moving, x, before = moving[~ends], x[~ends], here.values[~ends]
            if not moving.size:
                break
            proposed, exists = self.values(x, before)
            proposed[~exists] = before[~exists]
            new = self.expanded(proposed)
            reached, *slopes = self._objective(new)
            finite = np.isfinite(new.gradient).all(axis=1) & np.isfinite(new.information).all(axis=(1, 2))
            better = exists & finite & (reached > level[moving])
            for old, now in zip((*at, level, gradient, information), (*new, reached, *slopes), strict=True):
                old[moving[better]] = now[better]
            damping[moving] = np.clip(np.where(better, 0.1, 10.0) * damping[moving], *_DAMPING[1:])
        return at, level

    def uncertainty(self, at: Expanded) -> Matrix:
        """Standard deviations of the natural coordinates about optima, at most those of the priors, (batch,
        size)."""
        steep, information = at.steepness, self._objective(at)[2]
        covariance = steep @ covariance_of(information) @ steep.swapaxes(1, 2)
        sd = np.sqrt(np.maximum(np.diagonal(covariance, axis1=1, axis2=2), 0.0))
        return np.asarray(np.minimum(sd, self.widths))

    def _stepped(self, at: Expanded, gradient: Matrix, information: Array, damping: Vector) -> Matrix:
        """Coordinates one step on; shares stay positive."""
        scale = np.sqrt(np.maximum(np.diagonal(information, axis1=1, axis2=2), 1e-300))
        curved = information / scale[:, :, None] / scale[:, None, :]
        curved += damping[:, None, None] * np.eye(scale.shape[1])
        slope = gradient / scale
        step = np.linalg.solve(curved, slope[..., None])[..., 0] / scale
        shares = np.zeros(scale.shape[1], dtype=bool)
        for element in self.elements:
            shares[element.part] = True
        # shares that would vanish shrink, and the others follow
        least = (_SHRINK - 1.0) * at.x
        fixed = shares & (step < least)
        if fixed.any():
            step = solve_with_held(curved, slope, fixed, least * scale) / scale
            step = np.where(shares, np.maximum(step, least), step)
        length = np.ones(len(step))
        for element in self.elements:
            powers = self.powers(element, at.values)[:, element.free]
            left = self.left(element, at.values)
            fall = (powers * step[:, element.part]).sum(axis=1)
            room = (1.0 - _SHRINK) * left
            length = np.minimum(length, np.where(fall > room, room / np.where(fall > 0, fall, 1.0), 1.0))
        x = at.x + length[:, None] * step
        for position, k in enumerate(self.columns):
            row = self.posterior.table.rows[k]
            if not shares[position] and row.kind != "gain":
                x[:, position] = np.clip(x[:, position], *_inside(row.domain))
            elif row.kind == "gain" and row.log_scale:
                x[:, position] = np.maximum(x[:, position], _SHRINK * at.x[:, position])
        return x


def _inside(domain: tuple[float, float]) -> tuple[float, float]:
    """Ends of a domain, moved inside by a little where they are finite."""
    low, high = domain
    edge = 1e-6 * (high - low if np.isfinite(high - low) else 1.0)
    return low + edge, high - edge


def screened(conditional: Conditional, values: Matrix, tries: int, rng: np.random.Generator) -> Matrix:
    """`values` with the coordinates of the best of so many prior draws for each point, the times of an
    element equal: a start from which a descent seldom ends with a term of no effect."""
    posterior, count = conditional.posterior, len(values)
    drawn = np.repeat(values, tries, axis=0)
    for k in conditional.columns:
        drawn[:, k] = posterior.table.rows[k].draw(len(drawn), rng)
    for element in conditional.elements:
        rows = [element.times[i] for i in element.free]
        drawn[:, rows] = drawn[:, rows[:1]]
    likelihood = posterior.log_likelihood(drawn).reshape(count, tries)
    best = np.argmax(likelihood, axis=1)
    return np.asarray(drawn.reshape(count, tries, -1)[np.arange(count), best])
