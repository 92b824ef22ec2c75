"""What to measure next: candidates within limits, exact information, words where there is no number."""

from __future__ import annotations

import json
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from scipy.stats import chi2
from small import TRUTH, TWO, check_page, draws_of, problem, record, row_values

from lcopa_bayes.bench.command import quiet, step
from lcopa_bayes.bench.device import Bench as VirtualBench
from lcopa_bayes.bench.device import truth
from lcopa_bayes.calibration.replica import device_of
from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import load_record, save_record
from lcopa_bayes.experiments.candidates import (
    PLAIN,
    Candidate,
    Limits,
    bench_times,
    candidates,
    limits_of,
    template,
)
from lcopa_bayes.experiments.confirmation import confirm, confirmed
from lcopa_bayes.experiments.design import checked, cramer_rao, design, promises, reached, within
from lcopa_bayes.experiments.information import Bench, refit
from lcopa_bayes.experiments.summary import as_json, next_measurement
from lcopa_bayes.identifiability.contraction import prior_draws, prior_spread
from lcopa_bayes.identifiability.curvature import sensitivities
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.results.predictive import Predictive
from lcopa_bayes.sampling.draws import Draws
from lcopa_bayes.verbs.design import design as design_next

PLANT = {key: value for key, value in TRUTH.items() if key not in ("offset", "sigma")}


@dataclass(frozen=True, eq=False)
class Known(Predictive):
    """A posterior that is known without sampling; there is nothing of it to save."""

    problem: Problem
    draws: Draws
    verdict = "known"

    def to_json(self):
        return {}

    def to_datatree(self):
        raise NotImplementedError

    def save(self, folder):
        return folder

    def report(self, folder, *, jobs=1):
        return folder


def fitted(made, *, spread: float = 0.01, rows=None):
    """What a design needs of a fit, with draws around the truth."""
    table, rng = made.posterior.table, np.random.default_rng(3)
    values = row_values(table, TRUTH if rows is None else rows)
    free = np.array([row.free for row in table.rows])
    draws = draws_of(table, values * (1 + spread * free * rng.standard_normal((48, values.size))))
    return Known(made, draws)


@pytest.fixture(scope="module")
def one():
    return problem()


# -- what a bench can play -------------------------------------------------------------------------


@settings(max_examples=40, deadline=None)
@given(
    ticks=st.integers(4, 700),
    seed=st.integers(0, 99),
    low=st.floats(-2, 0),
    high=st.floats(0.1, 3),
    axes=st.integers(1, 2),
)
def test_every_candidate_keeps_the_limits_and_the_refresh(ticks, seed, low, high, axes):
    limits = Limits(np.zeros(axes), np.full(axes, low), np.full(axes, high), 1.0, 0.1)
    drives = candidates(limits, float(ticks), np.random.default_rng(seed), unit="ms")
    assert drives[0].name == PLAIN
    assert len({drive.name for drive in drives}) == len(drives)
    for drive in drives:
        assert within(drive, limits), drive.name
        assert drive.command.times.size
        assert drive.command.times[-1] < ticks


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_drives_reach_both_ends_of_a_range_that_holds_rest(sign):
    """From rest at 0.5 to -1.5 and 3.5, or mirrored: what is low is that, and what is off is rest."""
    rest, near, far = sign * 0.5, sign * -1.5, sign * 3.5
    limits = Limits(np.array([rest]), np.array([min(near, far)]), np.array([max(near, far)]), 1.0, 0.1)
    assert (limits.near, limits.far) == (near, far)
    drives = {
        one.family: one.command for one in candidates(limits, 64.0, np.random.default_rng(2), unit="ms")
    }
    levels = {family: set(np.unique(one.values)) for family, one in drives.items()}
    assert levels["step"] == {far}
    assert levels["on/off"] == {rest, far}
    assert levels["pseudo-random binary"] == levels["random telegraph"] == {near, far}
    quarters = {rest + (far - rest) * k / 4 for k in (1, 2, 3, 4)}
    assert levels["staircase"] == levels["amplitude series"] == quarters | {rest}
    wave = drives["multisine"].values
    assert {wave.min(), wave.max()} == {near, far}


