"""The door for studies: defaults, what is refused and in which words, and that all is reported at once."""

import hashlib
import os
import pickle
import time
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import (
    ModelSettings,
    NoiseSettings,
    PriorSettings,
    RecordsSettings,
    SamplerSettings,
)
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.inference.assembly import problem_of

HEADER = "time_ms,drive_x_rad,response_x_rad\n"
STEP = HEADER + "0,0,\n0.5,1,0.1\n1.5,1,0.2\n"
QUIET = HEADER + "0,1,0\n1,1,0\n"
PAIR = "time_ms,drive_x_rad,drive_y_V,response_x_rad\n0,0,1,0\n1,1,2,0\n2,1,2,0\n"
FLIPPED = "time_ms,response_x_rad,drive_y_V,drive_x_rad\n0,7,1,5\n1,7,1,5\n2,7,1,5\n"
RECORDS = Path(os.environ.get("LCOPA_BAYES_DATA", Path(__file__).parents[2] / ".." / "shared")) / "records"


def folder_of(tmp_path: Path, text: str, **files: str) -> Path:
    folder = tmp_path / "bench"
    folder.mkdir(exist_ok=True)
    (folder / "study.toml").write_text(text, encoding="utf-8")
    for stem, content in (files or {"step": STEP}).items():
        (folder / f"{stem}.csv").write_text(content, encoding="utf-8")
    return folder


def problems_of(*args: object, **kwargs: object) -> tuple[str, ...]:
    with pytest.raises(InputError) as caught:
        load_study(*args, **kwargs)  # type: ignore[arg-type]
    return caught.value.problems


def test_three_lines_are_a_study(tmp_path):
    folder = folder_of(tmp_path, '[study]\nname = "paper-step"\nseed = 7\n', step=STEP, again=STEP)
    (folder / ".step-unfinished.csv").write_text("", encoding="utf-8")
    study = load_study(folder)
    (folder / ".step-unfinished.csv").unlink()
    assert (study.name, study.folder, study.time_unit, study.seed) == ("paper-step", folder, "ms", 7)
    assert [record.name for record in study.fit] == ["again", "step"]
    assert study.held_out == ()
    assert study.drive_axes == study.response_axes == (Axis("x", "rad"),)
    model = ModelSettings(share="paper", delay="shared")
    assert (study.model, study.noise, study.sampler) == (model, NoiseSettings(), SamplerSettings())
    assert dict(study.priors) == {}
    assert study.stages == ("fit", "rival")
    expected = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in os.listdir(folder)}
    assert dict(study.inputs) == expected
    assert load_study(folder / "study.toml").inputs == study.inputs


def test_an_empty_study_file_is_a_study(tmp_path):
    assert load_study(folder_of(tmp_path, "")).name == "bench"


SECONDS = STEP.replace("time_ms", "time_s")


def test_times_are_in_the_unit_of_the_records_unless_the_study_states_one(tmp_path):
    """A record means the same alone and beside a study file; the exposure stays in ms in the file."""
    alone = load_study([folder_of(tmp_path, "", step=SECONDS) / "step.csv"])
    beside = load_study(folder_of(tmp_path, "[model]\nexposure_ms = 250\n", step=SECONDS))
    stated = load_study(
        folder_of(tmp_path, '[study]\ntime_unit = "ms"\n[model]\nexposure_ms = 250\n', step=SECONDS)
    )
    assert (alone.time_unit, beside.time_unit, stated.time_unit) == ("s", "s", "ms")
    for study, last, exposure in ((alone, 1.5, 0.0), (beside, 1.5, 0.25), (stated, 1500.0, 250.0)):
        assert study.fit[0].time_unit == study.time_unit
        assert study.fit[0].time[-1] == last
        assert study.exposure == exposure


