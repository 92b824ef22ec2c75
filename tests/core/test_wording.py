"""Lists of names and clauses of a sentence."""

from lcopa_bayes.core.errors import nearest
from lcopa_bayes.core.wording import joined, listed


def test_a_list_ends_with_how_many_more_there_are():
    assert listed(["a", "b"], 2) == "a, b"
    assert listed(["a", "b", "c", "d"], 2) == "a, b and 2 more"
    assert listed([]) == ""
    assert listed([str(k) for k in range(9)]).endswith("7 and 1 more")


def test_of_many_known_words_a_message_lists_some():
    assert nearest("q", [f"{k:03d}" for k in range(500)]).endswith("038, 039 and 460 more")
    assert nearest("00l", ["000", "001"]) == "; did you mean '001'?"


def test_clauses_become_one_sentence():
    assert joined(["one thing", "another", "one thing"]) == "One thing; another."
    assert joined(iter(())) == ""