def test_a_drive_beyond_the_limits_is_seen():
    limits = Limits(np.zeros(1), np.zeros(1), np.ones(1), 1.0, 0.1)
    assert not within(Candidate("", "", "", step(1.1)), limits)
    assert not within(Candidate("", "", "", step(1.0, at=0.5)), limits)


def test_ranges_are_those_of_the_records_or_of_an_amplitude(one):
    found = limits_of(one)
    assert (found.low, found.high, found.far) == (0.0, 1.0, 1.0)
    assert (found.period, found.refresh) == (0.2, 2.0)
    assert limits_of(one, amplitude=3.0).high == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"amplitude": 0.0}, "amplitude limit"),
        ({"amplitude": float("nan")}, "amplitude limit"),
        ({"refresh": 0.01}, "shorter than the camera period"),
        ({"repeats": 0}, "one or more"),
        ({"time": 1.0}, "four refreshes"),
        ({"time": 1e9}, "samples"),
        ({"time": float("nan")}, "four refreshes"),
    ],
)
def test_what_cannot_be_designed_is_refused_in_words(one, asked, said):
    with pytest.raises(InputError, match=said):
        checked(one, **asked)


def test_a_drive_that_never_moved_has_no_range_of_its_own():
    made = problem(record(device=TWO, command=step((1.0, 0.0), at=0.35), camera=0.5))
    assert limits_of(made).high == pytest.approx([1.0, 1.0])  # both in volts
    other = [made.study.drive_axes[0], made.study.drive_axes[1].__class__("y", "K")]
    foreign = SimpleNamespace(study=SimpleNamespace(**vars_of(made.study) | {"drive_axes": tuple(other)}))
    with pytest.raises(InputError, match="'y' moves in no record"):
        limits_of(foreign)


def vars_of(study) -> dict:
    return {"fit": study.fit, "time_unit": study.time_unit}


def test_bench_times_are_spans_and_hold_the_one_asked_for(one):
    times, chosen = bench_times(one, limits_of(one), 50.0)
    assert chosen == 50.0
    assert 50.0 in times
    assert list(times) == sorted(times)
    assert times[-1] / 0.2 <= 100_000


# -- information -----------------------------------------------------------------------------------


def test_information_is_that_of_the_likelihood(one):
    """Two methods: slopes of the design, and those that whiten a simulated record of the same drive."""
    values = row_values(one.posterior.table, TRUTH)
    bench = Bench(one, 24.0, 0.2)
    drive = candidates(limits_of(one), 24.0, np.random.default_rng(2), unit="ms")[-1].command
    clean = truth(
        device_of(one.posterior.table, values, 0, time_unit="ms"),
        VirtualBench(camera=0.2),
        drive,
        duration=24.0,
        name="x",
    )
    again = refit(one, clean, bench)
    found = sensitivities(Landscape(again.posterior), row_values(again.posterior.table, TRUTH))
    gram = found.matrix.T @ found.matrix
    at = [found.names.index(name) for name in bench.names]
    rest = found.names.index("offset")
    seen = gram[np.ix_(at, at)] - np.outer(gram[at, rest], gram[rest, at]) / gram[rest, rest]
    mine = bench.gram(values, drive, {})
    np.testing.assert_allclose(mine, seen, rtol=1e-6, atol=1e-6 * seen.max())


@pytest.mark.parametrize("noise", ["white", "ar1", "student"])
def test_repeats_and_amplitude_count_as_they_must(noise):
    made = problem(noise=noise)
    rows = TRUTH | {"rho": 0.3, "nu": 4.0}
    table = made.posterior.table
    draws = row_values(table, {name: rows[name] for name in table.names})[None]
    bench = Bench(made, 24.0, 0.2)
    drives = [Candidate("", "", "", step(level)) for level in (1.0, 2.0)]
    (small, large), (four, _) = (promises(bench, drives, draws, repeats=k) for k in (1, 4))
    np.testing.assert_allclose(large.relative, small.relative / 2, rtol=1e-6)
    np.testing.assert_allclose(four.relative, small.relative / 2, rtol=1e-6)