def test_priors_of_a_study_are_in_the_unit_of_its_records(tmp_path):
    """Default priors and stated ones speak of the same seconds: the study in ms has them a thousandfold."""

    def table(text):
        study = load_study(folder_of(tmp_path, text, step=LONGER))
        return {row.name: row for row in problem_of(study).posterior.table.rows}

    own = table("[priors]\ntime_1 = 0.7\n")
    milli = table('[study]\ntime_unit = "ms"\n[priors]\ntime_1 = 700\n')
    assert (own["time_1"].unit, own["delay"].unit, milli["delay"].unit) == ("s", "s", "ms")
    assert (own["time_1"].value, milli["time_1"].value) == (0.7, 700.0)
    assert milli["delay"].domain[1] == pytest.approx(1000 * own["delay"].domain[1], rel=1e-12)


LONGER = "time_s,drive_x_rad,response_x_rad\n0,0,\n" + "".join(f"{k},1,{1 - 0.8**k}\n" for k in range(1, 20))


def test_records_in_other_units_are_converted_to_that_of_the_first(tmp_path):
    folder = folder_of(tmp_path, '[records]\nfit = ["b.csv", "a.csv"]\n', a=STEP, b=SECONDS)
    study = load_study(folder)
    assert study.time_unit == "s"
    assert_allclose(study.fit[1].time, [0, 0.0005, 0.0015], rtol=1e-15)


@pytest.mark.parametrize(
    "path",
    sorted((Path(__file__).parents[2] / "studies").rglob("study.toml")),
    ids=lambda path: path.parent.name,
)
def test_bundled_studies_are_in_milliseconds(path):
    assert load_study(path).time_unit == "ms"


FULL = """
[study]
time_unit = "us"
seed = 3
[records]
held_out = ["b.csv"]
[model]
orders = [2, 1, 1]
share = "none"
delay = "path"
offset = "shared"
blocks = 128
exposure_ms = 0.25
[priors]
delay = 3.027
gain = {dist = "loguniform", a = 1e-3, b = 10}
[priors.order]
dist = "beta"
a = 2
b = 2
scale = 2
[noise]
kind = "student"
[sampler]
ensembles = 3
walkers = 32
steps = 5000
target_ess = 100
thin = 2
[stages]
fit = true
"""


