"""What the verb `optics` is asked to compute: array, cell, targets and voltages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import isfinite, pi
from typing import final

from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.array import LinearArray
from lcopa_bayes.optics.cell import Cell, Field, paper_cell


@final
@dataclass(frozen=True)
class OpticsPlan:
    """Array, cell and what to look at; InputError for what cannot be built."""

    optics: StatedOptics = PAPER.optics
    fill_factor: float = 1.0
    """Element width over pitch [-] of the second column of the lobe table."""
    voltages: tuple[float, ...] = (1.0, 2.0, 3.0, 4.0, 5.0)
    """[V]; up to the end of Eq. 24."""
    pretilt: float = 0.0
    """Tilt at both plates [rad]."""
    field: Field = Field.UNIFORM

    @classmethod
    def of(
        cls,
        *,
        elements: int | None = None,
        pitch: float | None = None,
        wavelength: float | None = None,
        fill_factor: float = 1.0,
        targets_deg: Sequence[float] | None = None,
        voltages: Sequence[float] = (1.0, 2.0, 3.0, 4.0, 5.0),
        pretilt: float = 0.0,
        field: str = Field.UNIFORM.value,
        stated: StatedOptics = PAPER.optics,
    ) -> OpticsPlan:
        """The paper's optics with other numbers where given: pitch and wavelength [m], targets [deg].

        Without a pitch it is as many wavelengths as the paper's. InputError with all problems.
        """
        problems: list[str] = []
        length = stated.wavelength if wavelength is None else wavelength
        distance = stated.pitch_in_wavelengths * length if pitch is None else pitch
        count = stated.elements if elements is None else elements
        goals = tuple(stated.targets_1d_deg if targets_deg is None else targets_deg)
        volts = tuple(sorted(set(voltages)))
        known = [each.value for each in Field]
        if field not in known:
            problems.append(
                f"`field` must be one of {', '.join(known)}; got {field!r}{nearest(field, known)}"
            )
        try:
            LinearArray(count, distance, length, fill_factor)
        except InputError as error:
            problems += error.problems
        else:
            if 2 * pi * distance < length:
                problems.append(
                    f"`pitch` must exceed wavelength / (2 pi) = {length / 2 / pi:.3g} m, where Eq. 26 ends; "
                    f"got {distance:.3g} m"
                )
        if not goals or not all(isfinite(goal) and abs(goal) < 90 for goal in goals):
            problems.append(f"`targets` must be angles between -90 and 90 degrees; got {list(goals)}")
        if not volts or not all(isfinite(v) and 0 <= v <= stated.largest_voltage for v in volts):
            problems.append(
                f"`voltages` must lie within the solved range, 0 to {stated.largest_voltage:g} V; got "
                f"{list(volts)}: leave out the others"
            )
        try:
            paper_cell(stated, pretilt=pretilt)
        except InputError as error:
            problems += error.problems
        if problems:
            raise InputError(problems)
        optics = replace(
            stated,
            elements=count,
            wavelength=length,
            pitch_in_wavelengths=distance / length,
            targets_1d_deg=goals,
        )
        return cls(optics, fill_factor, volts, pretilt, Field(field))

    @property
    def array(self) -> LinearArray:
        """Elements of the plan, isotropic."""
        pitch = self.optics.pitch_in_wavelengths * self.optics.wavelength
        return LinearArray(self.optics.elements, pitch, self.optics.wavelength)

    @property
    def cell(self) -> Cell:
        """Liquid crystal of the plan."""
        return paper_cell(self.optics, pretilt=self.pretilt)
