"""Pages as assistive techniques and phones meet them, by what stands in their HTML and style."""

import json
import re
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path

import pytest
from test_report import run_folder

from lcopa_bayes.plot.theme import CYCLE, OUTSIDE
from lcopa_bayes.report import write_report
from lcopa_bayes.report.svg import COLOURS

VOID = {"meta", "br", "img", "input", "use", "path", "rect", "image", "line", "circle"}


class Tree(HTMLParser):
    """Elements with their attributes and the elements around them, and the text of those that are closed."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.elements: list[tuple[str, dict[str, str | None], tuple[str, ...]]] = []
        self.text: dict[str, list[str]] = {}
        self.around: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), tuple(self.around)))
        if tag not in VOID:
            self.around.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs), tuple(self.around)))

    def handle_endtag(self, tag: str) -> None:
        while self.around and self.around.pop() != tag:
            pass

    def handle_data(self, data: str) -> None:
        if self.around:
            self.text.setdefault(self.around[-1], []).append(data)

    def of(self, tag: str) -> list[tuple[dict[str, str | None], tuple[str, ...]]]:
        return [(attrs, around) for name, attrs, around in self.elements if name == tag]


@pytest.fixture(scope="module")
def html(tmp_path_factory) -> str:
    """With empty figures: what is looked at stands around them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("lcopa_bayes.report.svg.svg_of", lambda figure: "<svg></svg>")
        return write_report(run_folder(tmp_path_factory.mktemp("reports") / "bench")).read_text("utf-8")


@pytest.fixture(scope="module")
def tree(html) -> Tree:
    return Tree(html)


def test_a_page_has_language_title_and_a_way_past_its_head(tree):
    assert tree.of("html")[0][0]["lang"] == "en"
    assert "".join(tree.text["title"]).strip()
    first = next(attrs for name, attrs, _ in tree.elements if name == "a")
    (main,) = tree.of("main")
    assert (first["class"], first["href"]) == ("skip", f"#{main[0]['id']}")


def test_headings_come_in_order(tree):
    levels = [int(tag[1]) for tag, _, _ in tree.elements if re.fullmatch(r"h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after - before <= 1 for before, after in pairwise(levels))


def test_every_table_has_caption_scopes_and_scrolls_by_keyboard(tree):
    tables = tree.of("table")
    assert len(tables) == len(tree.of("caption")) > 5
    assert all(text.strip() != "" for text in tree.text["span"])
    for attrs, around in tree.of("th"):
        assert attrs["scope"] == ("col" if "thead" in around else "row")
    assert len([1 for attrs, around in tree.of("th") if "tbody" in around]) == len(
        [1 for attrs, around in tree.of("tr") if "tbody" in around]
    )
    wide = [attrs for attrs, _ in tree.of("div") if attrs.get("class") == "wide"]
    for attrs in wide:
        assert attrs["aria-label"]
        assert attrs["role"] == "img" or attrs["tabindex"] == "0"


def test_diagnostics_of_sampling_are_folded_and_answers_are_not(html):
    folded = re.findall(r"<details>\n<summary><h2>(.*?)</h2>", html)
    assert {"Traces", "Sampler and provenance", "Priors and posteriors"} <= set(folded)
    assert not {"Summary", "Parameters", "Data and bands", "Residuals"} & set(folded)


def luminance(colour: str) -> float:
    """Relative luminance (WCAG 2.2) of a hexadecimal colour."""
    digits = colour.lstrip("#")
    digits = "".join(2 * one for one in digits) if len(digits) == 3 else digits
    parts = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in parts]
    return sum(weight * c for weight, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def contrast(one: str, other: str) -> float:
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def test_contrast_is_calculated_as_defined():
    assert contrast("#000", "#fff") == pytest.approx(21)
    assert contrast("#777777", "#ffffff") == pytest.approx(4.48, abs=0.01)


@pytest.mark.parametrize("dark", [False, True])
def test_every_text_has_contrast_enough(html, dark):
    style = html[html.index("<style>") : html.index("</style>")]
    blocks = re.findall(r":root \{(.*?)\}", style, flags=re.DOTALL)
    light, darker = blocks[::2], blocks[1::2]
    values = dict(re.findall(r"--([\w-]+): (#\w+)", " ".join(light)))
    assert values["ink"] == next(iter(COLOURS))
    if dark:
        values |= dict(re.findall(r"--([\w-]+): (#\w+)", " ".join(darker)))
    grounds = [values["paper"], *(values[name] for name in values if name.startswith("soft"))]
    for text in ("ink", "faint", "good", "fair", "bad", "held"):
        for ground in grounds:
            if text != "held" or ground == values["paper"]:
                assert contrast(values[text], ground) >= 4.5, (text, ground)
    assert contrast(values["mark"], "#fff") >= 4.5


def test_colours_of_a_cycle_stay_apart_and_seen_on_a_dark_ground():
    """Each stands for a candidate or an ensemble; what shades a range must not light up."""
    dark = [COLOURS.get(colour, ("", colour))[1] for colour in CYCLE]
    assert len(set(dark)) == len(CYCLE)
    assert all(contrast(colour, "#15181c") >= 3 for colour in dark)
    assert contrast(COLOURS[OUTSIDE][1], "#15181c") < 1.5


def test_explored_values_are_those_of_the_record(html, tmp_path):
    (first, *_) = re.findall(r'<script type="application/json">(.*?)</script>', html)
    given = json.loads(first)
    titles = [panel["title"] for panel in given["panels"]]
    assert titles == ["x [rad]", "residual [rad]", "drive x [V]"]
    response, residual, _ = given["panels"]
    named = {one["label"]: one["values"] for one in response["series"]}
    left = [seen - middle for seen, middle in zip(named["observed"], named["median"], strict=True)]
    assert residual["series"][0]["values"] == pytest.approx(left, abs=2e-6)
    assert len(response["time"]) == 80
    assert all(low < high for low, high in zip(named["5 %"], named["95 %"], strict=True))


def test_scripts_are_inlined_once(html):
    assert html.count("var uPlot=") == 1
    assert "The MIT License" in html
    for name in ("page.js", "explore.js"):
        text = (Path(__file__).parents[2] / "lcopa_bayes" / "report" / name).read_text("utf-8")
        assert text.strip() in html
