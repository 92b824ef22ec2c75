"""What a simulated device has of the numbers that a loop gives: figures of its step responses, and the sizes
of its effects in the scales that the loop measures them in."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.optimize import brentq
from scipy.stats import norm

from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.bench.hiddeneffects import Hidden, HiddenDevice
from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.bench.undeclared import LARGEST, Campaign, shot_of
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.effectsearch.findings import Side
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.openeffects import Weighed, mixture
from lcopa_bayes.model.path import TransferPath

_FINE = 4001
"""Points at which a step response is looked at for where it crosses a level first."""
_LATE = 1e4
"""When what an effect adds has ended [longest record]."""
LINEAR = ("overdrive_pulse", "ion_creep", "extra_mode", "missing_cross_path", "sensor_lag", "exposure")
"""Effects that are linear and do not change with time: where they are not named they are part of the response
that was measured, which no record of it can tell apart."""
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
    """Places of the figures of the device."""
    axes = made.device.response_axes, made.device.drive_axes
    span, steady = found.problem.scales.span, steady_truth(found, made)
    hidden, told = unnamed(found, made), told_device(found, made)
    truth = {}
    for j, drive in enumerate(axes[1]):
        time = np.linspace(0.0, span, _FINE)
        seen = unit_responses(told, hidden, j, time) if hidden else None
        for i, response in enumerate(axes[0]):
            path = told.paths[i][j]
            rises = partial(risen, path)
            if seen is not None:
                rises = partial(_between, time - path.delay, seen[:, i] / steady[i, j])
            own = step_truth(rises, steady[i, j], path.delay, span)
            truth |= {f"{key}[{response.name}_{drive.name}]": value for key, value in own.items()}
    return places(figures, truth, alone=alone)


def risen(path: TransferPath, time: Vector) -> Vector:
    """Response to a unit step, without the delay and over the steady one."""
    return np.asarray(path.stiffness * unit_step(path, time))


def _between(nodes: Vector, values: Vector, time: Vector) -> Vector:
    return np.asarray(np.interp(time, nodes, values))


def unnamed(found: Loop, made: Campaign) -> tuple[Hidden, ...]:
    """Hidden effects that are part of the response that was measured, since nothing tells them apart."""
    return tuple(one for one in made.hidden if one.name in LINEAR and one.name not in found.names)


def unit_responses(device: Device, hidden: tuple[Hidden, ...], drive: int, time: Vector) -> Matrix:
    """Responses to a unit step of one drive at time 0, (times, axes) [response unit / drive unit]."""
    shot = shot_of(device, 0.0, np.random.default_rng(0))
    command = step(np.eye(len(device.paths[0]))[drive])
    return HiddenDevice(device, hidden, shot).response(command, time) - np.array(device.offsets)


def steady_truth(found: Loop, made: Campaign) -> Matrix:
    """Gains of the device, (responses, drives), with what unnamed linear effects add in the end."""
    steady = np.array([[path.steady for path in row] for row in made.device.paths])
    hidden, late = unnamed(found, made), _LATE * found.problem.scales.span * np.array([1.0, 1.0 + 1e-6])
    if hidden:
        for j in range(steady.shape[1]):
            own, bare = (unit_responses(made.device, acting, j, late)[-1] for acting in (hidden, ()))
            steady[:, j] += own - bare
    return steady


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
    return found.figures_of(side.state, mixture(side.state, None, ()))


def told_device(found: Loop, made: Campaign) -> Device:
    """The device of such paths."""
    paths = tuple(tuple(as_told(path, found, made) for path in row) for row in made.device.paths)
    return replace(made.device, paths=paths)


def as_told(path: TransferPath, found: Loop, made: Campaign) -> TransferPath:
    """A path with the viscosity that is left when the part that depends on the level is named in the scales
    of the loop."""
    named = {one.name: one for one in made.hidden if one.name in found.names}
    slowed: Hidden | None = named.get("level_dependent_speed")
    if slowed is None:
        return path
    factor = 1 + slowed.numbers["e"] * (1 - float(ratios(found, made).mean()))
    return replace(path, etas=tuple(factor * eta for eta in path.etas))
