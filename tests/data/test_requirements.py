"""Records that no fit can use are refused by every verb that samples, each in its own words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import U, Y, path, record, study

from lcopa_bayes.bench.command import Command
from lcopa_bayes.bench.device import Device
from lcopa_bayes.cli import main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Record, save_record
from lcopa_bayes.data.requirements import unmet
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.results.discretisation import resolved
from lcopa_bayes.results.fit import fit

PLAIN = record()


def with_twin(gap: float) -> Record:
    """The record with one sample more, `gap` after another."""
    at = int(np.searchsorted(PLAIN.time, 4.0))
    parts = {key: np.insert(getattr(PLAIN, key), at + 1, getattr(PLAIN, key)[at], axis=0)
             for key in ("drive", "response")}  # fmt: skip
    return replace(PLAIN, time=np.insert(PLAIN.time, at + 1, PLAIN.time[at] + gap), **parts)


def scaled(factor: float, level: float = 0.0) -> Record:
    return replace(PLAIN, drive=level + factor * PLAIN.drive)


BAD = {
    "exposure over the record": (
        PLAIN,
        {"exposure_ms": 50.0},
        "the exposure of 50 ms is longer than the 0.2 ms",
    ),
    "exposure over the sampling": (PLAIN, {"exposure_ms": 0.3}, "in which a sample cannot be taken"),
    "constant response": (
        replace(PLAIN, response=np.where(np.isnan(PLAIN.response), np.nan, 0.5)),
        {},
        "response y is constant throughout the fit records (0.5 rad)",
    ),
    "rounding": (scaled(1e-12, 5.0), {}, "which is rounding"),
    "far too small": (scaled(1e-300), {}, "drive 'u' has a range of 1e-300 V"),
    "twins": (with_twin(1e-9), {}, "as if one were read twice"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_no_fit_can_use_is_refused_in_words(name):
    bad, model, words = BAD[name]
    made = study(bad, **model)
    (problem,) = unmet(made)
    assert words in problem
    for refuses in (fit, lambda made: loop(made, sample=False, quick=True)):
        with pytest.raises(InputError) as caught:
            refuses(made)
        assert caught.value.problems == (problem,)


def test_what_is_unusual_but_sound_is_fitted():
    assert unmet(study(PLAIN)) == []
    assert unmet(study(PLAIN, exposure_ms=0.2)) == []
    for sound in (scaled(1e-12), scaled(1e12), scaled(1.0, 1e3), with_twin(1e-3)):
        assert unmet(study(sound)) == []


def test_the_command_line_tells_the_exposure_in_the_unit_of_the_records(tmp_path, capfd):
    save_record(replace(PLAIN, time_unit="s"), tmp_path / "step.csv")
    (tmp_path / "study.toml").write_text("[model]\nexposure_ms = 300\n", encoding="utf-8")
    code = main(["fit", str(tmp_path), "--out", str(tmp_path / "run"), "--quick", "--quiet"])
    printed, reported = capfd.readouterr()
    assert (code, printed) == (2, "")
    assert reported.startswith(
        "error: record 'step': the exposure of 0.3 s is longer than the 0.2 s from one sample"
    )
    assert not (tmp_path / "run").exists()


ORDINARY = {"gain": 2.0, "time_1": 1.5, "order_1": 0.9, "delay": 0.53, "offset": 0.3}
EVERY = 0.2 * np.arange(60.0)
SOUND = {
    "exposure longer than the delay": ({"delay": 0.05}, EVERY, (1.0,), (1.0,), 0.19),
    "delay below a sample": ({"delay": 0.03}, EVERY, (1.0,), (1.0,), 0.0),
    "time constant below a sample": ({"time_1": 0.12}, EVERY, (1.0, 4.07), (1.0, 0.0), 0.0),
    "changes between samples": ({}, EVERY, (1.07, 4.33), (1.0, 0.0), 0.0),
    "a pulse between two samples": ({}, EVERY, (1.05, 1.1), (20.0, 0.0), 0.0),
    "irregular samples": ({}, np.sort(np.random.default_rng(8).uniform(0, 12, 60)), (0.9,), (1.0,), 0.0),
    "bursts": ({}, np.r_[np.arange(0, 1, 0.02), np.arange(1, 12, 0.5)], (0.31,), (1.0,), 0.0),
    "samples over decades": ({}, np.geomspace(0.01, 100, 60), (0.05,), (1.0,), 0.0),
    "clock of years": ({}, EVERY, (1.07,), (1.0,), 0.0),
}


@pytest.mark.parametrize("name", SOUND)
def test_unusual_records_give_the_truth_of_the_bench(name):
    """Least-squares optima at noise of 0.2 % of the response, within 4.5 of their own standard deviations."""
    changed, times, changes, levels, exposure = SOUND[name]
    truth = ORDINARY | changed
    device = Device(
        ((path(truth["gain"], truth["delay"], (truth["time_1"],), (truth["order_1"],)),),), (U,), (Y,), (0.3,)
    )
    command = Command(np.array(changes), np.array(levels)[:, None], np.zeros(1))
    exact = device.response(command, times, exposure=exposure)
    rows = np.union1d(np.r_[times[0] - 1.0, times], changes)
    drive = np.r_[0.0, levels][np.searchsorted(changes, rows, side="right")]
    response = np.full((rows.size, 1), np.nan)
    noisy = exact + 0.002 * np.ptp(exact) * np.random.default_rng(1).standard_normal(exact.shape)
    response[np.searchsorted(rows, times)] = noisy
    rows = rows + (1.7e12 if name == "clock of years" else 0.0)  # to 0.001 of a sample in double precision
    made = study(Record("r", rows, drive[:, None], response, (U,), (Y,), "ms"), exposure_ms=exposure)
    assert unmet(made) == []
    posterior = resolved(problem_of(made)).posterior
    best = find_optima(posterior, np.random.default_rng(0), starts=6)[0]
    reported = dict(zip(posterior.table.names, best.values, strict=True))
    spread = dict(
        zip(
            [posterior.table.names[k] for k in posterior.sampled],
            np.sqrt(np.diag(best.covariance)),
            strict=True,
        )
    )
    for key in ("time_1", "order_1", "delay"):
        size = truth[key] if key == "time_1" else 1.0  # sampled by its logarithm
        assert abs(reported[key] - truth[key]) < 4.5 * spread[key] * size, (key, reported[key], spread[key])
