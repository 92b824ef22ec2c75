"""The documentation says what the code does: keys, defaults, limits of grades, verbs, examples and links."""

import dataclasses
import inspect
import re
import shlex
import tomllib
from pathlib import Path

import pytest

import lcopa_bayes
from lcopa_bayes.cli import _parser, main
from lcopa_bayes.comparison.candidates import KNOWN, VARIANTS
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import load_record
from lcopa_bayes.data.settings import (
    STAGES,
    CandidateSettings,
    CompareSettings,
    EffectsSettings,
    HeadingSettings,
    ModelSettings,
    NoiseSettings,
    RecordsSettings,
    SamplerSettings,
)
from lcopa_bayes.data.studyfile import load_candidates, load_study
from lcopa_bayes.identifiability import verdict as audit
from lcopa_bayes.inference.kinds import COEFFICIENTS, CONSTANTS, KINDS
from lcopa_bayes.model.effects.catalogue import bundled
from lcopa_bayes.results import adequacy, discretisation, resonances
from lcopa_bayes.sampling import convergence, evidence
from lcopa_bayes.sampling.run import SamplePlan

ROOT = Path(__file__).parents[1]
FIGURES = {name for name, one in vars(lcopa_bayes.plot).items() if inspect.isfunction(one)}
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
TABLES = {
    "study": HeadingSettings,
    "records": RecordsSettings,
    "model": ModelSettings,
    "noise": NoiseSettings,
    "sampler": SamplerSettings,
    "effects": EffectsSettings,
    "compare": CompareSettings,
    "candidates": CandidateSettings,
}
"""Tables of a study file with fixed keys, by name."""


