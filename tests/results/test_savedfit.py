"""A fit read back from its folder is the fit that was saved; what is no whole run folder is refused."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_array_equal
from small import TWO, record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.drive import Drive
from lcopa_bayes.data.settings import CandidateSettings, CompareSettings, PriorSettings
from lcopa_bayes.data.studywriter import study_from_json, study_to_json
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.runfolder import fingerprint, settings_of
from lcopa_bayes.results.savedfit import fit_to_json, load_fit

TINY = {"target_ess": 50}
HELD = record(3, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.3, name="held")
PAIR = (record(1, camera=0.4, name="a/b"), record(2, camera=0.5, name="b"))


@pytest.fixture(scope="module")
def fitted() -> Fit:
    return fit(study(*PAIR, sampler=TINY, priors={"delay": 0.73}, noise="ar1"))


@pytest.fixture(scope="module")
def folder(fitted, tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    fitted.save(path)
    return path


def test_a_saved_fit_predicts_scores_and_grades_as_it_did(fitted, folder):
    again = load_fit(folder)
    assert_array_equal(again.draws.values, fitted.draws.values)
    assert_array_equal(again.draws.log_density, fitted.draws.log_density)
    assert again.draws.grade == fitted.draws.grade
    assert [one.as_json() for one in again.draws.estimates()] == [
        one.as_json() for one in fitted.draws.estimates()
    ]
    drive = Drive.steps(u=[(0, 1.0), (3, -0.4)], until=9.0)
    assert again.predict(drive).to_json() == fitted.predict(drive).to_json()
    pd.testing.assert_frame_equal(again.predict(drive).table(), fitted.predict(drive).table())
    pd.testing.assert_frame_equal(again.score(HELD), fitted.score(HELD))
    assert again.frequency_response().to_json() == fitted.frequency_response().to_json()
    pd.testing.assert_frame_equal(again.step_metrics(), fitted.step_metrics())
    # the posterior is that of the fit as well, narrower blocks included
    some = fitted.draws.flat[:5]
    assert_array_equal(
        again.problem.posterior.joint_log_likelihood(some),
        fitted.problem.posterior.joint_log_likelihood(some),
    )


def test_the_exposure_of_a_study_in_seconds_survives_its_copy_exactly():
    slow = study(replace(record(1), time_unit="s"), exposure_ms=0.1 / 3)
    again = study_from_json(json.loads(json.dumps(study_to_json(slow))))
    assert again.exposure == slow.exposure == 0.1 / 3 / 1000


def test_a_study_survives_its_copy_exactly():
    first = record(1, device=TWO, camera=0.37, name="x y")
    known = study(
        first,
        held_out=(record(2, device=TWO, camera=0.41, name="other"),),
        priors={"delay": 0.1, "sigma_x": ("loguniform", {"a": 0.001, "b": 1.0})},
        terms={"direct": 2, "cross": 1},
        exposure_ms=0.05,
        sampler=TINY,
    )
    prior = PriorSettings("delay", dist="norm", parameters={"loc": 0.1, "scale": 0.2})
    candidate = CandidateSettings(
        "rival", orders=(2.0, 1.0), priors={"delay": prior, "gain": PriorSettings("gain", dist="flat")}
    )
    known = type(known)(
        **{key: getattr(known, key) for key in known.__dataclass_fields__}
        | {"candidates": (candidate,), "compare": CompareSettings(("rival",)), "stages": ("fit",)}
    )
    again = study_from_json(json.loads(json.dumps(study_to_json(known), allow_nan=False)))
    assert settings_of(again) == settings_of(known)
    assert (again.candidates, again.compare, again.stages) == (known.candidates, known.compare, known.stages)
    for one, other in zip((*known.fit, *known.held_out), (*again.fit, *again.held_out), strict=True):
        for name in ("time", "drive", "response"):
            assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.name, one.drive_axes, one.response_axes) == (
            other.name,
            other.drive_axes,
            other.response_axes,
        )


def altered(folder, tmp_path, **changes):
    """A copy of the run folder with other values in fit.json."""
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    values = json.loads((copy / "fit.json").read_text()) | changes
    (copy / "fit.json").write_text(json.dumps(values))
    return copy


def cut(name: str, share: float):
    def do(copy):
        whole = (copy / name).read_bytes()
        (copy / name).write_bytes(whole[: int(share * len(whole))])

    return do


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (shutil.rmtree, "there is no such run folder"),
        (lambda copy: (copy / "fit.json").unlink(), "fit.json: this file of the run folder is missing"),
        (lambda copy: (copy / "posterior.nc").unlink(), "posterior.nc: this file of the run folder"),
        (cut("fit.json", 0.5), "fit.json: cannot be read"),
        (cut("posterior.nc", 0.5), "posterior.nc: cannot be read as draws"),
        (cut("posterior.nc", 0.0), "posterior.nc: cannot be read as draws"),
        (lambda copy: (copy / "fit.json").write_text("[]"), "no JSON object"),
    ],
)
def test_a_folder_that_was_cut_short_is_refused_in_one_sentence(folder, tmp_path, spoil, words):
    copy = altered(folder, tmp_path)
    spoil(copy)
    with pytest.raises(InputError) as raised:
        load_fit(copy)
    (known,) = raised.value.problems
    assert words in known


def test_another_version_another_fit_and_other_contents_are_refused(folder, fitted, tmp_path):
    for number, (changes, words) in enumerate(
        (
            ({"version": "0.0.1"}, "was written by lcopa-bayes 0.0.1, this is"),
            ({"draws_sha256": "0"}, "does not hold the draws of"),
            ({"study": {"name": "x"}}, "does not hold a fit"),
            ({"qualities": [{"name": "gain"}]}, "does not hold a fit"),
        )
    ):
        with pytest.raises(InputError, match=words) as raised:
            load_fit(altered(folder, tmp_path / str(number), **changes))
        assert len(raised.value.problems) == 1


def test_narrower_blocks_are_kept(folder, fitted, tmp_path):
    finer = fitted.problem.refined(3)
    again = load_fit(altered(folder, tmp_path, **fit_to_json(finer, fitted.draws)))
    assert again.problem.refinement == finer.refinement
    some = fitted.draws.flat[:3]
    density = [one.posterior.joint_log_likelihood(some) for one in (again.problem, finer, fitted.problem)]
    assert_array_equal(density[0], density[1])
    assert np.abs(density[0] - density[2]).max() > 1e-9


def test_the_copy_has_the_fingerprint_of_the_study(fitted, folder):
    plan = fitted.run.plan
    assert fingerprint(load_fit(folder).study, plan) == fingerprint(fitted.study, plan)
    assert np.isfinite(load_fit(folder).draws.values).all()
