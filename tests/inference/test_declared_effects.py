"""Effects that a study declares: parameters like any other, and a likelihood of the model with them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import multivariate_normal
from small import TWO, problem, record, study, with_effect

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.settings import EffectsSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.inference import optimum
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import campaign_places
from lcopa_bayes.inference.effects import Effected, effected
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.optimum import again, find_optima, known_optimum, nearly_white
from lcopa_bayes.model.effects import passage
from lcopa_bayes.model.effects.catalogue import bundled

ACTING = sorted(set(bundled()) - {"outliers"})
PLANT = {
    "gain": 1.1, "time": 1.4, "order": 0.8, "delay": 0.43, "offset": 0.1,
    "sigma": 0.02, "sigma_ar": 0.01, "rho": 0.6,
}  # fmt: skip


def two_axes() -> Study:
    made = [record(k, device=TWO, camera=0.25, duration=14.0, name=f"r{k}") for k in (1, 2)]
    return study(*made, noise="white+ar1")


def one_axis(duration: float = 16.0, camera: float = 0.2) -> Study:
    commands = [staircase([a, -0.7 * a, 0.4 * a, 0.0], hold=duration / 5, start=0.55) for a in (1.0, 0.5)]
    made = [
        record(k, command=c, camera=camera, duration=duration, name=f"r{k}") for k, c in enumerate(commands)
    ]
    return study(*made, noise="white", seed=4)


def using(base: Study, *names: str, **priors: float) -> Problem:
    reported = {key.replace("__", "."): PriorSettings(key, fixed=value) for key, value in priors.items()}
    return problem_of(replace(base, effects=EffectsSettings(use=names), priors=dict(base.priors) | reported))


def values_of(made: Problem, size: float) -> np.ndarray:
    """Plausible values; coefficients of `size` prior standard deviations."""
    rng = np.random.default_rng(2)
    out = []
    for row in made.posterior.table.rows:
        if row.kind in COEFFICIENTS:
            assert row.prior is not None
            out.append(size * row.prior.parameters["scale"])
        elif row.kind in CONSTANTS:
            out.append(row.value if row.prior is None else float(row.prior.frozen.median()))
        else:
            out.append(PLANT[row.kind] * (1 + 0.05 * rng.random()))
    return np.array(out)


TWO_AXES = two_axes()


@pytest.mark.parametrize("name", ACTING)
def test_without_strength_it_is_the_plant_alone(name: str):
    """The joint log likelihood at coefficients of 0 is that of the study without, integrated or not."""
    made, plain = using(TWO_AXES, name).posterior, problem_of(TWO_AXES).posterior
    values = values_of(using(TWO_AXES, name), 0.0)[None]
    own = [made.table.names.index(known) for known in plain.table.names]
    assert_allclose(made.joint_log_likelihood(values), plain.joint_log_likelihood(values[:, own]), rtol=1e-10)
    assert made.without_effects.table.names == plain.table.names


@pytest.mark.parametrize("name", ACTING)
def test_responses_are_those_of_the_simulator(name: str):
    """Base plus columns times linear parameters, against one simulation of the whole."""
    made = using(TWO_AXES, name)
    values, posterior = values_of(made, 0.7), made.posterior
    simulation = posterior.simulation
    assert simulation is not None
    names = tuple(one.name for one in TWO_AXES.fit)
    whole = Effected(posterior.table, simulation.simulator(simulation.rows.effects(values)), names, (0, 1))
    direct = whole.responses(values, simulation.rows.psi(values))
    for r, (split, y) in enumerate(zip(simulation.responses(values[None]), direct, strict=True)):
        for axis in range(y.shape[1]):
            level = posterior.table.offset(values[None], axis, r)[0]
            assert_allclose(split[axis, 0] + level, y[:, axis], rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ACTING)
def test_slopes_are_slopes(name: str):
    """Of the whitened residual in every search coordinate, by central differences."""
    made = using(TWO_AXES, name)
    values, least = values_of(made, 0.5), LeastSquares(made.posterior)
    x = least.coordinates(values)
    residual, jacobian = least.residual(x, values)
    assert_allclose(residual, least.misfit(x, values), rtol=0, atol=1e-9)
    for position, k in enumerate(least.columns):
        row, step = made.posterior.table.rows[k], np.zeros(x.size)
        small = 1e-3 * row.prior.parameters["scale"] if row.kind in COEFFICIENTS and row.prior else 3e-5
        step[position] = small
        slope = (least.misfit(x + step, values) - least.misfit(x - step, values)) / (2 * small)
        assert np.abs(slope - jacobian[:, position]).max() < 2e-3 * (np.abs(slope).max() + 1), row.name


def test_what_is_integrated_out_is_integrated_out():
    """Gains, levels and the waves of a vibration under a pulse that is sampled: dense normal density."""
    base = one_axis(8.0, 0.4)
    made = using(base, "overdrive_pulse", "vibration").posterior
    values = values_of(using(base, "overdrive_pulse", "vibration"), 0.6)
    assert [made.table.names[k] for k in made.linear] == [
        "gain", "offset_r0", "offset_r1",
        "vibration.a[r0]", "vibration.b[r0]", "vibration.a[r1]", "vibration.b[r1]",
    ]  # fmt: skip
    mean, columns = values.copy(), []
    mean[list(made.linear)] = [made.table.rows[k].prior.frozen.mean() for k in made.linear]  # type: ignore[union-attr]

    def stacked(at: np.ndarray) -> np.ndarray:
        units = made.responses(at[None])
        seen = [(r, one.axes[0]) for r, one in enumerate(made.samples)]
        return np.concatenate([o.values - made.residual(0, r, o, at[None], units[r])[0] for r, o in seen])

    middle = stacked(mean)
    for k in made.linear:
        prior = made.table.rows[k].prior
        assert prior is not None
        other = mean.copy()
        other[k] += prior.frozen.std()
        columns.append(stacked(other) - middle)
    spread = np.array(columns).T
    sigma = values[made.table.at("sigma", 0)]
    observed = np.concatenate([one.axes[0].values for one in made.samples])
    exact = multivariate_normal(middle, sigma**2 * np.eye(middle.size) + spread @ spread.T).logpdf(observed)
    assert_allclose(made.log_likelihood(values[None]), exact, rtol=1e-9)
    drawn = made.complete(made.coordinates(values[None]), None)
    assert not np.isnan(drawn).any()


@pytest.mark.parametrize(
    ("name", "gains"), [("overdrive_pulse", True), ("cubic_stiffness", False), ("clipping", False)]
)
def test_gains_are_integrated_out_where_responses_are_linear_in_them(name: str, gains: bool):
    made = using(one_axis(), name).posterior
    assert (made.table.at("gain", 0, 0) in made.linear) == gains
    assert made.table.at("offset", 0, 0) in made.linear


def test_rows_have_units_priors_and_domains():
    made = using(one_axis(), "overdrive_pulse", "vibration", "sensor_lag").posterior.table
    reported = {
        row.name: (row.unit, row.kind, None if row.prior is None else row.prior.dist) for row in made.rows
    }
    assert reported["overdrive_pulse.k"] == ("-", "coefficient", "norm")
    assert reported["overdrive_pulse.frame"] == ("ms", "constant", "loguniform")
    assert reported["vibration.a[r0]"] == ("rad", "coefficient", "norm")
    assert reported["vibration.frequency"] == ("1/ms", "constant", "loguniform")
    assert reported["sensor_lag.Ts"] == ("ms", "magnitude", "halfnorm")
    lag = made.rows[made.names.index("sensor_lag.Ts")]
    assert lag.log_prior(np.array([-0.1]))[0] == -np.inf


def test_priors_of_effects_are_priors():
    """Fixed, of another form, and of all records at once."""
    base = one_axis()
    priors = {
        "overdrive_pulse.frame": PriorSettings("overdrive_pulse.frame", fixed=1.5),
        "vibration.a": PriorSettings("vibration.a", dist="norm", parameters={"scale": 0.25}),
        "vibration.a[r1]": PriorSettings("vibration.a[r1]", fixed=0.0),
    }
    uses = EffectsSettings(use=("overdrive_pulse", "vibration"))
    table = problem_of(replace(base, effects=uses, priors=priors)).posterior.table
    reported = {row.name: row for row in table.rows}
    assert reported["overdrive_pulse.frame"].value == 1.5
    assert reported["vibration.a[r0]"].prior.parameters["scale"] == 0.25  # type: ignore[union-attr]
    assert reported["vibration.a[r1]"].value == 0.0
    assert reported["vibration.b[r0]"].default


def test_scatter_changes_the_noise():
    made = using(one_axis(), "outliers").posterior
    assert made.noise.kind == "student"
    assert "outliers.nu" in made.table.names
    assert made.simulation is None


def test_scales_come_from_the_records():
    """The largest deflection of a clean record, and the drive that goes with it; a study may state them."""
    base = one_axis()
    made = using(base, "odd_curvature")
    assert made.ranges is not None
    deflected = max(np.nanmax(np.abs(one.response[:, 0] - 0.3)) for one in base.fit)
    assert made.ranges.response[0] == pytest.approx(deflected, rel=0.1)
    assert made.ranges.drive[0] == 1.0
    stated = EffectsSettings(use=("odd_curvature",), deflection={"y": 3.0}, speed=0.7)
    again = problem_of(replace(base, effects=stated)).ranges
    assert again is not None
    assert (again.response[0], again.speed) == (3.0, 0.7)


def test_everything_wrong_is_said_at_once():
    priors = {
        "gain": PriorSettings("gain", fixed=2.0),
        "ion_creep.k": PriorSettings("ion_creep.k", fixed=0.1),
        "delya": PriorSettings("delya", fixed=0.1),
    }
    uses = EffectsSettings(
        use=("cubic_stifness", "bilinear_crosstalk", "clipping", "clipping"), deflection={"z": 1.0}
    )
    with pytest.raises(InputError) as caught:
        problem_of(replace(one_axis(), effects=uses, priors=priors))
    said = caught.value.problems
    assert len(said) == 6
    assert "no effect is named 'cubic_stifness'; did you mean 'cubic_stiffness'?" in said[0]
    assert "'bilinear_crosstalk' has no place in a plant of 1 drive and 1 response" in said[1]
    assert "'clipping' is listed 2 times" in said[2]
    assert "no response axis is named 'z'" in said[3]
    assert "[priors] ion_creep.k: the effect 'ion_creep' is not used" in said[4]
    assert "[priors] delya: this model has no such parameter" in said[5]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("sensor_lag.Ts", -1.0, "must lie in [0"),
        ("backflow.rising", 0.5, "a choice is fixed at 0 (no) or 1 (yes)"),
        ("overdrive_pulse.fram", 1.0, "did you mean 'overdrive_pulse.frame'?"),
    ],
)
def test_bad_priors_of_effects(name: str, value: float, words: str):
    uses = EffectsSettings(use=("sensor_lag", "backflow", "overdrive_pulse"))
    with pytest.raises(InputError, match=r"\[priors\]") as caught:
        problem_of(replace(one_axis(), effects=uses, priors={name: PriorSettings(name, fixed=value)}))
    assert words in str(caught.value)


def test_a_study_file_declares_effects(tmp_path: Path):
    rows = [f"{0.2 * k},{float(k > 4)},{np.tanh(0.05 * max(k - 5, 0)):.6f}" for k in range(60)]
    (tmp_path / "a.csv").write_text("\n".join(["time_ms,drive_u_V,response_y_rad", *rows]) + "\n")
    (tmp_path / "study.toml").write_text(
        '[records]\nfit = ["a.csv"]\n[effects]\nuse = ["cubic_stiffness"]\ndeflection = { y = 1.0 }\n'
        '[priors]\n"cubic_stiffness.c" = { dist = "norm", scale = 0.2 }\n'
    )
    table = problem_of(load_study(tmp_path)).posterior.table
    assert table.rows[-1].name == "cubic_stiffness.c"
    assert table.rows[-1].prior.parameters["scale"] == 0.2  # type: ignore[union-attr]
    (tmp_path / "study.toml").write_text('[effects]\nuse = "cubic_stiffness"\nuses = 1\n')
    with pytest.raises(InputError) as caught:
        load_study(tmp_path)
    assert "unknown key 'uses'; did you mean 'use'?" in str(caught.value)
    assert "`use` must be a list of names" in str(caught.value)


def test_without_effects_nothing_is_simulated():
    made = problem(record()).posterior
    assert made.simulation is None
    assert made.model.effects is None
    assert made.without_effects.model is made.model


def test_a_plant_without_a_bounded_response_is_impossible():
    made = using(one_axis(), "cubic_stiffness")
    values = np.tile(values_of(made, 1.0), (2, 1))
    values[1, made.posterior.table.names.index("cubic_stiffness.c")] = -300.0
    reported = made.posterior.log_likelihood(values)
    assert np.isfinite(reported[0])
    assert reported[1] == -np.inf


def test_the_optimum_of_a_simulated_stiffness():
    """Within four standard errors of the truth, and a higher density than the plant alone has."""
    made, truth = with_effect(
        one_axis(),
        ["cubic_stiffness"],
        {
            "gain": 2.0,
            "time": 1.5,
            "order": 0.8,
            "delay": 0.73,
            "offset": 0.3,
            "sigma": 0.02,
            "coefficient": 0.4,
        },
    )
    posterior = problem_of(made).posterior
    best = find_optima(posterior, np.random.default_rng(1), starts=2)[0]
    k = posterior.table.names.index("cubic_stiffness.c")
    error = np.sqrt(np.diag(best.covariance))[posterior.sampled.index(k)]
    assert abs(best.values[k] - truth[k]) < 4 * error
    assert error < 0.1 * truth[k] + 0.02
    off = best.values.copy()
    off[k] = 0.0
    assert posterior.log_likelihood(best.values[None])[0] > posterior.log_likelihood(off[None])[0] + 20


@pytest.mark.parametrize(("sigma", "evaluated"), [(2e-3, 1), (2e-4, 2)])
def test_a_descent_beside_an_optimum_keeps_the_slopes_it_begins_with(monkeypatch, sigma, evaluated):
    """To the optimum on blocks four times narrower as with slopes from everywhere; where it moves by several
    standard deviations slopes are taken anew there."""
    base = one_axis(camera=0.3)
    base = replace(base, model=replace(base.model, blocks=2))
    made, _ = with_effect(base, ["cubic_stiffness"], PLANT | {"sigma": sigma, "coefficient": 0.3})
    wide = problem_of(made)
    first, narrow = find_optima(wide.posterior, np.random.default_rng(1), starts=2)[0], wide.refined(4)
    exact = again(narrow.posterior, [first])[0]
    actual, calls = LeastSquares.residual, []
    monkeypatch.setattr(LeastSquares, "residual", lambda *given: calls.append(1) or actual(*given))
    found = again(narrow.posterior, [first], begun=True)[0]
    assert len(calls) == evaluated
    points = [narrow.posterior.coordinates(one.values[None])[0] for one in (exact, found, first)]
    sd = np.sqrt(np.diag(exact.covariance))
    assert np.abs((points[2] - points[0]) / sd).max() > (0.2 if evaluated == 1 else 2.0)
    assert np.abs((points[1] - points[0]) / sd).max() < 0.1
    assert_allclose(np.sqrt(np.diag(found.covariance)), sd, rtol=0.1)


def test_an_optimum_that_is_known_is_described_without_a_descent(monkeypatch: pytest.MonkeyPatch):
    """Its noise is that of its residual, wherever that stood; without a bounded response it is none."""
    made, _ = with_effect(one_axis(), ["cubic_stiffness"], PLANT | {"coefficient": 0.3})
    posterior = problem_of(made).posterior
    best = find_optima(posterior, np.random.default_rng(1), starts=2)[0]
    monkeypatch.setattr(LeastSquares, "solve", None)  # no call of it would end
    off = nearly_white(posterior, best.values[None])[0]
    assert not np.allclose(off, best.values)
    known = known_optimum(posterior, off)
    assert known is not None
    assert_allclose(known.values, best.values, rtol=1e-3)
    assert_allclose(known.covariance, best.covariance, rtol=1e-2, atol=1e-12)
    assert known.log_density == pytest.approx(best.log_density, abs=1e-3)
    off[posterior.table.names.index("cubic_stiffness.c")] = -300.0
    assert known_optimum(posterior, off) is None
    early = best.values.copy()
    k = posterior.table.at("delay", 0)
    early[k] = -0.1  # beyond the end of its prior
    there = known_optimum(posterior, early)
    assert there is not None
    assert 0.0 <= there.values[k] < 1e-3


def test_starts_far_below_the_best_are_not_followed(monkeypatch: pytest.MonkeyPatch):
    """Each descent with the effects in place costs as much as the search before it."""
    made, good = with_effect(one_axis(camera=0.05), ["cubic_stiffness"], PLANT | {"coefficient": 0.3})
    posterior = problem_of(made).posterior
    far, close = good.copy(), good.copy()
    time = posterior.table.at("time", 0, 0)
    far[time], close[time] = 3.0 * good[time], 1.02 * good[time]
    monkeypatch.setattr(LeastSquares, "solve", lambda self, values: (values, None))
    kept = optimum._near(posterior, [good, close, far])
    assert [values[time] for values in kept] == [good[time], close[time]]


def test_scales_of_a_fit_and_of_the_records_give_the_same_model():
    """`effected` is the same simulation with scales of its own."""
    made = using(one_axis(), "cubic_stiffness")
    values = values_of(made, 1.0)
    plain = problem_of(one_axis()).posterior
    other = effected(plain, values[:-1], [bundled()["cubic_stiffness"]()])
    assert made.ranges is not None
    stretch = (other.ranges.response[0] / made.ranges.response[0]) ** 2
    reported = other.responses(values[:-1], values[-1:] * stretch)
    simulation = made.posterior.simulation
    assert simulation is not None
    for r, one in enumerate(simulation.responses(values[None])):
        level = made.posterior.table.offset(values[None], 0, r)[0]
        assert_allclose(one[0, 0] + level, reported[r][:, 0], rtol=0, atol=1e-9)
    assert_array_equal(made.posterior.model.effects.epochs, [-0.5, 0.5])  # type: ignore[union-attr]


@pytest.mark.parametrize(
    "names",
    [
        ("cubic_stiffness",), ("level_dependent_speed",), ("rise_fall_asymmetry",), ("overflow",),
        ("cubic_stiffness", "clipping", "vibration"), ("overdrive_pulse",), ("voltage_knee", "odd_curvature"),
        ("clock_skew", "rise_fall_asymmetry"), ("voltage_knee", "field_dependent_delay", "cubic_stiffness"),
        ("trigger_jitter", "overflow", "odd_curvature"), ("viscosity_drift",), ("sensor_lag", "clock_skew"),
        ("exposure", "viscosity_drift", "vibration"), ("sensor_lag", "odd_curvature"),
        ("exposure", "backflow"),
    ],
)  # fmt: skip
def test_many_plants_at_once_are_each_by_itself(names: tuple[str, ...]):
    """Forces and commands of a batch against the simulation of every plant alone."""
    made = using(TWO_AXES, *names)
    rng, rows = np.random.default_rng(3), made.posterior.table.rows
    values = np.tile(values_of(made, 0.7), (6, 1))
    shared = [row.kind in CONSTANTS and "overdrive" in row.name for row in rows]
    values *= np.where(shared, 1.0, 1 + 0.05 * rng.random(values.shape))
    simulation = made.posterior.simulation
    assert simulation is not None
    batch = simulation.responses(values)
    for k, row in enumerate(values):
        one = Effected(
            made.posterior.table, simulation.simulator(simulation.rows.effects(row)), ("r1", "r2"), (0, 1)
        )
        plant = simulation.rows.plant(row)
        alone = one.simulator.responses(plant, simulation.rows.psi(row))
        for together, y in zip(batch, alone, strict=True):
            assert_allclose(together[:, k], y.T, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "name", ["cubic_stiffness", "level_dependent_speed", "rise_fall_asymmetry", "overflow"]
)
def test_iterating_the_whole_and_dividing_it_give_one_response(name: str, monkeypatch: pytest.MonkeyPatch):
    """Accelerated sweeps of all plants against Newton's method stretch by stretch, plant by plant."""
    made = using(TWO_AXES, name)
    rng = np.random.default_rng(4)
    values = np.tile(values_of(made, 0.7), (3, 1))
    values *= 1 + 0.05 * rng.random(values.shape)
    simulation = made.posterior.simulation
    assert simulation is not None
    swept = simulation.responses(values)
    monkeypatch.setattr(passage, "_FEWER", 0)
    for one, other in zip(swept, simulation.responses(values), strict=True):
        assert np.isfinite(one).all()
        assert_allclose(one, other, rtol=0, atol=1e-9)


