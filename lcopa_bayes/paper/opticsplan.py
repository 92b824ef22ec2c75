"""What the verb `optics` is asked to compute: array, cell, targets and voltages."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite, pi
from typing import final

from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.array import LinearArray, paper_array
from lcopa_bayes.optics.cell import Cell, Field, paper_cell


@final
@dataclass(frozen=True)
class OpticsPlan:
    """Array, cell and what to look at, by default the paper's; InputError, all problems at once, for what
    cannot be built."""

    elements: int = PAPER.optics.elements
    """Along an axis [-]."""
    pitch: float | None = None
    """Distance of elements [m]; None: as many wavelengths as the paper's."""
    wavelength: float = PAPER.optics.wavelength
    """[m]."""
    fill_factor: float = 1.0
    """Element width over pitch [-] of the second column of the lobe table."""
    targets_deg: tuple[float, ...] = PAPER.optics.targets_1d_deg
    """Steering angles [deg]."""
    voltages: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """Increasing [V]; up to the end of Eq. 24."""
    pretilt: float = 0.0
    """Tilt at both plates [rad]."""
    field: str = Field.UNIFORM.value
    """How the voltage spreads over the cell, by the values of `Field`."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "targets_deg", tuple(self.targets_deg))
        object.__setattr__(self, "voltages", tuple(sorted(set(self.voltages))))
        problems: list[str] = []
        known = [each.value for each in Field]
        if self.field not in known:
            problems.append(
                f"`field` must be one of {', '.join(known)}; got {self.field!r}{nearest(self.field, known)}"
            )
        try:
            LinearArray(self.elements, self._pitch, self.wavelength, self.fill_factor)
        except InputError as error:
            problems += error.problems
        else:
            if 2 * pi * self._pitch < self.wavelength:
                problems.append(
                    f"`pitch` must exceed wavelength / (2 pi) = {self.wavelength / 2 / pi:.3g} m, where "
                    f"Eq. 26 ends; got {self._pitch:.3g} m"
                )
        if not self.targets_deg or not all(isfinite(goal) and abs(goal) < 90 for goal in self.targets_deg):
            problems.append(
                f"`targets` must be angles between -90 and 90 degrees; got {list(self.targets_deg)}"
            )
        limit = PAPER.optics.largest_voltage
        if not self.voltages or not all(isfinite(v) and 0 <= v <= limit for v in self.voltages):
            problems.append(
                f"`voltages` must lie within the solved range, 0 to {limit:g} V; got {list(self.voltages)}: "
                "leave out the others"
            )
        try:
            paper_cell(pretilt=self.pretilt)
        except InputError as error:
            problems += error.problems
        if problems:
            raise InputError(problems)

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
