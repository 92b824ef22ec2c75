"""The device on the virtual bench: paths with delay from every drive to every response, superposed.

Measuring on the virtual bench: refresh, camera, noise, and the record they leave.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from math import inf, isfinite, sqrt
from typing import Annotated, TypeAlias, final

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial, chebyshev
from numpy.typing import ArrayLike
from scipy.interpolate import PPoly
from scipy.signal import lfilter

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.inversion import unit_ramp, unit_step, unsuited
from lcopa_bayes.core.arrays import Array, Matrix, Vector, frozen
from lcopa_bayes.core.errors import InputError, refuse_if
from lcopa_bayes.core.rules import FLAG, POSITIVE, Rule, Ruled, is_number
from lcopa_bayes.data.record import Axis, Record
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


@final
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


Responding: TypeAlias = Callable[..., Matrix]
"""What answers commands as `Device.response` does, with effects that a device lacks."""


@final
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
        refuse_if(problems)

    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix:
        """Responses to `command` at `time` [ms], (n, n_responses) [response unit].

        ``offset_i + sum_j steady_ij rest_j + sum_jc jump_jc step_ij(time - time_c)``: rest under the
        command's resting drive, then one step response per change. With an `exposure` > 0 [ms] each
        value is the mean over the exposure that ends at its time, taken exactly by the integral of the
        step response. Accuracy: `ACCURACY`, plus rounding 1e-13 time/exposure when there is an exposure.
        """
        time = frozen(time, name="time")
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


_SAME = 1e-9
"""A change closer than this part of a camera period to a sample is at that sample."""


_NOT_NEGATIVE = Rule("at least 0 and finite", lambda value: is_number(value) and value >= 0)
_DEVIATIONS = Rule(
    "at least 0 and finite", lambda value: all(map(_NOT_NEGATIVE.holds, np.atleast_1d(np.asarray(value))))
)
_CORRELATION = Rule("a number between -1 and 1", lambda value: is_number(value) and -1 < value < 1)


@final
@dataclass(frozen=True)
class Bench(Ruled):
    """How a device is driven and watched, with times in the unit of the device; InputError with all that is
    wrong."""

    refresh: Annotated[float, _NOT_NEGATIVE] = 0.0
    """Period of the drive refresh [ms]; commands act at its next multiple; 0: at once."""
    camera: Annotated[float, POSITIVE] = 0.1
    """Period of the camera [ms]."""
    exposure: Annotated[float, _NOT_NEGATIVE] = 0.0
    """Each sample is the mean over this time up to its own [ms], at most a camera period; 0: none."""
    noise_sd: Annotated[float | tuple[float, ...], _DEVIATIONS] = 0.0
    """Stationary standard deviation of a sample [response unit], one for all response axes or one each."""
    noise_correlation: Annotated[float, _CORRELATION] = 0.0
    """rho [-], correlation of successive camera samples (AR(1)); 0: white. Axes are independent."""
    logged: Annotated[bool, FLAG] = False
    """Whether changes of the drive are written with the next camera sample, up to a period late, as many
    loggers do, not at the instants of the commands."""

    def contradictions(self) -> list[str]:
        """An exposure longer than the camera period."""
        wrong = self.exposure > self.camera
        return [f"`exposure` must be at most the camera period; got {self.exposure}"] if wrong else []

    def noise(self, n: int, n_responses: int, rng: np.random.Generator) -> Matrix:
        """Stationary AR(1) noise, ``e_k = rho e_(k-1) + sd sqrt(1 - rho^2) z_k``, (n, n_responses).

        Raises InputError when `noise_sd` has neither one entry nor one per response.
        """
        sd = np.atleast_1d(np.asarray(self.noise_sd, dtype=float))
        if sd.size not in (1, n_responses):
            raise InputError(f"`noise_sd` needs 1 or {n_responses} entries, one per response; got {sd.size}")
        rho = self.noise_correlation
        innovations: Array = sqrt(1 - rho**2) * rng.standard_normal((n, n_responses))
        innovations[:1] /= sqrt(1 - rho**2)  # the first sample is already stationary
        return np.asarray(sd * lfilter([1.0], [1.0, -rho], innovations, axis=0))


PAPER_BENCH = Bench(
    refresh=1 / PAPER.records.refresh_rate,
    camera=1 / PAPER.records.camera_rate,
    noise_sd=PAPER.records.fractional_rmse,
)
"""Ta et al. 2026, Section 5.1: refresh 1 kHz, camera 10 kHz; noise as large as the fit error reported."""


def truth(
    device: Device,
    bench: Bench,
    command: Command,
    *,
    duration: float,
    name: str,
    responding: Responding | None = None,
) -> Record:
    """The record without noise, of the device or of what is `responding` in its place.

    Rows: one before everything, a camera period before time 0 or before the first change if that is
    earlier, with the resting drive and no response; the camera samples ``0, camera, 2 camera, ...``
    below `duration` [ms]; and, wherever the command changes between samples and is not `logged` with them,
    a row at that instant without a response. The drive column is the drive as commanded: the refresh is the
    device's business. Raises InputError for a duration that holds no sample.
    """
    if not bench.camera <= duration < inf:
        raise InputError(f"`duration` must be finite and at least a camera period; got {duration}")
    camera = _rounded(bench.camera * np.arange(np.ceil(duration / bench.camera - _SAME)))
    changes = command.times[command.times < duration - _SAME * bench.camera]
    nearest = bench.camera * np.round(changes / bench.camera)
    apart = (np.abs(changes - nearest) > _SAME * bench.camera) | (nearest < -_SAME)
    time = np.union1d(camera, changes[apart & (changes < 0.0)] if bench.logged else changes[apart])
    time = np.insert(time, 0, _rounded(time[:1] - bench.camera))
    drive = command.at(time + _SAME * bench.camera)

    response = np.full((time.size, len(device.response_axes)), np.nan)
    obeyed = command.refreshed(bench.refresh)
    sampled = np.searchsorted(time, camera)
    response[sampled] = (responding or device.response)(obeyed, camera, exposure=bench.exposure)
    return Record(name, time, drive, response, device.drive_axes, device.response_axes, device.time_unit)


def simulate(
    device: Device,
    bench: Bench,
    command: Command,
    *,
    duration: float,
    name: str,
    rng: np.random.Generator,
) -> Record:
    """`truth` with the noise of the bench on every camera sample; rows and errors as there."""
    clean = truth(device, bench, command, duration=duration, name=name)
    response = np.array(clean.response)
    sampled = ~np.isnan(response[:, 0])
    response[sampled] += bench.noise(int(sampled.sum()), response.shape[1], rng)
    return replace(clean, response=response)


def _rounded(time: ArrayLike) -> Vector:
    """Without the digits that binary rounding adds to multiples of a decimal period."""
    return np.round(np.asarray(time, dtype=float), 12)