@pytest.mark.parametrize("size", [0.02, 20.0])
@pytest.mark.parametrize(
    ("prior", "relative"),
    [
        (("loguniform", {"a": 1e-3, "b": 1e3}), np.log(1e6) / np.sqrt(12)),
        (("norm", {"loc": 0.0, "scale": 5.0}), None),
    ],
)
def test_a_prior_counts_on_the_scale_that_it_has(prior, relative, size):
    """A drive that excites nothing leaves the standard deviation of the prior, relative to the value."""
    made = problem(priors={"gain": prior})
    table = made.posterior.table
    draws = row_values(table, TRUTH | {"gain": size})[None]
    landscape, bench = Landscape(made.posterior), Bench(made, 24.0, 0.2)
    spread = prior_spread(landscape, prior_draws(landscape, np.random.default_rng(1)))[list(bench.columns)]
    (still,) = promises(bench, [Candidate("still", "", "", quiet())], draws, prior=spread)
    found = dict(zip(bench.names, still.relative[0], strict=True))
    assert found["gain"] == pytest.approx(relative or 5.0 / size, rel=0.05)
    assert found["time_1"] == pytest.approx(spread[bench.names.index("time_1")])
    assert found["order_1"] == pytest.approx(spread[bench.names.index("order_1")] / TRUTH["order_1"])


def test_correlated_noise_costs_what_its_whitening_says():
    """A constant gain under AR(1): n (1 - rho) / (1 + rho) samples are as good as independent ones."""
    found = {}
    for rho in (0.0, 0.6):
        made = problem(noise="ar1", offset="none")
        table = made.posterior.table
        rows = {name: (TRUTH | {"rho": rho})[name] for name in table.names} | {"time_1": 1e-3}
        bench = Bench(made, 2000.0, 0.2)
        values = row_values(table, rows)
        gram = bench.gram(values, step(1.0), {})
        found[rho] = gram[0, 0]
    assert found[0.6] / found[0.0] == pytest.approx(0.4 / 1.6, rel=0.02)


def test_cramer_rao_of_a_known_matrix():
    np.testing.assert_allclose(cramer_rao(np.diag([4.0, 1e12])), np.diag([0.25, 1e-12]))
    whole = np.array([[2.0, 1.0], [1.0, 3.0]])
    np.testing.assert_allclose(cramer_rao(whole), np.linalg.inv(whole))


def test_singular_information_has_no_finite_variance():
    v = np.array([1.0, 2.0, 0.0])
    found = cramer_rao(np.outer(v, v) + np.diag([0.0, 0.0, 5.0]))
    assert np.isinf(np.diag(found)[:2]).all()
    assert found[2, 2] == pytest.approx(0.2)
    assert np.isinf(np.diag(cramer_rao(np.zeros((3, 3))))).all()


def test_a_drive_that_excites_nothing_determines_nothing(one):
    draws = row_values(one.posterior.table, TRUTH)[None]
    (still,) = promises(Bench(one, 24.0, 0.2), [Candidate("still", "", "", quiet())], draws)
    assert not still.excites
    assert np.isinf(still.relative).all()
    assert still.typical(np.ones(4, dtype=bool)) == np.inf


def test_bench_time_is_interpolated_bounded_or_absent():
    times = np.array([1.0, 10.0, 100.0])
    assert reached(times, np.array([1.0, 0.1, 0.01]), 0.1) == (10.0, False)
    time, bound = reached(times, np.array([1.0, 1.0, 0.01]), 0.1)
    assert (time, bound) == (pytest.approx(10**1.5), False)
    assert reached(times, np.array([0.05, 0.02, 0.01]), 0.1) == (1.0, True)
    assert reached(times, np.array([np.inf, 0.05, 0.01]), 0.1) == (10.0, True)
    assert reached(times, np.array([np.inf, 3.0, 0.2]), 0.1) is None