def test_every_setting_arrives(tmp_path):
    study = load_study(folder_of(tmp_path, FULL, a=STEP, b=QUIET))
    np.testing.assert_allclose(study.fit[0].time, [0, 500, 1500], rtol=1e-15)
    assert [r.name for r in study.held_out] == ["b"]
    assert study.model == ModelSettings(3, (2.0, 1.0, 1.0), "none", "path", "shared", 128, 0.25)
    assert study.exposure == 250.0
    assert study.noise == NoiseSettings("student")
    assert study.sampler == SamplerSettings(3, 32, 5000, 100, 2)
    assert study.priors["delay"].fixed == 3.027
    gain, order = study.priors["gain"].frozen(), study.priors["order"].frozen()
    assert gain.logpdf(0.1) == stats.loguniform(1e-3, 10).logpdf(0.1)
    assert order.pdf(1.3) == stats.beta(2, 2, scale=2).pdf(1.3)
    assert study.stages == ("fit",)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[modl]\nterms = 1", ["unknown table [modl]", "'model'"]),
        ("[[candidate]]\nname = 3", ["unknown table [candidate]", "'candidates'"]),
        ("seed = 1", ["key 'seed' stands above all tables", "[study]"]),
        ('[study]\nnam = "a"', ["[study]", "unknown key 'nam'", "'name'"]),
        ('[study]\nname = "a/b"', ["[study]", "`name`", "'a/b'"]),
        ("[study]\nname = 3", ["[study]", "`name`", "3"]),
        ('[study]\ntime_unit = "mss"', ["[study]", "`time_unit`", "did you mean 'ms'?"]),
        ("[study]\nseed = -1", ["[study]", "`seed`", "at least 0", "-1"]),
        ("[study]\nseed = 1.5", ["[study]", "`seed`", "whole number", "1.5"]),
        ("[study]\nseed = true", ["[study]", "`seed`", "True"]),
        ("priors = 3", ["[priors]", "must be a table", "3"]),
        ("study = 3", ["[study]", "must be a table", "3"]),
        ('[records]\nheldout = ["step.csv"]', ["[records]", "'heldout'", "'held_out'"]),
        ('[records]\nfit = "step.csv"', ["[records]", "`fit`", "list of file names"]),
        ("[records]\nfit = []", ["[records]", "`fit` names no record"]),
        ('[records]\nheld_out = ["step.csv"]', ["[records]", "no record to fit"]),
        ('[records]\nfit = ["stp.csv"]', ["stp.csv", "no such file", "did you mean 'step.csv'?"]),
        (
            '[records]\nfit = ["step.csv"]\nheld_out = ["step.csv"]',
            ["step.csv", "held_out", "already in fit"],
        ),
        ('[records]\nfit = ["step.csv", "./step.csv"]', ["step.csv", "already in fit"]),
        ("[model]\nterm = 2", ["[model]", "'term'", "'terms'"]),
        ("[model]\nterms = 7", ["[model]", "`terms`", "from 1 to 6", "7"]),
        ("[model]\nterms = 0", ["[model]", "`terms`", "0"]),
        ("[model]\nterms = {xx = 2, xy = 1.5}", ["[model]", "`terms.xy`", "1.5"]),
        ("[model]\nterms = {}", ["[model]", "`terms` names no element"]),
        ('[model]\norders = "fixed"', ["[model]", "`orders`", "'fixed'"]),
        ("[model]\norders = [1, 2]", ["[model]", "`orders` must not increase"]),
        ("[model]\norders = [2.5, 1]", ["[model]", "`orders`", "(0, 2]", "2.5"]),
        ("[model]\norders = [1, 0]", ["[model]", "`orders`", "(0, 2]"]),
        ("[model]\norders = [nan]", ["[model]", "`orders`", "nan"]),
        ("[model]\norders = []", ["[model]", "`orders`", "[]"]),
        ("[model]\nterms = 3\norders = [2, 1]", ["[model]", "one order per term", "3"]),
        ('[model]\nshare = "papr"', ["[model]", "`share`", "'papr'", "'paper'"]),
        ("[model]\ndelay = 3", ["[model]", "`delay`", "shared, element, path", "3"]),
        ('[model]\noffset = "all"', ["[model]", "`offset`", "record, shared, none"]),
        ("[model]\nblocks = 1", ["[model]", "`blocks`", "at least 2"]),
        ("[model]\nexposure_ms = -1", ["[model]", "`exposure_ms`", "-1"]),
        ("[model]\nexposure_ms = inf", ["[model]", "`exposure_ms`", "inf"]),
        ("[model]\nexposure = 1", ["[model]", "'exposure'", "'exposure_ms'"]),
        ('[priors]\ngain = {dist = "nrm"}', ["[priors]", "'gain'", "'nrm'", "'norm'"]),
        ('[priors]\ngain = {dist = "norm", sclae = 1}', ["[priors]", "'gain'", "'sclae'", "'scale'"]),
        ('[priors]\ngain = {dist = "beta", a = 1}', ["[priors]", "'gain'", "needs its parameter 'b'"]),
        ('[priors]\ngain = {dist = "norm", scale = -1}', ["[priors]", "'gain'", "out of range"]),
        ('[priors]\ngain = {dist = "norm", scale = 0}', ["[priors]", "'gain'", "out of range"]),
        ('[priors]\ngain = {dist = "loguniform", a = 2, b = 1}', ["[priors]", "'gain'", "out of range"]),
        ('[priors]\ngain = {dist = "uniform", scale = inf}', ["[priors]", "'gain'", "'scale'", "finite"]),
        ('[priors]\ngain = {dist = "norm", loc = "0"}', ["[priors]", "'gain'", "'loc'", "finite number"]),
        ('[priors]\ngain = {dist = "poisson", mu = 1}', ["[priors]", "'gain'", "'poisson'"]),
        (
            '[priors]\ngain = {dist = "flat"}',
            ["[priors]", "'gain'", "flat is no distribution", "only a candidate"],
        ),
        ("[priors]\ngain = {loc = 1}", ["[priors]", "'gain'", "dist ="]),
        ("[priors]\ngain = nan", ["[priors]", "'gain'", "finite"]),
        ('[priors]\ngain = "norm"', ["[priors]", "'gain'", "'norm'"]),
        ('[noise]\nkind = "ar"', ["[noise]", "`kind`", "'ar1'"]),
        ("[sampler]\nensembles = 1", ["[sampler]", "`ensembles`", "at least 2"]),
        ("[sampler]\nwalkers = 3", ["[sampler]", "`walkers`", "at least 4"]),
        ("[sampler]\nsteps = 0", ["[sampler]", "`steps`", "at least 1"]),
        ('[sampler]\ntarget_ess = "many"', ["[sampler]", "`target_ess`", "'many'"]),
        ("[sampler]\nthin = 0", ["[sampler]", "`thin`", "at least 1"]),
        ("[sampler]\nseconds = 0", ["[sampler]", "`seconds`", "0"]),
        ("[sampler]\nwalker = 8", ["[sampler]", "'walker'", "'walkers'"]),
        ("[stages.fits]\na = 1", ["[stages]", "'fits'", "'fit'"]),
        ('stages = ["fit", "fitt"]', ["[stages]", "'fitt'", "'fit'"]),
        ("[stages]\nfit = {most = 2}", ["[stages]", "`fit`", "true or false", "'most'"]),
        ("[stages]\nfit = 3", ["[stages]", "`fit`", "true or false", "3"]),
        ("[stages]\nfit = false", ["[stages]", "names no stage"]),
        ('stages = "fit"', ["[stages]", "must be a table or a list", "'fit'"]),
    ],
)
def test_a_bad_setting_is_one_problem_that_names_file_table_and_key(tmp_path, text, words):
    (problem,) = problems_of(folder_of(tmp_path, text + "\n"))
    assert str(tmp_path / "bench") in problem
    for part in words:
        assert part in problem
    assert sorted(os.listdir(tmp_path / "bench")) == ["step.csv", "study.toml"]


