"""The report: what it says, that it is one page on its own, and that it never invents a number."""

import json
import re
from dataclasses import replace
from decimal import Decimal
from functools import partial
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
import xarray as xr
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from small import record, study

import lcopa_bayes as lb
from lcopa_bayes.bench.command import step
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference import defaultpriors
from lcopa_bayes.plot.draws import ranked
from lcopa_bayes.plot.rundata import load_run
from lcopa_bayes.plot.theme import extremes
from lcopa_bayes.report import design, records, write_page, write_report
from lcopa_bayes.report.formatting import NOT_REACHED, figures, interval, sentence, signed, stopped, to_spread
from lcopa_bayes.report.page import noted
from lcopa_bayes.report.pages import write_page_of
from lcopa_bayes.report.rules import passages
from lcopa_bayes.report.svg import Drawing, drawing, inlined
from lcopa_bayes.results.result import write_fit_page
from lcopa_bayes.sampling.modes import Modes

PARAMETERS = {
    "gain": ("rad/V", "reliable", False),
    "time_1": ("ms", "tentative", True),
    "delay": ("ms", "unusable", False),
    "sigma": ("rad", "reliable", True),
}
"""Unit, grade and whether sampled on a log scale."""
RECORDS = (("step", False), ("<i>odd$name$</i>", True))
QUANTILES = {"05": -1.6, "25": -0.7, "50": 0.0, "75": 0.7, "95": 1.6}


def estimate(name: str, unit: str, value: float | None, sd: float | None, grade: str, **more: object) -> dict:
    reported = {"name": name, "value": value, "unit": unit, "mean": value, "sd": sd, "grade": grade}
    ends = {"lower": None, "upper": None} if value is None else {"lower": value - sd, "upper": value + sd}
    return reported | ends | {"level": 0.9, "interval": "equal-tailed credible", "ess": 512.0} | more


def bands_of(record: str, held: bool, size: int) -> pd.DataFrame:
    time = np.linspace(0.0, 25.0, size)
    middle = 0.02 * (1 - np.exp(-time / 3))
    table = {"record": record, "axis": "x", "unit": "rad", "held_out": held, "time": time}
    table["observed"] = middle + 1e-4 * np.sin(40 * time)
    for kind, scale in (("plant", 1e-4), ("noisy", 2e-4)):
        table |= {f"{kind}_pointwise_{q}": middle + scale * z for q, z in QUANTILES.items()}
    return pd.DataFrame(table)


def tables_of(size: int) -> dict[str, pd.DataFrame]:
    bands = pd.concat([bands_of(record, held, size) for record, held in RECORDS])
    labels = bands[["record", "axis", "unit", "held_out", "time"]]
    time = np.linspace(0.1, 25.0, 60)
    step = {"path": "x", "unit": "rad/V", "time": time}
    step |= {f"response_{q}": 1 - np.exp(-time / 3) + 0.01 * z for q, z in QUANTILES.items()}
    step |= {f"steady_{q}": 1.0 + 0.01 * QUANTILES[q] for q in ("05", "50", "95")}
    x = np.linspace(0.5, 2.0, 20)
    bode = {"path": "x", "unit": "rad/V", "frequency": np.geomspace(0.04, 5.0, 40)}
    for curve, middle in (("gain", 1 / (1 + bode["frequency"])), ("phase", -90 * bode["frequency"])):
        bode |= {f"{curve}_pointwise_{q}": middle + 0.01 * z for q, z in QUANTILES.items()}
        bode |= {f"{curve}_simultaneous_{q}": middle + 0.02 * QUANTILES[q] for q in ("05", "95")}
    return {
        "frequency_response": pd.DataFrame(bode),
        "bands": bands,
        "drives": pd.concat(
            pd.DataFrame(
                {"record": r, "axis": "x", "unit": "V", "time": [-1.0, 0.0, 25.0], "drive": [0, 1, 1]}
            )
            for r, _ in RECORDS
        ),
        "residuals": labels.assign(residual=1e-4 * np.sin(labels["time"]), innovation=0.0),
        "autocorrelation": pd.concat(
            pd.DataFrame(
                {
                    **{"record": r, "axis": "x", "held_out": h, "lag": np.arange(1, 6)},
                    **{"autocorrelation": 0.1, "white_band_95": 0.2},
                }
            )
            for r, h in RECORDS
        ),
        "spectrum": pd.concat(
            pd.DataFrame(
                {
                    **{"record": r, "axis": "x", "held_out": h, "frequency": np.arange(1, 20) / 25},
                    "power_over_white": np.linspace(0, 2, 19),
                }
            )
            for r, h in RECORDS
        ),
        "step_response": pd.DataFrame(step),
        "priors": pd.DataFrame(
            {
                **{"name": list(PARAMETERS), "unit": [row[0] for row in PARAMETERS.values()]},
                **{"prior": "norm(loc=0, scale=1)", "from": "default", "integrated_out": False},
            }
        ),
        "prior_density": pd.concat(
            pd.DataFrame({"name": name, "log_scale": row[2], "x": x, "density": 0.3})
            for name, row in PARAMETERS.items()
        ),
    }