# -- the whole -------------------------------------------------------------------------------------


def test_the_winner_beats_the_step_as_promised_in_simulation(one):
    made = design(fitted(one), time=60.0, ladder=False, draws=4)
    assert made.winner is not made.step
    assert made.factor.value > 1.5
    trials = confirm(made, replicas=6)
    assert trials
    first = trials[0]
    assert 0.3 * first.expected < first.factor < 3 * first.expected
    freedom = first.winner.errors.shape[0] - 1
    low, high = chi2(freedom).ppf([1e-4, 1 - 1e-4])  # 0.01 % either side
    for side in (first.winner, first.step):
        share = freedom * (side.spread / side.expected) ** 2
        assert (share > low).all()
        assert (share < high).all()
    reported = confirmed(made, replicas=3)["confirmed"]
    assert json.dumps(reported, allow_nan=False)
    begun = {"Confirmed" if one["confirmed"] else "Not confirmed" for one in reported["trials"]}
    said = [one["sentence"] for one in reported["trials"]]
    assert all(one.startswith(tuple(begun)) and one.endswith(".") for one in said)
    assert reported["sentence"] == " ".join(said)


def test_precision_is_confirmed_by_what_one_record_alone_promises(one):
    """Fits take one record and no prior, also where the design counts several and a prior beside them."""
    fit, options = fitted(one), {"time": 120.0, "ladder": False, "draws": 3}
    several = design(fit, **options, repeats=4, with_prior=True)
    alone = promises(
        Bench(fit.problem.thrifty, 120.0, several.limits.period), [several.winner.candidate], several.draws
    )
    covariances = [np.diagonal(each) for each in alone[0].covariance]
    trials = confirm(several, replicas=2)
    assert trials
    for trial in trials:
        assert any(np.allclose(trial.winner.expected**2, each, rtol=1e-6, atol=0.0) for each in covariances)


def test_a_sum_is_recognised_at_draws_of_the_prior_under_drives_that_change_often():
    made = problem(record(camera=0.6), terms=2, orders=(0.8, 0.8))
    table, draws = made.posterior.table, made.posterior.table.draw(48, np.random.default_rng(1))
    believed = SimpleNamespace(
        problem=made,
        study=made.study,
        draws=draws_of(table, draws),
        run=SimpleNamespace(plan=SimpleNamespace(seed=1)),
    )
    found = design(believed, time=48.0, ladder=False, draws=6)
    assert found.structure.blind == {"time_1", "time_2"}
    assert "time_1" in found.reason("time_2")


def test_what_only_acts_as_a_sum_gets_words_and_no_number():
    made = problem(terms=2, orders=(0.8, 0.8))
    rows = TRUTH | {"time_1": 1.5, "time_2": 0.7, "order_1": 0.8, "order_2": 0.8}
    table = made.posterior.table
    rows = {name: rows[name] for name in table.names}
    found = as_json(design(fitted(made, rows=rows), time=50.0, draws=4))
    reported = {row["name"]: row for row in found["parameters"]}
    for name in ("time_1", "time_2"):
        assert "structurally unidentifiable" in reported[name]["reason"]
        assert reported[name]["relative_sd"] is None
        assert reported[name]["time_words"] == "not by any drive tried"
    assert reported["gain"]["relative_sd"]["value"] > 0
    assert json.dumps(found, allow_nan=False)


def test_an_idle_path_is_seen_by_the_drive_that_moves_it():
    made = problem(record(device=TWO, camera=0.5), terms={"direct": 2, "cross": 1})
    known = {"delay": 0.4, "offset_x": 0.1, "offset_y": -0.2, "sigma_x": 0.02, "sigma_y": 0.02}
    known |= {"gain_x_x": 1.0, "gain_x_y": 0.2, "gain_y_x": 0.3, "gain_y_y": 1.5}
    known |= {"time_1_direct": 1.2, "order_1_direct": 1.6, "time_2_direct": 2.5, "order_2_direct": 0.7}
    known |= {"time_1_cross": 2.0, "order_1_cross": 0.9}
    found = design(fitted(made, rows=known), time=100.0, ladder=False, draws=4)
    alone = next(one for one in found.here if one.candidate.name == f"{PLAIN}, axis 1 alone")
    at = found.names.index("gain_y_y")
    assert np.isinf(alone.expected[at])
    assert np.isfinite(found.winner.expected[at])


