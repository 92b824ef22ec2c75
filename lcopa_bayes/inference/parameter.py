"""One number of the model: its name, unit, place, prior and the scale it is sampled on.

Kinds of parameters: what all parameters of one kind have in common, declared once.

Prior densities by their scipy.stats name, with the common ones evaluated in closed form.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from math import inf, log, pi
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from scipy import stats
from scipy.special import expit, log_expit, logit

from lcopa_bayes.core.arrays import Array, Flags, Vector


def _uniform(x: Vector, p: Mapping[str, float]) -> Vector:
    low, width = p.get("loc", 0.0), p.get("scale", 1.0)
    standard = (x - low) / width  # as scipy rounds, so that both agree on which ends are inside
    return np.where((standard >= 0) & (standard <= 1), -log(width), -np.inf)


def _loguniform(x: Vector, p: Mapping[str, float]) -> Vector:
    inside = (x >= p["a"]) & (x <= p["b"])
    level = -log(log(p["b"] / p["a"]))
    return np.where(inside, level - np.log(np.where(inside, x, 1.0)), -np.inf)


def _norm(x: Vector, p: Mapping[str, float]) -> Vector:
    mean, sd = p.get("loc", 0.0), p.get("scale", 1.0)
    return -log(sd) - 0.5 * log(2 * pi) - 0.5 * ((x - mean) / sd) ** 2


_CLOSED = {"uniform": _uniform, "loguniform": _loguniform, "norm": _norm}
_CLOSED_PARAMETERS = {"uniform": {"loc", "scale"}, "loguniform": {"a", "b"}, "norm": {"loc", "scale"}}
"""Closed forms are ten times faster than scipy's general path and tested against it."""


@dataclass(frozen=True)
class Prior:
    """A proper density of one parameter."""

    dist: str
    """Name of a continuous distribution of scipy.stats."""
    parameters: Mapping[str, float]
    """Its shape parameters, `loc` and `scale`, in the parameter's unit."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))

    @cached_property
    def frozen(self) -> Any:
        """The scipy.stats distribution."""
        return getattr(stats, self.dist)(**self.parameters)

    def log_density(self, x: Vector) -> Vector:
        """Logarithm of the density; -inf outside the support."""
        if set(self.parameters) <= _CLOSED_PARAMETERS.get(self.dist, set()):
            return _CLOSED[self.dist](x, self.parameters)
        return np.asarray(self.frozen.logpdf(x), dtype=float)

    @cached_property
    def support(self) -> tuple[float, float]:
        """Lower and upper end, infinite when open."""
        low, high = self.frozen.support()
        return float(low), float(high)

    @property
    def normal(self) -> tuple[float, float] | None:
        """Mean and standard deviation of the square that the logarithm of the density is; None for another.
        That of a half-normal density falls from its lower end."""
        if self.dist == "norm":
            return float(self.frozen.mean()), float(self.frozen.std())
        if self.dist == "halfnorm":
            return self.support[0], self.parameters.get("scale", 1.0)
        return None

    def draw(self, size: int | tuple[int, ...], rng: np.random.Generator) -> Array:
        """Independent draws."""
        return np.asarray(self.frozen.rvs(size=size, random_state=rng), dtype=float)

    def __reduce__(self) -> tuple[Any, ...]:
        return Prior, (self.dist, dict(self.parameters))

    def __str__(self) -> str:
        inside = ", ".join(f"{key}={value:.4g}" for key, value in self.parameters.items())
        return f"{self.dist}({inside})"


@dataclass(frozen=True)
class Kind:
    """A kind of parameter."""

    name: str
    low: float = -inf
    """Lower end of the domain, excluded [unit of the parameter]."""
    high: float = inf
    """Upper end of the domain, excluded unless `closed` [unit of the parameter]."""
    closed: bool = False
    """Whether the upper end belongs to the domain."""
    scale: Literal["plain", "log", "logit"] = "plain"
    """What the parameter is sampled by: its value, its logarithm or its logit."""
    zero: bool = False
    """Whether it may be fixed at 0: no delay, no correlation."""
    noise: Literal["", "scale", "shape"] = ""
    """Of a noise model: a standard deviation or scale [response unit], or a shape [-]; "" of the plant."""

    def contains(self, x: Vector) -> Flags:
        """Whether values lie in the domain."""
        inside: Flags = (x > self.low) & ((x <= self.high) if self.closed else (x < self.high))
        return inside

    @property
    def interval(self) -> str:
        """The domain as text, with the values a parameter may be fixed at."""
        return f"{'[' if self.zero else '('}{self.low:g}, {self.high:g}{']' if self.closed else ')'}"


COEFFICIENTS = ("coefficient", "magnitude")
"""Kinds of what an effect estimates; it vanishes where they are 0."""
CONSTANTS = ("constant", "fraction", "choice")
"""Kinds of the internal constants of effects."""
KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        kind.name: kind
        for kind in (
            Kind("gain"),
            Kind("time", low=0.0, scale="log"),
            Kind("order", low=0.0, high=2.0, closed=True),
            Kind("delay", low=0.0, zero=True),
            Kind("offset"),
            Kind("sigma", low=0.0, scale="log", noise="scale"),
            Kind("sigma_ar", low=0.0, scale="log", noise="scale", zero=True),
            # near 1 the logit and the logarithm of the noise scale trade off along a straight line
            Kind("rho", low=0.0, high=1.0, scale="logit", noise="shape", zero=True),
            Kind("nu", low=0.0, scale="log", noise="shape"),
            # of effects: what they estimate, of either sign or not, and their internal constants
            Kind("coefficient"),
            Kind("magnitude", low=0.0, zero=True),
            Kind("constant", low=0.0, scale="log"),
            Kind("fraction", low=0.0, high=1.0, closed=True, zero=True),
            Kind("choice", low=0.0, high=1.0, closed=True, zero=True),
        )
    }
)
"""Every kind by its name."""


_LEAST_MASS = 1e-9
"""A prior with less mass in its parameter's domain is a mistake [-]."""
_REJECTION = 0.1
"""Draws are rejected until inside the domain down to this mass [-], and found by inversion below it."""


