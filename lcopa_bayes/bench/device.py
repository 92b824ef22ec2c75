"""The device on the virtual bench: paths with delay from every drive to every response."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import inf, isfinite
from typing import Protocol, final

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.inversion import unit_ramp, unit_step, unsuited
from lcopa_bayes.bench.superposition import superposed
from lcopa_bayes.core.arrays import Matrix, frozen
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath

ACCURACY = 1e-9
"""Error of a response [-], of the steady deflection per unit drive and per unit jump."""


class Responsive(Protocol):
    """Anything that responds to a command: a device, or a device with a hidden effect."""

    @property
    def drive_axes(self) -> tuple[Axis, ...]: ...  # noqa: D102
    @property
    def response_axes(self) -> tuple[Axis, ...]: ...  # noqa: D102
    @property
    def time_unit(self) -> str: ...  # noqa: D102
    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix: ...  # noqa: D102


@final
@dataclass(frozen=True)
class Device:
    """Responses that are sums over paths from all drives, each about a resting offset.

    Raises InputError unless `paths` has one row per response axis and one column per drive axis, every path
    is physical with distinct orders, and there is one finite offset per response axis.
    """

    paths: tuple[tuple[TransferPath, ...], ...]
    """``paths[i][j]`` leads from drive j to response i."""
    drive_axes: tuple[Axis, ...]
    response_axes: tuple[Axis, ...]
    offsets: tuple[float, ...]
    """Response without any drive [response unit], one per response axis."""
    time_unit: str = "ms"
    """Unit of delays, of viscosities and of every time given to this device."""

    def __post_init__(self) -> None:
        rows, columns = len(self.response_axes), len(self.drive_axes)
        problems = []
        if not (rows and columns and [len(row) for row in self.paths] == [columns] * rows):
            problems.append(f"a device needs {rows} x {columns} paths, one per response and drive axis")
        problems += [problem for row in self.paths for path in row for problem in unsuited(path)]
        if len(self.offsets) != rows or not all(isfinite(offset) for offset in self.offsets):
            problems.append(f"one finite offset per response axis is needed; got {self.offsets}")
        if problems:
            raise InputError(problems)

    def response(self, command: Command, time: ArrayLike, *, exposure: float = 0.0) -> Matrix:
        """Responses to `command` at `time` [ms], (n, n_responses) [response unit].

        ``offset_i + sum_j steady_ij rest_j + sum_jc jump_jc step_ij(time - time_c)``: rest under the
        command's resting drive, then one step response per change. With an `exposure` > 0 [ms] each
        value is the mean over the exposure that ends at its time, taken exactly by the integral of the
        step response. Accuracy: `ACCURACY`, plus rounding 1e-13 time/exposure when there is an exposure.
        Raises InputError for a command with another number of axes or a negative exposure.
        """
        time = frozen(time, name="time")
        problems = []
        if command.rest.size != len(self.drive_axes):
            problems.append(
                f"the device has {len(self.drive_axes)} drive axes; the command {command.rest.size}"
            )
        if not 0 <= exposure < inf:
            problems.append(f"an exposure must be at least 0 and finite; got {exposure}")
        if problems:
            raise InputError(problems)
        out = np.tile(np.array(self.offsets), (time.size, 1))
        jumps = command.jumps
        for i, row in enumerate(self.paths):
            for j, path in enumerate(row):
                out[:, i] += path.steady * command.rest[j]
                moved = jumps[:, j] != 0
                if path.gain == 0 or not moved.any():
                    continue
                changes, sizes = command.times[moved] + path.delay, path.gain * jumps[moved, j]
                tolerance = ACCURACY / path.stiffness
                if exposure == 0:
                    curve = partial(unit_step, path)
                    out[:, i] += superposed(curve, time, changes, sizes, tolerance=tolerance)
                else:
                    curve = partial(unit_ramp, path)
                    end, start = (
                        superposed(curve, edge, changes, sizes, tolerance=tolerance * exposure)
                        for edge in (time, time - exposure)
                    )
                    out[:, i] += (end - start) / exposure
        return out


PAPER_DEVICE = Device(
    paths=PAPER.plant.paths,
    drive_axes=(Axis("x", "rad"), Axis("y", "rad")),
    response_axes=(Axis("x", "rad"), Axis("y", "rad")),
    offsets=(0.0, 0.0),
)
"""The identified 2 x 2 model of Ta et al. 2026, Eq. 65."""
