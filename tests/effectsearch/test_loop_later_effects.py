"""Effects beside others where something remains that no effect explains: named where unseen records are
predicted better with them."""

from dataclasses import replace
from functools import lru_cache, partial

import numpy as np
import pytest

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch import rounds
from lcopa_bayes.effectsearch.basemodel import Base, fitted_base
from lcopa_bayes.effectsearch.findings import Side, findings_of, predicts_better, unfollowed
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.rounds import Search
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.sampling.convergence import Grade

MODES = ((0.6, 1.0, 0.2), (0.25, 2.6, 0.1), (0.15, 1.7, 0.1))
"""Share of the gain [-], angular frequency [1/ms] and damping [-] of three resonances: no plant of the family
has them, nor has one with the extra mode of the catalogue."""
LIBRARY = [catalogue()[name] for name in ("extra_mode", "flicker", "vibration")]
U, Y = (Axis("u", "V"),), (Axis("y", "mm"),)


def ringing(t: np.ndarray) -> np.ndarray:
    late, out = np.maximum(t, 0.0), np.zeros_like(t)
    for share, frequency, damping in MODES:
        decay, swing = damping * frequency, frequency * np.sqrt(1 - damping**2)
        wave = np.cos(swing * late) + decay / swing * np.sin(swing * late)
        out += share * (1 - np.exp(-decay * late) * wave)
    return out


def study(seed: int, rest: int = 30) -> Study:
    rng, records, time = np.random.default_rng(seed), [], np.arange(rest + 120) * 0.4
    for name in ("a", "b", "held"):
        drive, response = np.zeros(time.size), 0.01 * rng.standard_normal(time.size)
        for at in np.sort(rng.choice(np.arange(rest, time.size - 10), 6, replace=False)):
            level = rng.choice([-2.0, -1.0, 0.0, 1.0, 2.0])
            response += 2.0 * (level - drive[-1]) * ringing(time - time[at] - 1.0)
            drive[at:] = level
        records.append(Record(name, time, drive[:, None], response[:, None], U, Y, "ms"))
    return Study("modes", None, "ms", seed, tuple(records[:2]), tuple(records[2:]), ModelSettings(terms=2))


def judged_given(base: Base, searched: Search) -> tuple[str, ...]:
    """Effects that held-out records are taken to say of themselves."""
    before, after = (Side.of(base.problem, state) for state in (base.start, searched.state))
    own = base.problem.study
    return findings_of(own, searched, before, after, outliers=None, cautions=(), alone=False).varying


@lru_cache
def base_of(seed: int) -> Base:
    return fitted_base(study(seed), LIBRARY, as_stated=True, draws=200)


@lru_cache
def searched(seed: int) -> tuple[Search, Search, list[list[str]]]:
    """What is found, what had been added before unseen records were asked, and for which effects they
    were."""
    base, added, asked = base_of(seed), [], []
    one_by_one = rounds._one_by_one

    def recorded(*given, **how):
        every = one_by_one(*given, **how)
        added.append(Search.ending(list(every), dict))
        return every

    def better(larger, smaller):
        asked.append([effect.name for effect in larger.model.effects])
        return predicts_better(base.problem, larger, smaller)

    options = {"noise_samples": base.fit.noise_samples, "draws": 200}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rounds, "_one_by_one", recorded)
        found = rounds.search(base.start, LIBRARY, np.random.default_rng(1), better=better, **options)
    return found, added[0], asked


@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_an_effect_that_unseen_records_do_not_confirm_is_taken_back(seed: int) -> None:
    """Amplitudes of a flicker are free in every record, and take up some of what a resonance leaves."""
    base, (found, unasked, asked) = base_of(seed), searched(seed)
    assert [effect.name for effect in unasked.state.model.effects] == ["extra_mode", "flicker"]
    assert [effect.name for effect in found.state.model.effects] == ["extra_mode"]
    assert ["extra_mode", "flicker"] in asked
    assert found.rounds[-1].alarmed
    assert found.groups == (("extra_mode",),)
    assert 0 < found.gained < unasked.gained
    assert judged_given(base, unasked) == ()  # it would take up what the resonance leaves there too
    last = unasked.rounds[-1]
    quiet = replace(last, trace=replace(last.trace, threshold=np.inf))
    assert judged_given(base, replace(unasked, rounds=(*unasked.rounds[:-1], quiet))) == ("flicker",)


def test_an_effect_that_is_there_predicts_better() -> None:
    """Of the first resonance that is missing: with it and without it, and the other way round."""
    base, found = base_of(0), searched(0)[1].rounds[1].state
    assert [effect.name for effect in found.model.effects] == ["extra_mode"]
    better = partial(predicts_better, base.problem)
    assert better(found, base.start)
    assert not better(base.start, found)


@pytest.fixture(scope="module")
def unexplained() -> Loop:
    """A plant of two terms that leaves many times the noise, and nothing to explain that."""
    kinds = [catalogue()["unmodelled_nonlinear"]]
    found = loop(study(1, rest=80), library=kinds, sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "unexplained"
    return found


def test_numbers_of_a_model_that_does_not_follow_its_records_are_unusable(unexplained: Loop) -> None:
    scores = unexplained.after.fit
    error = np.sqrt(np.mean(np.concatenate([one.observed - one.predicted for one in scores]) ** 2))
    said = unfollowed(scores)
    assert f"the error of y is {error / scores[0].noise_sd:.3g} times the noise" in said
    assert error > 20 * 0.01
    assert unexplained.grade == Grade("unusable", said)
    assert unexplained.estimate(0)["grade"] == "unusable"
    tenth = [0.1 * one.observed.std() for one in scores]
    within = [
        replace(one, predicted=one.observed + size, noise_sd=size / 2)
        for one, size in zip(scores, tenth, strict=True)
    ]
    slight = [replace(one, predicted=one.observed + 0.02 * one.observed.std()) for one in scores]
    assert unfollowed(within) == unfollowed(slight) == ""


def test_intervals_beside_what_remains_are_those_of_the_noise_with_it(unexplained: Loop) -> None:
    """Several times wider than those of the measured noise, and over draws under that of the residual."""
    assert unexplained.loose is not None
    measured, loose = unexplained.after.state, unexplained.loose
    k = measured.model.names.index("gain")
    assert measured.whitening.excess(measured.optimum.residual) > 20
    assert loose.whitening.excess(loose.optimum.residual) < 2
    assert loose.optimum.sd[k] / measured.optimum.sd[k] > 3
    own = unexplained.estimate(k)
    assert own["sd_noise"] > 0.3 * loose.optimum.sd[k]
    assert own["sd_structure"] == 0.0
