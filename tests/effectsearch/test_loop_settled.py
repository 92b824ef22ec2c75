"""What the loop ends with: noise as the last residual has it, internal constants that are not known, and firm
names."""

import types
from dataclasses import replace
from typing import NoReturn

import numpy as np
import pytest
from test_loop import LIBRARY, records, study

from lcopa_bayes.core.crew import ALONE
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basemodel import fitted_base
from lcopa_bayes.effectsearch.candidates import other_instance
from lcopa_bayes.effectsearch.freedconstants import released
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.refits import SIGNIFICANT, evidence_over, refit
from lcopa_bayes.effectsearch.regression import Regression
from lcopa_bayes.effectsearch.rounds import Round, _beside_others, _groups, search
from lcopa_bayes.effectsearch.scores import State
from lcopa_bayes.effectsearch.signature import Scale, Signature
from lcopa_bayes.effectsearch.trace import Trace, Traced, trace
from lcopa_bayes.inference.noise import WhiteAR1
from lcopa_bayes.model.effects.catalogue import catalogue

LAW = np.array([[0.0, 5e-3, 0.6]])
BENT = 0.06
"""Curvature of a reading [1/rad]."""


def coloured(seed):
    """Four records of coloured noise with 14 samples at rest each."""
    made, rng = [], np.random.default_rng(seed + 100)
    for bare, noisy in zip(records(seed, quiet=2.0, noise=0.0), records(seed, quiet=2.0), strict=True):
        seen = ~np.isnan(bare.response[:, 0])
        noise = np.full(bare.response.shape, np.nan)
        noise[seen, 0] = WhiteAR1().draw(LAW, np.ones(seen.sum()), rng)[0]
        made.append(replace(noisy, response=bare.response + noise))
    return Study(
        "small", None, "ms", seed, tuple(made[:4]), (made[4],), ModelSettings(terms=1, offset="shared")
    )


def test_noise_that_few_samples_at_rest_leave_open_is_that_of_the_residual():
    """By the law that made it; samples at rest leave laws plausible under which no effect would stand out."""
    made = coloured(4)
    base = fitted_base(made, LIBRARY, as_stated=True, draws=400)
    quiet = trace(base.start, LIBRARY, np.random.default_rng(0), noise_samples=base.fit.noise_samples)
    found = loop(made, library=LIBRARY, sample=False, quick=True, as_stated=True)
    (law,) = found.after.state.whitening.noise
    assert not base.fit.noise[0].firm
    assert found.verdict.kind == "clean"
    assert found.trace.threshold < 0.5 * quiet.threshold
    assert law.sd == pytest.approx(5e-3, rel=0.1)
    assert law.share * law.rho == pytest.approx(0.6, abs=0.1)


def bent():
    """Two records of a bent reading."""
    made = study(2, BENT)
    return replace(made, fit=made.fit[:2])


@pytest.fixture(scope="module")
def pulsed():
    """A base fit with a pulse after every change, of a length that is not known."""
    made = study(3)
    base = fitted_base(made, [], as_stated=True, draws=400).start
    kind = catalogue()["overdrive_pulse"]
    model = base.model.having(kind(2.3))
    shape = model.predict(np.append(base.optimum.x, 0.2)) - base.model.predict(base.optimum.x)
    white = base.whitening
    samples, first = [], 0
    for one in white.samples:
        (axis,) = one.axes
        values = axis.values + shape[first : first + axis.values.size]
        samples.append(replace(one, axes=(replace(axis, values=values),)))
        first += axis.values.size
    plant = replace(base.model.plant, samples=tuple(samples))
    white = replace(white, samples=tuple(samples))
    bare = replace(base.model, plant=plant)
    before = Regression(bare, white).descend(base.optimum.x)
    return refit(bare, before, white, [(kind(2.0), np.ones(1))], 1e4)


def test_what_a_length_leaves_open_is_in_every_interval(pulsed):
    """By differences of the prediction in all coordinates, the length among them."""
    end = released(pulsed.state)
    (effect,) = end.model.effects
    x, k = end.optimum.x, end.optimum.x.size
    assert effect.frame == pytest.approx(2.3, abs=0.3)

    def predicted(at):
        return end.whitening(end.model.having(replace(effect, frame=float(np.exp(at[k])))).predict(at[:k]))

    here, steps = np.append(x, np.log(effect.frame)), 1e-4 * np.eye(k + 1)
    slopes = np.array([(predicted(here + h) - predicted(here - h)) / 2e-4 for h in steps])
    information = slopes @ slopes.T
    information[:k, :k] += np.diag(1 / end.model.spread**2)
    assert np.sqrt(np.diag(end.covariance)) == pytest.approx(
        np.sqrt(np.diag(np.linalg.inv(information)))[:k], rel=0.03
    )
    assert (end.covariance.diagonal() > 1.05 * end.optimum.covariance.diagonal()).any()


def test_an_effect_of_several_instances_is_worth_what_its_refit_is(pulsed):
    """The choice among the frames of a pulse is paid for in either."""
    plain, _ = pulsed.without(pulsed.added)
    gained, _ = evidence_over(State(plain, pulsed.before, pulsed.whitening), pulsed.state, pulsed.quiet)
    assert gained == pytest.approx(pulsed.log_bayes_factor)
    assert pulsed.paid < -2.0
    assert evidence_over(pulsed.state, pulsed.state, pulsed.quiet)[0] == 0.0


