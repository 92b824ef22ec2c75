"""How narrow an interval must be for its parameter to be called identified."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.parameter import Parameter

FACTOR = 2.0
"""Upper over lower end of a gain, a time constant or a noise scale [-]: a controller that suits one end has
used up its customary gain margin, 6 dB, at the other, and a corner frequency is not known to an octave."""
ORDER = 0.5
"""Width of an order [-]: it turns the phase by 45 degrees, a customary phase margin, and does not tell a half
from a whole order."""
CORRELATION = 0.5
"""Width of a noise correlation [-]: half of all it may be."""
LEVEL = 0.5
"""Width of an offset over the range of the response [-]."""


@final
@dataclass(frozen=True)
class Tolerance:
    """Largest interval of an identified parameter."""

    width: float
    """Difference of its ends that is narrow enough, in the parameter's unit; 0 where their ratio counts."""
    ratio: float
    """Ratio of its ends that is narrow enough [-]; 1 where their difference counts."""
    unit: str

    @classmethod
    def of(cls, row: Parameter, scales: Scales) -> Tolerance:
        """Of a parameter of a plant or its noise; a delay may also be known to one sampling period only."""
        if row.kind == "order":
            return cls(ORDER, 1.0, row.unit)
        if row.kind == "rho":
            return cls(CORRELATION, 1.0, row.unit)
        if row.kind == "offset":
            return cls(LEVEL * float(scales.amplitude[row.place.first]), 1.0, row.unit)
        return cls(scales.period if row.kind == "delay" else 0.0, FACTOR, row.unit)

    def exceeded(self, lower: float, upper: float) -> str:
        """What is too wide about an interval, a clause; empty where it is narrow enough."""
        if upper - lower <= self.width:
            return ""
        if self.ratio == 1.0:
            unit = "" if self.unit == "-" else f" {self.unit}"
            return f"wider than {self.width:.3g}{unit}"
        if lower < 0 < upper:
            return "which leaves its sign open"
        smaller, larger = sorted((abs(lower), abs(upper)))
        if larger <= self.ratio * smaller:
            return ""
        if smaller == 0:
            return "which reaches to zero"
        return f"whose ends are a factor of {larger / smaller:.2g} apart"