@pytest.mark.parametrize(
    ("text", "line"),
    [("[study]\nseed = \n", 2), ("[study]\nseed = 1\nseed = 2\n", 3), ('[study]\nname = "a', 2)],
)
def test_bad_toml_is_named_by_line(tmp_path, text, line):
    (problem,) = problems_of(folder_of(tmp_path, text))
    assert "study.toml: is not valid TOML" in problem
    assert f"at line {line}" in problem


def test_a_key_without_end_is_refused_at_once(tmp_path):
    """The reader of TOML takes minutes over it, as a list of as many numbers does not."""
    began = time.process_time()
    (problem,) = problems_of(folder_of(tmp_path, "a." * 50_000 + "a = 1\n"))
    assert "a key of more than 200 parts" in problem
    assert time.process_time() - began < 2.0
    (problem,) = problems_of(folder_of(tmp_path, f"[model]\nodd = [{'0.5, ' * 5_000}]\n"))
    assert "unknown key 'odd'" in problem


def test_study_files_that_cannot_be_read(tmp_path):
    assert "holds neither a study.toml nor a record" in problems_of(tmp_path)[0]
    (tmp_path / "camera.toml").write_text("")
    assert problems_of(tmp_path / "camra.toml")[0].endswith("no such file; did you mean 'camera.toml'?")
    folder_of(tmp_path, "")
    (tmp_path / "bench" / "study.toml").write_bytes("[study]\nname = 'ä'".encode("latin-1"))
    assert "cannot be read as UTF-8" in problems_of(tmp_path / "bench")[0]
    assert "no study" in problems_of([])[0]
    assert "no such file" in problems_of(tmp_path / "elsewhere")[0]


def test_problems_of_the_study_file_and_all_records_come_together(tmp_path):
    text = '[study]\nseed = "x"\n[model]\ntermz = 3\n[priors]\ngain = {dist = "nrm"}\n'
    text += '[records]\nfit = ["a.csv", "b.csv"]\nheld_out = ["c.csv", "d.csv"]\n'
    bad = HEADER + "0,0,0\n1,one,0\n"
    reported = problems_of(folder_of(tmp_path, text, a=bad, b=STEP, c=bad, e=STEP))
    for part in (
        "`seed`",
        "'termz'",
        "'nrm'",
        "a.csv, line 3, column 'drive_x_rad'",
        "c.csv, line 3",
        "d.csv: no such",
    ):
        assert sum(part in problem for problem in reported) == 1
    assert len(reported) == 6


