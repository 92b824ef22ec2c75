"""Records that do not begin at rest are recognised, and noise is not taken for one of them."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from small import U, Y, path, study

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Record, save_record
from lcopa_bayes.data.requirements import not_at_rest, straight, unmet, unrest
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.inference.declared import obstacles
from lcopa_bayes.results.fit import fit

RECORDS = Path(os.environ.get("LCOPA_BAYES_DATA", Path(__file__).parents[2] / ".." / "shared")) / "records"
ALWAYS = 1e-9
"""A range of which every movement is a large part, so that significance alone decides."""


def noise(n: int, correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Stationary first-order autoregressive noise of sd 1; a random walk at correlation 1."""
    fresh = rng.standard_normal(n)
    if correlation == 1.0:
        return np.cumsum(fresh)
    out = fresh.copy()
    for k in range(1, n):
        out[k] = correlation * out[k - 1] + np.sqrt(1 - correlation**2) * fresh[k]
    return out


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9, 0.99, 1.0])
@pytest.mark.parametrize(
    ("sizes", "draws"), [((8, 20, 60), 100), pytest.param((8, 30, 400), 2000, marks=pytest.mark.slow)]
)
def test_noise_is_refused_in_less_than_one_case_of_a_hundred(correlation, sizes, draws):
    """A failure is more than the 99.9 % quantile of what 1 % would give; half have white noise on top."""
    rng, refused, count = np.random.default_rng(int(100 * correlation)), 0, 0
    for n in sizes:
        for k in range(draws):
            values = noise(n, correlation, rng) + (k % 2) * rng.standard_normal(n)
            refused += unrest(np.arange(n) * 0.2, values, ALWAYS) is not None
            count += 1
    assert refused <= stats.binom.ppf(0.999, count, 0.01)


def switched(rng: np.random.Generator, *, before: float, first: float, noise_sd: float) -> Record:
    """A plant that rested under `before`, in a record whose rows begin when the drive goes to `first`."""
    order, time = rng.uniform(0.6, 1.6), rng.uniform(0.5, 8.0)
    device = Device(((path(2.0, rng.uniform(0.0, 0.8), (time,), (order,)),),), (U,), (Y,), (0.3,))
    off = rng.uniform(6.0, 14.0)
    command = Command(np.array([0.0, off]), np.array([[first], [0.0]]), np.array([before]))
    at = np.linspace(0.0, 20.0, int(rng.integers(80, 400)))
    clean = device.response(command, at)[:, 0]
    rho = rng.uniform(0.0, 0.6)
    response = clean + noise_sd * noise(at.size, rho, rng)
    drive = np.where(at < off, first, 0.0)
    return Record("step", at, drive[:, None], response[:, None], (U,), (Y,), "ms")


def test_a_drive_that_was_switched_on_as_the_record_began_is_recognised():
    """100 plants at rest before a drive of 1 in the first row, and the same that had rested under it."""
    rng = np.random.default_rng(11)
    moving = [switched(rng, before=0.0, first=1.0, noise_sd=0.02) for _ in range(100)]
    resting = [switched(rng, before=1.0, first=1.0, noise_sd=0.02) for _ in range(100)]
    assert [k for k, one in enumerate(moving) if not not_at_rest([one])] == []
    assert sum(bool(not_at_rest([one])) for one in resting) <= 4  # 1 % of a hundred, at p = 0.003


def test_an_early_row_states_what_the_plant_rested_under():
    record = switched(np.random.default_rng(2), before=0.0, first=1.0, noise_sd=0.02)
    (problem,) = not_at_rest([record])
    assert "record 'step': response 'y' moves by " in str(problem)
    assert "while the drive stays as in the first row (u = 1 V) until " in str(problem)
    for level in (0.0, 1.0):
        assert not_at_rest([record.begun(np.array([level]))]) == []
    (problem,) = not_at_rest([record.begun(np.zeros(1))], [replace(record, name="apart")])
    assert "record 'apart'" in str(problem)


def test_a_readback_that_jitters_is_no_change_of_the_drive():
    rng = np.random.default_rng(3)
    record = switched(rng, before=0.0, first=1.0, noise_sd=0.02)
    jitter = record.drive + rng.uniform(-0.004, 0.004, record.drive.shape)
    assert len(not_at_rest([replace(record, drive=jitter)])) == 1
    early = np.vstack((np.zeros((4, 1)), record.drive[4:]))  # a change in row 5 explains what follows
    assert not_at_rest([replace(record, drive=early)]) == []


def test_a_slight_drift_is_left_alone():
    rng = np.random.default_rng(4)
    record = switched(rng, before=1.0, first=1.0, noise_sd=0.002)
    drift = 0.08 * record.time[:, None] / record.time[-1]
    assert not_at_rest([replace(record, response=record.response + drift)]) == []