class Place(NamedTuple):
    """Where a parameter enters: (response, drive) for gains, (element, term) for times and orders,
    (slot, 0) for delays, (response, record or -1 for all) for offsets, (response, 0) for noise,
    (effect, position) for coefficients and for constants of effects."""

    first: int
    second: int


@dataclass(frozen=True)
class Parameter:
    """One number of the model."""

    name: str
    unit: str
    kind: str
    place: Place
    prior: Prior | None
    """None when fixed."""
    value: float = np.nan
    """Fixed value, in `unit`."""
    default: bool = True
    """Whether the prior is the default one."""
    adds_to: int | None = None
    """Response axis that a coefficient of an effect adds to in proportion, whatever the plant; else None."""

    @property
    def declared(self) -> Kind:
        """What all parameters of this kind have in common."""
        return KINDS[self.kind]

    @property
    def response(self) -> int:
        """Response axis of what enters linearly: gains, offsets and coefficients that only add."""
        return self.place.first if self.adds_to is None else self.adds_to

    @property
    def noise(self) -> bool:
        """Whether it belongs to the noise model."""
        return self.declared.noise != ""

    @property
    def free(self) -> bool:
        """Whether the parameter is inferred."""
        return self.prior is not None

    @property
    def log_scale(self) -> bool:
        """Whether it is sampled by its logarithm."""
        positive = self.prior is not None and self.prior.dist == "loguniform" and self.prior.support[0] >= 0
        return self.declared.scale == "log" or (positive and not self.logit_scale)

    @property
    def logit_scale(self) -> bool:
        """Whether it is sampled by its logit."""
        return self.declared.scale == "logit"

    def coordinate(self, values: Array | float) -> Array:
        """Values on the scale the parameter is sampled on, same shape."""
        return np.asarray(np.log(values) if self.log_scale else logit(values) if self.logit_scale else values)

    def value_at(self, coordinate: Array | float) -> Array:
        """Values at places on the scale the parameter is sampled on, same shape [unit]."""
        x = coordinate
        return np.asarray(np.exp(x) if self.log_scale else expit(x) if self.logit_scale else x)

    @property
    def domain(self) -> tuple[float, float]:
        """Interval on which the posterior can be positive: the prior's support within the kind's."""
        low, high = self.declared.low, self.declared.high
        support = (low, high) if self.prior is None else self.prior.support
        return max(low, support[0]), min(high, support[1])

    @property
    def sampled_domain(self) -> tuple[float, float]:
        """`domain` on the scale the parameter is sampled on."""
        low, high = self.domain
        if self.logit_scale:
            return float(logit(low)), float(logit(high))
        if not self.log_scale:
            return low, high
        return (log(low) if low > 0 else -inf), (log(high) if high < inf else inf)

    def log_prior(self, x: Vector) -> Vector:
        """Log density of the prior, restricted to the domain and normalised there."""
        assert self.prior is not None
        # also for a prior within the domain: far logits and logarithms round to its ends, where there
        # is no likelihood (a correlation of 1) or a density may be infinite (a scale of 0)
        return np.where(self.declared.contains(x), self.prior.log_density(x) - self._log_mass, -np.inf)

    def log_density(self, coordinate: Vector) -> Vector:
        """Log density of the prior in the coordinate the parameter is sampled by, same shape."""
        x = self.value_at(coordinate)
        stretch = np.zeros(x.shape)
        if self.log_scale:
            stretch = coordinate
        elif self.logit_scale:
            stretch = log_expit(coordinate) + log_expit(-coordinate)
        return np.asarray(self.log_prior(x) + stretch)

    def mass_below(self, x: float) -> float:
        """Prior probability of values below `x`, within the domain."""
        assert self.prior is not None
        low, high, at = (float(self.prior.frozen.cdf(end)) for end in (*self.domain, x))
        return float(np.clip((at - low) / (high - low), 0.0, 1.0))

    def draw(self, size: int, rng: np.random.Generator) -> Vector:
        """Draws from the prior within the domain, or copies of the fixed value."""
        if self.prior is None:
            return np.full(size, self.value)
        low, high = (float(self.prior.frozen.cdf(end)) for end in self._ends)
        if high - low < _REJECTION:
            return np.asarray(self.prior.frozen.ppf(rng.uniform(low, high, size)), dtype=float)
        out = np.empty(0)
        while out.size < size:
            drawn = self.prior.draw(2 * size, rng)
            out = np.concatenate([out, drawn[self.declared.contains(drawn)]])
        return out[:size]

    @property
    def problems(self) -> list[str]:
        """What is wrong with the prior or the fixed value for this kind of parameter."""
        zero, where = self.declared.zero, self.declared.interval
        where += "" if self.unit == "-" else f" {self.unit}"
        if self.kind == "choice":
            if self.prior is None and self.value in (0.0, 1.0):
                return []
            return [f"[priors] {self.name}: a choice is fixed at 0 (no) or 1 (yes)"]
        if self.prior is None:
            fits = bool(self.declared.contains(np.array(self.value))) or (zero and self.value == 0)
            return [] if fits else [f"[priors] {self.name} = {self.value:g}: must lie in {where}"]
        if self._mass >= _LEAST_MASS:
            return []
        return [
            f"[priors] {self.name}: {self.prior} has no mass in {where}, where this parameter must lie; "
            "shift or widen it"
        ]

    @property
    def _ends(self) -> tuple[float, float]:
        """Ends of the domain of the kind."""
        return self.declared.low, self.declared.high

    @cached_property
    def _mass(self) -> float:
        """Prior mass inside the domain of the kind."""
        assert self.prior is not None
        low, high = self._ends
        return float(self.prior.frozen.cdf(high) - self.prior.frozen.cdf(low))

    @cached_property
    def _log_mass(self) -> float:
        """Logarithm of the mass; exactly 0 when the support lies within the domain of the kind."""
        assert self.prior is not None
        low, high = self._ends
        within = self.prior.support[0] >= low and self.prior.support[1] <= high
        return 0.0 if within else log(self._mass)
