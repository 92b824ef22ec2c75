"""Exact derivatives of the predicted responses in every free plant parameter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.noise import Student
from lcopa_bayes.inference.posterior import Posterior


@final
@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Derivatives of the samples, made white by the noise model, at one set of values.

    Their products are the Fisher information, under Student noise too.
    """

    names: tuple[str, ...]
    matrix: Matrix
    """In the sampled coordinates of the plant parameters, (samples, parameters) [noise sd]."""
    values: Vector
    """Where they were taken, in each parameter's unit, (parameters,)."""
    logarithmic: tuple[bool, ...]
    """Whether a coordinate is a logarithm."""

    def relative(self) -> Matrix:
        """Derivatives in the logarithm of the size of every parameter, (samples, parameters)."""
        logs = np.array(self.logarithmic)
        return np.asarray(self.matrix * np.where(logs, 1.0, self.values))


def sensitivities(landscape: Landscape, values: Vector) -> Sensitivities:
    """At table values, whose noise parameters make the samples white (AR(1) included).

    Accuracy: that of the forward model's exact slopes, about 1e-10 of the largest.
    """
    least, rows = landscape.least, landscape.posterior.table.rows
    _, jacobian = least.residual(least.coordinates(values), values)
    white = jacobian[: landscape.posterior.size]
    if isinstance(landscape.posterior.noise, Student):
        white = white * np.sqrt(_information(landscape.posterior, values))[:, None]
    return Sensitivities(
        tuple(rows[k].name for k in least.columns),
        white,
        values[least.columns],
        tuple(rows[k].log_scale for k in least.columns),
    )


def _information(posterior: Posterior, values: Vector) -> Vector:
    """Information of every sample over that of a Gaussian of its scale, (samples,) [-]."""
    nu = [values[posterior.table.at("nu", axis)] for axis in range(len(posterior.table.layout.responses))]
    sizes = [axis.values.size for samples in posterior.samples for axis in samples.axes]
    return np.repeat(Student.information(np.tile(nu, len(posterior.samples))), sizes)
