"""The identified model as printed (Ta et al. 2026, Eq. 65) on the virtual bench, and its integer rival."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from lcopa_bayes.bench.acquisition import Bench, truth
from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.equation import output_rmse
from lcopa_bayes.paper.identify import integer_orders
from lcopa_bayes.paper.intervals import Interval, Scan
from lcopa_bayes.paper.outputerror import output_error_fit
from lcopa_bayes.paper.paths import path_data
from lcopa_bayes.paper.scan import scan
from lcopa_bayes.results.steps import settling

RECORD_LENGTH = 25.0
"""Length of the paper's records [ms]: the axes of Figs. 13 to 17 end between 20 and 25 ms."""
SETTLING_BANDS = (0.02, 0.05)
"""Bands about the steady value in customary use [-]; Table 1 does not state which."""
_LONG = 40.0
"""Record lengths over which a settling time is looked for [-]."""
_POINTS = 40001


@dataclass(frozen=True)
class PrintedModel:
    """The 2 x 2 model of Eq. 65 with the numbers of `stated`."""

    stated: Stated = PAPER

    @cached_property
    def device(self) -> Device:
        """The model on the virtual bench, resting at zero."""
        axes = (Axis("x", "rad"), Axis("y", "rad"))
        return Device(self.stated.plant.paths, axes, axes, (0.0, 0.0))

    def steady(self, drive_x: float, drive_y: float) -> tuple[float, float]:
        """Responses at rest under phases [rad] held for ever, ``sum_j b_ij / k_ij u_j`` [rad]."""
        x, y = self.device.paths
        return (
            x[0].steady * drive_x + x[1].steady * drive_y,
            y[0].steady * drive_x + y[1].steady * drive_y,
        )

    def at_end(self, drive_x: float, drive_y: float) -> tuple[float, float]:
        """Responses `RECORD_LENGTH` after a step of both phases [rad], from rest [rad]."""
        response = self.device.response(step([drive_x, drive_y]), [RECORD_LENGTH])[0]
        return float(response[0]), float(response[1])

    @cached_property
    def times(self) -> Vector:
        """Times after the step [ms], 0 first, the end of the record among them."""
        return np.linspace(0.0, _LONG * RECORD_LENGTH, _POINTS)

    @cached_property
    def step_on(self) -> Vector:
        """Response of x at `times` to the step of Fig. 13 [rad]."""
        return np.asarray(self.stated.records.step_drive * step_response(self.device.paths[0][0], self.times))

    def settled(self, level: float, band: float, *, within: float) -> float:
        """Time from which the step of Fig. 13 stays within `band` [-] of `level` [rad], up to `within` [ms].

        Counted from the step [ms]; infinite if it is outside at the end.
        """
        upto = (self.times > 0) & (self.times <= within)
        curve = self.step_on[upto][None] / level
        return float(settling(self.times[upto], curve, band)[0])

    @property
    def record(self) -> Record:
        """Noise-free record of the step of Fig. 13: one drive, one response, the paper's camera."""
        single = Device(
            ((self.device.paths[0][0],),), self.device.drive_axes[:1], self.device.response_axes[:1], (0.0,)
        )
        camera = Bench(camera=1 / self.stated.records.camera_rate)
        drive = step(self.stated.records.step_drive)
        return truth(single, camera, drive, duration=RECORD_LENGTH, name="printed model")


@dataclass(frozen=True)
class Rival:
    """The integer-order model that comes closest to the step response of Eq. 65."""

    model: TransferPath
    steady: float
    """Response at rest under the drive of Fig. 13 [rad]."""
    rmse: float
    """Root mean square distance to the noise-free response over the record [rad]."""


@lru_cache(maxsize=16)
def integer_rival(stated: Stated = PAPER) -> Rival:
    """Output-error fit of the element with integer orders (Section 5.2) to the noise-free record of Eq. 65.

    Orders 2, 1, 1 act as 2, 1; b, etas and a continuous delay are free.
    """
    record = PrintedModel(stated).record
    orders = integer_orders(len(stated.plant.xx.orders))
    settings = ModelSettings(terms=len(orders), orders=orders)
    study = Study("integer rival", None, "ms", 0, (record,), model=settings)
    data = path_data(study)[0]
    plan = Scan(orders=tuple(Interval(order, order) for order in orders), whole_blocks=False)
    start = scan([each.blocks for each in data.records], len(orders), data.span, plan).model
    model = output_error_fit(
        study, data, np.random.default_rng(0), terms=len(orders), orders=orders, start=start, starts=4
    )
    return Rival(model, model.steady * stated.records.step_drive, output_rmse(data.records, model))
