"""Campaigns that a loop must survive: what is done to their records, and what counts as a crash."""

import sys
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies" / "robustness"))

import spoiled

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.settings import ModelSettings, NoiseSettings


def test_spoiled_records_have_the_size_and_the_units_that_are_asked_for():
    own = spoiled.campaign("two lags", [], 1).study(1).fit[0]
    for how in spoiled.SPOILINGS:
        small = spoiled.spoiled(own, how, 25, (10.0, 100.0, 0.1))
        assert 25 <= small.time.size < 50
        assert np.ptp(small.time) <= 10 * np.ptp(own.time)
        assert small.time[0] == 10 * own.time[0]
        assert small.response.shape[1] == own.response.shape[1]
    still = spoiled.spoiled(own, "drive never moves", 25, (1.0, 1.0, 1.0))
    assert np.ptp(still.drive, axis=0).max() == 0
    flat = spoiled.spoiled(own, "constant", 25, (1.0, 1.0, 1.0))
    assert np.nanmax(np.ptp(np.nan_to_num(flat.response, nan=flat.response[0, 0]), axis=0)) == 0


BRIEF = {"model": ModelSettings(terms=1), "noise": NoiseSettings("white")}
"""What a study states that is to be fitted in half the time."""


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("verb", "stated"),
    [
        *(
            pytest.param(verb, {}, id=verb, marks=[pytest.mark.slow] * (verb == "fit"))
            for verb in spoiled.VERBS
        ),
        pytest.param("fit", BRIEF, id="short fit"),
    ],
)
def test_a_campaign_ends_in_a_result(monkeypatch, verb, stated):
    """With more of it `stated` than the campaign does, where a verb takes long."""
    own, said = spoiled.study(405)
    monkeypatch.setattr(spoiled, "study", lambda seed: (replace(own, **stated), said))
    monkeypatch.setattr(spoiled, "DRAWING", 1.0)
    row = spoiled.play((verb, 120), 405)
    assert row["outcome"] in spoiled.RESULTS[verb]
    assert row["cpu_seconds"] > 0


@pytest.mark.parametrize(
    ("raised", "outcome"),
    [
        (ValueError("shapes"), "crashed"),
        (InputError("no drive"), "refused"),
        (TimeoutError(), "not in time"),
        (None, "clean"),
        ("odd", "crashed"),
    ],
)
def test_what_counts_as_a_crash(monkeypatch, raised, outcome):
    def loop(*given, **options):
        if isinstance(raised, str):
            warnings.warn(raised, RuntimeWarning, stacklevel=1)
        elif raised is not None:
            raise raised
        return SimpleNamespace(values={"verdict": "clean"}, summary=lambda: None)

    monkeypatch.setattr(spoiled, "loop", loop)
    row = spoiled.play(("loop", 120), 405)
    assert row["outcome"] == outcome
    text = spoiled.page([row], "command", "loop", 120)
    counts = [cell.strip() for cell in text.splitlines()[-3 if outcome == "crashed" else -2].split("|")]
    assert ("crashed: `" in text) == (outcome == "crashed")
    assert counts.count("1") == 1 or outcome == "crashed"
