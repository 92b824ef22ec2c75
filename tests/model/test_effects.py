"""The effect library: effects vanish exactly, agree with closed forms, and their slopes are their slopes."""

from __future__ import annotations

import sys
from dataclasses import fields, replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.integrate import solve_ivp
from small import ONE, problem, record

from lcopa_bayes.bench.command import joint, on_off, prbs, staircase
from lcopa_bayes.bench.device import Device
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.packing import packed
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.effects import Effected, effected
from lcopa_bayes.model.effects import balance, sensor, simulator
from lcopa_bayes.model.effects.catalogue import bundled, catalogue
from lcopa_bayes.model.effects.commands import Hysteresis, RefreshHold, SampledDrive
from lcopa_bayes.model.effects.dynamics import (
    CubicStiffness,
    LevelDependentSpeed,
    Overflow,
    RiseFallAsymmetry,
)
from lcopa_bayes.model.effects.effect import UnstableError
from lcopa_bayes.model.effects.parallel import Backflow
from lcopa_bayes.model.effects.records import Vibration
from lcopa_bayes.model.effects.response import OddCurvature
from lcopa_bayes.model.effects.sensor import Exposure, SensorLag
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.results.prediction import responses

NAMES = [
    "rise_fall_asymmetry", "level_dependent_speed", "field_dependent_delay", "backflow", "cross_fade",
    "odd_curvature", "even_curvature", "voltage_knee", "cubic_stiffness", "overdrive_pulse",
    "refresh_hold", "grey_quantisation", "hysteresis", "ion_creep", "extra_mode", "missing_cross_path",
    "bilinear_crosstalk", "axis_rotation", "sensor_lag", "exposure", "clipping", "centroid_locking",
    "sampled_drive", "clock_skew", "viscosity_drift", "gain_drift", "pointing_offset", "pointing_drift",
    "trigger_jitter", "late_logging", "vibration", "flicker", "outliers", "overflow", "unmodelled_linear",
    "unmodelled_lag", "unmodelled_smooth", "unmodelled_nonlinear",
]  # fmt: skip
ALL = bundled()


def two_axes(unit: str = "rad") -> tuple[Effected, np.ndarray, list[np.ndarray]]:
    """Base model of two records, its values, and its responses by `prediction`; the second one in `unit`."""

    def path(gain: float, terms: tuple[tuple[float, float], ...]) -> TransferPath:
        return TransferPath(gain, 0.3873, tuple(t**a for t, a in terms), tuple(a for _, a in terms), 1.0)

    direct, cross = ((1.2, 1.7), (1.6, 0.7)), ((2.0, 0.9),)
    axes, read = (Axis("x", "rad"), Axis("y", "rad")), (Axis("x", "rad"), Axis("y", unit))
    paths = ((path(1.0, direct), path(0.2, cross)), (path(0.3, cross), path(1.5, direct)))
    device = Device(paths, axes, read, (0.1, 0.1))
    commands = (
        joint(on_off(1.0, hold=9.3, at=0.37), staircase([0.5, -0.4, 0.2], hold=6.1, start=1.03)),
        joint(on_off(-0.6, hold=7.2, at=1.38, rest=0.2), on_off(0.8, hold=5.0, at=2.64)),
    )
    made = [
        record(k, device=device, command=c, camera=0.1, duration=25.0, noise_sd=0.0, name=f"r{k}")
        for k, c in enumerate(commands)
    ]
    posterior = problem(*made, terms={"direct": 2, "cross": 1}, share="paper", offset="shared").posterior
    table = posterior.table
    reported = {
        "gain": lambda p: paths[p.first][p.second].gain,
        "time": lambda p: (direct, cross)[p.first][p.second][0],
        "order": lambda p: (direct, cross)[p.first][p.second][1],
        "delay": lambda p: 0.3873,
        "offset": lambda p: 0.1,
    }
    values = np.array([reported.get(row.kind, lambda p: 0.01)(row.place) for row in table.rows])
    plain = [one[:, 0].T + 0.1 for one in responses(table, posterior.model, values[None])]
    return effected(posterior, values), values, plain


BASE, VALUES, PLAIN = two_axes()


