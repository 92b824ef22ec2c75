"""What the verb `optics` is asked to compute: array, cell, targets and voltages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import pi
from typing import Annotated

from lcopa_bayes.core.rules import Rule, Ruled, is_number, whole, word_of
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.array import LinearArray, paper_array
from lcopa_bayes.optics.cell import Cell, Field, paper_cell
from lcopa_bayes.optics.checks import LENGTH, PRETILT, SHARE

_LIMIT = PAPER.optics.largest_voltage
_ANGLES = Rule(
    "angles between -90 and 90 degrees",
    lambda value: value and all(is_number(goal) and abs(goal) < 90 for goal in value),
)
_VOLTS = Rule(
    f"within the solved range, 0 to {_LIMIT:g} V: leave out the others",
    lambda value: value and all(is_number(volt) and 0 <= volt <= _LIMIT for volt in value),
)


@dataclass(frozen=True)
class OpticsPlan(Ruled):
    """Array, cell and what to look at, by default the paper's; InputError, all problems at once, for what
    cannot be built."""

    elements: Annotated[int, whole(2)] = PAPER.optics.elements
    """Along an axis [-]."""
    pitch: Annotated[float | None, LENGTH] = None
    """Distance of elements [m]; None: as many wavelengths as the paper's."""
    wavelength: Annotated[float, LENGTH] = PAPER.optics.wavelength
    """[m]."""
    fill_factor: Annotated[float, SHARE] = 1.0
    """Element width over pitch [-] of the second column of the lobe table."""
    targets_deg: Annotated[tuple[float, ...], _ANGLES] = PAPER.optics.targets_1d_deg
    """Steering angles [deg]."""
    voltages: Annotated[tuple[float, ...], _VOLTS] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """Increasing [V]; up to the end of Eq. 24."""
    pretilt: Annotated[float, PRETILT] = 0.0
    """Tilt at both plates [rad]."""
    field: Annotated[str, word_of(*(each.value for each in Field))] = Field.UNIFORM.value
    """How the voltage spreads over the cell, by the values of `Field`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets_deg", tuple(self.targets_deg))
        object.__setattr__(self, "voltages", tuple(sorted(set(self.voltages))))
        super().__post_init__()

    def contradictions(self) -> list[str]:
        """A pitch at which Eq. 26 is not real."""
        if 2 * pi * self._pitch >= self.wavelength:
            return []
        least = f"wavelength / (2 pi) = {self.wavelength / 2 / pi:.3g} m"
        return [f"`pitch` must exceed {least}, where Eq. 26 ends; got {self._pitch:.3g} m"]

    @property
    def _pitch(self) -> float:
        return PAPER.optics.pitch_in_wavelengths * self.wavelength if self.pitch is None else self.pitch

    @property
    def optics(self) -> StatedOptics:
        """The paper's optics with the array and targets of the plan."""
        return replace(
            PAPER.optics,
            elements=self.elements,
            wavelength=self.wavelength,
            pitch_in_wavelengths=self._pitch / self.wavelength,
            targets_1d_deg=self.targets_deg,
        )

    @property
    def array(self) -> LinearArray:
        """Elements of the plan, isotropic."""
        return paper_array(self.optics)

    @property
    def cell(self) -> Cell:
        """Liquid crystal of the plan."""
        return paper_cell(self.optics, pretilt=self.pretilt)
