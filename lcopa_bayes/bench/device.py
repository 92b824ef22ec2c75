"""The device on the virtual bench: paths with delay from every drive to every response, superposed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import inf, isfinite
from typing import Protocol, TypeAlias

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.inversion import unit_ramp, unit_step, unsuited
from lcopa_bayes.core.arrays import Array, Matrix, Vector, frozen
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath

Response: TypeAlias = Callable[[Array], Array]
"""A causal function of time [ms], zero up to time 0, elementwise."""

_DEGREE = 12
_DISTINCT = 4096
"""Up to this many different lags the response is evaluated at each of them."""
_PANELS, _HALVINGS = 1 << 16, 24
_PAIRS = 1 << 18
"""Pairs of sample and change treated at once."""
_RESOLUTION = 1e-12
"""Lags closer than this part of their span are one: a sample and a change at one instant in different
rounding must not resolve the steep onset of a low order."""


class TableError(ArithmeticError):
    """A response too rough to tabulate; holds the `time` reached and the remaining `error`."""

    def __init__(self, time: float, error: float) -> None:
        self.time, self.error = time, error
        super().__init__(
            f"interpolation error still {error:.3g} near time {time:.6g}; is the response noisy?"
        )


def tabulated(response: Response, first: float, last: float, *, tolerance: float) -> Response:
    """Interpolant of `response` on ``[first, last]`` [ms], ``0 < first``; zero up to time 0.

    Polynomials of degree 12 in log time, on which a fractional onset ``t^order`` is smooth; panels
    are halved until the error at 5 points between the nodes is below `tolerance` [response unit].
    Times must be at most 0 or within the interval. Raises TableError after 24 halvings, or when more
    than 65536 panels at once are not good enough.
    """
    nodes, between = chebyshev.chebpts1(_DEGREE + 1), np.array([-0.97, -0.5, 0.05, 0.6, 0.95])
    to_series = np.linalg.inv(chebyshev.chebvander(nodes, _DEGREE))
    low, high = np.log(first) - 1e-9, np.log(last) + 1e-9
    edges = np.linspace(low, high, 2 + int(high - low))
    lower, upper = edges[:-1], edges[1:]
    done: list[tuple[Vector, Array]] = []
    for halvings in range(_HALVINGS + 1):
        middle, half = (lower + upper)[:, None] / 2, (upper - lower)[:, None] / 2
        values = response(np.exp(middle + half * np.concatenate([nodes, between])))
        series = values[:, : nodes.size] @ to_series.T
        error = np.abs(series @ chebyshev.chebvander(between, _DEGREE).T - values[:, nodes.size :]).max(
            axis=1
        )
        rough = ~(error <= tolerance)
        done.append((lower[~rough], series[~rough]))
        if not rough.any():
            break
        if rough.sum() > _PANELS or halvings == _HALVINGS:
            worst = int(np.argmax(error))
            raise TableError(float(np.exp(middle[worst, 0])), float(error[worst]))
        lower, upper, middle = lower[rough], upper[rough], middle[rough, 0]
        lower, upper = np.concatenate([lower, middle]), np.concatenate([middle, upper])
    starts, panels = np.concatenate([start for start, _ in done]), np.vstack([series for _, series in done])
    rank = np.argsort(starts)
    edges = np.append(starts[rank], high)
    to_powers = np.zeros((_DEGREE + 1, _DEGREE + 1))  # of the part of the panel passed
    for k in range(_DEGREE + 1):
        to_powers[k, : k + 1] = Chebyshev.basis(k, domain=[0, 1]).convert(kind=Polynomial).coef
    powers = panels[rank] @ to_powers / np.diff(edges)[:, None] ** np.arange(_DEGREE + 1)
    table = PPoly(powers.T[::-1], edges)

    def interpolant(time: Array) -> Array:
        out = np.zeros(np.shape(time))
        later = time > 0
        out[later] = table(np.log(time[later]))
        return out

    return interpolant


def superposed(
    response: Response, time: Vector, changes: Vector, jumps: Vector, *, tolerance: float
) -> Vector:
    """``sum_j jumps[j] response(time - changes[j])``, (n,).

    Parameters: `time` (n,) and `changes` (m,) [ms]; `jumps` (m,); `tolerance` [response unit per unit
    jump]: the error of the table used when the lags that differ are more than 4096.
    """
    out = np.zeros(time.size)
    if time.size == 0 or changes.size == 0:
        return out
    span = float(max(time.max() - changes.min(), 0.0))
    resolution = _RESOLUTION * max(span, float(np.abs(changes).max()), float(np.abs(time).max()))
    if span <= resolution:
        return out
    rows = max(1, _PAIRS // changes.size)
    blocks = [time[i : i + rows] for i in range(0, time.size, rows)]

    def lags(block: Vector) -> Array:
        return np.asarray(resolution * np.round((block[:, None] - changes) / resolution))

    if len(blocks) == 1:
        distinct, which = np.unique(lags(time), return_inverse=True)
        if distinct.size <= _DISTINCT:
            return response(distinct)[which.reshape(time.size, changes.size)] @ jumps
    table = tabulated(response, resolution, span, tolerance=tolerance)
    return np.concatenate([table(lags(block)) @ jumps for block in blocks])


ACCURACY = 1e-9
"""Error of a response [-], of the steady deflection per unit drive and per unit jump."""


class Responsive(Protocol):
    """Anything that responds to a command: a device, or a device with a hidden effect."""

    @property
    def drive_axes(self) -> tuple[Axis, ...]: ...  # noqa: D102
    @property
    def response_axes(self) -> tuple[Axis, ...]: ...  # noqa: D102
    @property
    def time_unit(self) -> str: ...  # noqa: D102
    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix: ...  # noqa: D102


@dataclass(frozen=True)
class Device:
    """Responses that are sums over paths from all drives, each about a resting offset.

    Raises InputError unless `paths` has one row per response axis and one column per drive axis, every path
    is physical with distinct orders, and there is one finite offset per response axis.
    """

    paths: tuple[tuple[TransferPath, ...], ...]
    """``paths[i][j]`` leads from drive j to response i."""
    drive_axes: tuple[Axis, ...]
    response_axes: tuple[Axis, ...]
    offsets: tuple[float, ...]
    """Response without any drive [response unit], one per response axis."""
    time_unit: str = "ms"
    """Unit of delays, of viscosities and of every time given to this device."""

    def __post_init__(self) -> None:
        rows, columns = len(self.response_axes), len(self.drive_axes)
        problems = []
        if not (rows and columns and [len(row) for row in self.paths] == [columns] * rows):
            problems.append(f"a device needs {rows} x {columns} paths, one per response and drive axis")
        problems += [problem for row in self.paths for path in row for problem in unsuited(path)]
        if len(self.offsets) != rows or not all(isfinite(offset) for offset in self.offsets):
            problems.append(f"one finite offset per response axis is needed; got {self.offsets}")
        if problems:
            raise InputError(problems)

    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix:
        """Responses to `command` at `time` [ms], (n, n_responses) [response unit].

        ``offset_i + sum_j steady_ij rest_j + sum_jc jump_jc step_ij(time - time_c)``: rest under the
        command's resting drive, then one step response per change. With an `exposure` > 0 [ms] each
        value is the mean over the exposure that ends at its time, taken exactly by the integral of the
        step response. Accuracy: `ACCURACY`, plus rounding 1e-13 time/exposure when there is an exposure.
        Raises InputError for a command with another number of axes or a negative exposure.
        """
        time = frozen(time, name="time")
        problems = []
        if command.rest.size != len(self.drive_axes):
            problems.append(
                f"the device has {len(self.drive_axes)} drive axes; the command {command.rest.size}"
            )
        if not 0 <= exposure < inf:
            problems.append(f"an exposure must be at least 0 and finite; got {exposure}")
        if problems:
            raise InputError(problems)
        out = np.tile(np.array(self.offsets), (time.size, 1))
        jumps = command.jumps
        for i, row in enumerate(self.paths):
            for j, path in enumerate(row):
                out[:, i] += path.steady * command.rest[j]
                moved = jumps[:, j] != 0
                if path.gain == 0 or not moved.any():
                    continue
                changes, sizes = command.times[moved] + path.delay, path.gain * jumps[moved, j]
                tolerance = ACCURACY / path.stiffness
                if exposure == 0:
                    curve = partial(unit_step, path)
                    out[:, i] += superposed(curve, time, changes, sizes, tolerance=tolerance)
                else:
                    curve = partial(unit_ramp, path)
                    end, start = (
                        superposed(curve, edge, changes, sizes, tolerance=tolerance * exposure)
                        for edge in (time, time - exposure)
                    )
                    out[:, i] += (end - start) / exposure
        return out


PAPER_DEVICE = Device(
    paths=PAPER.plant.paths,
    drive_axes=(Axis("x", "rad"), Axis("y", "rad")),
    response_axes=(Axis("x", "rad"), Axis("y", "rad")),
    offsets=(0.0, 0.0),
)
"""The identified 2 x 2 model of Ta et al. 2026, Eq. 65."""
