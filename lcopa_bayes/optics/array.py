"""A linear array of phase elements and the law that steers it (Ta et al. 2026, Eq. 5)."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from lcopa_bayes.core.arrays import Array
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.rules import Ruled, whole
from lcopa_bayes.model.literature import PAPER, StatedOptics
from lcopa_bayes.optics.checks import LENGTH, SHARE, finite

_ROUNDING = 4 * float(np.finfo(float).eps)
"""A direction cosine beyond 1 by no more than this [-] is end-fire within rounding."""


@dataclass(frozen=True)
class LinearArray(Ruled):
    """Equally spaced elements in a row; InputError for an impossible array, all problems at once."""

    elements: Annotated[int, whole(2)]
    """N [-]; one alone steers nothing."""
    pitch: Annotated[float, LENGTH]
    """d, centre to centre [m]."""
    wavelength: Annotated[float, LENGTH]
    """lambda [m]."""
    fill_factor: Annotated[float, SHARE] = 0.0
    """Width of an element over the pitch [-]; 0 is a point, which radiates isotropically."""

    @property
    def period(self) -> float:
        """Distance between lobes in direction cosine, ``lambda / d`` [-]."""
        return self.wavelength / self.pitch

    def direction_cosine(self, step: ArrayLike) -> Array:
        """``u = sin th_s = lambda dphi / (2 pi d)`` for phase steps [rad] (Ta et al. 2026, Eq. 5).

        Returns: [-], shape of `step`. Raises InputError where ``|u| > 1``: no such wave propagates.
        """
        return _propagating(self.period * finite(step, name="step", unit="rad") / (2 * pi))

    def steering_angle(self, step: ArrayLike) -> Array:
        """Angle th_s [rad] of the main lobe for phase steps [rad] between neighbours, exact Eq. 5.

        Shape of `step`. Raises InputError for a phase step that steers beyond end-fire.
        """
        return np.asarray(np.arcsin(self.direction_cosine(step)))

    def phase_step(self, angle: ArrayLike) -> Array:
        """Phase step dphi [rad] that steers to `angle` [rad], ``2 pi d sin(th_s) / lambda`` (Eq. 5).

        Shape of `angle`. Not reduced modulo 2 pi. Raises InputError outside [-pi/2, pi/2].
        """
        theta = finite(angle, name="angle", lower=-pi / 2, upper=pi / 2, unit="rad")
        return np.asarray(2 * pi * np.sin(theta) / self.period)


def paper_array(optics: StatedOptics = PAPER.optics, *, fill_factor: float = 0.0) -> LinearArray:
    """Array of Section 2: 32 elements, d = 1.2 lambda, lambda = 1064 nm.

    `optics` holds the printed numbers; `fill_factor` [-], which the paper does not give, is free.
    """
    pitch = optics.pitch_in_wavelengths * optics.wavelength
    return LinearArray(optics.elements, pitch, optics.wavelength, fill_factor)


def _propagating(u: Array | np.float64) -> Array:
    """Direction cosines [-] as given, 1 where rounding alone exceeds it; InputError beyond."""
    out = np.asarray(u)
    beyond = np.abs(out) > 1 + _ROUNDING
    if beyond.any():
        raise InputError(
            f"the phase step steers to direction cosine {float(out[beyond].flat[0]):.6g}, beyond +-1: "
            "no such wave propagates; use a smaller phase step or a larger pitch."
        )
    return np.where(np.abs(out) > 1, np.sign(out), out)
