"""Which paths share what, and what each is called."""

from __future__ import annotations

import pytest

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.layout import ElementSlot, Layout, Unit

X, Y = Axis("x", "rad"), Axis("y", "rad")
HEATERS, SENSORS = (Axis("q1", "pct"), Axis("q2", "pct")), (Axis("t1", "degC"), Axis("t2", "degC"))


def names(layout: Layout) -> tuple[str, ...]:
    return tuple(slot.name for slot in layout.elements)


@pytest.mark.parametrize("share", ["paper", "all", "none"])
@pytest.mark.parametrize("delay", ["shared", "element", "path"])
@pytest.mark.parametrize("drive", [X, HEATERS[0]])
def test_one_path_has_no_names_to_tell_apart(share, delay, drive):
    layout = Layout.of((drive,), (X,), ModelSettings(terms=2, share=share, delay=delay))
    assert layout.elements == (ElementSlot("", 2),)
    assert layout.delays == ("",)
    assert layout.units == (Unit(0, 0, 0),)
    assert (layout.path_name(0, 0), layout.response_name(0)) == ("", "")


@pytest.mark.parametrize(("drives", "responses"), [((X, Y), (X, Y)), (HEATERS, SENSORS)])
def test_two_axes_as_in_the_paper(drives, responses):
    """Direct and cross elements, Eq. 65, by axis name or, when no name is both, by position."""
    layout = Layout.of(drives, responses, ModelSettings(terms={"direct": 3, "cross": 2}))
    assert layout.elements == (ElementSlot("direct", 3), ElementSlot("cross", 2))
    assert layout.element_of == ((0, 1), (1, 0))
    assert layout.delays == ("",)
    assert layout.delay_of == ((0, 0), (0, 0))
    assert layout.units == (Unit(0, 0, 0), Unit(1, 0, 1), Unit(1, 0, 0), Unit(0, 0, 1))
    assert layout.unit_of == ((0, 1), (2, 3))
    assert layout.path_name(0, 1) == f"{responses[0].name}_{drives[1].name}"
    assert layout.response_name(1) == responses[1].name


def test_names_decide_over_positions():
    layout = Layout.of((Y, X), (X, Y), ModelSettings())
    assert names(layout) == ("cross", "direct")
    assert layout.element_of == ((0, 1), (1, 0))
    assert layout.path_name(0, 0) == "x_y"


def test_a_single_shared_name_is_enough_to_decide():
    layout = Layout.of((X, HEATERS[1]), (X, SENSORS[1]), ModelSettings())
    assert layout.element_of == ((0, 1), (1, 1))
    assert names(layout) == ("direct", "cross")


def test_all_paths_share_one_element():
    layout = Layout.of((X, Y), (X, Y), ModelSettings(terms=2, share="all"))
    assert layout.elements == (ElementSlot("", 2),)
    assert layout.units == (Unit(0, 0, 0), Unit(0, 0, 1))
    assert layout.unit_of == ((0, 1), (0, 1))


def test_every_path_its_own():
    layout = Layout.of((X, Y), (X, Y), ModelSettings(share="none", delay="path"))
    assert names(layout) == layout.delays == ("x_x", "x_y", "y_x", "y_y")
    assert layout.element_of == layout.delay_of == ((0, 1), (2, 3))
    assert layout.units == tuple(Unit(k, k, k % 2) for k in range(4))


@pytest.mark.parametrize(
    ("share", "delay", "delays"),
    [
        ("paper", "shared", ("",)),
        ("paper", "element", ("direct", "cross")),
        ("paper", "path", ("x_x", "x_y", "y_x", "y_y")),
        ("all", "element", ("",)),
        ("all", "path", ("x_x", "x_y", "y_x", "y_y")),
        ("none", "element", ("x_x", "x_y", "y_x", "y_y")),
        ("none", "shared", ("",)),
    ],
)
def test_delays_follow_their_own_setting(share, delay, delays):
    assert Layout.of((X, Y), (X, Y), ModelSettings(share=share, delay=delay)).delays == delays


def test_one_drive_to_two_responses_and_two_to_one():
    fan = Layout.of((X,), (X, Y), ModelSettings(share="paper"))
    assert names(fan) == ("direct", "cross")
    assert fan.element_of == ((0,), (1,))
    assert fan.path_name(1, 0) == "y_x"
    assert fan.response_name(0) == "x"
    funnel = Layout.of((X, Y), (Y,), ModelSettings(share="paper"))
    assert names(funnel) == ("cross", "direct")
    assert funnel.element_of == ((0, 1),)
    assert funnel.path_name(0, 1) == "y_y"
    assert funnel.response_name(0) == ""


@pytest.mark.parametrize(("drives", "responses"), [((X,), (X, Y)), ((X, Y), (Y,))])
def test_paths_of_a_plant_that_is_not_square_share_nothing_unless_stated(drives, responses):
    own = Layout.of(drives, responses, ModelSettings())
    assert len(own.elements) == len(own.delays) == 2
    terms = Layout.of(drives, responses, ModelSettings(terms={"direct": 2, "cross": 1}))
    assert {slot.name: slot.terms for slot in terms.elements} == {"direct": 2, "cross": 1}
    stated = Layout.of(drives, responses, ModelSettings(share="all", delay="shared"))
    assert (len(stated.elements), len(stated.delays)) == (1, 1)


def test_one_kind_of_path_needs_no_name():
    """A drive that is no response axis, by name, next to one that is neither."""
    layout = Layout.of((X, Y), (X,), ModelSettings(share="all"))
    assert names(layout) == ("",)
    only_cross = Layout.of((X,), (Y, Axis("x", "V")), ModelSettings(share="paper"))
    assert names(only_cross) == ("cross", "direct")


def test_terms_for_elements_that_do_not_exist_are_refused_with_the_nearest():
    with pytest.raises(InputError) as caught:
        Layout.of((X, Y), (X, Y), ModelSettings(terms={"dirct": 3, "cross": 2}))
    wrong, missing = caught.value.problems
    assert "'dirct'" in wrong
    assert "did you mean 'direct'?" in wrong
    assert "no number for the element 'direct'" in missing
    assert "add `direct = 1`" in missing


def test_terms_by_name_where_there_is_one_element():
    with pytest.raises(InputError, match="'cross'"):
        Layout.of((X,), (X,), ModelSettings(terms={"cross": 2}))