def moved(name: str, prior: float | None, diagnosis: str) -> dict:
    reported = {"parameter": name, "prior": prior, "prior_mcse": prior and 0.0123, "likelihood": prior}
    reported |= {
        "likelihood_mcse": prior and 0.0123,
        "prior_k": None,
        "likelihood_k": 0.312,
        "threshold": 0.05,
    }
    return reported | {"grade": "tentative", "diagnosis": diagnosis, "note": ""}


def results_of() -> dict:
    scores = {"axis": "x", "unit": "rad", "coverage_50": 0.5, "coverage_90": 0.91, "samples": 80, "draws": 40}
    return {
        "study": "bench & co",
        "verdict": "Something was learned.",
        "overview": {
            "plant": ["y / <i>odd$name$ = 1.2 rad/V exp(-3 s) / (1 + (1.8 s)^0.8)"],
            "answers": [
                {"question": "What is missing?", "answer": "<i>odd$name$ & co.", "section": "Residuals"},
                {"question": "What next?", "answer": "Measure again.", "section": ""},
            ],
        },
        "grade": "tentative",
        "grade_reason": "too few draws of time_1",
        "time_unit": "ms",
        "parameters": [
            estimate(name, unit, 1.23456, 0.0321, grade, rhat=1.004)
            for name, (unit, grade, _) in PARAMETERS.items()
        ],
        "fixed": [{"name": "order_1", "value": 1.8, "unit": "-"}],
        "fit_scores": [scores | {"record": "step", "rmse": 1.84e-4, "offset_from": "fitted"}],
        "held_out": [scores | {"record": RECORDS[1][0], "rmse": 9.1e-4, "offset_from": "integrated out"}],
        "step_metrics": [
            estimate("settling_2[x]", "ms", None, None, "reliable", note="all draws are late"),
            estimate("settling_5[x]", "ms", None, None, "reliable", lower=7.5),
            estimate("overshoot[x]", "-", 0.04, 0.002, "reliable"),
        ],
        "modes": [],
        "rival": None,
        "structure": None,
        "log_evidence": -12.345,
        "log_evidence_sd": 0.0123,
        "log_evidence_grade": "tentative",
        "cross_check": None,
        "sensitivity": [moved("time_1", 0.21, "prior-data conflict"), moved("gain", None, "not trusted")],
        "residual_tests": [
            {"record": record, "axis": "x", "held_out": held, "p_white": 3.2e-7, "rms": 1e-4}
            for record, held in RECORDS
        ],
        "sampler": {
            "method": "ensembles",
            "ensembles": 2,
            "steps": 400,
            "thin": 4,
            "acceptance": 0.31234,
            "largest_rhat": 1.0041,
        },
    }


def run_folder(path: Path, size: int = 80) -> Path:
    path.mkdir(parents=True, exist_ok=True)
    (path / "tables").mkdir(exist_ok=True)
    for name, table in tables_of(size).items():
        table.to_csv(path / "tables" / f"{name}.csv", index=False)
    (path / "results.json").write_text(json.dumps(results_of()), encoding="utf-8")
    provenance = {
        "command": ["lcopa-bayes", "fit", "my study"],
        "seed": 7,
        "inputs_sha256": {"a.csv": "ab12"},
    }
    provenance |= {"python": "3.11.0", "versions": {"numpy": "2.0"}}
    (path / "provenance.json").write_text(json.dumps({"fit": provenance}), encoding="utf-8")
    rng = np.random.default_rng(1)
    drawn = {name: (("chain", "draw"), np.exp(0.1 * rng.normal(size=(2, 60)))) for name in PARAMETERS}
    xr.Dataset(drawn).to_netcdf(path / "posterior.nc", group="posterior", engine="h5netcdf")
    return path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_folder(tmp_path_factory.mktemp("reports") / "bench")


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    path = write_report(folder)
    assert path == folder / "report.html"
    return path.read_text(encoding="utf-8")


