"""Candidates of a study: which there are, what they derive, and what is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import pytest
from small import TWO, path, record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.device import Device
from lcopa_bayes.comparison.candidatefit import contender
from lcopa_bayes.comparison.candidates import BY_ELEMENT, Candidate, candidates_of, derived, known_settings
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import CandidateSettings, PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_candidates
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.structure import structure_of
from lcopa_bayes.verbs.compare import compare as compared


def named(one: Candidate) -> tuple[str, ...]:
    return problem_of(one.study).posterior.table.names


def made(name: str, source=None) -> Candidate:
    source = source or study(record())
    return derived(source, known_settings(name, source))


@pytest.mark.parametrize(
    ("terms", "wanted"),
    [
        (1, ["fractional-1", "fractional-2", "first-order", "second-order"]),
        (2, ["fractional-1", "fractional-2", "first-order", "second-order"]),
        (3, ["fractional-1", "fractional-2", "fractional-3", "second-order"]),
        (4, ["study", "fractional-1", "fractional-2", "second-order"]),
    ],
)
def test_a_short_list_for_any_study(terms, wanted):
    assert [one.name for one in candidates_of(study(record(), terms=terms))] == wanted


def test_a_study_with_terms_by_element_stands_for_itself():
    own = study(record(device=TWO, camera=0.5), terms={"direct": 3, "cross": 2})
    found = candidates_of(own)
    assert [one.name for one in found] == ["study", "fractional-1", "fractional-2", "second-order"]
    assert found[0].study.model == own.model
    assert [one.terms for one in found] == [3, 1, 2, 2]


def ring_and_lag(**model: object) -> Study:
    """The first response rings and creeps, the second is a lag."""
    paths = ((path(1.0, 0.5, (1.0, 2.0), (1.9, 0.7)),), (path(1.0, 0.5, (1.5,), (0.9,)),))
    device = Device(paths, (Axis("u", "V"),), TWO.response_axes, (0.0, 0.0))
    move = on_off(1.0, hold=9.0, at=0.5)
    return study(
        record(device=device, command=move, camera=0.25, duration=20.0, noise_sd=0.004),
        **{"terms": 1} | model,
    )


def test_terms_that_the_records_choose_for_each_element_are_a_candidate(monkeypatch):
    """A search that is asked for again, of the same study, is not made again."""
    chosen: dict[str, object] = {}

    def once(of: Study, **options: bool) -> object:
        asked = repr((of.model, of.priors, of.noise, of.effects, options))
        if asked not in chosen:
            chosen[asked] = structure_of(of, **options)
        return chosen[asked]

    monkeypatch.setattr("lcopa_bayes.comparison.candidates.structure_of", once)
    own = ring_and_lag()
    found = {one.name: one for one in candidates_of(own)}
    one = found[BY_ELEMENT]
    assert one.study.model.terms == {"x_u": 2, "y_u": 1}
    assert one.about.startswith("2 terms in x_u, and 1 in the others, free orders")
    assert one.notes == ("has as many terms in each element as the records choose by BIC, by least squares",)
    equal = problem_of(found["fractional-2"].study).posterior.table
    assert set(named(one)) == set(equal.names) - {"time_2_y_u", "order_2_y_u"}
    # described with "auto" it is the same model, which --resume recognises
    again = derived(own, CandidateSettings("own", terms="auto"))
    prints = {contender(each, None, quick=False, resume=True).fingerprint for each in (one, again)}
    assert len(prints) == 1


def test_terms_are_chosen_with_what_the_paths_of_a_candidate_share():
    """Of one element there is one number; chosen numbers that are equal are no candidate of their own."""
    own = ring_and_lag()
    shared = made(f"{BY_ELEMENT}-shared", own).study.model
    assert (shared.share, shared.delay) == ("all", "shared")
    assert isinstance(shared.terms, int)
    alike = study(record(device=TWO, camera=0.5, noise_sd=0.3))
    with pytest.raises(InputError, match="1 candidate left"):
        candidates_of(alike, pick=[BY_ELEMENT, "fractional-1"])


def test_terms_are_not_looked_for_where_they_are_known_or_there_is_one_element(monkeypatch):
    monkeypatch.setattr("lcopa_bayes.comparison.candidates.structure_of", None)
    plain = ["fractional-1", "fractional-1-shared", "fractional-2", "first-order", "second-order"]
    assert [one.name for one in candidates_of(ring_and_lag(), chosen=True)] == plain
    assert BY_ELEMENT not in [one.name for one in candidates_of(ring_and_lag(share="all"))]
    assert BY_ELEMENT not in [one.name for one in candidates_of(study(record()))]


def test_a_short_list_does_without_terms_that_cannot_be_chosen(monkeypatch):
    def refused(*_: object, **__: object) -> None:
        raise InputError("no search leads to a plant")

    monkeypatch.setattr("lcopa_bayes.comparison.candidates.structure_of", refused)
    assert BY_ELEMENT not in [one.name for one in candidates_of(ring_and_lag())]
    with pytest.raises(InputError, match=f"candidate '{BY_ELEMENT}': no search"):
        candidates_of(ring_and_lag(), pick=[BY_ELEMENT, "fractional-1"])


def candidates_taken(monkeypatch, source: Study | Sequence[Study]) -> list[Candidate]:
    """What the verb compares."""
    taken: list[Candidate] = []

    def noted(models: Sequence[Candidate], **_: object) -> None:
        taken.extend(models)
        raise InputError("enough is known")

    monkeypatch.setattr("lcopa_bayes.verbs.compare.compared", noted)
    with pytest.raises(InputError, match="enough is known"):
        compared(source)
    return taken


def test_studies_that_leave_their_terms_to_the_records_are_settled_before_they_are_compared(monkeypatch):
    several = [study(record(), terms=terms) for terms in ("auto", 2)]
    assert [one.study.model.terms for one in candidates_taken(monkeypatch, several)] == [1, 2]


def test_a_study_whose_records_have_chosen_is_not_searched_again(monkeypatch):
    own = ring_and_lag(terms="auto")
    settled = replace(own, model=replace(own.model, terms=2))
    monkeypatch.setattr("lcopa_bayes.verbs.compare.settled", lambda *_, **__: settled)
    monkeypatch.setattr("lcopa_bayes.comparison.candidates.structure_of", None)
    assert "fractional-2" in [one.name for one in candidates_taken(monkeypatch, own)]


def test_orders_that_priors_hold_at_integers_are_integer_orders():
    held = study(record(), terms=2, priors={"order_1": 2.0, "order_2": 1.0})
    assert made("study", held).integer
    assert not made("study", study(record(), terms=2, priors={"order_1": 2.0})).integer
    assert not made("study", study(record(), priors={"order_1": 0.5})).integer


def test_integer_candidates_have_integer_orders():
    second = made("second-order")
    table = problem_of(second.study).posterior.table
    assert second.integer
    assert [table.rows[k].value for k in table.of_kind("order")] == [2.0, 1.0]
    assert not made("fractional-2").integer
    kept = made("integer-kept", study(record(), terms=3))
    assert kept.study.model.orders == (2.0, 1.0, 1.0)
    assert made("first-order").study.model.orders == (1.0,)


def test_a_prior_on_an_order_does_not_free_an_integer():
    own = study(record(), priors={"order_1": ("uniform", {"loc": 0.2, "scale": 1.0})})
    table = problem_of(made("second-order", own).study).posterior.table
    assert not any(table.rows[k].free for k in table.of_kind("order"))
    assert problem_of(made("fractional-1", own).study).posterior.table.rows[2].prior.support == (0.2, 1.2)


def test_priors_of_parameters_that_are_gone_are_left_out_and_reported():
    own = study(record(), terms=2, priors={"time_2": 3.0, "delay": 0.5})
    one = made("fractional-1", own)
    assert set(one.study.priors) == {"delay"}
    assert "time_2" in one.notes[0]


def test_variants_of_a_two_by_two():
    own = study(record(device=TWO, camera=0.5), terms=1)
    assert sum(name.startswith("delay") for name in named(made("fractional-1-delays", own))) == 4
    assert sum(name.startswith("order") for name in named(made("fractional-1-separate", own))) == 4
    both = made("fractional-1-separate-delays", own)
    assert (both.study.model.share, both.study.model.delay) == ("none", "path")
    for name in ("fractional-1-no-cross", "fractional-1-separate-delays-no-cross"):
        table = problem_of(made(name, own).study).posterior.table
        fixed = {row.name: row.value for row in table.rows if not row.free}
        assert fixed["gain_x_y"] == fixed["gain_y_x"] == 0.0
        free = {row.name for row in table.rows if row.free and row.kind in ("gain", "time", "order", "delay")}
        assert not any(name.endswith(("x_y", "y_x")) for name in free)
    with pytest.raises(InputError, match="cross paths"):
        made("fractional-1-no-cross")


FILE = """
[compare]
pick = ["fractional-1", "slow", "flat"]
[[candidates]]
name = "slow"
terms = 2
noise = "ar1"
[candidates.priors]
time_1 = { dist = "loguniform", a = 1.0, b = 100.0 }
delay = 0.5
[[candidates]]
name = "flat"
orders = [1.5, 1]
priors = { gain = { dist = "flat" } }
"""


def test_a_file_adds_and_picks(tmp_path):
    path = tmp_path / "more.toml"
    path.write_text(FILE)
    pick, extra = load_candidates(path)
    found = candidates_of(study(record()), extra, pick)
    assert [one.name for one in found] == ["fractional-1", "slow", "flat"]
    slow = problem_of(found[1].study).posterior
    assert slow.noise.kind == "ar1"
    assert slow.table.rows[slow.table.names.index("delay")].value == 0.5
    assert found[2].improper == ("gain",)
    assert not found[2].integer
    assert found[2].notes[0].startswith("has an improper prior of gain, so its evidence is undefined")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[[candidates]]\nname = "a"\nfit = ["b.csv"]', "same data"),
        ("[[candidates]]\nterms = 2", "needs a `name`"),
        ('[[candidates]]\nname = "a/b"', "fit for a folder"),
        ('[[candidates]]\nname = "a"\nterms = 9', "`terms` must be a whole number"),
        ('[[candidates]]\nname = "a"\nterm = 2', "did you mean 'terms'"),
        ('[[candidates]]\nname = "a"\nnoise = "pink"', "`noise` must be one of"),
        ('[[candidates]]\nname = "a"\npriors = { gain = { dist = "nrm" } }', "unknown distribution"),
        ('[[candidates]]\nname = "a"\n[[candidates]]\nname = "a"', "2 candidates are named 'a'"),
        ("[compare]\npick = 3", "`pick` must be a list"),
        ("[candidate]\nname = 3", "did you mean 'candidates'"),
        ("", "names no candidate"),
        ("not toml", "is not valid TOML"),
    ],
)
def test_what_is_wrong_in_a_file_is_reported(tmp_path, text, said):
    path = tmp_path / "more.toml"
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load_candidates(path)
    assert said in str(refused.value)
    assert str(path) in str(refused.value)


def test_unknown_names_and_single_candidates_are_refused():
    with pytest.raises(InputError, match="did you mean 'fractional-2'"):
        candidates_of(study(record()), pick=["fractionl-2", "first-order"])
    with pytest.raises(InputError, match="1 candidate left"):
        candidates_of(study(record()), pick=["fractional-1", "study"])  # the same model twice


def test_what_is_wrong_with_a_candidate_says_which_it_is_also_by_a_short_name():
    """The letter occurs in the message anyway."""
    short = CandidateSettings("a", terms={"zz": 2})
    with pytest.raises(InputError, match="candidate 'a': "):
        candidates_of(study(record()), extra=[short], pick=["a", "first-order"])
    with pytest.raises(InputError, match="no parameter 'gian'"):
        derived(study(record()), CandidateSettings("a", priors={"gian": PriorSettings("gian", dist="flat")}))


def test_candidates_of_different_data_are_refused():
    one, other = made("fractional-1"), made("first-order", study(record(2)))
    with pytest.raises(InputError, match="different data"):
        compare([one, other])
    held = made("first-order", study(record(), held_out=[record(2, name="b")]))
    with pytest.raises(InputError, match="different data"):
        compare([one, held])
    with pytest.raises(InputError, match="two candidates or more"):
        compare([one])