def test_each_of_two_effects_counts_by_what_it_brings_beside_the_other():
    """By a refit that adds it to the plant with the other."""
    made = bent()
    base = fitted_base(made, LIBRARY, as_stated=True, draws=400).start
    odd, even = (catalogue()[name]() for name in ("odd_curvature", "even_curvature"))
    one = refit(base.model, base.optimum, base.whitening, [(even, np.zeros(1))], 1e3)
    two = refit(one.model, one.optimum, one.whitening, [(odd, np.zeros(1))], 1e3)
    of_even, of_odd = _beside_others(two.state, 1e3)
    assert of_odd == pytest.approx(two.log_bayes_factor, abs=0.5)
    assert of_even < 5 < 30 < of_odd
    assert two.wald("even_curvature") > SIGNIFICANT


def test_each_of_a_pair_has_the_names_that_may_stand_for_it_beside_the_other():
    """A twin of the one under another name, and none of the other; alone each confounds both."""
    made = bent()
    made = replace(
        made, fit=tuple(replace(one, response=one.response + BENT * one.response**2) for one in made.fit)
    )
    odd, even = (catalogue()[name] for name in ("odd_curvature", "even_curvature"))
    twin = type("Twin", (odd,), {"card": replace(odd.card, name="twin")})
    base = fitted_base(made, [], as_stated=True, draws=400).start

    def looking(state: State) -> Round:
        seen = trace(state, [odd, even, twin], np.random.default_rng(0), noise_samples=(1000,), draws=400)
        return Round(state, seen)

    pair = refit(base.model, base.optimum, base.whitening, [(odd(), np.zeros(1)), (even(), np.zeros(1))], 1e3)
    groups = _groups(pair, looking, ALONE)
    assert groups == {"odd_curvature": ("odd_curvature", "twin"), "even_curvature": ("even_curvature",)}


def test_another_instance_is_one_of_another_signature():
    """Of frames whose signatures lie at angles of 2, 60 and 90 degrees to that of the best."""
    kind, angles = catalogue()["overdrive_pulse"], np.radians([0.0, 2.0, 60.0, 90.0])
    signatures = tuple(
        Signature.of(kind(1.0 + k), 10 * np.array([[np.cos(a)], [np.sin(a)], [0.0]]), 1.0, False)
        for k, a in enumerate(angles)
    )
    residual = np.array([9.0, 7.0, 1.0])
    known = Scale(1e6, 3.0, np.array([residual @ residual]))
    traced = Traced(kind.card, signatures, 0.0, 0)
    seen = Trace((traced,), 3.0, (3.0, 3.0), np.nan, 0, residual, known)
    assert other_instance(seen, traced, 0.0) is signatures[2]
    assert other_instance(seen, traced, 0.99 * seen.alone(signatures[2])) is signatures[2]
    assert other_instance(seen, traced, 1.01 * seen.alone(signatures[2])) is None


def test_names_are_firm_where_each_brought_enough_and_nothing_remains():
    made = bent()
    base = fitted_base(made, LIBRARY, as_stated=True, draws=400)
    found = search(
        base.start, LIBRARY, np.random.default_rng(0), noise_samples=base.fit.noise_samples, draws=400
    )
    assert found.apart
    assert found.brought > 30
    assert not replace(found, brought=29.0).apart
    last = found.rounds[-1]
    left = replace(last, trace=replace(last.trace, threshold=-1e3))

    def asked() -> NoReturn:
        raise AssertionError

    remains = replace(found, rounds=(*found.rounds[:-1], left), confounded=asked)
    assert not remains.apart  # nothing has to be refitted to know that
    with pytest.raises(AssertionError):
        assert replace(found, confounded=asked).apart
    shared = replace(found, confounded=lambda: {"odd_curvature": ("odd_curvature", "twin")})
    assert shared.groups == (("odd_curvature", "twin"),)
    assert not shared.apart
    assert isinstance(found.state, State)


def test_a_name_is_firm_where_every_other_is_clearly_behind():
    """A generic class behind it says nothing of the name, and a pair has groups of its own."""
    made = bent()
    base = fitted_base(made, LIBRARY, as_stated=True, draws=400)
    found = search(
        base.start, LIBRARY, np.random.default_rng(0), noise_samples=base.fit.noise_samples, draws=400
    )
    first, *more = found.rounds
    assert first.chosen is not None

    def apart(behind: float, dynamics: bool = False) -> bool:
        assert first.chosen is not None
        other = types.SimpleNamespace(
            added=("other",), dynamics=dynamics, log_bayes_factor=first.chosen.log_bayes_factor - behind
        )
        return replace(found, rounds=(replace(first, refits=(first.chosen, other)), *more)).apart

    assert [apart(behind) for behind in (5.9, 6.1)] == [False, True]
    assert apart(4.0, dynamics=True)
    assert first.ahead > 6.0
    assert found.rounds[-1].ahead == np.inf
