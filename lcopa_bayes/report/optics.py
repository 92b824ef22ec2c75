"""The page of `optics`: far fields (Figs. 3, 5), tilt against Eq. 24 (Figs. 10, 11), volts to angle."""

from __future__ import annotations

from collections.abc import Mapping
from math import log10
from pathlib import Path
from typing import Any

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.paper.staticoptics import OpticsPlan, static_optics
from lcopa_bayes.plot.optics import (
    chain_figure,
    director_figure,
    far_field_figure,
    planar_figure,
    tilt_figure,
)
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import drawing


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Far fields, director, tilt law and steering chain; all is solved again for the plan in the values.

    InputError when this plan cannot be used.
    """
    try:
        calculated = static_optics(OpticsPlan(**values["plan"]))
    except TypeError as error:
        raise InputError(f"{folder / 'optics.json'}: holds no plan ({error}); run `optics` again") from None
    return {
        "verdict": None,
        "calculated": calculated,
        "decibel": lambda intensity: 10 * log10(intensity),
        "far_field": [
            drawing(
                "farfield_1d",
                far_field_figure(calculated),
                "Far field steered to each target (Ta et al. 2026, Eq. 4, Fig. 3). Dashed: the target.",
            )
        ],
        "planar": [
            drawing(
                "farfield_2d",
                planar_figure(calculated),
                "Far field of the square array in direction cosines (Eq. 12, Fig. 5): along the normal and "
                "steered. Circle: the target; every other bright spot is a grating lobe.",
            )
        ],
        "director": [
            drawing(
                "director",
                director_figure(calculated),
                "Tilt across the cell at several voltages (Fig. 10).",
            ),
            drawing(
                "tilt_voltage",
                tilt_figure(calculated),
                "Spatial mean of the solved tilt against voltage, beside Eq. 24 as printed and with its "
                "upper branch counted from the knee (Fig. 11). No tilt exceeds pi/2.",
            ),
        ],
        "chain": [
            drawing(
                "steering_chain",
                chain_figure(calculated),
                "Tilt, phase step, angle and error of Eq. 26.",
            )
        ],
    }
