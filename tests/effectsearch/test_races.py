"""Effort of a round: what a few evaluations leave far behind is not refitted to its end."""

from dataclasses import replace
from functools import lru_cache
from types import SimpleNamespace
from typing import NoReturn

import numpy as np
import pytest
from test_loop import LIBRARY, study

from lcopa_bayes.core.crew import ALONE
from lcopa_bayes.effectsearch import candidates, effectpairs, rounds
from lcopa_bayes.effectsearch.basemodel import fitted_base
from lcopa_bayes.effectsearch.candidates import _blind, followed, refitted
from lcopa_bayes.effectsearch.effectpairs import paired
from lcopa_bayes.effectsearch.refits import Refit, begun, ended, refit
from lcopa_bayes.effectsearch.rounds import Round, _one_by_one
from lcopa_bayes.effectsearch.trace import trace
from lcopa_bayes.model.effects.catalogue import catalogue

BENT = 0.06
"""Curvature of a reading [1/rad]."""


@lru_cache
def look(even: float = 0.0) -> Round:
    """A reading that bends, perhaps evenly too, looked at with the plant alone."""
    made = study(2, BENT)
    fit = tuple(replace(one, response=one.response + even * one.response**2) for one in made.fit)
    base = fitted_base(replace(made, fit=fit), LIBRARY, as_stated=True, draws=400)
    seen = trace(base.start, LIBRARY, np.random.default_rng(0), noise_samples=base.fit.noise_samples)
    return Round(base.start, seen)


@pytest.fixture
def near(monkeypatch):
    """All effects of some evidence come into question; the best is worth more than twice the next."""
    monkeypatch.setattr(candidates, "NEAR", 0.0)
    monkeypatch.setattr(candidates, "_BEHIND", 0.6)
    monkeypatch.setattr(candidates, "_CANDIDATES", 9)


def test_only_what_may_be_ahead_is_refitted_to_its_end(near, monkeypatch):
    first = look()
    some, failures = refitted(first.state, first.trace)
    assert not failures
    best = some[0]
    behind = [one for one in some if one.glances]
    assert best.added == ("odd_curvature",)
    assert not best.glances
    assert behind
    assert all(one.worth < min(0.6 * best.worth, best.worth - 30.0) for one in behind)

    monkeypatch.setattr(candidates, "_FAR_BEHIND", np.inf)
    every, _ = refitted(first.state, first.trace)
    assert not any(one.glances for one in every)
    assert every[0].added == best.added
    known = {one.added: one for one in every}
    for one in some:  # an end is no lower than where it began
        assert one.log_bayes_factor <= known[one.added].log_bayes_factor + 0.05
        assert bool(one.glances) or one.optimum.cost == known[one.added].optimum.cost
    after, failures = followed(first.state, some)
    assert not failures
    assert [one.added for one in after] == [one.added for one in every]
    assert [one.optimum.cost for one in after] == [known[one.added].optimum.cost for one in after]


def test_a_refit_that_has_no_end_is_a_failure_and_no_traceback(near, monkeypatch):
    """Where it was only begun and nothing ahead of it is accepted."""
    first = look().refitted(ALONE)
    begun_only = next(one for one in first.refits if one.glances)

    def unbounded(one: Refit) -> Refit:
        if one.added == begun_only.added:
            raise FloatingPointError("the simulated response is not finite")
        return ended(one)

    monkeypatch.setattr(candidates, "ended", unbounded)
    after = first.followed(ALONE)
    assert begun_only.added not in [one.added for one in after.refits]
    assert not any(one.glances for one in after.refits)
    assert after.failures == (*first.failures, f"{begun_only.added[0]}: the simulated response is not finite")


