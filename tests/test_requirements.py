"""Records that no fit can use are refused by every verb that samples, each in its own words."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import record, study

from lcopa_bayes.cli import main
from lcopa_bayes.fit import fit
from lcopa_bayes.loop.loop import loop
from lcopa_bayes.problems import InputError
from lcopa_bayes.record import Record, save_record
from lcopa_bayes.requirements import unmet

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
        {"exposure": 50.0},
        "the exposure of 50 ms is longer than the 0.2 ms",
    ),
    "exposure over the sampling": (PLAIN, {"exposure": 0.3}, "in which a sample cannot be taken"),
    "constant response": (
        replace(PLAIN, response=np.where(np.isnan(PLAIN.response), np.nan, 0.5)),
        {},
        "response 'y' is constant throughout the fit records (0.5 rad)",
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
    assert unmet(study(PLAIN, exposure=0.2)) == []
    for sound in (scaled(1e-12), scaled(1e12), scaled(1.0, 1e3), with_twin(1e-3)):
        assert unmet(study(sound)) == []


def test_the_command_line_tells_the_exposure_in_the_unit_of_the_records(tmp_path, capfd):
    save_record(replace(PLAIN, time_unit="s"), tmp_path / "step.csv")
    (tmp_path / "study.toml").write_text("[model]\nexposure_ms = 300\n", encoding="utf-8")
    code = main(["fit", str(tmp_path), "--out", str(tmp_path / "run"), "--quick", "--quiet"])
    printed, told = capfd.readouterr()
    assert (code, printed) == (2, "")
    assert told.startswith(
        "error: record 'step': the exposure of 0.3 s is longer than the 0.2 s from one sample"
    )
    assert not (tmp_path / "run").exists()
