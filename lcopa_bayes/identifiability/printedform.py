"""The printed parametrisation of a path, and its sensitivities from those of the normalised
parametrisation."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.identifiability.curvature import Sensitivities
from lcopa_bayes.identifiability.symmetries import Structure, structure
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.optics.array import paper_array
from lcopa_bayes.optics.steering import linearised_angle

SPRINGS = 4
"""Springs of the element, of which Eq. 16 adds up the stiffnesses."""


class PrintedForm(NamedTuple):
    """Values of a path as Eqs. 16, 21 and 28 write them."""

    names: tuple[str, ...]
    values: Vector
    slopes: Matrix
    """Derivatives of its normalised parameters in the logarithms of these, (normalised, printed)."""


def printed_form(
    gain: float, times: Vector, orders: Vector, delay: float, rng: np.random.Generator
) -> PrintedForm:
    """One of the many printed forms of ``gain exp(-delay s) / (1 + sum_i (T_i s)^order_i)``.

    ``gain = b / k``, ``T_i = (eta_i / k)^(1 / order_i)``, ``k = k1 + ... + k4`` and
    ``b = asin(lambda / (2 pi d)) j q / (0.4019 x)`` (Ta et al. 2026, Eqs. 16, 21, 28); the springs are
    drawn with `rng`, the rest follows. Rows of `slopes`: gain, log T_i, order_i, delay; units as given.
    """
    optics = PAPER.optics
    springs = rng.uniform(0.5, 2.0, SPRINGS)
    k = float(springs.sum())
    path = TransferPath.of_times(gain, delay, times.tolist(), orders.tolist())
    path = path.normalised(Normalisation.STIFFNESS, k)
    lever = float(linearised_angle(paper_array(optics), 1.0)) / optics.tilt_slope_low
    j = path.gain / lever * optics.element_width / optics.charge
    terms = times.size
    names = (
        *("j", "q", "x"),
        *(f"eta{i + 1}" for i in range(terms)),
        *(f"order_{i + 1}" for i in range(terms)),
        "delay",
        *(f"k{i + 1}" for i in range(SPRINGS)),
    )
    values = np.concatenate([[j, optics.charge, optics.element_width], path.etas, orders, [delay], springs])
    slopes = np.zeros((2 * terms + 2, len(names)))
    slopes[0, :3] = gain * np.array([1.0, 1.0, -1.0])
    slopes[0, -SPRINGS:] = -gain * springs / k
    for i in range(terms):
        slopes[1 + i, 3 + i] = 1 / orders[i]
        slopes[1 + i, 3 + terms + i] = -np.log(times[i])
        slopes[1 + i, -SPRINGS:] = -springs / k / orders[i]
        slopes[1 + terms + i, 3 + terms + i] = orders[i]
    slopes[1 + 2 * terms, 3 + 2 * terms] = delay
    return PrintedForm(names, values, slopes)


def printed_structure(points: list[Sensitivities], rng: np.random.Generator) -> Structure | None:
    """Symmetries of the printed form of the first path of a plant; None where it has parameters fixed.

    `points` are sensitivities of the normalised form at several values.
    """
    names: tuple[str, ...] = ()
    values, slopes = [], []
    for point in points:
        kinds = ("gain", "time", "order", "delay")
        where = {kind: [p for p, n in enumerate(point.names) if n.split("_")[0] == kind] for kind in kinds}
        terms = len(where["time"])
        single = len(where["gain"]) == len(where["delay"]) == 1 and len(where["order"]) == terms
        if not single or not terms:
            return None
        gain, delay = where["gain"][0], where["delay"][0]
        form = printed_form(
            float(point.values[gain]),
            point.values[where["time"]],
            point.values[where["order"]],
            float(point.values[delay]),
            rng,
        )
        columns = [gain, *where["time"], *where["order"], delay]
        natural = point.matrix[:, columns].copy()
        logs = np.array(point.logarithmic)[columns]
        for c, log in enumerate(logs):
            is_time = 1 <= c <= terms
            if is_time and not log:
                natural[:, c] *= point.values[columns[c]]
            elif not is_time and log:
                natural[:, c] /= point.values[columns[c]]
        names = form.names
        values.append(form.values)
        slopes.append(natural @ form.slopes)
    return structure(names, slopes, values)
