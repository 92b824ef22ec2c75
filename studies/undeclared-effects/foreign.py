"""Campaigns of plants outside the family that a loop fits: other shapes, time units, clocks and sensors, and
step responses in closed form or by numerical inversion."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from typing import Any, Protocol

import numpy as np
from devicetruth import places, side_figures, step_truth

from lcopa_bayes.bench.driveeffects import signed, unsigned
from lcopa_bayes.bench.hiddeneffects import Hidden, Shot
from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.bench.readingeffects import static
from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.core.estimate import quantile
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.model.path import TransferPath

SHAPES = ((1, 1), (1, 2), (2, 1), (2, 2), (3, 2))
"""Responses and drives."""
UNITS = {"us": "V", "ms": "rad", "s": "bar", "min": "degC", "h": "degC"}
"""Time unit of a campaign, and what responds there."""
SAMPLINGS = ("regular", "jittered", "gap", "missing")
_MODES = 300
"""Of a diffusion element [-]: exact to 3e-8 later than 5e-5 of its time, and to 7e-4 before."""


class Element(Protocol):
    """What responds to a unit step of its drive."""

    def rises(self, time: Array) -> Array:
        """Response [of the steady one] at `time` [time unit] after the step, in its shape; 0 up to time 0."""

    def lagging(self, lag: float) -> "Element":
        """The same seen by a sensor with a first-order lag [time unit]."""


@dataclass(frozen=True, eq=False)
class Modes:
    """``1 - Re sum_k weights_k exp(-rates_k t)``, with ``Re sum_k weights_k = 1``."""

    weights: Array
    rates: Array
    """[1 / time unit]; both may be complex."""

    def rises(self, time: Array) -> Array:
        decays = np.exp(-np.multiply.outer(np.maximum(time, 0.0), self.rates))
        return 1.0 - (decays @ self.weights).real

    def lagging(self, lag: float) -> "Modes":
        weights = self.weights / (1 - lag * self.rates)
        return Modes(np.append(weights, 1 - weights.sum().real), np.append(self.rates, 1 / lag))


@dataclass(frozen=True)
class Fractional:
    """``1 / (1 + sum_i eta_i s^order_i)``."""

    etas: dict[float, float]
    """Viscosities [time unit^order] by order."""

    def rises(self, time: Array) -> Array:
        return unit_step(TransferPath(1.0, 0.0, tuple(self.etas.values()), tuple(self.etas), 1.0), time)

    def lagging(self, lag: float) -> "Fractional":
        etas = dict(self.etas)
        for order, eta in [(0.0, 1.0), *self.etas.items()]:  # times (1 + lag s)
            etas[order + 1] = etas.get(order + 1, 0.0) + lag * eta
        return Fractional(etas)


def _series(weights: Array, rates: Array) -> Modes:
    """Modes with what the series lacks at time 0 in the last of them."""
    return Modes(np.append(weights[:-1], 1 - weights[:-1].sum()), rates)


def three_lags(time: float, rng: np.random.Generator) -> Modes:
    """A sum of three first-order lags."""
    times = time * np.array([rng.uniform(0.1, 0.3), 1.0, rng.uniform(2.0, 5.0)])
    return Modes(rng.dirichlet([3.0, 4.0, 2.0]), 1 / times)


def two_lags(time: float, rng: np.random.Generator) -> Modes:
    """``1 / ((1 + T s) (1 + r T s))``."""
    ratio = float(rng.uniform(0.2, 0.8))
    return Modes(np.array([1.0, -ratio]) / (1 - ratio), 1 / (time * np.array([1.0, ratio])))


def oscillator(time: float, rng: np.random.Generator) -> Modes:
    """Second order, lightly damped."""
    damping = float(rng.uniform(0.3, 0.7))
    ring = np.sqrt(1 - damping**2)
    return Modes(np.array([1 - 1j * damping / ring]), np.array([damping - 1j * ring]) / time)


def wall(time: float, rng: np.random.Generator) -> Modes:
    """Diffusion through a wall with an insulated face, ``1 / cosh sqrt(T s)`` (Carslaw and Jaeger 1959,
    3.4)."""
    odd = 2 * np.arange(_MODES) + 1
    return _series(4 / np.pi * np.cos(np.pi * (odd - 1) / 2) / odd, (np.pi * odd / 2) ** 2 / (3 * time))


def layer(time: float, rng: np.random.Generator) -> Modes:
    """Mean of a layer with an insulated back under its face, ``tanh sqrt(T s) / sqrt(T s)``."""
    roots = np.pi * (np.arange(_MODES) + 0.5)
    return _series(2 / roots**2, roots**2 / (3 * time))


def three_terms(time: float, rng: np.random.Generator) -> Fractional:
    """A fractional element of three terms."""
    orders = [float(rng.uniform(*ends)) for ends in ((0.95, 1.6), (0.6, 0.9), (0.3, 0.5))]
    return Fractional({order: float(time * rng.uniform(0.2, 1.0)) ** order for order in orders})


def distributed_order(time: float, rng: np.random.Generator) -> Fractional:
    """Seven terms of one weight, in place of an integral over the order."""
    orders = np.linspace(rng.uniform(0.4, 0.6), rng.uniform(0.9, 1.0), 7)
    return Fractional({float(order): time**order / orders.size for order in orders})


PLANTS: dict[str, Callable[[float, np.random.Generator], Element]] = {
    "three lags": three_lags,
    "two lags": two_lags,
    "oscillator": oscillator,
    "wall": wall,
    "layer": layer,
    "three terms": three_terms,
    "distributed order": distributed_order,
}
"""Elements of a time [time unit], by kind."""
MIXED = "mixed"
"""Every path of another kind."""
KINDS = (*PLANTS, MIXED)


@dataclass(frozen=True)
class Path:
    """From a drive to a response."""

    gain: float
    """[response unit / drive unit]."""
    delay: float
    """[time unit]."""
    element: Element

    def responds(self, time: Vector, changes: Vector, jumps: Vector) -> Vector:
        """To a drive that jumps, (n,) [response unit]."""
        return self.gain * (self.element.rises(time[:, None] - changes - self.delay) @ jumps)

    def figures(self, span: float, lag: float) -> dict[str, float]:
        """Of a unit step over `span`, seen by a sensor with a lag [time unit]."""
        rises = (self.element.lagging(lag) if lag else self.element).rises
        return {
            "steady_state": self.gain,
            "delay": self.delay,
            **step_truth(rises, self.gain, self.delay, span),
        }


def _hidden(name: str, time: float, rng: np.random.Generator) -> Hidden:
    """An effect of any linear response, of a size that is seen beside noise of 0.5 to 3 %."""
    if name == "gain_drift":
        d = signed(0.05, 0.2, rng)
        return Hidden(name, {"d": d}, seen=static(lambda y, shot: y * (1 + d * shot.epoch)))
    if name == "odd_curvature":
        c = signed(0.05, 0.15, rng)
        return Hidden(name, {"c": c}, seen=static(lambda y, shot: y + c * y**3 / shot.deflection**2))
    if name == "clipping":
        level = float(rng.uniform(0.6, 0.9))
        ends = static(lambda y, shot: np.clip(y, -level * shot.deflection, level * shot.deflection))
        return Hidden(name, {"level": level}, seen=ends)
    if name == "pointing_drift":
        size = unsigned(0.03, 0.1, rng)
        return Hidden(name, {"sd": size}, disturbance=True, seen=partial(_drifting, size))
    if name == "sensor_lag":
        lag = time * unsigned(0.05, 0.3, rng)
        return Hidden(name, {"Ts": lag}, lag=lag)
    raise ValueError(f"no effect of foreign plants is called {name!r}")


def _drifting(size: float, y: Matrix, times: Vector, command: object, shot: Shot) -> Matrix:
    """A straight line of each record."""
    course = (times - times[0]) / (times[-1] - times[0])
    return y + np.outer(course, size * shot.deflection * shot.chance.standard_normal(y.shape[1]))


EFFECTS = ("gain_drift", "odd_curvature", "clipping", "pointing_drift", "sensor_lag")


@dataclass(frozen=True, eq=False)
class Foreign:
    """Records of a foreign plant, and what only the judge reads."""

    fit: tuple[Record, ...]
    held_out: tuple[Record, ...]
    truth: dict[str, Matrix]
    """Response without noise and disturbances, (rows of the record, axes), by record."""
    hidden: tuple[Hidden, ...]
    paths: tuple[tuple[Path, ...], ...]
    """``paths[i][j]`` leads from drive j to response i."""
    noise: Vector
    """Standard deviation of the noise of each response axis [response unit]."""

    def study(self, seed: int) -> Study:
        """The records alone, as a user has them."""
        return Study("foreign", None, self.fit[0].time_unit, seed, self.fit, self.held_out)


@dataclass(frozen=True, eq=False)
class _Drawn:
    """One record before it is read."""

    time: Vector
    sampled: Array
    """Whether a row is a sample, (n,)."""
    drive: Matrix
    deflection: Matrix


def campaign(kind: str, effects: Iterable[str], seed: int) -> Foreign:
    """Two to four records to fit, another whose drive never moves, and one or two held out."""
    rng = np.random.default_rng([seed, 78])
    responses, drives = SHAPES[seed % len(SHAPES)]
    unit, sampling = str(rng.choice([*UNITS])), str(rng.choice(SAMPLINGS))
    time = float(10 ** rng.uniform(-0.5, 1.5))
    scale, heights = 10 ** rng.uniform(-3, 1), 10 ** rng.uniform(-1, 1.5, drives)
    paths = tuple(
        tuple(_path(kind, time, scale * (1.0 if i == j else 0.5) / heights[j], rng) for j in range(drives))
        for i in range(responses)
    )
    hidden = tuple(_hidden(name, time, rng) for name in effects)
    lag = sum(one.lag for one in hidden)
    seen = tuple(tuple(_behind(path, lag) for path in row) for row in paths)
    fitted, unseen = int(rng.integers(2, 5)), int(rng.integers(1, 3))
    roles = ["fit", *rng.permutation(["fit"] * (fitted - 1) + ["held out"] * unseen + ["dark"])]
    drawn = []
    for k, role in enumerate(roles):
        moving = (rng.random(drives) < 0.5) | (np.arange(drives) == k % drives) | (k == 0)
        drawn.append(_drawn(seen, time, heights * (moving & (role != "dark")), sampling, rng))
    largest = np.max([np.abs(one.deflection).max(axis=0) for one in drawn], axis=0)
    spread = np.ptp(np.concatenate([one.deflection for one in drawn]), axis=0)
    noise = spread * 10 ** rng.uniform(np.log10(0.005), np.log10(0.03))
    step = 2 * spread / 255 if rng.random() < 0.25 else None  # eight bits
    axes = [
        tuple(Axis(f"{letter}{k + 1}", of) for k in range(count))
        for letter, count, of in (("u", drives, "V"), ("y", responses, UNITS[unit]))
    ]
    records: dict[str, list[Record]] = {"fit": [], "held out": []}
    truth = {}
    for k, (role, one) in enumerate(zip(roles, drawn, strict=True)):
        name, epoch = f"run{k + 1:02d}", (k + 0.5) / len(roles) - 0.5
        shot = Shot(epoch, heights, largest, 0.0, np.zeros((responses, drives)), rng)
        offset = 0.3 * spread * rng.standard_normal(responses)
        exact = _read(one, [effect for effect in hidden if not effect.disturbance], shot)
        read = _read(one, hidden, shot) + offset + noise * rng.standard_normal(exact.shape)
        if step is not None:
            read = step * np.round(read / step)
        read[~one.sampled] = np.nan
        if sampling == "missing":
            read[rng.random(read.shape) < 0.15] = np.nan
        truth[name] = exact + offset
        records["held out" if role == "held out" else "fit"].append(
            Record(name, one.time, one.drive, read, *axes, unit)
        )
    return Foreign(tuple(records["fit"]), tuple(records["held out"]), truth, hidden, paths, noise)


def _path(kind: str, time: float, gain: float, rng: np.random.Generator) -> Path:
    own = str(rng.choice([*PLANTS])) if kind == MIXED else kind
    element = PLANTS[own](time * 10 ** rng.uniform(-0.3, 0.3), rng)
    return Path(signed(0.5, 2.0, rng) * gain, time * unsigned(0.03, 0.5, rng), element)


def _behind(path: Path, lag: float) -> Path:
    """The path seen by a sensor with a lag [time unit], 0 for none."""
    return Path(path.gain, path.delay, path.element.lagging(lag)) if lag else path


def _drawn(
    paths: tuple[tuple[Path, ...], ...],
    time: float,
    heights: Vector,
    sampling: str,
    rng: np.random.Generator,
) -> _Drawn:
    """Steps, staircases and random levels of the drives with a height, some too short to settle after."""
    samples, span = int(rng.choice([120, 250, 400])), time * float(rng.uniform(3, 20))
    at = np.linspace(0.0, span, samples)
    if sampling == "jittered":
        at = at + rng.uniform(-0.4, 0.4, samples) * at[1]
    if sampling == "gap":
        first = int(rng.uniform(0.3, 0.8) * samples)
        at = np.delete(at, np.arange(first, first + samples // 8))
    moves = [_moves(height, span, rng) for height in heights]
    rows = np.unique(np.concatenate([at, *(changes for changes, _ in moves)]))
    drive = np.stack(
        [np.append(0.0, levels)[np.searchsorted(at, rows, side="right")] for at, levels in moves], axis=1
    )
    deflection = np.zeros((rows.size, len(paths)))
    for i, row in enumerate(paths):
        for path, (changes, levels) in zip(row, moves, strict=True):
            deflection[:, i] += path.responds(rows, changes, np.diff(levels, prepend=0.0))
    return _Drawn(rows, np.isin(rows, at), drive, deflection)


def _moves(height: float, span: float, rng: np.random.Generator) -> tuple[Vector, Vector]:
    """Times at which a drive changes, and its levels from then on."""
    kind = str(rng.choice(["step", "staircase", "random"]))
    if not height:
        return np.empty(0), np.empty(0)
    count = {"step": int(rng.integers(1, 3)), "staircase": 4, "random": 8}[kind]
    changes = np.sort(rng.uniform(0.1, 0.9, count))
    changes[0] = rng.uniform(0.1, 0.2)
    levels = {
        "step": np.array([1.0, 0.0])[:count] * rng.choice([-1.0, 1.0]),
        "staircase": np.array([0.4, 1.0, 0.5, -0.3]),
        "random": rng.choice([-1.0, 1.0], count) * rng.uniform(0.2, 1.0, count),
    }[kind]
    return span * np.sort(changes), height * levels


def _read(one: _Drawn, effects: Iterable[Hidden], shot: Shot) -> Matrix:
    out = np.array(one.deflection)
    for effect in effects:
        if effect.seen is not None:
            out = effect.seen(out, one.time, None, shot)
    return out


def truths(made: Foreign, span: float, named: Iterable[str]) -> dict[str, float]:
    """Figures of every path over `span` by the name that a loop gives them; behind the sensor's lag, unless
    that is `named`."""
    first = made.fit[0]
    lag = sum(one.lag for one in made.hidden if one.name not in named)
    single = len(first.drive_axes) == len(first.response_axes) == 1
    return {
        f"{key}[{response.name if single else f'{response.name}_{drive.name}'}]": value
        for response, row in zip(first.response_axes, made.paths, strict=True)
        for drive, path in zip(first.drive_axes, row, strict=True)
        for key, value in path.figures(span, lag).items()
    }


def scored(found: Loop, made: Foreign) -> dict[str, Any]:
    """Places of the figures of every path [normal sd]; and true value, ends and median of each."""
    span = found.problem.scales.span
    bare, truth = truths(made, span, ()), truths(made, span, found.names)
    return {
        "plant_before": places(side_figures(found, found.before), bare),
        "plant_alone": places(found.figures, truth, alone=True),
        "plant_after": places(found.figures, truth),
        "sizes_after": {},
        "figures": {
            one.name: [truth[one.name], *(float(quantile(one.values, at)) for at in (0.05, 0.5, 0.95))]
            for one in found.figures
            if one.name in truth
        },
    }
