"""Figures of results: what they draw is what the result holds, in one look, from a fit or its run folder."""

import subprocess
import sys
from itertools import combinations

import matplotlib
import numpy as np
import pandas as pd
import pytest
from matplotlib.colors import to_hex
from small import record, study

import lcopa_bayes as lb
from lcopa_bayes.bench.command import on_off
from lcopa_bayes.paper.staticoptics import OpticsPlan
from lcopa_bayes.plot.draws import _reach
from lcopa_bayes.plot.records import record_figure
from lcopa_bayes.plot.theme import BAND, StyledFigure, look
from lcopa_bayes.report.svg import svg_of
from lcopa_bayes.verbs.papers import optics

pytestmark = pytest.mark.usefixtures("short_benches")
TINY = {"target_ess": 50}
PLANT = {"delay": 0.73, "order_1": 0.8}
KNOWN = PLANT | {"offset": 0.3}
ON = record(1, camera=0.5, name="on")
OFF = record(2, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.5, name="off")


@pytest.fixture(scope="module")
def fit() -> lb.Fit:
    return lb.fit(study(ON, held_out=[OFF], priors=KNOWN, sampler=TINY))


@pytest.fixture(scope="module")
def saved(fit, tmp_path_factory) -> lb.SavedFit:
    folder = tmp_path_factory.mktemp("runs") / "small"
    fit.save(folder)
    return lb.load_result(folder)


@pytest.fixture(scope="module")
def audit(fit) -> lb.AuditResult:
    return lb.audit(fit, quick=True)


def line(figure, label: str) -> np.ndarray:
    """Points of the curve of this label in the first panel, (n, 2)."""
    (one,) = [each for each in figure.axes[0].lines if each.get_label() == label]
    return np.column_stack(one.get_data())


@pytest.mark.parametrize("name", ["bands", "residuals", "corner", "forest", "steps", "bode"])
def test_a_fit_and_its_run_folder_give_the_same_figure(fit, saved, name):
    one, other = (getattr(lb.plot, name)(of) for of in (fit, saved))
    assert isinstance(one, StyledFigure)
    assert svg_of(one) == svg_of(other)


def test_bands_show_the_record_and_its_median(fit):
    figure = lb.plot.bands(fit, "off")
    held = next(band for band in fit.bands if band.held_out)
    np.testing.assert_allclose(line(figure, "observed"), np.column_stack([held.time, held.observed]))
    np.testing.assert_allclose(line(figure, "median")[:, 1], held.plant[2])
    assert "off, y: held out" in figure.axes[0].get_title("left")
    assert figure.axes[1].get_ylabel() == "u [V]"
    assert "on, y: fit" in lb.plot.bands(fit).axes[0].get_title("left")


def test_residuals_are_those_of_the_fit(fit):
    points = lb.plot.residuals(fit, record="on").axes[0].lines[1].get_data()
    own = next(one for one in fit.residuals if not one.held_out)
    np.testing.assert_allclose(np.column_stack(points), np.column_stack([own.time, own.values]))


@pytest.mark.parametrize("values", [0.3 + 1e-16 * np.arange(4), np.zeros(4), np.full(4, -1e9)])
def test_draws_that_are_alike_have_a_histogram(values):
    counts, _ = np.histogram(values, bins=30, range=_reach(values))
    assert counts.sum() == values.size


def test_a_histogram_of_other_draws_ends_at_them(rng):
    values = rng.normal(5.0, 1e-3, 100)
    assert _reach(values) == (values.min(), values.max())


def test_a_forest_has_a_row_for_every_parameter_at_its_interval(fit):
    table = fit.summary().set_index("parameter")
    figure, drawn = lb.plot.forest(fit), {}
    for panel in figure.axes:
        names = [one.get_text() for one in panel.get_yticklabels()]
        unit = panel.get_xlabel().strip("[]")
        for name, ends, middle in zip(names, panel.lines[::2], panel.lines[1::2], strict=True):
            assert table.loc[name, "unit"] == unit
            drawn[name] = [middle.get_xdata()[0], *ends.get_xdata()]
    assert set(drawn) == set(table.index)
    for name, values in drawn.items():
        np.testing.assert_allclose(values, table.loc[name, ["value", "lower", "upper"]].astype(float))
    (panel,) = lb.plot.forest(fit, ["time_1"]).axes
    assert [one.get_text() for one in panel.get_yticklabels()] == ["time_1"]


def test_a_corner_shows_the_parameters_that_are_asked_for(fit):
    assert len(lb.plot.corner(fit, ["gain", "time_1"]).axes) == 4
    assert len(lb.plot.corner(fit).axes) == len(fit.summary()) ** 2


def test_a_bode_plot_falls_by_the_median_of_the_fit(fit):
    rows = fit.frequency.table()
    middle = rows["gain_pointwise_50"].to_numpy()
    np.testing.assert_allclose(line(lb.plot.bode(fit), "median")[:, 1], middle)
    assert middle[-1] < middle[0]


def test_profiles_are_those_of_the_audit(audit):
    rows = {row["name"]: row["profile"] for row in audit.values["parameters"]}
    (panel,) = lb.plot.profiles(audit, ["time_1"]).axes
    np.testing.assert_allclose(panel.lines[0].get_xdata(), rows["time_1"]["values"])
    assert len(lb.plot.profiles(audit).axes) == len(rows)
    assert len(lb.plot.bands(audit).axes) == 2  # of the fit it rests on


