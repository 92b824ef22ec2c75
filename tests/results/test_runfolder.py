"""The run folder: every file there, readable, and telling the same story."""

from __future__ import annotations

import json
from importlib.metadata import version

import arviz_base
import arviz_stats
import h5py
import numpy as np
import pandas as pd
import pytest
import xarray
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from small import record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.files import save_json, save_table
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.plot.rundata import load_run
from lcopa_bayes.report import write_report
from lcopa_bayes.results import datatree
from lcopa_bayes.results.datatree import posterior_tree, save_tree, variable_names
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.runfolder import opened
from lcopa_bayes.results.tables import tables

TINY = {"target_ess": 50}
KNOWN = {"delay": 0.73, "order_1": 0.8}
PAIR = (record(1, camera=0.4, name="a"), record(2, camera=0.5, name="b"))
HELD = record(3, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.3, name="held")


@pytest.fixture(scope="module", params=["white", "student"])
def fitted(request) -> Fit:
    priors = {"white": {"delay": 0.73}, "student": KNOWN}[request.param]
    return fit(study(*PAIR, held_out=(HELD,), noise=request.param, sampler=TINY, priors=priors))


@pytest.fixture(scope="module")
def folder(fitted, tmp_path_factory):
    path = tmp_path_factory.mktemp("run")
    fitted.save(path)
    return path