def rows_of(html: str) -> list[list[str]]:
    rows = re.findall(r"<tr>(.*?)</tr>", html, flags=re.DOTALL)
    return [[unescape(cell) for cell in re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)] for row in rows]


def test_verdict_stands_on_top_coloured_and_in_words(html):
    box = html[html.index('<div class="verdict') : html.index("<nav ")]
    assert 'class="verdict tentative"' in box
    assert "Grade: tentative" in box
    assert "Something was learned." in box
    assert "too few draws of time_1" in box


def test_sections_come_in_the_order_of_reading(html):
    titles = re.findall(r"<h2>(.*?)</h2>", html)
    assert titles == [
        *("Summary", "Parameters", "Step responses", "Frequency response", "Data and bands", "Residuals"),
        *("Pairs of parameters", "Priors and posteriors", "Prior sensitivity", "Traces", "Evidence"),
        *("Second method", "Sampler and provenance"),
    ]


def test_the_answers_come_first_with_links(html):
    first = html[html.index('<section id="summary">') : html.index("</section>")]
    assert "<strong>What is missing?</strong> &lt;i&gt;odd$name$ &amp; co." in first
    assert '<a href="#residuals">Residuals</a>' in first
    assert first.count("<a ") == 1
    assert "y / &lt;i&gt;odd$name$ = 1.2 rad/V" in first


def test_every_parameter_has_its_unit_interval_and_grade(html):
    rows = rows_of(html)
    for name, (unit, grade, _) in PARAMETERS.items():
        row = ["1.235", unit, "1.202 to 1.267", "1.235", "0.032", "512", "1.004", grade]
        assert [name, *row] in rows
    assert ["order_1", "1.8", "-"] in rows
    assert "equal-tailed credible" in html


def test_open_sides_are_said_and_not_printed_as_numbers(html):
    reported = {row[1]: row for row in rows_of(html) if len(row) == 8 and row[0] == "x"}
    first, second, third = (
        reported[f"settling time to {share}"] if share else reported["overshoot"]
        for share in ("2 %", "5 %", "")
    )
    assert first[2] == first[4] == NOT_REACHED
    assert (first[7], second[7], third[7]) == ("1", "", "")
    assert "<p>Note 1: all draws are late.</p>" in html
    assert second[4] == "7.50 to open"  # the caption says why
    assert third[4] == "0.0380 to 0.0420"
    assert not re.search(r"\b(nan|inf|None)\b", re.sub(r"<svg.*?</svg>", "", html, flags=re.DOTALL))


def test_captions_carry_scores_and_mark_held_out_records(html):
    captions = [unescape(c) for c in re.findall(r"<figcaption>(.*?)</figcaption>", html)]
    fitted = next(c for c in captions if "Record step, axis x, fitted" in c)
    held = next(c for c in captions if "held out of the fit" in c)
    assert "RMSE 1.84×10⁻⁴ rad" in fitted  # noqa: RUF001
    assert "91\u00a0% of the 80 samples" in fitted
    assert "Offset: fitted." in fitted
    assert "held out</span>" not in fitted
    assert "held out</span>" in held
    assert "Offset: integrated out." in held
    assert all("pointwise 90\u00a0% band" in caption for caption in (fitted, held))
    assert any("median, pointwise 50 and 90\u00a0% bands" in caption for caption in captions)
    assert any("p\u00a0=\u00a03.2×10⁻⁷, not white" in c for c in captions)  # noqa: RUF001


@pytest.mark.usefixtures("undrawn")
def test_a_grade_and_its_reason_are_said_once(tmp_path):
    text = page_with(tmp_path, verdict="Grade tentative: too few draws of time_1. More was learned.")
    box = text[text.index('<div class="verdict') : text.index("<nav ")]
    assert box.count("too few draws of time_1") == box.count("entative") - 2 == 1
    assert "<p>More was learned.</p>" in box
    assert box.index("Why this grade") < box.index("<details>") < box.index("More was learned")


def test_default_priors_are_explained_in_the_words_of_their_module(html):
    shown = re.sub(r"<[^>]*>", "", unescape(html)).replace("\u2212", "-")
    for word in re.findall(r"[A-Za-z]{2,}", defaultpriors.__doc__):
        assert word in shown
    assert "log-normal(median by Q, s)" in shown
    assert "may well double with the level" in shown
    assert "=====" not in shown


def test_a_table_of_rules_has_rows_that_go_on():
    table = "===  ====\na    b\n===  ====\none  two\n     three\nx    y\n===  ===="
    first, table, last = passages(f"Before ``it``:\n\n{table}\n\nAfter\nit.")
    assert (first.text, last.text) == ("Before `it`:", "After it.")
    assert table.rows == (("one", "two three"), ("x", "y"))


