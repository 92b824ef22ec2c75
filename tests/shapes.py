"""Campaigns of every shape, as tables that a user would have: axes, units, clocks, sensors, drifts.

The plants are sums of lags with delays, solved in closed form, apart from all numerics of the package.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.study import Study

Frame = Mapping[str, Vector]


@dataclass(frozen=True)
class Shape:
    """One kind of campaign; times are in units of the slowest lag."""

    responses: int = 1
    drives: int = 1
    unit: str = "ms"
    """Time unit of the records."""
    second: float = 1.0
    """The slowest lag in that unit."""
    samples: int = 60
    records: int = 2
    dark: bool = False
    """Whether one record's drive never moves."""
    early: bool = False
    """Whether the first sample is taken as the drive moves; the row before it states the rest alone."""
    jitter: float = 0.0
    """Spread of sample times [periods]."""
    missing: float = 0.0
    """Share of response cells that are empty."""
    step: float = 0.0
    """Resolution of the sensor [of the range]; 0: as fine as a float."""
    drift: float = 0.0
    """Spread of each record's own offset [of the range]."""
    correlation: float = 0.0
    """Of the noise, from sample to sample."""
    tails: float = np.inf
    """Degrees of freedom of the noise."""
    ringing: float = 0.0
    """Share of a lightly damped oscillation in the response."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the study."""

    def study(self, seed: int = 1) -> Study:
        """Records of one campaign, the last held out when there are three or more."""
        rng = np.random.default_rng(seed)
        frames = [self._frame(k, rng) for k in range(self.records)]
        if self.dark:
            frames.append(self._frame(None, rng))
        fit, held_out = (frames[:-1], frames[-1:]) if self.records > 2 and not self.dark else (frames, [])
        return Study("campaign", fit=fit, held_out=held_out, seed=seed, **self.settings)

    def _frame(self, number: int | None, rng: np.random.Generator) -> Frame:
        """Record `number`, or one in the dark."""
        time = np.linspace(-1.0, 5.0, self.samples)
        time = np.sort(time + self.jitter * (time[1] - time[0]) * rng.uniform(-0.5, 0.5, time.size))
        if self.early:
            time = np.concatenate(([-0.1], time[time >= 0.0]))
        heights = (
            np.zeros(self.drives) if number is None else 1.0 + rng.uniform(size=self.drives) * (number + 1)
        )
        lit = heights * (time >= 0.0)[:, None]
        frame = {f"time_{self.unit}": time * self.second}
        frame |= {f"drive_u{k + 1}_V": lit[:, k] for k in range(self.drives)}
        clean = self._response(time, heights)
        for k in range(self.responses):
            values = clean[:, k] + self.drift * rng.normal() + 0.01 * self._noise(time.size, rng)
            if self.step:
                values = self.step * np.round(values / self.step)
            values[(rng.uniform(size=time.size) < self.missing) | (self.early and time < 0.0)] = np.nan
            frame[f"response_y{k + 1}_rad"] = values
        return frame

    def _response(self, time: Vector, heights: Vector) -> Matrix:
        """Every response to steps of all drives at 0, (samples, responses)."""
        out = np.zeros((time.size, self.responses))
        for i in range(self.responses):
            for j, height in enumerate(heights):
                past = np.maximum(time - 0.1 - 0.05 * abs(i - j), 0.0)
                lags = 0.7 * (1 - np.exp(-past)) + 0.3 * (1 - np.exp(-past / 0.2))
                wave = 1 - np.exp(-0.5 * past) * np.cos(6.0 * past)
                gain = 1.0 if i == j else 0.3
                out[:, i] += gain * height * ((1 - self.ringing) * lags + self.ringing * wave)
        return out

    def _noise(self, count: int, rng: np.random.Generator) -> Vector:
        """Noise of variance 1, correlated or heavy-tailed."""
        if np.isfinite(self.tails):
            return rng.standard_t(self.tails, count) * np.sqrt((self.tails - 2) / self.tails)
        white, out = rng.normal(size=count), np.empty(count)
        last = rng.normal()
        for k, value in enumerate(white):
            out[k] = last = self.correlation * last + np.sqrt(1 - self.correlation**2) * value
        return out


SHAPES: Mapping[str, Shape] = {
    "1x1, dark record": Shape(dark=True),
    "1x2": Shape(responses=1, drives=2, records=3),
    "2x1, jittered clock": Shape(responses=2, jitter=0.8),
    "2x2, held out": Shape(responses=2, drives=2, records=4),
    "3x2, dark record": Shape(responses=3, drives=2, samples=40, dark=True),
    "no sample at rest": Shape(early=True),
    "one record": Shape(records=1),
    "repeats": Shape(records=4),
    "repeats, hours": Shape(records=4, unit="s", second=9_000.0),
    "microseconds": Shape(unit="s", second=2e-6),
    "microseconds, dark record": Shape(unit="s", second=2e-6, dark=True),
    "hours, missing cells, jittered clock": Shape(
        unit="s", second=9_000.0, missing=0.3, jitter=0.8, records=3
    ),
    "few samples": Shape(samples=12),
    "missing cells": Shape(responses=2, missing=0.3),
    "eight bits": Shape(step=1 / 128),
    "offsets that drift": Shape(drift=0.2, records=3, settings={"model": {"offset": "record"}}),
    "coloured noise": Shape(correlation=0.8, settings={"noise": {"kind": "ar1"}}),
    "heavy tails": Shape(tails=3.0, settings={"noise": {"kind": "student"}}),
    "ringing": Shape(ringing=0.4, settings={"model": {"terms": 2}}),
}