def test_an_audit_says_what_to_measure_for_what_it_left_open(one):
    rows = [{"name": name, "verdict": "one-sided"} for name in ("time_1", "sigma")]
    reported = next_measurement(fitted(one), [*rows, {"name": "gain", "verdict": "identified"}])
    assert [row["name"] for row in reported["parameters"]] == ["time_1", "sigma"]
    assert reported["parameters"][0]["expected_relative_sd"]["value"] > 0
    assert reported["parameters"][1]["drive"] is None
    assert next_measurement(fitted(one), [{"name": "gain", "verdict": "identified"}]) is None


def test_a_filled_template_is_a_record(one, tmp_path):
    limits = limits_of(one)
    drive = candidates(limits, 24.0, np.random.default_rng(2), unit="ms")[-1].command
    path = tmp_path / "next.csv"
    path.write_text(template(one.study, limits, drive, 24.0))
    with pytest.raises(InputError, match="no response column holds a sample"):
        load_record(path)
    head, *rows = path.read_text().splitlines()
    path.write_text("\n".join([head, *(row + "0.5" for row in rows)]) + "\n")
    read = load_record(path)
    assert (read.drive_axes, read.response_axes) == (one.study.drive_axes, one.study.response_axes)
    clean = truth(
        device_of(one.posterior.table, row_values(one.posterior.table, TRUTH), 0, time_unit="ms"),
        VirtualBench(camera=0.2),
        drive,
        duration=24.0,
        name="x",
    )
    np.testing.assert_array_equal(read.time, clean.time)
    np.testing.assert_array_equal(read.drive, clean.drive)


@pytest.mark.usefixtures("undrawn")
def test_a_plan_is_numbers_a_page_and_a_drive(one, tmp_path):
    made = design_next(fitted(one), quick=True, bench_time=24.0)
    made.report(tmp_path)
    reported = json.loads((tmp_path / "design.json").read_text())
    assert reported == made.to_json()
    assert reported["verdict"] in str(made)
    assert list(made.summary()["parameter"]) == [row["name"] for row in reported["parameters"]]
    assert made.drive is not None
    assert_array_equal(made.drive.values[:, 0], load_template(tmp_path / reported["template"])[:, 1])
    assert_array_equal(made.drive.time, load_template(tmp_path / reported["template"])[:, 0])
    assert reported["factor_over_step"]["value"] > 1
    assert reported["confirmed"]["trials"]
    assert load_template(tmp_path / reported["template"]).shape[0] == 121  # 24 at 0.2, and one before
    assert reported["winner"]["drive"] in check_page(tmp_path / "design.html")


def load_template(path) -> np.ndarray:
    return np.genfromtxt(path, delimiter=",", skip_header=1)


STUDY = """[records]
fit = ["one.csv"]
[noise]
kind = "white"
[sampler]
target_ess = 100
"""


@pytest.fixture
def study(tmp_path):
    save_record(record(camera=0.6), tmp_path / "one.csv")
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path


def test_the_verb_refuses_before_it_fits(study, capsys):
    assert main(["design", str(study), "--amplitude", "-1", "--out", str(study / "run")]) == 2
    assert "amplitude limit" in capsys.readouterr().err
    assert not (study / "run").exists()


@pytest.mark.slow
def test_the_verb_from_records_to_drive(study, capsys):
    words = ["design", study, "--quick", "--jobs", 1, "--time", 120, "--json", "--out", study / "run"]
    assert main([str(word) for word in words]) == 0
    reported = json.loads(capsys.readouterr().out)
    assert reported.pop("report") == str(study / "run" / "design.html")
    assert reported == json.loads((study / "run" / "design.json").read_text())
    assert (study / "run" / reported["template"]).exists()
