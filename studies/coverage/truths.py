"""Plants whose every figure is known, in and outside the family that is fitted, and records of them."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.path import TransferPath

KINDS = ("lag", "two lags", "three lags", "chain", "one term", "two terms", "ringing", "wall")
"""Plants of one path; of several paths each has one of these."""
SHAPES = ((1, 1), (1, 1), (1, 1), (1, 2), (2, 1), (2, 2))
"""Drives and responses, in turn."""
SPAN, BEFORE = 18.0, 2.0
"""Time after and before the change of the drive, in time constants of about one [time unit]."""
_FINE = 40_001


@dataclass(frozen=True)
class Path:
    """A path from a drive to a response."""

    kind: str
    gain: float
    delay: float
    rises: Callable[[Vector], Vector]
    """Response to a unit step over its steady value, without the delay."""

    def step(self, time: Vector) -> Vector:
        """Response to a unit step at time 0 [response unit]."""
        since = time - self.delay
        return np.where(since > 0, self.gain * self.rises(np.maximum(since, 1e-12)), 0.0)

    @cached_property
    def figures(self) -> dict[str, float]:
        """True figures; a rise that is not over by the end of the record is infinite."""
        time = np.linspace(0.0, SPAN, _FINE)[1:]
        curve = self.step(time) / self.gain
        low, high = (
            float(time[(curve >= level).argmax()]) if (curve >= level).any() else np.inf
            for level in (0.1, 0.9)
        )
        return {
            "steady_state": self.gain,
            "delay": self.delay,
            "value_at_end": float(self.gain * curve[-1]),
            "rise_10_90": high - low if np.isfinite(high) else np.inf,
        }


def drawn(kind: str, rng: np.random.Generator) -> Path:
    """A plant of a kind."""
    time = 10 ** rng.uniform(-0.3, 0.4)
    gain = rng.uniform(0.3, 2.0) * rng.choice([-1, 1])
    delay = rng.uniform(0.1, 1.0)
    if kind == "lag":
        rises = _lags([1.0], [time])
    elif kind == "two lags":
        share = rng.uniform(0.15, 0.85)
        rises = _lags([share, 1 - share], [time, time * 10 ** rng.uniform(0.4, 0.9)])
    elif kind == "three lags":
        rises = _lags(rng.dirichlet([2, 2, 1]), [time, 0.25 * time, 3 * time])
    elif kind == "chain":  # partial fractions of 1 / ((1 + T s) (1 + r T s))
        ratio = rng.uniform(0.2, 0.8)
        rises = _lags([1 / (1 - ratio), -ratio / (1 - ratio)], [time, ratio * time])
    elif kind == "one term":
        rises = _elements([time], [rng.uniform(0.65, 0.95)])
    elif kind == "two terms":
        rises = _elements([time, 0.4 * time], [rng.uniform(0.9, 1.0), rng.uniform(0.4, 0.7)])
    elif kind == "ringing":
        rises = _elements([time], [rng.uniform(1.3, 1.6)])
    else:
        rises = _wall(4 * time)
    return Path(kind, gain, delay, rises)


def _lags(weights: list[float] | Vector, times: list[float]) -> Callable[[Vector], Vector]:
    def rises(time: Vector) -> Vector:
        return sum(-w * np.expm1(-time / t) for w, t in zip(weights, times, strict=True))

    return rises


def _elements(times: list[float], orders: list[float]) -> Callable[[Vector], Vector]:
    etas = tuple(t**order for t, order in zip(times, orders, strict=True))
    path = TransferPath(1.0, 0.0, etas, tuple(orders), 1.0)

    def rises(time: Vector) -> Vector:
        return np.asarray(step_response(path, time))

    return rises


def _wall(time: float) -> Callable[[Vector], Vector]:
    """Insulated face of a wall: 1 / cosh(sqrt(T s)) (Carslaw and Jaeger 1959, sect. 3.4)."""
    k = np.arange(200)
    odd = 2 * k + 1

    def rises(at: Vector) -> Vector:
        terms = (-1.0) ** k / odd * np.exp(-(odd**2) * np.pi**2 * at[:, None] / (4 * time))
        return np.maximum(1 - 4 / np.pi * terms.sum(axis=1), 0.0)

    return rises


@dataclass(frozen=True)
class Campaign:
    """Records with all that is true of them."""

    study: Study
    paths: dict[str, Path]
    """By the name that the fit gives them."""


def campaign(kind: str, seed: int) -> Campaign:
    """Steps up and down, one after the other for every drive, and a record whose drive never moves."""
    rng = np.random.default_rng([seed, KINDS.index(kind)])
    drives, responses = SHAPES[seed % len(SHAPES)]
    count = int(rng.choice([120, 250, 500]))
    time = np.sort(rng.uniform(-BEFORE, SPAN, count)) if seed % 2 else np.linspace(-BEFORE, SPAN, count)
    time = time - time[int(np.abs(time).argmin())]
    time *= SPAN / time[-1]
    kinds = [kind, *rng.choice(KINDS, drives * responses - 1)]
    paths = [drawn(str(one), rng) for one in kinds]
    table = [paths[i * drives : (i + 1) * drives] for i in range(responses)]
    inputs = tuple(Axis(f"u{j}", "V") for j in range(drives))
    outputs = tuple(Axis(f"y{i}", "K") for i in range(responses))
    sd = 10 ** rng.uniform(-2.7, -1.5) * 10 * np.array([max(abs(one.gain) for one in row) for row in table])
    records = []
    levels = [(j, height) for j in range(drives) for height in (10.0, -6.0)]
    for number, (drive, height) in enumerate([*levels, (0, 0.0)]):
        moved = np.where(time >= 0, height, 0.0)
        command = np.zeros((count, drives))
        command[:, drive] = moved
        read = np.stack([height * row[drive].step(time) for row in table], axis=1)
        read += 20 + 0.2 * sd * rng.standard_normal(responses) + sd * rng.standard_normal(read.shape)
        records.append(Record(f"r{number}", time, command, read, inputs, outputs, "s"))
    single = drives * responses == 1
    named = {"y0" if single else f"y{i}_u{j}": table[i][j] for i in range(responses) for j in range(drives)}
    return Campaign(Study(f"{kind} {seed}", None, "s", seed, tuple(records), (), ModelSettings()), named)
