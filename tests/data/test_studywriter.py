"""A study that was written is read again as the same study."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small import TWO, record, study

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.settings import EffectsSettings, PriorSettings
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.data.studywriter import write_folder, write_study

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
    assert load_study(tmp_path / "explained.toml", trust=True).effects.add == ("a/own.py:Mine",)


def plain(*names: str, held_out: str = "", seed: int = 7):
    made = [record(k, name=name, duration=6.0) for k, name in enumerate(names, start=1)]
    return study(*made, held_out=[record(9, name=held_out, duration=6.0)] if held_out else [], seed=seed)


def test_a_folder_holds_the_records_and_a_short_study(tmp_path: Path):
    folder, made = tmp_path / "new" / "paper", plain("on", "off 2", held_out="xy")
    paths = write_folder(folder, made, notes=["Of a bench."], settings="[model]\nterms = 1\n")
    assert sorted(folder.iterdir()) == sorted(paths)
    text = paths[-1].read_text(encoding="utf-8")
    assert text.startswith("# Of a bench.\n\n[study]")
    assert tomllib.loads(text) == {
        "study": {"name": made.name, "time_unit": "ms", "seed": 7},
        "records": {"fit": ["on.csv", "off 2.csv"], "held_out": ["xy.csv"]},
        "model": {"terms": 1},
    }
    again = load_study(folder)
    for one, other in zip((*made.fit, *made.held_out), (*again.fit, *again.held_out), strict=True):
        assert (one.drive_axes, one.response_axes) == (other.drive_axes, other.response_axes)
        for key in ("time", "drive", "response"):
            np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    assert list(again.summary()["held_out"]) == [False, False, True]


def test_a_folder_is_written_over_only_when_asked(tmp_path: Path):
    write_folder(tmp_path, plain("on"))
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    with pytest.raises(InputError, match="is there already") as caught:
        write_folder(tmp_path, plain("off", "on", seed=8))
    assert len(caught.value.problems) == 2  # on.csv and study.toml
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before
    write_folder(tmp_path, plain("off", "on", seed=8), overwrite=True)
    assert load_study(tmp_path).seed == 8


def test_a_record_without_a_name_for_a_file_is_refused(tmp_path: Path):
    with pytest.raises(InputError, match=r"'\.\./up'"):
        write_folder(tmp_path / "new", plain("../up"))
    assert not list(tmp_path.iterdir())


def test_a_folder_cut_short_holds_no_part(tmp_path: Path, monkeypatch):
    def fail(one, path):
        path.write_text("half")
        raise KeyboardInterrupt

    monkeypatch.setattr("lcopa_bayes.data.studywriter.save_record", fail)
    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path, plain("on"))
    assert not list(tmp_path.iterdir())