def sections(page: Path) -> dict[str, str]:
    """Text under each second heading of a page."""
    parts = re.split(r"^## (.*)$", page.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return dict(zip(parts[1::2], parts[2::2], strict=True))


def rows(text: str, head: str) -> dict[str, list[str]]:
    """Rows of the table whose first column is `head`, by the first cell without its code marks."""
    out: dict[str, list[str]] = {}
    inside = False
    for line in text.splitlines():
        parts = re.split(r"(?<!\\)\|", line.strip("|")) if line.startswith("|") else []
        cells = [cell.strip() for cell in parts]
        if not cells:
            inside = False
        elif cells[0] == head:
            inside = True
        elif inside and not set(cells[0]) <= {"-"}:
            assert cells[0] not in out, f"{cells[0]} has two rows"
            out[cells[0].strip("`")] = cells[1:]
    return out


def study_tables() -> dict[str, dict[str, list[str]]]:
    """Keys of every table of a study file as docs/study.md lists them, with default and meaning."""
    found = sections(ROOT / "docs" / "study.md")
    return {name.strip("`[]"): rows(text, "key") for name, text in found.items() if name.startswith("`[")}


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```$", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("name", TABLES)
def test_every_key_is_documented_and_every_documented_key_exists(name):
    assert set(study_tables()[name]) == {one.name for one in dataclasses.fields(TABLES[name])}


def test_every_table_of_a_study_file_is_documented(tmp_path):
    (tmp_path / "study.toml").write_text("[nothing]\n")
    named = set(study_tables())
    assert named == {*TABLES, "priors", "stages"}
    assert set(study_tables()["stages"]) == set(STAGES)
    for known in named - {"candidates"}:
        (tmp_path / "study.toml").write_text(f"[{known}]\n")
        with pytest.raises(InputError) as refused:
            load_study(tmp_path)
        assert not any("unknown table" in problem for problem in refused.value.problems)


@pytest.mark.parametrize("name", TABLES)
def test_documented_defaults_are_those_of_the_code(name):
    reported = study_tables()[name]
    for key, default in ((one.name, one.default) for one in dataclasses.fields(TABLES[name])):
        if default is dataclasses.MISSING or default is None:
            continue
        cell = reported[key][0]
        assert re.search(rf"(^|\W){re.escape(as_written(default))}(\W|$)", cell), f"{name}.{key}: {cell}"


def as_written(default: object) -> str:
    """A default as the page writes it."""
    if isinstance(default, bool):
        return str(default).lower()
    if default == ():
        return "none"
    return f'"{default}"' if isinstance(default, str) else f"{default:g}"


def test_documented_sizes_of_a_run_are_those_that_are_planned():
    reported = study_tables()["sampler"]
    least, one_more = SamplePlan.of(0, seed=0), SamplePlan.of(1, seed=0)
    many = SamplePlan.of(100, seed=0), SamplePlan.of(101, seed=0)
    assert numbers(reported["steps"][0]) == [least.steps, one_more.steps - least.steps]
    assert numbers(reported["thin"][0]) == [least.thin]
    assert numbers(reported["walkers"][0]) == [least.walkers, many[1].walkers - many[0].walkers]


def numbers(text: str) -> list[float]:
    return [float(one) for one in re.findall(r"\d+(?:\.\d+)?", text)]


def test_priors_are_documented_for_every_kind_of_parameter():
    reported = rows(sections(ROOT / "docs" / "study.md")["`[priors]`"], "parameter")
    assert set(reported) == set(KINDS) - {*COEFFICIENTS, *CONSTANTS}
    for name in reported:
        kind = KINDS[name]
        ends = [end for end in (kind.low, kind.high) if abs(end) < float("inf")]
        assert numbers(reported[name][0]) == ends, name
        assert ("or more" in reported[name][0]) == (kind.zero and len(ends) == 1), name


def test_documented_limits_of_grades_are_those_of_the_code():
    text = sections(ROOT / "docs" / "statistics.md")["Grades"]
    limits = rows(text, "")
    for row, reliable, tentative in (
        ("nested R-hat", convergence.RELIABLE_RHAT, convergence.TENTATIVE_RHAT),
        ("rank correlation", convergence.RELIABLE_MEMORY, convergence.TENTATIVE_MEMORY),
        ("difference of a mode's share", convergence.RELIABLE_SHARES, convergence.TENTATIVE_SHARES),
    ):
        cells = next(cells for name, cells in limits.items() if name.startswith(row))
        assert numbers(" ".join(cells)) == [reliable, tentative], row
    named = {name.split(",")[0]: cells for name, cells in limits.items()}
    assert numbers(named["effective sample size"][1]) == [convergence.TENTATIVE_ESS]
    bound = next(cells for name, cells in named.items() if name.startswith("bound on the error"))
    assert numbers(bound[0]) == [convergence.RELIABLE_SCATTER]
    warnings = rows(text, "warning")
    assert numbers(warnings["noise at the end of its prior"][0]) == [100 * adequacy._END]
    assert f"{discretisation.LARGEST:g} sd" in warnings["blocks too wide"][0]
    assert f"{discretisation.UNUSABLE:g} sd" in warnings["blocks too wide"][0]
    resonant = [100 * resonances.RESONANCE_SHARE, 100 * resonances.CONFIRMED]
    assert numbers(warnings["resonance faster than the samples"][0]) == resonant
    assert resonances.DISTURBANCE_SHARE == 0.5
    reported = numbers(sections(ROOT / "docs" / "statistics.md")["Evidence"])
    assert {evidence._RELIABLE, evidence._TENTATIVE} <= set(reported)


def test_documented_verdicts_of_an_audit_are_those_it_may_give():
    reported = rows(sections(ROOT / "docs" / "questions.md")["audit"], "verdict")
    assert set(reported) == set(audit.Verdict.__args__)


def test_candidates_and_variants_are_documented():
    text = sections(ROOT / "docs" / "questions.md")["compare"]
    named = set(re.findall(r"`([\w-]+)`", text))
    assert {f"-{name}" for name in VARIANTS} == {
        name for name in named if name.startswith("-") and name[1] != "-"
    }
    assert set(KNOWN) - {"fractional-2", "fractional-3"} <= named


def test_every_effect_is_documented_by_its_formula():
    text = (ROOT / "docs" / "effects.md").read_text(encoding="utf-8")
    reported: dict[str, list[str]] = {}
    for part in text.split("\n## "):
        reported |= rows(part, "effect")
    cards = {name: kind.card for name, kind in bundled().items()}
    assert set(reported) == set(cards)
    for name, (formula, shared) in reported.items():
        assert formula == "`" + cards[name].formula.replace("|", "\\|") + "`"
        assert (shared == "per record") == cards[name].per_record


def test_readme_lists_the_verbs_of_the_command_line(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    known = set(re.findall(r"^    (\w+)(?:  |$)", capsys.readouterr().out, flags=re.MULTILINE))
    reported = rows(sections(ROOT / "README.md")["Commands"], "verb")
    named = {name for cell in reported for name in re.findall(r"\w+", cell)}
    assert named == known
    assert len(known) > 10


def test_examples_are_read_as_they_stand(tmp_path):
    (table,) = blocks(ROOT / "README.md", "text")
    for name in ("on", "off", "both"):
        (tmp_path / f"{name}.csv").write_text(table)
    record = load_record(tmp_path / "on.csv")
    assert [axis.name for axis in record.response_axes] == ["x", "y"]
    assert blocks(ROOT / "docs" / "records.md", "text") == [table]
    for page in PAGES:
        for text in blocks(page, "toml"):
            if "candidates" in tomllib.loads(text):
                (tmp_path / "candidates.toml").write_text(text)
                assert load_candidates(tmp_path / "candidates.toml")[1]
            else:
                (tmp_path / "study.toml").write_text(text)
                assert load_study(tmp_path).fit[0].name in ("on", "both")


def slug(heading: str) -> str:
    """Anchor of a heading as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def links(page: Path) -> list[str]:
    text = re.sub(r"^```.*?^```$", "", page.read_text("utf-8"), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"\]\(([^)\s]+)\)", text)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_resolve(page):
    for link in links(page):
        if link.startswith("http"):
            continue
        name, _, anchor = link.partition("#")
        target = (page.parent / name).resolve() if name else page
        assert target.is_file(), f"{page.name}: {link}"
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), flags=re.MULTILINE)
            assert anchor in map(slug, headings), f"{page.name}: {link}"


def test_every_page_is_reached_from_the_readme_and_names_files_that_exist():
    reached = {(ROOT / link.partition("#")[0]).resolve() for link in links(ROOT / "README.md")}
    assert {page.resolve() for page in PAGES[1:]} <= reached
    for page in PAGES:
        for named in re.findall(
            r"`(?:python )?((?:reports|studies|tests)/[\w./-]+)", page.read_text("utf-8")
        ):
            assert (ROOT / named).exists(), f"{page.name}: {named}"


