"""One number of the model: its name, unit, place, prior and the scale it is sampled on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from math import inf, log
from typing import NamedTuple, final

import numpy as np
from scipy.special import expit, log_expit, logit

from lcopa_bayes.core.arrays import Array, Vector
from lcopa_bayes.inference.kinds import KINDS, Kind
from lcopa_bayes.inference.priors import Prior

_LEAST_MASS = 1e-9
"""A prior with less mass in its parameter's domain is a mistake [-]."""
_REJECTION = 0.1
"""Draws are rejected until inside the domain down to this mass [-], and found by inversion below it."""


@final
class Place(NamedTuple):
    """Where a parameter enters: (response, drive) for gains, (element, term) for times and orders,
    (slot, 0) for delays, (response, record or -1 for all) for offsets, (response, 0) for noise,
    (effect, position) for coefficients and for constants of effects."""

    first: int
    second: int


@final
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

    @cached_property
    def breadth(self) -> float:
        """A large difference on the sampled scale [natural log, or prior sd]; infinite for gains and for
        offsets, which the dynamics determine at any optimum."""
        if self.kind in ("gain", "offset"):
            return inf
        if self.prior is None or self.log_scale or self.logit_scale:
            return 1.0
        sd = self.prior.sd
        return sd if 0.0 < sd < inf else 1.0

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

    def quantiles(self, p: Array | Sequence[float]) -> Array:
        """Quantiles of the prior within the domain, its ends excluded: a prior may reach beyond it, such as
        a normal one of a scale."""
        assert self.prior is not None
        low, high = self._ends
        below = float(self.prior.frozen.cdf(low))
        x = self.prior.frozen.ppf(below + self._mass * np.asarray(p))
        return np.asarray(np.clip(x, np.nextafter(low, high), np.nextafter(high, low)), dtype=float)

    def draw(self, size: int, rng: np.random.Generator) -> Vector:
        """Draws from the prior within the domain, or copies of the fixed value."""
        if self.prior is None:
            return np.full(size, self.value)
        if self._mass < _REJECTION:
            return self.quantiles(rng.random(size))
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
