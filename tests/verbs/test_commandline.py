"""Manners of the command line: version, nearest words, JSON errors, examples, terms, completion."""

from __future__ import annotations

import json
import shlex
import subprocess
import sys
import tomllib
from importlib.metadata import version
from importlib.resources import files

import pytest

import lcopa_bayes as lb
from lcopa_bayes.cli import VERBS, _parser, main
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.model.effects.catalogue import bundled
from lcopa_bayes.verbs.commandline import USAGES

TERMS = tomllib.loads(files("lcopa_bayes.verbs").joinpath("glossary.toml").read_text(encoding="utf-8"))


def exit_code(*arguments: str) -> int:
    try:
        return main(arguments)
    except SystemExit as stopped:
        return int(stopped.code or 0)


def test_the_version_is_that_of_the_package(capsys):
    assert exit_code("--version") == 0
    assert capsys.readouterr().out.strip() == f"lcopa-bayes {version('lcopa-bayes')}"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("fti", "x"), "'fti' is not a verb; did you mean 'fit'?"),
        (("fit", "x", "--quik"), "--quik is not an option of fit; did you mean '--quick'?"),
        (
            ("fit", "x", "--folder"),
            "of fit; known: --cross-check, --dask, --held-out, --help, --jobs, --json",
        ),
        (("new", "x", "--out", "y"), "--out is not an option of new; example: lcopa-bayes new oven "),
        (("audit",), "the following arguments are required: source"),
        (("predict", "a", "b", "--offset", "some"), "invalid choice: 'some'"),
    ],
)
def test_a_wrong_command_line_names_what_is_meant(arguments, message, capsys):
    assert exit_code(*arguments) == 2
    captured = capsys.readouterr()
    assert message in captured.err
    assert captured.out == ""
    assert exit_code(*arguments, "--json") == 2
    (problem,) = json.loads(capsys.readouterr().out)["errors"]
    assert message in problem


def test_errors_are_json_where_json_is_asked_for(tmp_path, capsys):
    (tmp_path / "study.toml").write_text('[model]\nterms = 9\n[noise]\nkind = "ar"\n')
    assert exit_code("fit", str(tmp_path), "--json") == 2
    captured = capsys.readouterr()
    assert len(json.loads(captured.out)["errors"]) >= 2
    assert captured.err == ""


def test_the_example_of_every_verb_is_a_command_line():
    assert USAGES.keys() == VERBS.keys()
    for verb, usage in USAGES.items():
        given = [verb, *shlex.split(usage.example)]
        assert _parser(given).parse_args(given).verb == verb


@pytest.mark.parametrize("verb", VERBS)
def test_help_shows_the_example_and_the_exit_codes(verb, capsys):
    assert exit_code(verb, "--help") == 0
    said = capsys.readouterr().out
    assert f"example: lcopa-bayes {verb} {USAGES[verb].example}" in said
    assert "exit codes: 0 done, 1 unforeseen error, 2" in said


@pytest.mark.parametrize("term", TERMS)
def test_a_term_is_explained_in_three_lines(term, tmp_path):
    text = lb.explain(term, runs=tmp_path)
    assert text.startswith(f"{term}: ")
    assert 2 <= len(text.splitlines()) <= 3
    for word in TERMS[term]["words"]:
        assert lb.explain(word.upper(), runs=tmp_path) == text


def test_an_unknown_term_is_answered_by_the_nearest_or_by_the_terms_there_are(tmp_path):
    with pytest.raises(InputError, match="'survivel' is not a known term; did you mean 'survival'"):
        lb.explain("survivel", runs=tmp_path)
    with pytest.raises(InputError) as refused:
        lb.explain("zzzzqq", runs=tmp_path)
    assert str(refused.value).endswith(f"known: {', '.join(sorted(TERMS))}")


@pytest.mark.parametrize("name", bundled())
def test_an_effect_is_explained_by_its_card(name, tmp_path):
    card = bundled()[name].card
    text = lb.explain(name.upper().replace("_", " "), runs=tmp_path)
    assert text.startswith(f"{name}: an effect ")
    assert len(text.splitlines()) == 3
    for said in (card.formula, card.reveals, card.mistaken_for, card.source):
        assert said in text
    assert (f"acts on the {card.place}" in text) == (card.place != "generic")
    assert name not in TERMS


def test_an_unknown_effect_is_answered_by_the_nearest(tmp_path):
    with pytest.raises(InputError, match="did you mean 'odd_curvature'"):
        lb.explain("od curvature", runs=tmp_path)


def test_a_term_is_explained_without_loading_what_calculates():
    """Which takes seconds."""
    heavy = ("scipy", "pandas", "arviz_base", "sklearn", "matplotlib")
    lines = (
        "import sys",
        "from lcopa_bayes.cli import main",
        "assert main(['explain', 'grade']) == 0",
        f"assert not {{*{heavy}}} & {{*sys.modules}}",
    )
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("grade: ")


def test_a_word_means_one_term():
    words = [word.casefold() for name, one in TERMS.items() for word in (name, *one["words"])]
    own = [name.casefold() for name in TERMS]
    assert len({*own}) == len(own)
    assert {word for word in words if words.count(word) > 1} <= {*own}


def test_examples_come_from_the_last_fit(tmp_path):
    run = tmp_path / "oven"
    run.mkdir()
    row = {"value": 1.5, "lower": None, "upper": 2.25, "unit": "min"}
    values = {
        "study": "oven",
        "grade": "tentative",
        "grade_reason": "of a reason",
        "log_evidence": -12.3,
        "log_evidence_sd": 0.05,
        "sampler": {"largest_rhat": 1.0123, "smallest_ess": 412.4, "target_ess": 400.0},
        "parameters": [{"name": "delay", **row}, {"name": "order_1", **row}, {"name": "gain", **row}],
        "held_out": [{"record": "off", "axis": "t", "coverage_90": 0.912}],
    }
    (run / "results.json").write_text(json.dumps(values))
    wanted = {
        "grade": "oven: grade tentative, because of a reason.",
        "R-hat": "oven: the largest is 1.012.",
        "ESS": "the smallest is 412, wanted are 400.",
        "delay": "delay = 1.5 (open to 2.25) min",
        "coverage": "91 % of off/t in the 90 % band",
        "evidence": "-12.3 nat, uncertain by 0.05 nat",
    }
    for term, example in wanted.items():
        assert example in lb.explain(term, runs=tmp_path)
    for term, one in TERMS.items():  # no example names a number that a fit lacks
        assert (f"Example, {run}" in lb.explain(term, runs=tmp_path)) == bool(one["example"])
    (run / "results.json").write_text("{")
    assert "Example" not in lb.explain("R-hat", runs=tmp_path)


def test_an_unknown_term_names_the_nearest(capsys):
    assert exit_code("explain", "gade") == 2
    assert "did you mean 'grade'" in capsys.readouterr().err


def test_completion_knows_every_verb(capsys):
    assert exit_code("--print-completion", "bash") == 0
    script = capsys.readouterr().out
    assert all(verb in script for verb in VERBS)
    assert "--held-out" in script
