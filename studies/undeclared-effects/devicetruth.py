"""What a simulated device has of the numbers that a loop gives: figures of its step responses, and the sizes
of its effects in the scales that the loop measures them in."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from lcopa_bayes.bench.hiddeneffects import Hidden
from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.bench.undeclared import LARGEST, Campaign
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.loop import Loop, Side
from lcopa_bayes.effectsearch.openeffects import Weighed, mixture
from lcopa_bayes.model.path import TransferPath

_FINE = 4001
"""Points at which a step response is looked at for where it crosses a level first."""
UNSCORED = {
    "trigger_jitter": "a number for every record, drawn by chance",
    "pointing_offset": "a number for every record, drawn by chance",
    "pointing_drift": "a number for every record, drawn by chance",
    "vibration": "a phase for every record: the amplitude is no coefficient",
    "flicker": "a phase for every record: the amplitude is no coefficient",
    "outliers": "a share of samples that are far off has no number of degrees of freedom",
    "grey_quantisation": "all of it is the end of its support; the number of levels is not estimated",
    "refresh_hold": "all of it is the end of its support; refresh and phase jump with the commands",
}
"""Effects whose size has no counterpart, and why."""
Sizes = Callable[[Mapping[str, float], Vector], dict[str, float]]
"""From what the bench calls its numbers and the deflections that effects are measured in over those of the
bench, one per axis, to coefficients and constants."""


def _scaled(**powers: float) -> Sizes:
    """The numbers of these names, each times a power of the mean ratio of deflections."""
    return lambda own, ratio: {
        key: own[key] * float(np.exp(power * np.log(ratio).mean())) for key, power in powers.items()
    }


def _level_dependent(own: Mapping[str, float], ratio: Vector) -> dict[str, float]:
    """``1 + e (1 - 2 |y| / D)`` is as much viscosity as ``1 + e' (1 - 2 |y| / (ratio D))`` of another."""
    share = float(ratio.mean()) * own["e"]
    return {"e": share / (1 + own["e"] - share)}


_EPOCHS = 10 / 11
"""Epochs of eleven records run from -1/2 to 1/2 in the loop, from the middle of the first eleventh to that of
the last on the bench [-]."""

SIZES: dict[str, Sizes] = {
    "voltage_knee": _scaled(k=0),
    "hysteresis": _scaled(h=0, width=0),
    "overdrive_pulse": _scaled(k=0, frame=0),
    "field_dependent_delay": _scaled(e=0),
    "clock_skew": _scaled(e=0),
    "cubic_stiffness": _scaled(c=2),
    "rise_fall_asymmetry": _scaled(e=0),
    "level_dependent_speed": _level_dependent,
    "overflow": _scaled(s=1, k=0, level=-1),
    "viscosity_drift": lambda own, _: {"d": own["d"] * _EPOCHS},
    "ion_creep": _scaled(k=0, time=0),
    "backflow": _scaled(k=0, time=0),
    "extra_mode": _scaled(k=0, frequency=0, damping=0),
    "missing_cross_path": lambda own, ratio: {
        "k_x_2": own["k_xy"] / ratio[0],
        "k_y_1": own["k_yx"] / ratio[1],
        "time": own["time"],
    },
    "odd_curvature": _scaled(c=2),
    "even_curvature": _scaled(c=1),
    "bilinear_crosstalk": _scaled(c=1),
    "axis_rotation": _scaled(phi=0),
    "clipping": _scaled(level=-1),
    "centroid_locking": _scaled(a=-1, cycles=1),
    "cross_fade": _scaled(strength=0),
    "sensor_lag": _scaled(Ts=0),
    "exposure": _scaled(Te=0),
    "gain_drift": lambda own, _: {"d": own["d"] * _EPOCHS},
}


def place(values: Vector, truth: float) -> float:
    """Where a truth lies among equally probable values, negative above their median [normal sd]; of several
    equal to it, at the one nearest to the median, so that an interval that ends there holds it."""
    below = np.clip(0.5 * values.size, np.sum(values < truth), np.sum(values <= truth))
    return -float(norm.ppf((below + 0.5) / (values.size + 1)))


def ratios(found: Loop, made: Campaign) -> Vector:
    """Deflections that effects of a loop are measured in over those of the bench, by axis [-]."""
    own = np.array([abs(row[i].steady) for i, row in enumerate(made.device.paths)]) * LARGEST
    return np.asarray(found.after.state.model.effected.ranges.response / own)


def size_deviations(found: Loop, made: Campaign) -> dict[str, float]:
    """Places of the sizes of hidden effects that were named, by coefficient or constant [normal sd]."""
    names = found.after.state.model.names
    truth = {
        f"{one.name}.{key}": value
        for one in made.hidden
        if one.name in SIZES
        for key, value in SIZES[one.name](one.numbers, ratios(found, made)).items()
    }
    found_there = {name: found.number(names.index(name)).values for name in truth if name in names}
    return {name: place(values, truth[name]) for name, values in found_there.items()}


def step_truth(
    rises: Callable[[Vector], Vector], steady: float, delay: float, span: float
) -> dict[str, float]:
    """Figures of a response ``steady rises(time - delay)`` to a unit step; the rise is infinite where it is
    not within `span`."""
    time = (span - delay) * np.linspace(0.0, 1.0, _FINE)
    curve = rises(time)

    def first(level: float) -> float:
        k = int(np.argmax(curve >= level))  # of a response that rings, the first crossing
        if not k:
            return np.inf
        return float(brentq(lambda t: rises(np.array([t]))[0] - level, time[k - 1], time[k]))

    most = first(0.9)
    rise = most - first(0.1) if np.isfinite(most) else np.inf
    return {"value_at_end": steady * float(curve[-1]), "rise_10_90": rise}


def step_deviations(
    figures: tuple[Weighed, ...], found: Loop, made: Campaign, *, alone: bool = False
) -> dict[str, float]:
    """Places of the figures of the device without its effects."""
    axes = made.device.response_axes, made.device.drive_axes
    span = found.problem.scales.span
    told = [[as_told(path, found, made) for path in row] for row in made.device.paths]
    truth = {
        f"{key}[{response.name}_{drive.name}]": value
        for response, row in zip(axes[0], told, strict=True)
        for drive, path in zip(axes[1], row, strict=True)
        for key, value in step_truth(partial(risen, path), path.steady, path.delay, span).items()
    }
    return places(figures, truth, alone=alone)


def risen(path: TransferPath, time: Vector) -> Vector:
    """Response to a unit step, without the delay and over the steady one."""
    return np.asarray(path.stiffness * unit_step(path, time))


def places(
    figures: tuple[Weighed, ...], truth: Mapping[str, float], *, alone: bool = False
) -> dict[str, float]:
    """Where true figures lie among those of a loop [normal sd]; `alone`, among the values of the final
    model."""
    return {
        one.name: place(one.parts[0] if alone else one.values, truth[one.name])
        for one in figures
        if one.name in truth
    }


def side_figures(found: Loop, side: Side) -> tuple[Weighed, ...]:
    """Figures of one side alone."""
    return found.figures_of(side.state, *mixture(side.state, None, ()))


def as_told(path: TransferPath, found: Loop, made: Campaign) -> TransferPath:
    """A path with the viscosity that is left when the part that depends on the level is named in the scales
    of the loop."""
    named = {one.name: one for one in made.hidden if one.name in found.names}
    slowed: Hidden | None = named.get("level_dependent_speed")
    if slowed is None:
        return path
    factor = 1 + slowed.numbers["e"] * (1 - float(ratios(found, made).mean()))
    return replace(path, etas=tuple(factor * eta for eta in path.etas))