def test_a_force_that_runs_away_leaves_the_other_plants_alone():
    made = using(one_axis(), "cubic_stiffness")
    values = np.tile(values_of(made, 1.0), (3, 1))
    values[1, made.posterior.table.names.index("cubic_stiffness.c")] = -300.0
    simulation = made.posterior.simulation
    assert simulation is not None
    reported = simulation(values)
    assert reported[0].bounded.tolist() == [True, False, True]
    assert_array_equal(reported[0].base[0, 1], 0.0)


def test_a_plant_that_runs_backwards_leaves_the_other_plants_alone():
    made = using(one_axis(), "viscosity_drift")
    values = np.tile(values_of(made, 1.0), (3, 1))
    values[1, made.posterior.table.names.index("viscosity_drift.d")] = 40.0
    simulation = made.posterior.simulation
    assert simulation is not None
    reported = simulation(values)
    assert reported[0].bounded.tolist() == [True, False, True]
    others = simulation(values[[0, 2]])
    for one, other in zip(reported, others, strict=True):
        for k, column in other.columns.items():
            assert_allclose(one.columns[k][[0, 2]], column, rtol=0, atol=1e-9)
            assert_array_equal(one.columns[k][1], 0.0)


def test_places_in_the_campaign_go_by_name_and_numbers_by_value():
    taken = [replace(record(), name=name) for name in ("run1", "run10", "run3", "run2")]
    made = Study("campaign", None, "ms", 1, tuple(taken[:3]), (taken[3],))
    places = campaign_places(made)
    found = [places[name] for name in ("run1", "run2", "run3", "run10")]
    assert found == pytest.approx([-0.5, -1 / 6, 1 / 6, 0.5])


def test_neighbours_whose_difference_is_taken_are_solved_alike(monkeypatch: pytest.MonkeyPatch):
    """Where a force all but jumps two ways of solving end apart by far more than a slope's step moves a
    response: if one neighbour has to be solved block by block, all are; in a density each is by itself."""
    made = using(TWO_AXES, "rise_fall_asymmetry")
    values, simulation, plain, marched = values_of(made, 0.7), made.posterior.simulation, [], []
    assert simulation is not None
    iterated, blockwise = passage.iterated, passage.marched

    def failing(swept, start, scale, most, **more):
        y, solved = iterated(swept, start, scale, most, **more)
        if len(start) > 2:
            solved[-1] = False
            plain.append(len(start))
        return y, solved

    def counted(kernel, force, scale, plants, **more):
        marched.append(plants)
        return blockwise(kernel, force, scale, plants, **more)

    monkeypatch.setattr(passage, "iterated", failing)
    monkeypatch.setattr(passage, "marched", counted)
    simulation.responses(np.tile(values, (3, 1)))
    assert marched == [1] * len(plain)
    plain.clear(), marched.clear()
    least = LeastSquares(made.posterior)
    least.residual(least.coordinates(values), values)
    assert max(plain) > 2
    assert marched == plain
