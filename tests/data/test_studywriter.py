"""A study that was written is read again as the same study."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from small import TWO, record, study

from lcopa_bayes.data.settings import EffectsSettings, PriorSettings
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.data.studywriter import write_study

OWN = """
from dataclasses import dataclass
from lcopa_bayes.model.effects.dynamics import CubicStiffness


class Mine(CubicStiffness):
    pass
"""


def test_every_setting_and_number_comes_back(tmp_path: Path):
    made = study(
        *(record(k, device=TWO, name=f"r{k}", duration=6.0) for k in (1, 2)),
        held_out=[record(3, device=TWO, name="r 3", duration=6.0)],
        noise="white+ar1",
        priors={"delay": ("uniform", {"loc": 0.1, "scale": 1 / 3}), "time_1_direct": 1 / 7},
        sampler={"ensembles": 3, "target_ess": 250},
        terms={"direct": 2, "cross": 1},
        exposure_ms=0.01,
        blocks=300,
    )
    made = replace(
        made,
        effects=EffectsSettings(use=("clipping", "vibration"), deflection={"x": 1 / 3}, speed=0.7),
        priors=dict(made.priors) | {"vibration.a_x[r1]": PriorSettings("vibration.a_x[r1]", fixed=0.25)},
    )
    paths = write_study(made, tmp_path / "explained.toml", note="Two lines\nof a note.")
    again = load_study(tmp_path / "explained.toml")
    assert paths[-1].read_text().startswith("# Two lines\n# of a note.\n\n[study]")
    assert len(paths) == 4
    for one, other in zip((*made.fit, *made.held_out), (*again.fit, *again.held_out), strict=True):
        assert one.name == other.name
        for key in ("time", "drive", "response"):
            np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    for key in ("name", "time_unit", "seed", "model", "noise", "sampler", "effects"):
        assert getattr(made, key) == getattr(again, key), key
    assert dict(made.priors) == dict(again.priors)


def test_effects_of_ones_own_are_found_from_the_new_folder(tmp_path: Path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "own.py").write_text(OWN)
    made = replace(
        study(record(1, duration=6.0)), folder=tmp_path / "a", effects=EffectsSettings(add=("own.py:Mine",))
    )
    write_study(made, tmp_path / "explained.toml")
    assert load_study(tmp_path / "explained.toml").effects.add == ("a/own.py:Mine",)
