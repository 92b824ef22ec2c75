"""Pages in a real browser: no fault of accessibility, no error, and everything that folds, sorts, zooms does.

Needs Playwright, the axe-core that `axe-playwright-python` brings with it, and a Chromium of the system;
skipped, with the reason, where one of them is missing.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from small import record, study
from test_report import run_folder

import lcopa_bayes as lb
from lcopa_bayes.bench.command import on_off
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import save_record
from lcopa_bayes.report import write_report
from lcopa_bayes.report.pages import write_page_of

playwright = pytest.importorskip("playwright.sync_api", reason="Playwright is not installed")
axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="axe-core is not installed")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed on this system")

TINY = {"target_ess": 50}
KNOWN = {"delay": 0.73, "order_1": 0.8}
PHONE = {"width": 390, "height": 844}
REPORTS = Path(__file__).parents[2] / "reports"
SCAN = ("--alpha", "1.4", "1.8", "--beta", "0.5", "0.9", "--delay", "0.4", "1.0", "--rounds", "0")
SCAN += ("--order-step", "0.2", "--jobs", "1")


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as started:
        one = started.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox", "--disable-quic"])
        yield one
        one.close()


@pytest.fixture(scope="module")
def optics(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("optics")
    assert main(["optics", "--out", str(folder), "--quiet"]) == 0
    return folder / "optics.html"


def pages_of(place: Path) -> dict[str, Path]:
    """The page of every verb that can be had in seconds, but for those of fits and of optics."""
    off = record(2, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.5, name="off")
    small = study(record(1, camera=0.5, name="on"), held_out=[off], priors=KNOWN, sampler=TINY)
    fit = lb.fit(small, folder=place / "audit")
    lb.audit(fit, quick=True, folder=place / "audit")
    fit.predict(off).save(place / "predict")
    lb.check(small, folder=place / "check")
    lb.compare(fit, ["study", "first-order"], quick=True, folder=place / "compare")
    lb.loop(small, quick=True, as_stated=True, folder=place / "loop")
    lb.design(fit, quick=True, bench_time=24.0, folder=place / "design")
    (place / "calibrate").mkdir()
    shutil.copy(REPORTS / "calibration" / "one-term" / "results.json", place / "calibrate")
    pages = {one.name: write_page_of(one.name, one) for one in sorted(place.iterdir()) if one.is_dir()}
    save_record(record(1, camera=0.5), place / "step.csv")
    (place / "study.toml").write_text('[records]\nfit = ["step.csv"]\n[model]\nterms = 2\n')
    for verb, words in (("identify", (str(place), *SCAN)), ("claims", ())):  # these draw their page
        assert main([verb, *words, "--out", str(place / verb), "--quiet"]) == 0
        pages[verb] = place / verb / f"{verb}.html"
    return pages


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    return write_report(run_folder(tmp_path_factory.mktemp("reports") / "bench"))


def opened(browser, path: Path, **settings):
    """A page, and the errors that it reports."""
    page, errors = browser.new_page(**settings), []
    page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(path.as_uri())
    return page, errors


def broken(page, *rules: str) -> list[object]:
    """Rules of axe-core that a page breaks, of those of these names or of all."""
    options = {"resultTypes": ["violations"]} | ({"runOnly": [*rules]} if rules else {})
    found = axe.Axe().run(page, options=options).response["violations"]
    return [(one["id"], one["impact"], one["nodes"][0]["html"][:200]) for one in found]


def faults(browser, path: Path, *, dark: bool = False) -> dict[str, list[object]]:
    """What axe-core finds with every section unfolded, errors, and tables or figures cut without a hint.

    In the `dark` only faint colours: all that depends on the scheme are colours. Unfolding takes longer than
    the rules, so that one page is shown in both.
    """
    page, out = opened(browser, path, viewport=PHONE, color_scheme="light")
    page.evaluate("for (const part of document.querySelectorAll('details')) part.open = true")
    found = {"light": broken(page)}
    width = page.evaluate("document.documentElement.scrollWidth")
    found["light"] += [f"{width} px wide"] if width > PHONE["width"] else []
    cut = "e => e.scrollWidth > e.clientWidth + 16 && !e.classList.contains('scrolls')"
    found["light"] += page.evaluate(
        f"[...document.querySelectorAll('.wide')].filter({cut}).map(e => e.outerHTML.slice(0, 99))"
    )
    if dark:
        page.emulate_media(color_scheme="dark")
        found["dark"] = broken(page, "color-contrast")
    page.close()
    return {scheme: one for scheme, one in (found | {"errors": out}).items() if one}


@pytest.mark.usefixtures("short_benches")
def test_no_page_has_a_fault_or_an_error_and_each_fits_a_phone(browser, report, optics, tmp_path):
    pages = pages_of(tmp_path) | {"fit": report, "optics": optics}
    found = {verb: faults(browser, path, dark=verb in ("fit", "loop")) for verb, path in pages.items()}
    assert {key: one for key, one in found.items() if one} == {}


def test_the_rules_see_a_fault(browser, tmp_path):
    path = tmp_path / "bad.html"
    path.write_text(
        '<!DOCTYPE html><title>t</title><main><h1>t</h1><img src="data:,">'
        '<p style="width: 900px">wide</p></main><script>missing()</script>',
        encoding="utf-8",
    )
    text = str(faults(browser, path))
    assert all(rule in text for rule in ("image-alt", "html-has-lang", "px wide", "missing is not defined"))


def test_the_rule_of_colours_sees_a_faint_text_in_the_dark(browser, tmp_path):
    path = tmp_path / "faint.html"
    path.write_text(
        '<!DOCTYPE html><html lang="en"><title>t</title><style>@media (prefers-color-scheme: dark)'
        " { body { background: #000 } p { color: #333 } }</style><main><h1>t</h1><p>faint</p></main></html>",
        encoding="utf-8",
    )
    seen = faults(browser, path, dark=True)
    assert [*seen] == ["dark"]
    assert [one[0] for one in seen["dark"]] == ["color-contrast"]


def test_panels_side_by_side_stand_below_each_other_on_a_phone(browser, report):
    page, errors = opened(browser, report, viewport=PHONE)
    figure = page.locator("#frequency-response figure .wide")
    lefts = (
        "e => [...e.querySelectorAll(':scope > svg')].map(one => Math.round(one.getBoundingClientRect().x))"
    )
    assert figure.evaluate(lefts) == [figure.evaluate("e => Math.round(e.getBoundingClientRect().x)")] * 4
    first, _, second, third = (one.bounding_box() for one in figure.locator(":scope > svg").all())
    assert (
        first["height"] < second["height"] == pytest.approx(third["height"], rel=0.2)
    )  # a legend in two lines, two panels
    assert second["y"] + second["height"] <= third["y"] + 1
    figure.click()
    assert len(figure.evaluate(lefts)) == 1
    figure.click()
    assert len(figure.evaluate(lefts)) == 4
    page.set_viewport_size({"width": 1300, "height": 844})
    page.wait_for_function("document.querySelectorAll('#frequency-response figure .wide > svg').length === 1")
    assert errors == []
    page.close()


SQUEEZED = """e => {
    const drawn = e.querySelector("g[id$='figure_1']"), root = drawn.getScreenCTM().inverse();
    const all = (what) => [...drawn.querySelectorAll(what)].filter(one => !one.closest("[visibility]"));
    const place = (one) => root.multiply(one.getScreenCTM());
    const sizes = ({ a, b, c, d }) => [Math.hypot(a, b), Math.hypot(c, d)];
    const middle = (one) => { const box = one.getBoundingClientRect(); return box.x + box.width / 2; };
    const words = all("g[id*='xtick_'] text"), labels = words.map(one => one.getBoundingClientRect());
    const marks = words.map(one => one.closest("g[id*='xtick_']").querySelector("use"));
    return {
        views: [...e.children].map(one => one.viewBox.baseVal.width),
        letters: all("g[id*='axes_'] text").map(place).flatMap(sizes),
        panels: [...drawn.querySelectorAll(":scope > g[id*='axes_']")].map(one => place(one).a),
        off: words.map((one, k) => Math.abs(middle(one) - middle(marks[k]))),
        gaps: labels.slice(1).map((one, k) => one.left - labels[k].right),
    };
}"""


def test_a_wide_panel_is_squeezed_on_a_phone_but_not_its_letters(browser, report):
    page, errors = opened(browser, report, viewport=PHONE)
    figure = page.locator("#data-and-bands figure .wide").first
    narrow = figure.evaluate(SQUEEZED)
    assert max(narrow["views"]) < 300  # letters of 7.5 units have more than 8 pixels
    assert narrow["letters"] == pytest.approx([1.0] * len(narrow["letters"]), abs=1e-3)
    assert all(share < 0.6 for share in narrow["panels"])
    assert max(narrow["off"]) < 1.0  # labels stay below their ticks
    assert min(gap for gap in narrow["gaps"] if gap > -100) > 0  # below -100: the next panel begins
    figure.click()
    wide = figure.evaluate(SQUEEZED)
    assert len(wide["views"]) == 1
    assert wide["panels"] == pytest.approx([1.0] * len(wide["panels"]))
    assert len(wide["off"]) >= len(narrow["off"])
    assert errors == []
    page.close()


def test_sections_fold_and_open_where_a_link_leads(browser, report):
    page, _ = opened(browser, report)
    traces, summary = page.locator("#traces > details"), page.locator("#summary > details")
    assert traces.get_attribute("open") is None
    assert summary.get_attribute("open") is not None
    page.click("nav a[href='#traces']")
    page.locator("#traces > details[open]").wait_for()  # it opens on an event, after the click
    page.click("#summary > details > summary")
    page.locator("#summary > details:not([open])").wait_for()
    page.close()


def test_a_table_sorts_by_its_numbers_both_ways(browser, optics):
    page, _ = opened(browser, optics)
    table = page.locator("table").nth(1)
    head = table.locator("thead button", has_text="angle")

    def column() -> list[float]:
        cells = table.locator("tbody tr > :nth-child(3)").all_inner_texts()
        return [float(text.replace("\u2212", "-")) for text in cells]

    before = column()
    head.click()
    assert column() == sorted(before) != before
    head.click()
    assert column() == sorted(before, reverse=True)
    page.close()


def test_a_long_table_shows_the_rows_with_all_words_typed(browser, optics):
    page, errors = opened(browser, optics)
    long = [
        k
        for k in range(page.locator("table").count())
        if page.locator("table").nth(k).locator("tbody tr").count() >= 12
    ]
    assert page.locator(".filter").count() == len(long) > 0
    table, place = page.locator("table").nth(long[0]), page.locator(".filter").first
    rows = table.locator("tbody tr")
    every = [" ".join(row.split("\t")).lower() for row in rows.all_inner_texts()]
    words = every[3].split()[0], every[3].split()[-1]
    place.locator("input").fill(f"  {words[0].upper()} {words[1]} ")
    kept = [row for row in every if all(word in row for word in words)]
    assert 0 < rows.locator("visible=true").count() == len(kept) < len(every)
    assert place.locator("[role=status]").inner_text() == f"{len(kept)} of {len(every)} rows"
    place.locator("input").fill("no such row")
    assert place.locator("[role=status]").inner_text() == f"0 of {len(every)} rows"
    place.locator("input").fill("")
    assert [row.is_visible() for row in rows.all()] == [True] * len(every)
    assert errors == []
    page.close()


def test_a_zoom_is_shared_and_values_follow_the_cursor(browser, report):
    page, errors = opened(browser, report, viewport={"width": 1300, "height": 2000})
    part = page.locator("details.explore").first
    part.locator("summary").click()
    charts = part.locator(".u-over")
    charts.nth(2).wait_for()
    assert charts.count() == 3
    part.scroll_into_view_if_needed()
    ticks = "e => [...e.querySelectorAll('.u-legend .u-value')].map(v => v.textContent)"
    area = charts.first.bounding_box()
    y = area["y"] + area["height"] / 2
    page.mouse.move(area["x"] + 0.5 * area["width"], y)
    middle = part.evaluate(ticks)
    assert any(value not in ("", "--") for value in middle)
    page.mouse.move(area["x"] + 0.4 * area["width"], y)
    page.mouse.down()
    page.mouse.move(area["x"] + 0.6 * area["width"], y)
    page.mouse.up()
    page.mouse.move(area["x"] + 0.01 * area["width"], y)
    span = 25.0
    assert 0.35 * span < float(part.evaluate(ticks)[0]) < 0.45 * span  # the left end after the zoom
    box = charts.nth(2).bounding_box()
    page.mouse.move(box["x"] + 0.99 * box["width"], box["y"] + box["height"] / 2)
    assert 0.55 * span < float(part.evaluate(ticks)[0]) < 0.65 * span  # in another panel too
    assert errors == []
    page.close()