def test_every_command_of_the_documentation_is_one_that_the_command_line_takes():
    shown = [line for page in PAGES for block in blocks(page, "sh") for line in re.split("\n|&&", block)]
    found = [shlex.split(line, comments=True) for line in shown]
    commands = [words[1:] for words in found if words and Path(words[0]).name == "lcopa-bayes"]
    assert len(commands) > 15
    for words in commands:
        _parser(words).parse_args(words)
    with pytest.raises(SystemExit):
        _parser([]).parse_args(["audit", "study", "--benchtime", "3"])


def test_the_gallery_shows_every_figure_and_pictures_are_small_and_described():
    shown = rows((ROOT / "docs" / "gallery.md").read_text("utf-8"), "function")
    assert {name.partition("(")[0] for name in shown} == FIGURES
    pictures = set((ROOT / "docs" / "pictures").iterdir())
    text = "".join(page.read_text("utf-8") for page in PAGES)
    named = re.findall(r"!\[([^\]]*)\]\((pictures/[^)]+)\)", text)
    assert {ROOT / "docs" / path for _, path in named} == pictures
    assert all(1_000 < path.stat().st_size < 100_000 for path in pictures)
    assert all(words for words, _ in named)


def test_readme_figure_is_small():
    (figure,) = (link for link in links(ROOT / "README.md") if link.endswith((".svg", ".png")))
    assert 1_000 < (ROOT / figure).stat().st_size < 60_000


def test_no_candidate_key_is_read_and_dropped(tmp_path):
    (tmp_path / "candidates.toml").write_text('[[candidates]]\nname = "a"\nimproper = ["gain"]\n')
    with pytest.raises(InputError, match="unknown key 'improper'"):
        load_candidates(tmp_path / "candidates.toml")


def test_every_public_name_is_on_its_page():
    listed = re.findall(
        r"^\.\. auto\w+:: lcopa_bayes\.(\w+)$", (ROOT / "docs" / "api.md").read_text("utf-8"), re.M
    )
    assert sorted(listed) == lcopa_bayes.__all__


def test_reports_hold_no_path_of_a_machine_and_no_failure():
    place = re.compile(r"(?<![\w.:/-])/(home|mnt|opt|private|root|tmp|usr|Users|var|work)/|\b[A-Z]:\\")
    files = [one for one in (ROOT / "reports").rglob("*") if one.is_file()]
    assert {".html", ".json", ".md", ".svg"} <= {one.suffix for one in files}
    for file in files:
        text = file.read_text(encoding="utf-8")
        assert "unforeseen" not in text, file
        assert not (at := place.search(text)), (file, text[at.start() : at.end() + 40])