def middle(name: str) -> Effected:
    grid = ALL[name].grid(BASE.ranges)
    return BASE.with_effects([grid[len(grid) // 2]])


def scales(made: Effected) -> np.ndarray:
    return np.array([one.coefficient.scale for one in made.coefficients])


def apart(first: list[np.ndarray], second: list[np.ndarray]) -> float:
    return max(float(np.abs(a - b).max()) for a, b in zip(first, second, strict=True))


def test_every_effect_asked_for_is_there():
    assert set(NAMES) == set(ALL)


@pytest.mark.parametrize("name", NAMES)
def test_a_card_says_everything(name: str):
    kind = ALL[name]
    card, grid = kind.card, kind.grid(BASE.ranges)
    assert card.name == name
    assert all(getattr(card, field.name) for field in fields(card) if field.type == "str")
    assert grid
    assert len({str(one.constants) for one in grid}) == len(grid)
    for one in grid[0].coefficients(BASE.ranges):
        assert one.scale > 0
        assert one.unit in ("-", "time", "response")


@pytest.mark.parametrize("name", NAMES)
def test_vanishes(name: str):
    made = middle(name)
    assert apart(made.responses(VALUES, made.vanishing), PLAIN) < 1e-12
    # and nearly vanishes by its own path through the simulator, which at 0 is not taken
    assert apart(made.responses(VALUES, 1e-9 * scales(made)), PLAIN) < 3e-9


@pytest.mark.parametrize("first", ["refresh_hold", "sensor_lag", "rise_fall_asymmetry", "odd_curvature"])
@pytest.mark.parametrize("name", ["grey_quantisation", "level_dependent_speed", "sensor_lag", "vibration"])
def test_the_signature_of_a_further_effect_is_that_of_the_whole_simulated_anew(first: str, name: str):
    """What the first does alone is simulated once, for all that is tried beside it."""
    kept, tried = middle(first).effects[0], ALL[name].grid(BASE.ranges)[:2]
    for effect in tried if name != first else ():
        made = BASE.with_effects([kept, effect])
        size = len(made.coefficients) - 1
        psi = np.append(0.3 * scales(made)[:-size], np.zeros(size))
        own = made.signature(VALUES, psi, last=True)
        alone = replace(made, simulator=replace(made.simulator, still=simulator.Latest()))
        for found, whole in zip(own, alone.signature(VALUES, psi), strict=True):
            assert_allclose(found[..., -size:], whole[..., -size:], rtol=1e-9, atol=1e-7)
            assert not found[..., :-size].any()


@pytest.mark.parametrize("name", NAMES)
def test_signature_is_the_slope(name: str):
    """What is left after the signature falls at first order per unit or faster (kinks) and is small."""
    made = middle(name)
    here, signature = made.responses(VALUES, made.vanishing), made.signature(VALUES)
    assert [s.shape for s in signature] == [(*y.shape, made.vanishing.size) for y in here]
    left = []
    for part in (0.04, 0.02, 0.01):
        psi = part * scales(made)
        reported = [y + s @ psi for y, s in zip(here, signature, strict=True)]
        left.append(apart(made.responses(VALUES, psi), reported))
    size = max(float(np.abs(s @ scales(made)).max()) for s in signature)
    assert left[2] < 0.02 * 0.01 * size + 2e-3 * 0.01 + 1e-12
    assert left[2] < 0.75 * left[0] or left[0] < 1e-9


@pytest.mark.parametrize("name", [name for name in NAMES if ALL[name].linear])
def test_a_linear_effect_is_proportional_to_its_coefficients(name: str):
    """What one difference for a slope rests on."""
    made = middle(name)
    psi, here = scales(made), made.responses(VALUES, made.vanishing)
    once, twice = made.responses(VALUES, psi), made.responses(VALUES, 2 * psi)
    size = max(float(np.abs(b - a).max()) for a, b in zip(here, once, strict=True))
    left = [c - 2 * b + a for a, b, c in zip(here, once, twice, strict=True)]
    assert max(float(np.abs(one).max()) for one in left) < 1e-8 * max(size, 1e-3)


def test_axes_of_one_unit_share_their_scales():
    """Drives of 1 and 0.8 and a device twice as long the other way: a coefficient means the same on both."""
    ranges = BASE.ranges
    assert ranges.drive[0] == ranges.drive[1] == 1.0
    gains = [abs(VALUES[BASE.table.at("gain", k, k)]) for k in (0, 1)]
    assert ranges.response[1] / ranges.response[0] == pytest.approx(gains[1] / gains[0])
    assert ranges.period == pytest.approx(0.1, rel=1e-9)


def test_grey_levels_are_those_of_one_driver():
    """Both axes step by a sixteenth of the larger drive, at full strength."""
    made = BASE.with_effects([ALL["grey_quantisation"](16.0)])
    scene = made.simulator.scenes(made.plant(VALUES), np.array([1.0]))[0]
    for drive in scene.drives:
        assert np.allclose(16 * drive.values, np.round(16 * drive.values), atol=1e-9)


def test_half_way_between_grey_levels_rounding_errors_do_not_decide():
    """4.5, 4.5 + 1e-15, 13.5 and 7.5 of 15 levels go to the even one."""
    scene = BASE.simulator.scenes(BASE.plant(VALUES), np.zeros(0))[0]
    drive = AxisDrive(np.arange(4.0), np.array([0.3, 0.1 + 0.2, 0.9, 0.5]))
    grey, _ = ALL["grey_quantisation"](15.0).commands(drive, 0.0, 0, scene, np.ones(1))
    assert grey.values[[0, -2, -1]] * 15 == pytest.approx([4.0, 14.0, 8.0])
    assert grey.times.tolist() == [0.0, 2.0, 3.0]


@pytest.mark.parametrize("name", sorted(set(NAMES) - {"outliers", "grey_quantisation", "unmodelled_smooth"}))
def test_it_does_something(name: str):
    made = middle(name)
    assert apart(made.responses(VALUES, scales(made)), PLAIN) > 1e-4


@pytest.mark.parametrize(
    "name", ["odd_curvature", "overdrive_pulse", "cubic_stiffness", "sensor_lag", "ion_creep"]
)
def test_jacobian_with_an_effect(name: str):
    """Against central differences of the responses, away from psi = 0."""
    made = middle(name)
    psi = 0.5 * scales(made)
    exact = made.jacobian(VALUES, psi)
    for k, row in enumerate(made.table.rows):
        step = np.zeros(VALUES.size)
        step[k] = 3e-6
        up, down = made.responses(VALUES + step, psi), made.responses(VALUES - step, psi)
        slope = [(a - b) / 6e-6 for a, b in zip(up, down, strict=True)]
        size = max(float(np.abs(one).max()) for one in slope) + 1.0
        assert apart([j[..., k] for j in exact], slope) < 2e-3 * size, row.name


@pytest.mark.parametrize(
    ("names", "calls"),
    [
        (("cubic_stiffness",), 1),
        (("rise_fall_asymmetry", "overflow", "ion_creep"), 1),
        (("viscosity_drift", "sensor_lag", "odd_curvature"), 1),
        (("clock_skew", "cubic_stiffness", "pointing_offset"), 1),
        (("odd_curvature", "overdrive_pulse"), 0),
    ],
)
def test_all_slopes_at_once_are_those_one_after_the_other(names, calls, monkeypatch):
    """By one set of simulations where something acts before the reading."""
    made = BASE.with_effects(
        [ALL[name].grid(BASE.ranges)[len(ALL[name].grid(BASE.ranges)) // 2] for name in names]
    )
    psi, inner, asked = 0.3 * scales(made), simulator.Simulator.moved_together, []
    by_row, by_coefficient = made.jacobian(VALUES, psi), made.signature(VALUES, psi)
    monkeypatch.setattr(
        simulator.Simulator, "moved_together", lambda own, cases: asked.append(cases) or inner(own, cases)
    )
    at_once = made.slopes(VALUES, psi)
    assert sum(len(cases) > len(VALUES) // 2 for cases in asked) == calls
    assert len(asked) == 1
    assert apart(at_once[0], by_row) < 1e-6 * max(float(np.abs(one).max()) for one in by_row)
    assert apart(at_once[1], by_coefficient) < 1e-6 * max(float(np.abs(one).max()) for one in by_coefficient)


def test_jacobian_without_effects_is_exact():
    plain = BASE.jacobian(VALUES)
    for k in range(len(BASE.table.rows)):
        step = np.zeros(VALUES.size)
        step[k] = 1e-5
        up, down = (BASE.responses(VALUES + sign * step, BASE.vanishing) for sign in (1, -1))
        slope = [(a - b) / 2e-5 for a, b in zip(up, down, strict=True)]
        assert apart([j[..., k] for j in plain], slope) < 1e-5


# ------------------------------------------------------------ independent methods

LAG = Device(((TransferPath(2.0, 0.3, (1.5,), (1.0,), 1.0),),), ONE.drive_axes, ONE.response_axes, (0.0,))
LAG_VALUES = {"gain": 2.0, "time_1": 1.5, "order_1": 1.0, "delay": 0.3, "offset": 0.0, "sigma": 0.1}


def lag_plant(blocks: int | None = 2000) -> tuple[Effected, np.ndarray]:
    """A first-order plant, whose ordinary differential equation can be solved directly."""
    command = staircase([1.0, -0.7, 0.4, 0.0], hold=2.7, start=0.35)
    made = record(1, device=LAG, command=command, camera=0.1, duration=14.0, noise_sd=0.0)
    posterior = problem(made, blocks=blocks).posterior
    values = np.array([LAG_VALUES[name] for name in posterior.table.names])
    return effected(posterior, values), values


@pytest.mark.parametrize(
    ("effect", "psi", "law"),
    [
        (CubicStiffness(), [0.4], lambda f, y, m: f - y - 0.4 * y**3 / m**2),
        (CubicStiffness(), [40.0], lambda f, y, m: f - y - 40.0 * y**3 / m**2),
        (LevelDependentSpeed(), [0.5], lambda f, y, m: (f - y) / (1 + 0.5 * (1 - 2 * abs(y) / m))),
        (RiseFallAsymmetry(), [0.6], lambda f, y, m: (f - y) / (1 + 0.6 * (y * (f - y) < 0))),
        (RiseFallAsymmetry(), [3.0], lambda f, y, m: (f - y) / (1 + 3.0 * (y * (f - y) < 0))),
        (
            Overflow(0.5),
            [0.4, 3.0],
            lambda f, y, m: (
                f
                - np.sign(y) * (m * (np.sqrt(1 + 0.8 * abs(y) / m) - 1) / 0.4 + 3 * max(abs(y) - 0.5 * m, 0))
            ),
        ),
    ],
)
def test_forces_against_the_differential_equation(effect, psi, law):
    """``T dy/dt = law(K u(t - tau), y)`` by a Runge-Kutta method, segment by segment."""
    made, values = lag_plant()
    scale = float(made.ranges.response[0])
    reported = made.with_effects([effect]).responses(values, np.array(psi))[0][:, 0]
    times = made.simulator.times[0]
    levels, edges = [0.0, 1.0, -0.7, 0.4, 0.0], [-1.0, 0.65, 3.35, 6.05, 8.75, 15.0]
    exact, start = np.zeros(times.size), 0.0
    for level, a, b in zip(levels, edges[:-1], edges[1:], strict=True):
        inside = (times >= a) & (times < b)
        at = np.append(times[inside], b)
        found = solve_ivp(
            lambda t, y, f=2.0 * level: [law(f, y[0], scale) / 1.5],
            (a, b), [start], t_eval=at, rtol=1e-9, atol=1e-11, max_step=0.02,
        )  # fmt: skip
        exact[inside], start = found.y[0][:-1], found.y[0][-1]
    assert np.abs(reported - exact).max() < 2e-3 * np.abs(exact).max()


def test_strong_cubic_stiffness_converges_in_blocks():
    """Second order in the block width, also where whole-record sweeps do not converge."""
    reported = [
        made.with_effects([CubicStiffness()]).responses(values, np.array([40.0]))[0]
        for made, values in (lag_plant(blocks) for blocks in (250, 500, 1000, 4000))
    ]
    errors = [np.abs(one - reported[-1]).max() for one in reported[:-1]]
    assert errors[0] / errors[1] > 2.5
    assert errors[1] / errors[2] > 2.5


def test_a_runaway_is_reported_and_not_returned():
    made, values = lag_plant(None)
    with pytest.raises(UnstableError, match=r"cubic_stiffness.*runs away"):
        made.with_effects([CubicStiffness()]).responses(values, np.array([-3.0]))


def test_slopes_exist_wherever_the_response_is_bounded():
    """Beside the largest force that does not run away a coefficient and a gain are differenced to the other
    side, as here by hand."""
    plain, values = lag_plant(250)
    made, gain = plain.with_effects([CubicStiffness()]), plain.table.names.index("gain")
    runaway, bounded = -3.0, 0.0
    for _ in range(25):
        middle = 0.5 * (runaway + bounded)
        try:
            made.responses(values, np.array([middle]))
            bounded = middle
        except UnstableError:
            runaway = middle
    psi, step, back = np.array([bounded]), 1e-4, values.copy()
    with pytest.raises(UnstableError):
        made.responses(values, psi - step)
    here = made.responses(values, psi)[0]
    by_hand = (made.responses(values, psi + step)[0] - here) / step
    assert_allclose(made.signature(values, psi)[0][..., 0], by_hand, rtol=1e-6, atol=1e-9)
    step = 1e-5 * float(made.ranges.response[0] / made.ranges.drive[0])
    back[gain] -= step
    by_hand = (here - made.responses(back, psi)[0]) / step
    assert_allclose(made.jacobian(values, psi)[0][..., gain], by_hand, rtol=1e-6, atol=1e-9)
    by_row, by_coefficient = made.slopes(values, psi)
    assert_allclose(by_row[0], made.jacobian(values, psi)[0], rtol=1e-12)
    assert_allclose(by_coefficient[0], made.signature(values, psi)[0], rtol=1e-12)
    for slopes in (made.jacobian, made.signature, made.slopes):
        with pytest.raises(UnstableError):
            slopes(values, psi - 0.1)


def test_sensor_lag_is_one_more_lag():
    """A first-order plant behind a sensor of first order, in closed form."""
    command = on_off(1.0, hold=50.0, at=0.35)
    posterior = problem(record(1, device=LAG, command=command, camera=0.1, noise_sd=0.0)).posterior
    values = np.array([LAG_VALUES[name] for name in posterior.table.names])
    made = effected(posterior, values, [SensorLag()])
    for lag in (0.02, 0.1, 0.5, 3.0):
        t = np.maximum(made.simulator.times[0] - 0.65, 0.0)
        exact = 2.0 * (1 - (1.5 * np.exp(-t / 1.5) - lag * np.exp(-t / lag)) / (1.5 - lag))
        reported = made.responses(values, np.array([lag]))[0][:, 0]
        assert np.abs(reported - exact).max() < 0.012  # the kink at the onset falls within a block
        assert np.abs(reported - exact)[t > 1.0].max() < 1e-3


@pytest.mark.parametrize("exposure", [0.3, 1.0, 2.6, 17.25, -1.4])
def test_an_exposure_is_the_mean_over_itself(exposure: float):
    """Of cubics exactly, block by block; without a response before the first block, and as at the last one
    after it."""
    step, n = 0.5, 60
    scene = SimpleNamespace(grid=SimpleNamespace(step=step))
    at = step * np.arange(n)
    cubics = np.array([[1.0, 0.0, 0.0, 0.0], [0.2, -1.0, 0.5, 0.03]])
    read = Exposure().filtered(
        np.array([np.polyval(one[::-1], at) for one in cubics]), scene, [step * exposure]
    )
    reach = int(np.ceil(abs(exposure))) + 2
    inner = slice(reach, n - reach)
    for one, own in zip(cubics, read, strict=True):
        whole = np.polynomial.Polynomial(one).integ()
        assert_allclose(
            own[inner], ((whole(at) - whole(at - step * exposure)) / (step * exposure))[inner], rtol=1e-9
        )
    assert read[0, -1] == pytest.approx(1.0, abs=1e-12)
    early = np.clip((at / step + 0.5) / exposure, 0.0, 1.0) if exposure > 0 else 1.0
    assert_allclose(read[0], early, atol=0.6 / max(exposure, 1.0))


@pytest.mark.parametrize(
    ("name", "size"),
    [
        ("odd_curvature", 0.1),
        ("even_curvature", 0.1),
        ("clipping", 1.0),
        ("gain_drift", 0.1),
        ("sensor_lag", 0.3),
    ],
)
def test_responses_of_two_units_are_read_by_two_devices(name: str, size: float):
    model, values, plain = two_axes("degC")
    grid = ALL[name].grid(model.ranges)
    made = model.with_effects([grid[0]])
    alike = BASE.with_effects([grid[0]])
    own = [one.coefficient.name for one in made.coefficients]
    assert own == [f"{one.coefficient.name}_{axis}" for one in alike.coefficients for axis in ("x", "y")]
    first, second, both = (made.responses(values, size * np.array(psi)) for psi in ((1, 0), (0, 1), (1, 1)))
    assert all(
        max(np.abs(one[:, axis] - still[:, axis]).max() for one, still in zip(moved, plain, strict=True))
        > 1e-3
        for axis, moved in enumerate((first, second))
    )
    for k, still in enumerate(plain):
        for axis, (moved, rests) in enumerate(((first, second), (second, first))):
            assert np.array_equal(moved[k][:, axis], both[k][:, axis])
            assert_allclose(rests[k][:, axis], still[:, axis], atol=1e-12)
    if name in ("gain_drift", "sensor_lag"):  # the others are measured in deflections
        assert_allclose(alike.responses(VALUES, np.array([size]))[0], both[0], atol=1e-12)


@given(rate=st.floats(1e-3, 60.0))
@settings(deadline=None, max_examples=60)
def test_moments_of_the_lag(rate: float):
    x, w = np.polynomial.legendre.leggauss(200)
    s = (1 + x) / 2
    exact = [float(np.sum(w / 2 * rate * np.exp(-rate * (1 - s)) * s**k)) for k in range(4)]
    assert_allclose(sensor._moments(rate), exact, rtol=1e-10)


def test_balance_of_a_linear_force_is_a_geometric_series():
    """``y = k * (f - a y)`` has the solution of a triangular system."""
    n, a, rng = 300, 30.0, np.random.default_rng(3)
    kernel = np.exp(-np.arange(n) / 40.0)[None] / 40.0
    f = rng.normal(size=(1, n)).cumsum(axis=1)
    matrix = np.array([[kernel[0, i - j] if i >= j else 0.0 for j in range(n)] for i in range(n)])
    exact = np.linalg.solve(np.eye(n) + a * matrix, matrix @ f[0])
    found, lost = balance.marched(
        kernel, lambda blocks, y, one, two: f[:, blocks] - a * y, np.ones((1, 1)), 1
    )
    assert_allclose(found[0, 0], exact, atol=1e-9)
    assert not lost.any()


def test_plants_iterated_together_end_where_each_does_by_itself():
    """``y = c + s y`` ends at c / (1 - s) where |s| < 1; acceleration reaches it for s < -1 too, and what
    squares runs away."""
    c, slope = np.array([1.0, -2.0, 0.5]), np.array([0.9, -3.0, 0.0])

    def swept(plants, y):
        steep = np.where(plants[:, None, None] == 2, 10.0 + y**2, slope[plants][:, None, None] * y)
        return c[plants][:, None, None] + steep

    start, scale = np.zeros((3, 1, 2)), np.ones((3, 1, 1))
    found, solved = balance.iterated(swept, start, scale, 50)
    assert solved.tolist() == [True, True, False]
    assert_allclose(found[:2, 0, 0], c[:2] / (1 - slope[:2]), rtol=1e-11)
    for k in range(2):
        alone, _ = balance.iterated(lambda _, y, k=k: swept(np.array([k]), y), start[:1], scale[:1], 50)
        assert_allclose(alone[0], found[k], rtol=1e-11)


def test_backflow_kicks_only_after_falls():
    made = BASE.with_effects([Backflow(0.5, False)])
    kick = made.signature(VALUES)[0][:, 0, 0]
    times = BASE.simulator.times[0]
    assert np.all(kick[times < 0.37 + 9.3 + 0.43] == 0.0)
    peak = times[np.argmax(np.abs(kick))]
    assert abs(peak - (0.37 + 9.3 + 0.43 + 2 * 0.5)) < 0.11  # x^2 e^-x is largest at x = 2
    assert np.abs(kick).max() == pytest.approx(2 * np.exp(-2), rel=0.01)


def test_refresh_at_full_strength_is_on_the_grid():
    made = BASE.with_effects([RefreshHold(1.0, 0.25)])
    scenes = made.simulator.scenes(made.plant(VALUES), np.ones(1))
    for before, after in zip(BASE.simulator.model.experiments, scenes, strict=True):
        for old, new in zip(before.drives, after.drives, strict=True):
            assert_allclose((new.times - 0.25) % 1.0 % (1 - 1e-9), 0.0, atol=1e-8)
            assert ((new.times >= old.times - 1e-9) & (new.times < old.times + 1.0)).all()


def test_hysteresis_needs_a_reversal():
    """On a drive that goes one way the play only shifts levels; after a reversal it lags."""
    up = AxisDrive(np.arange(4.0), np.array([0.2, 0.4, 0.6, 0.4]))
    drive, _ = Hysteresis(0.1).commands(up, 0.0, 0, BASE.simulator.scene(0, BASE.plant(VALUES)), np.ones(1))
    assert_allclose(drive.values, [0.1, 0.3, 0.5])  # and the last step of 0.2 down is all play


@given(st.lists(st.tuples(st.integers(0, 5), st.floats(-2, 2)), max_size=8))
def test_sorted_jumps_keep_the_sum(reported):
    times, jumps = np.array([float(t) for t, _ in reported]), np.array([j for _, j in reported])
    drive = AxisDrive.of_jumps(times, jumps)
    assert (np.diff(drive.times) > 0).all()
    if jumps.any():
        assert drive.values[-1] == pytest.approx(jumps.sum(), abs=1e-12)


# ------------------------------------------------------------ interface


def test_coefficients_of_records_and_of_all():
    made = BASE.with_effects([OddCurvature(), Vibration(0.1)])
    assert [one.record for one in made.coefficients] == [None, *[0] * 4, *[1] * 4]
    assert made.coefficients[1].name == "vibration.a_x[r0]"
    psi = np.zeros(9)
    psi[0], psi[5] = 0.02, 1e-3
    assert apart(made.responses(VALUES, psi)[:1], made.responses(VALUES, np.r_[0.02, np.zeros(8)])[:1]) == 0.0
    alone = made.over(made.simulator.model, [], np.zeros(2))
    assert alone.offsets is None


def test_two_effects_do_not_only_add():
    both = BASE.with_effects([CubicStiffness(), OddCurvature()])
    psi = np.array([0.3, 0.1])
    parts = [both.responses(VALUES, psi * mask) for mask in ([1, 0], [0, 1])]
    summed = [a + b - c for a, b, c in zip(*parts, PLAIN, strict=True)]
    assert 1e-4 < apart(both.responses(VALUES, psi), summed) < 0.05


def test_campaign_speed_is_reported_by_the_grid():
    """A record pseudo-random for its whole length costs no more than its blocks: it is simulated at all."""
    rng = np.random.default_rng(2)
    made = record(3, device=LAG, command=prbs(-1.0, 1.0, hold=0.4, duration=12.0, rng=rng), noise_sd=0.0)
    posterior = problem(made).posterior
    values = np.array([LAG_VALUES[name] for name in posterior.table.names])
    reported = effected(posterior, values, [CubicStiffness()]).responses(values, np.array([5.0]))
    assert np.isfinite(reported[0]).all()


OWN = """
from dataclasses import dataclass
from typing import ClassVar
from lcopa_bayes.model.effects.effect import Card, ReadoutEffect, single

@dataclass(frozen=True)
class Doubled(ReadoutEffect):
    card: ClassVar[Card] = Card("doubled", "output", "y -> (1 + d) y", "here", "all", "gain")
    def coefficients(self, ranges):
        return single("d", 1.0)
    def seen(self, y, scene, psi):
        return (1 + psi[0]) * y

class Unfinished(ReadoutEffect):
    pass

class Taken(Doubled):
    card = Card("backflow", "output", "", "", "", "")
"""


def test_a_class_of_the_user(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    kind = catalogue(["own.py:Doubled"], tmp_path)["doubled"]
    made = BASE.with_effects([kind()])
    reported = made.responses(VALUES, np.ones(1))
    assert apart(reported, [2 * y - 0.1 for y in PLAIN]) < 1e-12


WRITTEN_AS_HERE = """
from __future__ import annotations
from dataclasses import dataclass
from typing import ClassVar
import numpy as np
from lcopa_bayes.model.effects.effect import Card, ReadoutEffect, single

@dataclass(frozen=True)
class Power(ReadoutEffect):
    power: float
    estimated = single("c", 0.1)
    card: ClassVar[Card] = Card("power", "output", "y -> y + c |y|^power", "here", "all", "gain")

    @classmethod
    def grid(cls, ranges):
        return (cls(3.0),)

    def seen(self, y, scene, psi):
        return y + psi[0] * np.abs(y) ** self.power
"""


@pytest.mark.parametrize("name", ["power", "numpy"])
def test_a_class_of_the_user_written_as_those_of_the_package(tmp_path, name):
    """With constants, and annotations as text; in a file of any name, also that of a module it needs."""
    (tmp_path / f"{name}.py").write_text(WRITTEN_AS_HERE)
    before = dict(sys.modules)
    kind = catalogue([f"{name}.py:Power"], tmp_path)["power"]
    assert kind.grid(None)[0].constants == {"power": 3.0}
    assert packed(kind(3.0)) is None  # a worker could not import its file
    assert sys.modules == before


def test_bad_classes_are_reported_together(tmp_path):
    (tmp_path / "own.py").write_text(OWN)
    (tmp_path / "broken.py").write_text("1 / 0")
    add = ["own.py:Unfinished", "own.py:Taken", "own.py:Dubbled", "none.py:A", "broken.py:A", "own.py"]
    with pytest.raises(InputError) as reported:
        catalogue(add, tmp_path)
    text = "\n".join(reported.value.problems)
    for part in (
        "must be a concrete",
        "backflow",
        "did you mean 'Doubled'",
        "not a file",
        "Zero",
        "expected file",
    ):
        assert part in text
    assert len(reported.value.problems) == len(add)


@pytest.mark.parametrize("name", ["trigger_jitter", "clock_skew"])
def test_changes_a_rounding_apart_may_be_shifted(name):
    """An overdrive of a frame of a whole number of samples leaves them; shifted they may fall together."""
    times = np.array([1.0, 1.0 + 2.3e-16, 2.0])
    drive = AxisDrive(times, np.array([1.0, 1.5, 0.5]))
    effect, scene = catalogue()[name](), SimpleNamespace(times=np.array([-8.0]))
    moved, rest = effect.commands(drive, 0.0, 0, scene, np.array([70.0]))
    assert rest == 0.0
    np.testing.assert_array_equal(moved.values, [1.5, 0.5])
    assert (np.diff(moved.times) > 0).all()


def fractional_plant(command) -> tuple[Problem, np.ndarray]:
    """A plant of order 1.7."""
    path = TransferPath(2.0, 0.3, (1.5**1.7,), (1.7,), 1.0)
    device = Device(((path,),), ONE.drive_axes, ONE.response_axes, (0.0,))
    made = problem(record(1, device=device, command=command, camera=0.1, noise_sd=0.0), terms=1)
    return made, np.array([(LAG_VALUES | {"order_1": 1.7})[name] for name in made.posterior.table.names])


@pytest.mark.parametrize(("effect", "psi"), [(CubicStiffness(), 0.5), (RiseFallAsymmetry(), 0.3)])
def test_where_a_delayed_change_falls_within_a_block_moves_nothing(effect, psi):
    """Against blocks eight times narrower the error is the same for every delay: a change of the drive that
    falls within a block would move it to and fro."""
    whole, values = fractional_plant(on_off(1.0, hold=9.0, at=0.35))
    at, errors = whole.posterior.table.at("delay", 0), []
    for part in (0.0, 0.25, 0.5, 0.75):
        moved = values.copy()
        moved[at] += 0.1 * part
        models = [effected(one.posterior, values, [effect]) for one in (whole, whole.refined(8))]
        coarse, fine = (model.responses(moved, np.array([psi]))[0][:, 0] for model in models)
        errors.append(np.linalg.norm(coarse - fine))
    assert np.ptp(errors) < 0.01 * max(errors)


def test_a_force_that_turns_within_a_block_is_met_there():
    """A switch is averaged over the block in which the response goes through 0, or turns: at the middle of
    blocks alone each would count as a whole block or none."""
    whole, values = fractional_plant(staircase([1.0, -1.0, 0.6], hold=4.0, start=0.35))
    made = [
        effected(whole.refined(k).posterior, values, [RiseFallAsymmetry()]).responses(values, np.array([0.5]))
        for k in (1, 2, 4, 32)
    ]
    errors = [apart(one, made[-1]) for one in made[:-1]]
    assert errors[1] < 0.15 * errors[0]
    assert errors[2] < 0.06 * errors[0]


def test_a_force_that_jumps_is_met_block_by_block():
    """Newton's method fails where a force all but jumps with the direction; the balance still holds."""
    n = 200
    kernel = np.repeat(np.exp(-np.arange(n) / 3.0)[None] / 4.0, 2, axis=0)
    f = np.array([2.0, -1.5])[:, None] * np.sin(np.arange(n) / 9.0)

    def force(blocks, y, one, two):
        return f[:, blocks] - y - 0.4 * np.tanh(1e5 * (y - one))

    found, lost = balance.marched(kernel, force, np.ones((2, 1)), 2)
    y = found[:, 0]
    before = np.concatenate((np.zeros((2, 2)), y), axis=1)
    v = force(slice(None), y, before[:, 1:-1], before[:, :-2])
    again = np.array([np.convolve(k, own)[:n] for k, own in zip(kernel, v, strict=True)])
    assert not lost.any()
    assert_allclose(again, y, atol=1e-5)


def test_stiff_plants_together_are_each_by_itself():
    """Where sweeps do not end for one of them none is swept."""
    whole, values = fractional_plant(staircase([1.0, -1.0, 0.6], hold=4.0, start=0.35))
    made = effected(whole.posterior, values, [Overflow(0.3)])
    names = np.array(whole.posterior.table.names)
    plants = [made.plant(values * np.where(names == "gain", s, 1)) for s in (1.0, 1.2)]
    for psi in (np.array([0.5, 40.0]), np.array([0.1, 0.1])):
        for plant, moved in zip(
            plants, made.simulator.moved_together([(one, psi) for one in plants]), strict=True
        ):
            alone = made.simulator.moved(plant, psi)[0].deflection
            assert_allclose(moved[0].deflection, alone, atol=1e-9 * np.abs(alone).max())


@pytest.mark.parametrize("blocks", [1, 1 << 18])
@pytest.mark.parametrize(
    ("names", "psis"),
    [
        (["sensor_lag"], [[0.3], [0.3], [0.5], [0.0]]),
        (["exposure"], [[0.2], [0.2], [0.4], [0.2]]),
        (["viscosity_drift"], [[0.3], [-0.2], [0.3], [0.0]]),
        (["viscosity_drift", "sensor_lag"], [[0.3, 0.2], [-0.2, 0.4], [0.0, 0.2], [0.3, 0.0]]),
        (["sensor_lag", "odd_curvature"], [[0.3, 0.1], [0.3, 0.1], [0.0, 0.1], [0.3, 0.0]]),
    ],
)
def test_plants_together_are_each_by_itself(names, psis, blocks, monkeypatch):
    """Before the sensor and on elements; plants differ in a time, a delay and gains, the scenes in these."""
    monkeypatch.setattr(simulator, "_TOGETHER", blocks)
    made = BASE.with_effects([ALL[name].grid(BASE.ranges)[0] for name in names])
    table = np.array(BASE.table.names)
    factors = [
        np.where(np.char.startswith(table, kind), 1.2, 1.0) for kind in ("none", "time", "delay", "gain")
    ]
    cases = [(made.plant(VALUES * factor), np.array(psi)) for factor, psi in zip(factors, psis, strict=True)]
    for case, moved in zip(cases, made.simulator.moved_together(cases), strict=True):
        for one, other in zip(moved, made.simulator.moved(*case), strict=True):
            assert_allclose(one.deflection, other.deflection, rtol=0, atol=1e-9)
            assert_allclose(one.scene.gains, case[0].gains)
            assert_allclose(one.scene.delays, other.scene.delays)


@pytest.mark.parametrize(
    ("names", "psis"),
    [
        (
            ["clock_skew", "cubic_stiffness"],
            [[0.01, 0.2], [-0.02, 0.2], [0.01, 0.3], [0.0, 0.2], [0.01, 0.0]],
        ),
        (["voltage_knee", "overflow"], [[0.1, 0.3, 2.0], [0.2, 0.3, 2.0], [0.0, 0.5, 0.0], [0.1, 0.0, 1.0]]),
    ],
)
def test_plants_under_commands_of_their_own_are_each_by_itself(names, psis):
    """Forces on many plants at once, also of one that they or the effect on commands leave alone."""
    made = BASE.with_effects([ALL[name].grid(BASE.ranges)[0] for name in names])
    table = np.array(BASE.table.names)
    kinds = ["none", "time", "delay", "gain", "order"]
    factors = [np.where(np.char.startswith(table, kind), 1.02, 1.0) for kind in kinds]
    cases = [(made.plant(VALUES * factor), np.array(psi)) for factor, psi in zip(factors, psis, strict=False)]
    for case, moved in zip(cases, made.simulator.moved_together(cases), strict=True):
        for one, other in zip(moved, made.simulator.moved(*case), strict=True):
            assert_allclose(one.deflection, other.deflection, rtol=0, atol=1e-9)
            for drive, own in zip(one.scene.drives, other.scene.drives, strict=True):
                np.testing.assert_array_equal(drive.times, own.times)


def test_a_plant_that_runs_backwards_among_others_is_reported():
    made = BASE.with_effects([ALL["viscosity_drift"].grid(BASE.ranges)[0]])
    plant = made.plant(VALUES)
    with pytest.raises(UnstableError, match="time constants would be multiplied by -"):
        made.simulator.moved_together([(plant, np.array([psi])) for psi in (0.1, 40.0, -40.0)])


def test_a_sampled_drive_is_a_delay_that_coefficients_move():
    """A drive that only lags, with a force: as commands, plant by plant, and as delays, all at once."""
    whole, values = fractional_plant(staircase([1.0, -1.0, 0.6], hold=4.0, start=0.35))
    kinds = [SampledDrive(), CubicStiffness()]
    made = effected(whole.posterior, values, kinds)
    psi = np.array([0.7, 0.4])
    plants = [
        made.plant(values * np.where(np.array(whole.posterior.table.names) == "gain", s, 1)) for s in (1, 1.2)
    ]
    together = made.simulator.moved_together([(plant, psi) for plant in plants])
    for plant, moved in zip(plants, together, strict=True):
        alone = made.simulator.moved(plant, psi)
        assert_allclose(
            moved[0].deflection, alone[0].deflection, atol=2e-5 * np.abs(alone[0].deflection).max()
        )


def test_a_drive_sampled_while_it_moved_acts_before_it_was_written():
    """The whole delay below 0 as changes that come earlier, on narrow blocks: the linear plant with the drive
    moved by hand, to the force's own share."""
    whole, values = fractional_plant(staircase([1.0, -1.0, 0.6], hold=4.0, start=0.35))
    values = np.where(np.array(whole.posterior.table.names) == "delay", 0.01, values)
    narrow = whole.refined(16).posterior
    made = effected(narrow, values, [SampledDrive(), CubicStiffness()])
    psi, tiny = np.array([0.7, 0.0]), np.array([0.7, 1e-9])
    plants = [made.plant(values) for _ in range(2)]
    for moved in made.simulator.moved_together([(plant, tiny) for plant in plants]):
        alone = made.simulator.moved(plants[0], psi)
        reach = np.abs(alone[0].deflection).max()
        assert_allclose(moved[0].deflection, alone[0].deflection, atol=1e-7 * reach)
