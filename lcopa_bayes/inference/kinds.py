"""Kinds of parameters: what all parameters of one kind have in common, declared once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import inf
from types import MappingProxyType
from typing import Literal, final

from lcopa_bayes.core.arrays import Flags, Vector


@final
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