def test_columns_take_the_order_of_the_first_record(tmp_path):
    study = load_study(folder_of(tmp_path, '[records]\nfit = ["a.csv", "b.csv"]', a=PAIR, b=FLIPPED))
    assert study.drive_axes == (Axis("x", "rad"), Axis("y", "V"))
    assert study.fit[1].drive_axes == study.drive_axes
    np.testing.assert_array_equal(study.fit[1].drive, [[5, 1]] * 3)


@pytest.mark.parametrize(
    ("held_out", "words"),
    [
        (PAIR.replace("drive_y", "drive_z"), ["drive axis 'z' is in V", "absent"]),
        (PAIR.replace("drive_y", "drive_z"), ["drive axis 'y' is absent", "in V"]),
        (PAIR.replace("drive_y_V", "drive_y_mV"), ["drive axis 'y' is in mV", "in V"]),
        (PAIR.replace("drive_y_V", "response_y_V"), ["response axis 'y' is in V", "absent"]),
        (PAIR.replace("response_x_rad", "response_x_deg"), ["response axis 'x' is in deg", "in rad"]),
    ],
)
def test_another_axis_is_named_with_its_record(tmp_path, held_out, words):
    text = '[records]\nfit = ["a.csv"]\nheld_out = ["later.csv"]'
    reported = problems_of(folder_of(tmp_path, text, a=PAIR, later=held_out))
    assert any(all(part in p for part in ("record 'later'", "record 'a'", *words)) for p in reported)


@pytest.mark.parametrize("rows", ["0,1,0\n1,1,0\n2,1,0\n", "0,1,0\n1,1,0\n2,2,0\n", "0,1,0\n1,2,\n"])
def test_a_drive_that_never_acts_teaches_nothing(tmp_path, rows):
    folder = folder_of(tmp_path, '[records]\nfit = ["a.csv"]', a=HEADER + rows, b=STEP)
    (problem,) = problems_of(folder)
    assert "the drive is constant throughout the fit records" in problem
    load_study(folder_of(tmp_path, "", a=HEADER + rows, b=STEP))  # one record that teaches is enough


def test_records_that_were_not_read_are_not_judged(tmp_path):
    reported = problems_of(folder_of(tmp_path, "", a=QUIET, b=HEADER + "0,0,0\n1,one,0\n"))
    assert len(reported) == 1
    assert "b.csv, line 3" in reported[0]


def test_axes_and_constant_drive_are_reported_together(tmp_path):
    reported = problems_of(folder_of(tmp_path, "", a=QUIET, b=QUIET.replace("drive_x", "drive_y")))
    assert len(reported) == 3
    assert "the drive is constant" in reported[-1]


def test_a_response_axis_without_samples_is_refused(tmp_path):
    silent = "time_ms,drive_x_rad,response_x_rad,response_y_rad\n0,0,0,\n1,1,0,\n2,1,0,\n"
    (problem,) = problems_of(folder_of(tmp_path, "", a=silent))
    assert "response axis 'y' has no sample" in problem


def test_records_need_names_of_their_own(tmp_path):
    folder = folder_of(tmp_path, '[records]\nfit = ["step.csv", "more/step.csv"]')
    (folder / "more").mkdir()
    (folder / "more" / "step.csv").write_text(STEP, encoding="utf-8")
    (problem,) = problems_of(folder)
    assert "2 records are named 'step'" in problem


def test_record_files_alone_are_a_study(tmp_path):
    seconds = STEP.replace("time_ms", "time_s")
    folder = folder_of(tmp_path, "", a=seconds, b=STEP, c=STEP)
    study = load_study([folder / "a.csv", folder / "b.csv"], held_out=[folder / "c.csv"])
    assert (study.name, study.folder, study.time_unit, study.seed) == ("a-b", None, "s", 0)
    np.testing.assert_allclose(study.fit[1].time, [0, 0.5e-3, 1.5e-3], rtol=1e-12)
    assert [record.name for record in study.held_out] == ["c"]
    assert list(study.inputs) == ["a.csv", "b.csv", "c.csv"]
    assert load_study(folder / "b.csv").name == "b"
    folder_of(tmp_path, "", d=STEP, e=STEP)
    assert load_study([folder / f"{stem}.csv" for stem in "abcde"]).name == "a-b-c-and-2-more"
    assert "already in fit" in problems_of(folder / "a.csv", held_out=[folder / "a.csv"])[0]
    both = problems_of([folder, folder / "a.csv"])
    assert any("is not a record" in problem for problem in both)