def test_a_refit_that_was_only_begun_ends_where_one_at_once_does():
    state, effect = look().state, catalogue()["odd_curvature"]()
    given = (state.model, state.optimum, state.whitening, [(effect, np.ones(1))], 1e3)
    start, whole = begun(*given), refit(*given)
    assert start.glances
    assert start.optimum.cost == pytest.approx(min(one.cost for one in start.glances))
    assert start.optimum.cost >= whole.optimum.cost
    assert 0 < start.worth <= whole.worth
    assert ended(start).optimum.cost == whole.optimum.cost
    assert ended(whole) is whole
    assert start.under(start.whitening).glances == ()


def test_a_refit_that_was_only_begun_is_taken_to_its_end_before_it_is_chosen(near, monkeypatch):
    """Where all that is ahead of it cannot be accepted."""

    class ChosenError(Exception):
        """The refit that is added."""

    def kept(chosen: Refit) -> NoReturn:
        raise ChosenError(chosen)

    def accepted(refits, *_, **__) -> list[Refit]:
        return [one for one in refits if one.added == ("even_curvature",)]

    first = look()
    begun_only = next(
        one for one in refitted(first.state, first.trace)[0] if one.added == ("even_curvature",)
    )
    assert begun_only.glances
    monkeypatch.setattr(rounds, "accepted", accepted)
    monkeypatch.setattr(rounds, "_kept", kept)
    with pytest.raises(ChosenError) as caught:
        _one_by_one(first, lambda state: first, ALONE, alone=False)
    (chosen,) = caught.value.args
    assert chosen.added == ("even_curvature",)
    assert not chosen.glances


@pytest.mark.parametrize(("effects", "error", "searched"), [(1, 6.0, True), (2, 6.0, False), (2, 4.0, True)])
def test_no_third_effect_is_looked_for_where_two_leave_far_more_than_the_noise(effects, error, searched):
    """Errors of six and four times the noise."""
    model = SimpleNamespace(effects=tuple(catalogue()[name]() for name in LIBRARY_NAMES[:effects]))
    state = SimpleNamespace(model=model, whitening=SimpleNamespace(dependence=()))
    seen = SimpleNamespace(alarmed=True, residual=np.full(10, error), threshold=3.0)
    last = Round(state, seen)
    if searched:
        with pytest.raises(AttributeError):  # a refit needs all that is known of a trace
            _one_by_one(last, lambda state: last, ALONE, alone=False)
    else:
        (only,) = _one_by_one(last, lambda state: last, ALONE, alone=False)
        assert only.chosen is None
        assert only.trace is seen


LIBRARY_NAMES = ("odd_curvature", "even_curvature")


def test_a_pair_that_begins_far_below_what_is_to_be_beaten_is_left_out(monkeypatch):
    first, taken = look(BENT), []
    monkeypatch.setattr(effectpairs, "ended", lambda one: taken.append(one.added) or ended(one))
    assert paired(first.state, first.state, first.trace) is not None
    assert {"odd_curvature", "even_curvature"} in map(set, taken)
    monkeypatch.setattr(effectpairs, "evidence_over", lambda *_: (1e4, 0.0))
    taken.clear()
    assert paired(first.state, first.state, first.trace) is None
    assert not taken


@pytest.mark.parametrize(
    ("survival", "tried"),
    [
        (0.0, []),
        (0.02, ["cross_fade", "exposure", "sensor_lag", "odd_curvature"]),
        (0.6, ["cross_fade", "exposure", "sensor_lag"]),
    ],
)
def test_what_looks_like_a_delay_is_tried_whatever_its_linear_estimate(
    survival: float, tried: list[str]
) -> None:
    """As what the plant imitates to first order is; not what has no signature at all, and no other effect."""
    names = ("cross_fade", "exposure", "sensor_lag", "odd_curvature", "clock_skew", "cubic_stiffness")
    own = SimpleNamespace(survival=survival)
    seen = [
        SimpleNamespace(card=catalogue()[name].card, survival=survival, signature=own, signatures=(own,))
        for name in names
    ]
    assert [one.card.name for one in _blind(SimpleNamespace(traced=seen))] == tried