def test_a_design_and_its_drive_are_drawn(fit):
    planned = lb.design(fit, bench_time=30.0, quick=True)
    panels = lb.plot.design(planned).axes
    assert [one.get_title("left") for one in panels] == list(planned.values["curve"][0]["best"])
    assert planned.drive is not None
    shown = lb.plot.drive(planned.drive).axes[0].lines[0].get_data()
    np.testing.assert_allclose(shown[1], planned.drive.values[:, 0])


def test_residuals_before_and_after_are_those_of_the_loop():
    found = lb.loop(study(ON, OFF, priors=PLANT, sampler=TINY), quick=True, as_stated=True)
    figure = lb.plot.before_after(found, record="off")
    for panel, when in zip(figure.axes, ("before", "after"), strict=True):
        assert panel.get_title("left") == f"off, y: {when}"
        score = next(one for one in found.values[when]["scores"] if one["record"] == "off")
        drawn = np.asarray(panel.lines[0].get_ydata())
        assert np.sqrt(np.mean(drawn**2)) == pytest.approx(score["rmse"], rel=1e-3)


def test_a_predicted_response_is_drawn_under_its_drive(fit):
    wanted = fit.predict(lb.Drive.steps(u=[(0, 1.0), (5, 0.0)]))
    figure = lb.plot.prediction(wanted)
    np.testing.assert_allclose(line(figure, "median")[:, 1], wanted.bands[0].plant[2])
    assert "observed" not in [one.get_label() for one in figure.axes[0].lines]
    assert "observed" in [one.get_label() for one in lb.plot.prediction(fit.predict(OFF)).axes[0].lines]


def test_far_field_and_director_are_of_the_plan():
    device = optics(OpticsPlan(targets_deg=(0.0, 5.0), voltages=(2.0, 4.0)))
    field = lb.plot.far_field(device)
    for panel, target in zip(field.axes, (0.0, 5.0), strict=True):
        angle, level = panel.lines[0].get_data()
        level = np.where(np.abs(angle) < 20, level, -np.inf)  # a grating lobe is as high
        assert angle[np.argmax(level)] == pytest.approx(target, abs=0.2)
    tilts = lb.plot.director(device).axes[0].lines
    assert [one.get_label() for one in tilts[:2]] == ["2 V", "4 V"]
    assert max(tilts[1].get_ydata()) > max(tilts[0].get_ydata())


def test_a_comparison_shows_the_best_at_zero():
    made = study(ON, priors=KNOWN, sampler=TINY)
    compared = lb.compare(made, ["study", "first-order"], quick=True)
    (panel,) = lb.plot.evidence(compared).axes
    tops = [box.lines[0].get_ydata()[0] for box in panel.containers]
    own = [row["log_evidence"] for row in compared.values["models"]]
    np.testing.assert_allclose(tops, np.array(own) - max(own))


def test_what_is_not_there_is_refused_by_name(fit, audit):
    with pytest.raises(lb.InputError, match=r"no record 'of' .* there are: on \(y\), off \(y\)"):
        lb.plot.bands(fit, "of")
    with pytest.raises(lb.InputError, match=r"no 'time1' here.*time_1"):
        lb.plot.corner(fit, ["time1"])
    with pytest.raises(lb.InputError, match="needs the result of `design`; got that of `audit`"):
        lb.plot.design(audit)
    with pytest.raises(lb.InputError, match="rests on no fit"):
        lb.plot.bands(optics(OpticsPlan(targets_deg=(0.0,), voltages=(2.0,))))


def test_a_figure_keeps_its_look_and_leaves_settings_alone(fit):
    before = dict(matplotlib.rcParams)
    usual = svg_of(lb.plot.bode(fit))
    with matplotlib.rc_context({"font.size": 31.0, "lines.color": "red", "svg.fonttype": "path"}):
        figure = lb.plot.bode(fit)
        assert svg_of(figure) == usual
        assert figure._repr_png_()[:4] == b"\x89PNG"
    assert dict(matplotlib.rcParams) == before
    assert to_hex(figure.axes[0].lines[-1].get_color()) == BAND
    assert ">frequency [cycles per ms]</text>" in usual  # text as text


def test_figures_are_reached_without_loading_matplotlib():
    code = (
        "import sys, lcopa_bayes as lb; assert 'plot' in dir(lb); assert 'matplotlib' not in sys.modules; "
        "lb.plot.bands; assert 'matplotlib' in sys.modules"
    )
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_drive_of_many_changes_is_drawn_with_its_beginning():
    few, many = (lb.Drive.steps(x=[(float(t), t % 2) for t in range(n)], until=float(n)) for n in (9, 300))
    assert len(lb.plot.drive(few).axes) == 1
    whole, beginning = lb.plot.drive(many).axes
    assert whole.get_xlim()[1] >= 300
    assert beginning.get_xlim() == pytest.approx((0, 21))


def test_names_of_drives_do_not_run_into_each_other():
    """Long names stand above their panels, short ones at their side."""
    names = {"Heater power of the shell": "W", "Coolant flow": "L/min", "u": "V"}
    rows = pd.DataFrame(
        [
            {"role": role, "axis": axis, "unit": unit, "time": time, "value": float(time > 1)}
            for axis, unit, role in [*((*one, "drive") for one in names.items()), ("T", "K", "response")]
            for time in (0.0, 1.0, 2.0)
        ]
    )
    with look():
        figure = record_figure(rows, "h", held_out=False)
        figure.draw_without_rendering()
    texts = [one for panel in figure.axes for one in (panel.yaxis.label, panel._left_title) if one.get_text()]
    boxes = [one.get_window_extent() for one in texts]
    assert len(boxes) == 4
    assert not any(one.overlaps(other) for one, other in combinations(boxes, 2))
    assert all(figure.bbox.contains(*corner) for box in boxes for corner in (box.min, box.max))