@pytest.mark.parametrize("jobs", [pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("noise", ["white", pytest.param("student", marks=pytest.mark.slow)])
def test_a_page_drawn_while_the_rest_is_written_is_that_of_the_folder(tmp_path, noise, jobs):
    made = fit(study(record(camera=0.8, name="a"), noise=noise, sampler=TINY, priors=KNOWN))
    made.save(tmp_path, jobs=jobs, page=True)
    page = tmp_path / "report.html"
    before = page.read_bytes()
    assert b'href="posterior.nc"' in before
    assert len(list((tmp_path / "figures").iterdir())) >= 5
    page.unlink()
    assert write_report(tmp_path).read_bytes() == before


def test_the_folder_holds_what_was_promised(fitted, folder):
    assert sorted(p.name for p in folder.iterdir()) == [
        "fit.json",
        "posterior.nc",
        "provenance.json",
        "results.json",
        "tables",
    ]
    assert {p.stem for p in (folder / "tables").iterdir()} == set(tables(fitted))
    assert json.loads((folder / "results.json").read_text()) == fitted.to_json()
    assert json.loads((folder / "provenance.json").read_text())["fit"]["command"] == ["lcopa_bayes.fit"]


def test_tables_read_back(fitted, folder):
    for name, table in tables(fitted).items():
        read = pd.read_csv(folder / "tables" / f"{name}.csv")
        assert list(read.columns) == list(table.columns), name
        assert len(read) == len(table) > 0, name
    bands = pd.read_csv(folder / "tables" / "bands.csv")
    assert set(bands["record"]) == {"a", "b", "held"}
    assert (bands["noisy_pointwise_05"] <= bands["noisy_pointwise_95"]).all()
    priors = pd.read_csv(folder / "tables" / "priors.csv").set_index("name")
    assert priors.loc["delay", "prior"] == "fixed at 0.73"
    assert priors.loc["gain", "integrated_out"] == (fitted.problem.posterior.noise.kind == "white")
    for _, part in pd.read_csv(folder / "tables" / "prior_density.csv").groupby("name"):
        assert np.isfinite(part["density"]).all()
        assert (part["density"] >= 0).all()


def test_posterior_has_the_arviz_groups(fitted, folder):
    tree = arviz_base.from_dict({"posterior": {"x": np.zeros((2, 3))}})
    with xarray.open_datatree(folder / "posterior.nc", engine="h5netcdf") as read:
        assert type(read) is type(tree)
        assert set(read.children) == {
            "posterior",
            "sample_stats",
            "log_prior",
            "log_likelihood",
            "posterior_predictive",
            "observed_data",
            "constant_data",
            "prior",
            "prior_predictive",
            "predictions",
            "predictions_constant_data",
        }
        free = [row.name for row in fitted.draws.table.rows if row.free]
        assert "delay" not in free
        assert set(read["posterior"].data_vars) == set(read["log_prior"].data_vars) == set(free)
        for group in ("log_likelihood", "posterior_predictive", "observed_data"):
            assert set(read[group].data_vars) == {"a_y", "b_y"}
        ensembles, draws, _ = fitted.draws.values.shape
        assert read["posterior"]["gain"].dims == ("chain", "draw")
        assert dict(read["posterior"].sizes) == {"chain": ensembles, "draw": draws}
        assert read["posterior"]["time_1"].attrs["units"] == "ms"
        assert_array_equal(read["posterior"]["gain"], fitted.draws.values[..., 0])
        assert_array_equal(read["sample_stats"]["lp"], fitted.draws.log_density)
        assert_allclose(read["observed_data"]["a_y"], PAIR[0].response[~np.isnan(PAIR[0].response[:, 0]), 0])
        assert_allclose(read["observed_data"]["b_y_time"], PAIR[1].time[~np.isnan(PAIR[1].response[:, 0])])
        assert read.attrs["grade"] == fitted.draws.grade.level
        assert read.attrs["seed"] == fitted.study.seed
        assert json.loads(read.attrs["settings"])["sampler"]["target_ess"] == TINY["target_ess"]
        assert read.attrs["version"] == version("lcopa-bayes")
        assert (read.attrs["study"], read.attrs["time_unit"]) == ("small", "ms")
        assert read["constant_data"]["a_drive"].dims == ("a_drive_time", "drive")
        assert read["predictions"]["held_y"].dims == ("chain", "draw", "held_y_time")
        assert read["observed_data"]["a_y_time"].attrs["units"] == "ms"
        assert read["log_likelihood"]["a_y"].dims == ("chain", "draw", "a_y_time")
        assert read["observed_data"]["a_y"].attrs["units"] == "rad"
        assert list(read["constant_data"].coords["record"].to_numpy()) == ["a", "b"]
        assert_array_equal(read["constant_data"]["a_drive"].sel(drive="u").to_numpy(), PAIR[0].drive[:, 0])
        assert_array_equal(read["constant_data"]["a_drive_time"], PAIR[0].time)
        # held-out records: the same draws as the bands'
        held = [band for band in fitted.bands if band.held_out]
        assert_allclose(
            np.quantile(read["predictions"]["held_y"].to_numpy()[0], 0.95, axis=0),
            held[0].noisy[4],
            atol=1e-5,
        )
        assert_array_equal(read["predictions_constant_data"]["held_y"], held[0].observed)
        # the prior as it is drawn, and wider than what the records leave of it
        assert read["prior"]["time_1"].shape == (1, 200)
        assert read["prior"]["time_1"].attrs["units"] == "ms"
        assert set(read["prior_predictive"].data_vars) == {"a_y", "b_y"}
        spread = [float(read[group]["a_y"].std()) for group in ("prior_predictive", "posterior_predictive")]
        assert spread[0] > spread[1]
        assert arviz_stats.summary(read, var_names=["time_1"], fmt="wide").shape[0] == 1
        predictive = np.median(read["posterior_predictive"]["a_y"], axis=(0, 1))
        width = fitted.bands[0].noisy[4] - fitted.bands[0].noisy[0]
        assert np.all(np.abs(predictive - fitted.bands[0].noisy[2]) < 0.2 * width)


def test_every_variable_is_compressed_without_loss(fitted, folder):
    with h5py.File(folder / "posterior.nc") as file:
        stored = {f"{group}/{name}": one for group, part in file.items() for name, one in part.items()}
        for group, node in fitted.to_datatree().children.items():
            for name in node.data_vars:
                assert stored[f"{group}/{name}"].compression == "gzip"
        assert_array_equal(stored["posterior/gain"], fitted.draws.values[..., 0])


def test_long_records_keep_every_kth_draw_of_what_has_a_number_a_sample(fitted, monkeypatch):
    """The same log likelihoods, at the draws that the coordinate names."""
    whole = fitted.to_datatree()
    monkeypatch.setattr(datatree, "_CELLS", 0)
    monkeypatch.setattr(datatree, "_FEWEST", fitted.draws.flat.shape[0] // 3)
    some = fitted.to_datatree()
    where = some["log_likelihood"].coords["draw"].to_numpy()
    assert some.sizes.get("draw") is None
    assert where.tolist() == list(range(0, whole["posterior"].sizes["draw"], 3))
    assert some["posterior_predictive"]["a_y"].shape == some["log_likelihood"]["a_y"].shape
    expected = whole["log_likelihood"]["a_y"].sel(draw=where)
    np.testing.assert_array_equal(some["log_likelihood"]["a_y"], expected)
    assert some["posterior"].sizes == whole["posterior"].sizes


def test_a_compact_tree_is_the_same_without_the_prior(fitted):
    whole, compact = fitted.to_datatree(), posterior_tree(fitted, compact=True)
    assert set(whole.children) - set(compact.children) == {"log_prior", "prior", "prior_predictive"}
    for group in ("posterior", "sample_stats", "log_likelihood", "observed_data", "constant_data"):
        own, every = compact[group].to_dataset(), whole[group].to_dataset()
        assert own.equals(every.sel(draw=own["draw"]) if "draw" in own.coords else every)
    assert compact["posterior_predictive"].sizes == compact["log_likelihood"].sizes


def test_log_prior_and_log_likelihood_are_consistent_with_the_density(fitted, folder):
    """Their sum is the density sampled, plus that of the linear parameters given the others."""
    posterior, draws = fitted.problem.posterior, fitted.draws
    with xarray.open_datatree(folder / "posterior.nc", engine="h5netcdf") as read:
        prior = sum(read["log_prior"][name].to_numpy() for name in read["log_prior"].data_vars)
        prior = prior + read["log_prior"].attrs["joint_support"]
        likelihood = sum(
            part.to_numpy().astype(float).sum(axis=2) for part in read["log_likelihood"].data_vars.values()
        )
        lp = read["sample_stats"]["lp"].to_numpy()
    sampled = [posterior.table.rows[k] for k in posterior.sampled]
    volume = sum(
        np.log(draws.values[..., k])
        for k, row in zip(posterior.sampled, sampled, strict=True)
        if row.log_scale
    )
    conditional = np.zeros(lp.shape)
    for e, d in np.ndindex(*lp.shape) if posterior.linear else ():
        if d % 25:
            conditional[e, d] = np.nan
            continue
        values = draws.values[e, d]
        at = dict(zip(posterior.table.names, values, strict=True))
        units = posterior.model.unit_responses(posterior.table.dynamics(values[None]))
        seen = [samples.axes[0] for samples in posterior.samples]
        unit = [u[0, 0, o.index] for u, o in zip(units, seen, strict=True)]
        first, second = (np.ones(u.size) for u in unit)
        columns = np.stack([np.concatenate(unit), np.r_[first, 0 * second], np.r_[0 * first, second]])
        priors = [posterior.table.rows[k].prior.frozen for k in posterior.linear]
        precision = columns @ columns.T / at["sigma"] ** 2 + np.diag([1 / p.var() for p in priors])
        data = np.concatenate([o.values for o in seen])
        pull = columns @ data / at["sigma"] ** 2 + [p.mean() / p.var() for p in priors]
        covariance = np.linalg.inv(precision)
        normal = stats.multivariate_normal(covariance @ pull, covariance)
        conditional[e, d] = normal.logpdf(values[list(posterior.linear)])
    error = prior + likelihood + volume - conditional - lp
    assert np.nanmax(np.abs(error)) < 1e-3  # the densities of single samples are stored to seven digits
    assert np.isfinite(error).sum() >= 20


def test_a_failed_save_leaves_no_file(fitted, tmp_path, monkeypatch):
    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr("lcopa_bayes.results.fit.save_tree", fail)
    with pytest.raises(InputError, match=r"posterior\.nc: cannot be written \(disk full\)"):
        fitted.save(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["tables"]


def test_json_and_tables_refuse_what_json_cannot_say(tmp_path):
    save_json({"a": np.nan, "b": np.array([1.0, np.inf])}, tmp_path / "a.json")
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": None, "b": [1.0, None]}
    save_table(pd.DataFrame({"x": [1.0, np.nan]}), tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == 'x\n1.0\n""\n'


def test_names_that_a_netcdf_group_would_split_are_kept_apart(tmp_path):
    """A slash in an axis name is a path in a netCDF file."""
    plain = PAIR[0]
    axis = Axis("front/left", "rad")
    slashed = Record("a", plain.time, plain.drive, plain.response, (Axis("u/1", "V"),), (axis,), "ms")
    made = fit(study(slashed, sampler=TINY, priors=KNOWN))
    save_tree(made.to_datatree(), tmp_path / "posterior.nc")
    with xarray.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as read:
        (name,) = read["observed_data"].data_vars
        assert_allclose(read["observed_data"][name], made.bands[0].observed)
        assert len(read.children) == 9


def test_a_record_too_short_for_residual_tests_is_saved_all_the_same(tmp_path):
    short = record(camera=1.5)
    assert short.response.size - np.isnan(short.response).sum() == 8
    made = fit(study(short, sampler=TINY, priors=KNOWN))
    made.save(tmp_path)
    assert made.to_json()["residual_tests"] == []


def test_names_are_kept_plain_unless_they_collide():
    assert variable_names(["a_x", "b_x", "a/b_c"]) == ["a_x", "b_x", "a|b_c"]
    assert variable_names(["a_b_c", "a_b_c", "d"]) == ["a_b_c_1", "a_b_c_2", "d"]
    assert variable_names(["a_b_c", "a_b_c_1", "a_b_c"]) == ["a_b_c_2", "a_b_c_1", "a_b_c_3"]
    assert variable_names(["a/b", "a|b"]) == ["a|b_1", "a|b_2"]
    assert variable_names(["a_y", "a_y_time"]) == ["a_y", "a_y_time_1"]


@given(st.lists(st.text("ab_/|1", min_size=1, max_size=3) | st.sampled_from(["a_time", "a_time_time"])))
def test_names_and_their_times_never_collide(wanted):
    names = variable_names(wanted)
    times = [f"{name}_time" for name in names]
    assert len({*names, *times}) == 2 * len(wanted)
    assert not any("/" in name for name in names)
    for name, want in zip(names, wanted, strict=True):
        assert name.startswith(want.replace("/", "|"))
    assert variable_names(wanted) == names


def test_no_folder_is_opened_as_none(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with opened(None, {"study": "any"}) as place:
        assert place is None
    assert not any(tmp_path.iterdir())


def test_records_and_axes_with_the_same_joint_name_are_kept_apart(tmp_path):
    """Record a_b with axis c against record a with axis b_c."""
    plain = PAIR[0]
    drive, response = np.tile(plain.drive, 1), np.column_stack([plain.response, 0.9 * plain.response])
    axes = Axis("c", "rad"), Axis("b_c", "rad")
    both = [
        Record(name, plain.time, drive, response + shift, (Axis("u", "V"),), axes, "ms")
        for name, shift in (("a_b", 0.0), ("a", 0.01))
    ]
    known = {"time_1": 1.5, "order_1": 0.8, "delay": 0.73}
    made = fit(study(*both, sampler=TINY, share="all", delay="shared", offset="shared", priors=known))
    save_tree(made.to_datatree(), tmp_path / "posterior.nc")
    with xarray.open_datatree(tmp_path / "posterior.nc", engine="h5netcdf") as read:
        groups = [read[g] for g in ("observed_data", "log_likelihood", "posterior_predictive")]
        for group in groups:
            reported = {(v.attrs["record"], v.attrs["axis"]): name for name, v in group.data_vars.items()}
            assert reported == {
                ("a_b", "c"): "a_b_c_1",
                ("a_b", "b_c"): "a_b_b_c",
                ("a", "c"): "a_c",
                ("a", "b_c"): "a_b_c_2",
            }
        seen = ~np.isnan(response[:, 1])
        assert_array_equal(read["observed_data"]["a_b_c_2"], response[seen, 1] + 0.01)
        assert read["observed_data"]["a_b_c_2"].attrs["record"] == "a"


def test_the_report_finds_parameters_whose_names_hold_a_slash(tmp_path):
    plain = PAIR[0]
    axes = Axis("front/left", "rad"), Axis("rear", "rad")
    two = Record(
        "a", plain.time, plain.drive, np.column_stack([plain.response] * 2), (Axis("u", "V"),), axes, "ms"
    )
    known = {"time_1": 1.5, "order_1": 0.8, "delay": 0.73}
    fit(study(two, sampler=TINY, share="all", delay="shared", priors=known)).save(tmp_path)
    assert "gain_front/left_u" in load_run(tmp_path).draws