@pytest.mark.parametrize("correlation", [0.0, 0.5, 0.9])
def test_a_drift_is_straight_in_noise_of_any_correlation_and_a_relaxation_is_not(correlation):
    """Lines are taken for curved in less than 1 % (a failure is more than the 99.9 % quantile of that), and
    relaxations of up to half of the record for straight in none, 200 noise sd large."""
    rng, curved = np.random.default_rng(int(10 * correlation)), 0
    for k in range(60):
        at = np.sort(rng.uniform(0.0, 3.0, (30, 120, 500)[k % 3]))
        scatter = noise(at.size, correlation, rng) / 200
        curved += not straight(at, 2.0 + at / 3.0 + scatter, 1.0)
        lag = rng.uniform(0.1, 1.5)
        assert not straight(at, np.exp(-at / lag) + scatter * (1.0 - np.exp(-3.0 / lag)), 1.0)
    assert curved <= stats.binom.ppf(0.999, 60, 0.01)


def with_moving_dark(shape: np.ndarray) -> Study:
    """A step and a staircase of one lag, and a record without a drive that moves as `shape`, with noise."""
    rng, at = np.random.default_rng(8), np.linspace(0.0, 20.0, 60)
    device = Device(((path(2.0, 0.5, (1.5,), (1.0,)),),), (U,), (Y,), (0.3,))
    changes, levels = at[[0, 9, 35]], np.array([[0.0], [1.0], [-0.5]])
    records = []
    for name, size in (("a", 1.0), ("b", -0.7), ("dark", 0.0)):
        clean = device.response(Command(changes, size * levels, np.zeros(1)), at)[:, 0]
        seen = clean + 0.02 * rng.standard_normal(at.size) + shape * (name == "dark")
        drive = size * np.select([at >= at[35], at >= at[9]], [-0.5, 1.0], 0.0)
        records.append(Record(name, at, drive[:, None], seen[:, None], (U,), (Y,), "ms"))
    return replace(study(records[0]), fit=tuple(records))


def test_the_loop_traces_a_drift_of_a_record_in_which_no_drive_moves():
    drifting = with_moving_dark(0.06 * np.linspace(0.0, 20.0, 60))
    with pytest.raises(InputError, match="along a straight line, as a drift does; `loop` traces one"):
        fit(drifting)
    found = loop(drifting, sample=False, quick=True)
    assert found.names == ("pointing_drift",)
    assert found.verdict.confidence == "tentative"
    assert any("is taken for one. If the drive was another one before" in one for one in found.cautions)
    (k,) = [k for k, name in enumerate(found.after.state.model.names) if "dark" in name and "drift" in name]
    low, high = found.estimate(k)["lower"], found.estimate(k)["upper"]
    # a line through 60 samples of noise 0.02 has a slope of sd 0.0089 over its length, 90 % are 3.3 sd wide
    assert high - low == pytest.approx(0.029, rel=0.5)
    assert abs(0.5 * (low + high) - 1.2) < high - low
    assert not obstacles(found.study)  # what it declares describes the drift
    assert unmet(found.study)


def test_a_dark_record_that_relaxes_is_refused_by_the_loop():
    with pytest.raises(InputError, match=r"at rest there, as the model assumes\. If the drive was another"):
        loop(with_moving_dark(np.exp(-np.linspace(0.0, 20.0, 60) / 4.0)), sample=False, quick=True)


def test_fit_and_loop_refuse_in_words_and_write_nothing(tmp_path, capfd):
    record = switched(np.random.default_rng(5), before=0.0, first=1.0, noise_sd=0.02)
    for refuses in (fit, lambda made: loop(made, sample=False, quick=True)):
        with pytest.raises(InputError, match="not at rest there, as the model assumes"):
            refuses(study(record))
    save_record(record, tmp_path / "step.csv")
    for verb in ("fit", "audit", "loop"):
        out = tmp_path / verb
        code = main([verb, str(tmp_path / "step.csv"), "--out", str(out), "--quick", "--quiet"])
        printed, reported = capfd.readouterr()
        assert (code, printed) == (2, "")
        assert reported.startswith("error: record 'step': response 'y' moves by ")
        assert "add a row before the first (time " in reported
        assert not list(out.glob("*"))


@pytest.mark.skipif(not RECORDS.exists(), reason="no measured records")
def test_measured_records_are_refused_without_the_row_that_states_their_rest():
    """As they stand none is refused; stripped of the early row every switched-on one is, but for a creep
    whose 58 samples, a growth as the logarithm of time, are no better than a random walk."""
    refused = set()
    for file in sorted(RECORDS.glob("*/study.toml")):
        made = load_study(file)
        assert not_at_rest(made.fit, made.held_out) == [], file
        if not_at_rest([stripped(one) for one in made.fit], [stripped(one) for one in made.held_out]):
            refused.add(file.parent.name)
    panels = {file.parent.name for file in RECORDS.glob("lcd_panel_*/study.toml")}
    assert refused == panels | {"hair_dryer", "heating_system", "tclab", "tclab_2x2"}


def stripped(record: Record) -> Record:
    """The record from its first response on."""
    first = int(np.isfinite(record.response).any(axis=1).argmax())
    parts = {key: getattr(record, key)[first:] for key in ("time", "drive", "response")}
    return replace(record, **parts)