def test_more_records_can_be_held_out(tmp_path):
    study = load_study(folder_of(tmp_path, "", a=STEP, b=STEP), held_out=[tmp_path / "bench" / "b.csv"])
    assert ([r.name for r in study.fit], [r.name for r in study.held_out]) == (["a"], ["b"])


def test_a_study_is_locked_and_can_be_sent_to_another_process(tmp_path):
    text = FULL.replace("orders = [2, 1, 1]", "terms = {xx = 2, xy = 1}")
    study = load_study(folder_of(tmp_path, text, a=STEP, b=QUIET))
    for one in (study, pickle.loads(pickle.dumps(study))):
        assert (one.model, one.priors, one.stages, one.inputs) == (
            study.model,
            study.priors,
            study.stages,
            study.inputs,
        )
        assert one.model.terms == {"xx": 2, "xy": 1}
        for mapping in (one.priors, one.inputs, one.model.terms):
            with pytest.raises(TypeError):
                mapping["other"] = 1  # type: ignore[index]
        np.testing.assert_array_equal(one.fit[0].response, study.fit[0].response)


def test_a_study_made_by_hand_is_checked_too(tmp_path):
    (record,) = load_study(folder_of(tmp_path, "")).fit
    assert Study("mine", None, "ms", 0, (record,)).model == ModelSettings().for_plant(1, 1)
    with pytest.raises(InputError, match="record 'step' is in ms"):
        Study("mine", None, "s", 0, (record,))
    with pytest.raises(InputError, match="2 records are named 'step'"):
        Study("mine", None, "ms", 0, (record,), (record,))
    with pytest.raises(InputError, match="one or more records to fit"):
        Study("mine", None, "ms", 0, ())


def test_settings_tell_all_their_problems():
    with pytest.raises(InputError) as caught:
        ModelSettings(terms=0, share="x", blocks=0, exposure_ms=-1.0)  # type: ignore[arg-type]
    assert len(caught.value.problems) == 4
    with pytest.raises(InputError, match="held_out"):
        RecordsSettings(held_out="a.csv")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="fixed at 2"):
        PriorSettings("gain", fixed=2.0).frozen()
    with pytest.raises(InputError, match="expected a number, or a distribution"):
        PriorSettings("gain", fixed=2.0, dist="norm")


@pytest.mark.parametrize(
    ("dist", "parameters"),
    [
        ("norm", {"loc": 1.0, "scale": 2.0}),
        ("truncnorm", {"a": -1.0, "b": 3.0}),
        ("halfcauchy", {"scale": 0.1}),
        ("lognorm", {"s": 1.0}),
        ("t", {"df": 3.0}),
    ],
)
def test_a_prior_is_scipys_distribution(dist, parameters):
    prior = PriorSettings("gain", dist=dist, parameters=parameters).frozen()
    np.testing.assert_array_equal(prior.ppf([0.1, 0.9]), getattr(stats, dist)(**parameters).ppf([0.1, 0.9]))


@pytest.mark.measured
@pytest.mark.skipif(not RECORDS.is_dir(), reason="measured records are absent; set LCOPA_BAYES_DATA")
def test_every_measured_study_is_read():
    folders = sorted(path.parent for path in RECORDS.glob("*/study.toml"))
    assert folders
    for folder in folders:
        study = load_study(folder)
        assert study.name == folder.name
        assert set(study.inputs) == {path.name for path in folder.iterdir()}
        for record in (*study.fit, *study.held_out):
            lines = (folder / f"{record.name}.csv").read_text(encoding="utf-8").splitlines()
            assert record.time.size == len(lines) - 1
            cells = [float(cell) if cell else np.nan for cell in lines[-1].split(",")]
            last = np.r_[record.time[-1], record.drive[-1], record.response[-1]]
            np.testing.assert_array_equal(last, cells)