def test_page_needs_nothing_else(folder, html):
    """Links lead into the page or to the tables beside it; those that are not there are not named."""
    for outside in ("http:", "https:", "src=", "<link", "@import", "file:"):
        assert outside not in html
    assert not re.search(r"url\((?!#)", html)
    assert len(html) < 5_000_000
    links = [one for one in re.findall(r'href="([^"]*)"', html) if not one.startswith(("#", "data:"))]
    assert set(links) == {
        *("tables/bands.csv", "tables/residuals.csv", "tables/step_response.csv", "posterior.nc"),
        *("tables/frequency_response.csv", "tables/prior_density.csv"),
    }
    assert all((folder / link).is_file() for link in links)


def test_names_from_the_records_stay_text(html):
    assert "<i>" not in html
    assert "&lt;i&gt;odd$name$" in html
    assert "bench &amp; co" in html


class _Ids(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen += [value for key, value in attrs if key == "id"]


def test_ids_are_unique_and_references_lead_somewhere(html):
    parser = _Ids()
    parser.feed(html)
    assert len(parser.seen) == len(set(parser.seen))
    used = re.findall(r'href="#([^"]+)"', html) + re.findall(r"url\(#([^)]+)\)", html)
    assert used
    assert set(used) <= set(parser.seen)


def test_second_rendering_gives_the_same_bytes_and_leaves_matplotlib_as_it_was(folder, html, tmp_path):
    again, before = run_folder(tmp_path / "elsewhere"), dict(matplotlib.rcParams)
    with matplotlib.rc_context({"font.size": 31.0}):
        assert write_report(again).read_text(encoding="utf-8") == html
        assert matplotlib.rcParams["font.size"] == 31.0
    assert dict(matplotlib.rcParams) == before
    assert matplotlib.pyplot.get_fignums() == []
    names = sorted(path.name for path in (folder / "figures").iterdir())
    assert names == sorted(path.name for path in (again / "figures").iterdir())
    assert all((folder / "figures" / n).read_bytes() == (again / "figures" / n).read_bytes() for n in names)
    assert all(re.fullmatch(r"[\w-]+\.svg", name) for name in names)


@pytest.mark.slow
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_page_drawn_in_halves_is_the_same(folder, html, jobs):
    assert write_fit_page(folder, None, jobs=jobs).read_text(encoding="utf-8") == html


@pytest.mark.parametrize("lacking", ["parameters", "sampler"])
@pytest.mark.parametrize("write", [write_report, partial(write_fit_page, fresh=None, jobs=2)])
def test_what_the_figures_lack_of_an_older_run_is_named(tmp_path, write, lacking):
    folder = run_folder(tmp_path / "run")
    values = json.loads((folder / "results.json").read_text(encoding="utf-8"))
    del values[lacking]
    (folder / "results.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(InputError, match=rf"results\.json: lacks '{lacking}'; run `fit` again"):
        write(folder)


@pytest.mark.parametrize("missing", ["results.json", "provenance.json", "posterior.nc", "tables/bands.csv"])
def test_missing_file_is_named(tmp_path, missing):
    folder = run_folder(tmp_path / "run")
    (folder / missing).unlink()
    with pytest.raises(InputError, match=re.escape(str(folder / missing))):
        write_report(folder)
    assert not (folder / "report.html").exists()


def test_all_that_is_wrong_is_reported_at_once(tmp_path):
    folder = run_folder(tmp_path / "run")
    (folder / "tables" / "drives.csv").unlink()
    (folder / "tables" / "priors.csv").write_text("name,unit,prior,from\n", encoding="utf-8")
    (folder / "results.json").write_text('{"study": ', encoding="utf-8")
    (folder / "posterior.nc").write_text("no netCDF", encoding="utf-8")
    with pytest.raises(InputError) as refused:
        load_run(folder)
    reported = "\n".join(refused.value.problems)
    assert len(refused.value.problems) == 4
    for word in ("drives.csv", "'integrated_out'", "results.json", "posterior.nc"):
        assert word in reported
    with pytest.raises(InputError, match="no such run folder"):
        write_report(tmp_path / "nowhere")


def test_draws_of_another_run_are_refused(tmp_path):
    folder = run_folder(tmp_path / "run")
    reported = results_of()
    reported["parameters"].append(estimate("rho", "-", 0.5, 0.1, "reliable", rhat=1.0))
    (folder / "results.json").write_text(json.dumps(reported), encoding="utf-8")
    with pytest.raises(InputError, match="'rho'"):
        load_run(folder)


@pytest.mark.usefixtures("undrawn")
def test_records_too_short_for_residuals_leave_a_sentence(tmp_path):
    folder = run_folder(tmp_path / "run")
    for name in ("residuals", "autocorrelation", "spectrum"):
        (folder / "tables" / f"{name}.csv").write_text("\n", encoding="utf-8")
    assert records.drawn(load_run(folder))["residuals"] == []
    assert "too short" in section_of(write_report(folder).read_text(encoding="utf-8"), "residuals")


@pytest.mark.usefixtures("undrawn")
def test_of_many_records_the_least_white_residual_comes_first_and_others_are_folded(tmp_path, monkeypatch):
    shares = {"a": 0.5, "b": None, "c": 1e-4, "d": 0.03, "e": 0.9}
    monkeypatch.setitem(globals(), "RECORDS", tuple((name, False) for name in shares))
    folder, results = run_folder(tmp_path / "run"), results_of()
    for test, share in zip(results["residual_tests"], shares.values(), strict=True):
        test["p_white"] = share
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    drawn = records.drawn(load_run(folder))
    assert [one.stem[-3:] for one in drawn["residuals"]] == ["c_x", "d_x", "a_x", "e_x", "b_x"]
    assert [one.stem[-3:] for one in drawn["data"]] == ["c_x", "d_x", "a_x", "e_x", "b_x"]
    assert "<summary>1 more</summary>" in write_report(folder).read_text(encoding="utf-8")


def test_names_that_look_like_numbers_or_nothing_stay_names(tmp_path):
    folder = run_folder(tmp_path / "run")
    for name in ("bands", "drives"):
        path = folder / "tables" / f"{name}.csv"
        text = path.read_text(encoding="utf-8").replace("step,", "007,").replace("<i>odd$name$</i>,", "NA,")
        path.write_text(text, encoding="utf-8")
    assert load_run(folder).records("bands") == [("007", "x"), ("NA", "x")]


def test_long_records_make_small_figures_and_say_so(tmp_path):
    """Drawn as they are, 8000 samples take 0.7 MB or more."""
    drawn = records.drawn(load_run(run_folder(tmp_path / "run", size=8_000)))
    drawings = (*drawn["data"], *drawn["residuals"])
    assert max(len(drawing.svg) for drawing in drawings) < 300_000
    assert all("the record has 8000 samples" in drawing.caption for drawing in drawings)


CURVES = arrays(float, st.integers(2, 400), elements=st.floats(-1e6, 1e6) | st.just(np.nan))


@settings(max_examples=100, deadline=None)
@given(CURVES, st.integers(4, 60))
def test_decimation_keeps_extremes_and_ends(curve, most):
    other = -np.nan_to_num(curve) + np.arange(curve.size)
    at = extremes(curve, other, most=most)
    assert np.all(np.diff(at) > 0)
    assert at[0] == 0
    assert at[-1] == curve.size - 1
    assert at.size <= most + 2
    for values in (curve, other):
        if not np.isnan(values).all():
            assert np.nanmax(values[at]) == np.nanmax(values)
            assert np.nanmin(values[at]) == np.nanmin(values)


def test_decimation_keeps_a_single_spike_in_every_stretch():
    curve = np.zeros(10_000)
    spikes = np.arange(50, 10_000, 100)
    curve[spikes] = 1.0 + np.arange(100)
    assert np.isin(spikes, extremes(curve, most=200)).all()
    assert np.array_equal(extremes(curve[:150], most=200), np.arange(150))


@pytest.mark.parametrize(
    ("value", "spread", "printed"),
    [
        (21.6337, 2.175, "21.6"),
        (1879.63, 52.1, "1880"),
        (701.6, 158.4, "700"),
        (0.9958235, 0.00444, "0.9958"),
        (0.99, 1.69, "0.99"),
        (-3.0171, 0.0996, "−3.02"),  # noqa: RUF001
        (0.0, 0.4, "0.00"),
        (1.8432e-4, 3.1e-6, "1.843×10⁻⁴"),  # noqa: RUF001
        (9.9996e-4, 3e-6, "1.0000×10⁻³"),  # noqa: RUF001
        (2.5e7, 1.3e6, "2.50×10⁷"),  # noqa: RUF001
        (1.25, None, "1.25"),
        (None, 1.0, "–"),  # noqa: RUF001
    ],
)
def test_digits_follow_the_spread(value, spread, printed):
    assert to_spread(value, spread) == printed


def test_intervals_and_significant_digits():
    assert interval(0.02838, None, 0.015) == "0.028 to open"
    assert interval(None, None, None, nothing=NOT_REACHED) == NOT_REACHED
    assert [figures(x) for x in (0.0, 0.99996, 123456.0, float("inf"))] == ["0", "1.00", "123000", "–"]  # noqa: RUF001


@given(st.floats(allow_nan=False, allow_infinity=False, allow_subnormal=True), st.integers(1, 6))
@example(5e-324, 2).via("no power of ten divides it: it was 0")
@example(1.7976931348623157e308, 3).via("rounded up it is no number any more")
@example(-9.996e-5, 3).via("rounded up to the next power of ten")
def test_every_number_is_printed_to_its_digits(value, count):
    """Read again, what is printed is the number that Python rounds to so many digits."""
    printed = figures(value, count).translate(str.maketrans("−⁻⁰¹²³⁴⁵⁶⁷⁸⁹", "--0123456789"))  # noqa: RUF001
    assert Decimal(printed.replace("×10", "e")) == Decimal(f"{value:.{count - 1}e}")  # noqa: RUF001
    assert to_spread(value, abs(value)) == figures(value, 2)


def test_powers_of_ten_in_sentences_are_raised_or_written_in_full():
    assert signed("falls by 3.5e-05 at -2e-7") == "falls by 3.5×10⁻⁵ at −2×10⁻⁷"  # noqa: RUF001
    assert signed("3.61e+03 ms, run1e5, -0.0") == "3610 ms, run1e5, 0.0"
    assert to_spread(0.0, 2.4e-21) == "0"


def test_interesting_parameters_come_first_and_the_rest_is_named(tmp_path):
    names = ["sigma", "gain_a", "offset", "delay", "gate_1", "order_1", "time_2", "time_1"]
    assert ranked(names) == [
        "time_2",
        "time_1",
        "order_1",
        "delay",
        "gain_a",
        "gate_1",
        "offset",
        "sigma",
    ]


def test_a_page_of_any_template_can_be_written(tmp_path):
    svg = '<svg xmlns="http://www.w3.org/2000/svg"><g id="a"/><use href="#a"/></svg>'
    template = tmp_path / "fields.html"
    template.write_text(
        """{% call section("Far field") %}{{ p("Text.") }}{{ figures(drawn.field) }}
        {% call(row) table(v.claims, "claim", "how:prose") %}{{ cells(*row) }}{% endcall %}{% endcall %}""",
        encoding="utf-8",
    )
    drawn = {"field": [Drawing("far field", svg, "Caption.")]}
    values = {"claims": [("<1>", "by test")]}
    path = write_page(tmp_path, template, "optics", values, drawn, name="optics.html")
    text = path.read_text(encoding="utf-8")
    assert (tmp_path / "figures" / "far_field.svg").read_text(encoding="utf-8") == svg
    assert inlined(svg, "far_field") == '<svg><g id="far_field-a"/><use href="#far_field-a"/></svg>'
    assert '<use href="#far_field-a"/>' in text
    assert '<a href="#far-field">Far field</a>' in text
    assert rows_of(text) == [["claim", "how"], ["<1>", "by test"]]
    assert "<1>" not in text
    assert "verdict" not in text[text.index("<body>") :]
    with pytest.raises(ValueError, match="2 cells"):
        write_page(tmp_path, template, "optics", {"claims": [("1",)]}, drawn)
    without = write_page(tmp_path, template, "optics", {"claims": []}, drawn)
    assert "<table>" not in without.read_text(encoding="utf-8")


def section_of(html: str, name: str) -> str:
    """A section of a page as text, without its figures."""
    start = html.index(f'<section id="{name}">')
    whole = html[start : html.index("</section>", start)]
    return unescape(re.sub(r"<svg.*?</svg>", "", whole, flags=re.DOTALL))


def page_with(tmp_path: Path, **more: object) -> str:
    """The page of a run with other results."""
    folder = run_folder(tmp_path / "other")
    (folder / "results.json").write_text(json.dumps(results_of() | more), encoding="utf-8")
    return write_report(folder).read_text(encoding="utf-8")


@pytest.mark.usefixtures("undrawn")
def test_step_table_is_left_out_when_there_are_no_metrics(html, tmp_path):
    assert "<table>" in section_of(html, "step-responses")
    assert "<table>" not in section_of(page_with(tmp_path, step_metrics=[]), "step-responses")


def test_notes_that_rows_share_stand_once_below_their_table():
    rows = [{"note": "b"}, {}, {"note": "a"}, {"note": "b"}, {"note": ""}]
    assert noted(rows) == {"b": "1", "a": "2", "": ""}
    assert noted([{}, {"note": ""}]) == {}


def test_numbers_of_a_loop_end_at_the_digits_of_their_intervals(tmp_path):
    """Three digits put a number beside its interval that may lie outside it."""
    ends = {"lower": 20.00012, "upper": 20.00241, "alone": [20.0, 20.001, 20.002], "sd_noise": 7e-4}
    row = {"name": "offset", "value": 20.00127, "unit": "degC", "sd": 7e-4, "grade": "tentative"} | ends
    row |= {"sd_structure": 0.0, "prior_sd": 1.0}
    late = {
        "name": "settling_2[y]",
        "value": None,
        "upper": None,
        "sd": None,
        "note": "100 % of draws are late",
    }
    side = {"held_out_coverage_90": 0.9, "log_evidence": 1234567.84, "scores": []}
    effect = {
        "name": "creep",
        "formula": "f",
        "source": "s",
        "group": ["creep"],
        "nearest": [],
        "constants": [],
    }
    values = {
        **{"sentence": "s.", "cautions": [], "next_measurement": "", "open": [], "alternatives": {}},
        **{"effects": [effect | {"parameters": [row | {"name": "creep.a"}]}], "parameters": [row]},
        **{"figures": [row | {"name": "value_at_end[y]"}, row | late], "unseen_by": "held-out records"},
        **{
            "before": side,
            "after": side,
            "moved": [],
            "evidence": {"classes": []},
            "rounds": [],
            "noise": [],
        },
    }
    drawn = {"curves_left": 0, "residuals": (), "evidence": (), "views": ()}
    html = write_page(tmp_path, "loop.html", "t", values, drawn).read_text(encoding="utf-8")
    rows = {one[0]: one for one in rows_of(html) if one}
    for name in ("creep.a", "offset", "value_at_end[y]"):
        assert rows[name][1:3] == ["20.00127", "20.00012 to 20.00241"]
    assert rows["settling_2[y]"][1:3] == ["open", "20.0 to open"]
    assert (rows["value_at_end[y]"][-1], rows["settling_2[y]"][-1]) == ("", "1")
    assert "<p>Note 1: 100\u00a0% of draws are late.</p>" in html
    assert "log evidence 1234567.8 before" in html
    values["figures"] = values["figures"][:1]
    plain = write_page(tmp_path, "loop.html", "t", values, drawn).read_text(encoding="utf-8")
    assert "Note 1" not in plain
    assert len({one[0]: one for one in rows_of(plain) if one}["value_at_end[y]"]) == 8


def test_a_drive_that_determines_what_the_step_leaves_open_comes_first(tmp_path):
    """Its factor is infinite, which JSON holds as None."""
    table = [
        {"drive": name, "factor_over_step": k} for name, k in (("on", 1.0), ("prbs", None), ("ramp", 2.5))
    ]
    ranked = design.drawn(tmp_path, {"curve": [{"best": {}}], "template": None, "table": table})["ranked"]
    assert [row["drive"] for row in ranked] == ["prbs", "ramp", "on"]


def test_a_clause_becomes_a_sentence_once():
    assert sentence("the data bound it") == sentence("The data bound it.") == "The data bound it."
    assert stopped("on/off, 14 ms is best") == "on/off, 14 ms is best."


@pytest.mark.usefixtures("undrawn")
def test_several_modes_are_shown_with_their_shares(html, tmp_path):
    assert "several modes" not in section_of(html, "parameters")
    modes = Modes("time_1", "ms", (1.1,), np.array([[0.3, 0.7], [0.5, 0.5]]), np.full((2, 2), 0.02))
    row = modes.as_json() | {"grade": "tentative"}
    rows = rows_of(section_of(page_with(tmp_path, modes=[row]), "parameters"))
    (shown,) = [cells for cells in rows if cells[:2] == ["time_1", "1.10"]]
    assert shown[:6] == [
        *("time_1", "1.10", "ms", "0.40 ± 0.10, 0.60 ± 0.10", "0.30 to 0.50, 0.50 to 0.70", "tentative"),
    ]
    assert "run longer" in shown[6]


@pytest.mark.usefixtures("undrawn")
def test_the_most_prior_sensitive_parameters_are_shown_and_the_rest_counted(html, tmp_path):
    shown = section_of(html, "prior-sensitivity")
    rows = rows_of(shown)
    assert rows[1] == [
        *("time_1", "0.210 ± 0.012", "0.210 ± 0.012", "prior-data conflict", "0.31", "tentative", ""),
    ]
    assert rows[2][1:4] == ["–", "–", "not trusted"]  # noqa: RUF001
    assert "matters for 1 of 2 parameters: time_1" in shown
    assert "Not trusted for gain: " in shown
    moved_by = [moved(f"p{k}", 0.01, "-") for k in range(30)]
    many = section_of(page_with(tmp_path / "many", sensitivity=moved_by), "prior-sensitivity")
    assert len(rows_of(many)) == 1 + 20
    assert "20 most affected of 30" in many
    assert "No parameter depends noticeably" in many
    none = section_of(page_with(tmp_path / "none", sensitivity=[]), "prior-sensitivity")
    assert "<table>" not in none


@pytest.mark.usefixtures("undrawn")
def test_a_page_of_importance_draws_speaks_of_no_ensembles(html, tmp_path):
    """Batches of weighted draws are no ensembles of walkers, and their evidence is no bridge."""
    assert "by bridge sampling" in section_of(html, "evidence")
    assert "Each colour is an independent ensemble" in section_of(html, "traces")
    settings = {"method": "importance draws", "batches": 2, "seed": 1}
    weighted = page_with(tmp_path, sampler=settings)
    shown = [section_of(weighted, name) for name in ("evidence", "traces", "sampler-and-provenance")]
    assert "the mean weight of the importance draws" in shown[0]
    assert "ensemble" not in "".join(shown)


@pytest.mark.usefixtures("undrawn")
def test_a_fixed_parameter_is_not_called_sampled(tmp_path):
    folder = run_folder(tmp_path / "run")
    row = {"unit": "-", "prior": "x", "from": "study", "integrated_out": False}
    rows = pd.DataFrame([{"name": name, **row} for name in ("a", "b")])
    rows.to_csv(folder / "tables" / "priors.csv", index=False)
    results = results_of() | {"fixed": [{"name": "a", "value": 1.0, "unit": "-"}]}
    (folder / "results.json").write_text(json.dumps(results), encoding="utf-8")
    shown = section_of(write_report(folder).read_text(encoding="utf-8"), "priors-and-posteriors")
    assert [cells[-1] for cells in rows_of(shown)][:3] == ["treated", "fixed", "sampled"]


def test_a_check_begins_with_its_remarks_and_the_record_that_they_name(tmp_path):
    at, slow = {"command": step(1.0, at=5.0)}, {"camera": 0.3}
    quiet, noisy = (
        record(k, name=name, noise_sd=sd, **at, **slow) for k, name, sd in ((1, "a", 0.01), (2, "b", 0.1))
    )
    other = record(3, name="c", noise_sd=0.001, **at, **slow)
    odd = replace(other, response=5.0 * other.response)
    for these, expected in (((quiet, noisy), "ba"), ((quiet, noisy, odd), "acb")):  # a and c disagree
        folder = tmp_path / expected
        lb.check(study(*these), folder=folder)
        titles = re.findall("<h2>(.*?)</h2>", write_page_of("check", folder).read_text("utf-8"))
        assert [title.removeprefix("Record ") for title in titles if title.startswith("Record ")] == [
            *expected
        ]
        assert ("Remarks" in titles) == (odd in these)
        assert titles.index("Plant") == (2 if odd in these else 1)


def test_files_of_drawings_whose_long_names_begin_alike_are_two():
    figure = matplotlib.figure.Figure(figsize=(1, 1))
    first, second = (drawing(f"{'a' * 200}{k}", figure, "") for k in range(2))
    assert first.stem != second.stem
    assert max(len(first.stem), len(second.stem)) < 125
    assert drawing("a" * 110, figure, "").stem == "a" * 110


@pytest.mark.usefixtures("undrawn")
def test_many_reasons_of_a_grade_are_a_list_below_the_first(tmp_path):
    reasons = ["a contradicts b", "the noise grew", "add terms"]
    text = page_with(tmp_path, verdict="Nothing.", grade_reason="; ".join(reasons))
    box = text[text.index('<div class="verdict') : text.index("<nav ")]
    assert "<p>Why this grade: a contradicts b.</p>" in box
    assert "2 more" in box
    assert [f"<li>{one}</li>" in box for one in reasons] == [False, True, True]
    few = page_with(tmp_path, verdict="Nothing.", grade_reason="; ".join(reasons[:2]))
    assert "Why this grade: a contradicts b; the noise grew." in few
