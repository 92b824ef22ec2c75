"""A candidate with effects and held-out records beside one that its optima reject."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import record, study, with_effect

from lcopa_bayes.bench.command import staircase
from lcopa_bayes.comparison import candidatefit
from lcopa_bayes.comparison.candidatefit import REJECTED, contender, laplace
from lcopa_bayes.comparison.candidates import of_studies
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.comparison.predictivedensity import predictions
from lcopa_bayes.data.settings import EffectsSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.sampling.convergence import Limitation

TRUTH = {
    "gain": 2.0, "time": 1.5, "order": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.003, "coefficient": 0.4,
}  # fmt: skip


@pytest.fixture(scope="module")
def explained() -> Fit:
    """Two records of a plant with a stiffening spring, and a third held out."""
    commands = [staircase([a, -0.7 * a, 0.0], hold=3.0, start=0.55) for a in (1.0, 0.5, 0.8)]
    made = [record(k, command=c, camera=0.3, duration=12.0, name=f"r{k}") for k, c in enumerate(commands)]
    whole, _ = with_effect(study(*made, seed=4), ["cubic_stiffness"], TRUTH)
    return fit(replace(whole, name="explained", fit=whole.fit[:2], held_out=whole.fit[2:]), quick=True)


@pytest.fixture(scope="module")
def plain(explained: Fit) -> Fit:
    return fit(replace(explained.study, name="plain", effects=EffectsSettings(), priors={}))


def test_a_surrogate_predicts_held_out_records_as_the_effects_do(explained: Fit):
    """The known records by the surrogate or simulated; the record that is predicted is always simulated."""
    assert explained.run.surrogate is not None
    exact = replace(explained, run=replace(explained.run, surrogate=None))
    near, own = (predictions(one, held_out_only=True) for one in (explained, exact))
    assert [one.part.name for one in near] == ["r2"]
    assert near[0].log_density.size > 20
    np.testing.assert_allclose(near[0].log_density, own[0].log_density, atol=0.02)


def test_what_its_optima_reject_is_sampled_around_them_alone(explained: Fit, plain: Fit):
    """Its evidence is that of sampling in full; the candidate with the effect is preferred."""
    models = of_studies([plain.study, explained.study], [None, explained])
    result = compare(models, quick=True)
    cards = {one["name"]: one for one in result["models"]}
    assert result["preferred"] == "explained"
    apart = cards["explained"]["log_evidence"] - cards["plain"]["log_evidence"]
    assert apart > REJECTED
    assert cards["plain"]["grade"] == "tentative"
    assert "around them alone" in cards["plain"]["grade_reason"]
    assert plain.evidence is not None
    assert cards["plain"]["log_evidence"] == pytest.approx(plain.evidence.value, abs=0.5)
    assert laplace(plain.problem) == pytest.approx(plain.evidence.value, abs=3.0)


@pytest.mark.parametrize(("stopped", "fits"), [(None, 2), (60.0, 1)])
def test_a_candidate_is_fitted_again_unless_its_budget_ended_it(plain: Fit, monkeypatch, stopped, fits):
    """The other plan would end at the same time."""
    unusable = plain.draws.limited((Limitation("unusable", "no draw counts", "draw more"),))
    run, plans = replace(plain.run, stopped_after=stopped), []

    def fitted(study: Study, **_: object) -> Fit:
        plans.append(study.sampler)
        return replace(plain, draws=unusable, run=run)

    monkeypatch.setattr(candidatefit, "fit", fitted)
    (one, _) = of_studies([plain.study, plain.study], [None, None])
    card = contender(one, None, quick=True, resume=False)()
    assert card["grade"] == "unusable"
    assert len(plans) == fits


def test_what_is_not_far_behind_is_sampled_in_full(plain: Fit):
    """Also where it is sampled again: a finished fit has the evidence that it has."""
    one, other = (
        contender(each, None, quick=True, resume=False)
        for each in of_studies([plain.study, plain.study], [plain, None])
    )
    assert plain.evidence is not None
    assert one.rough == plain.evidence.value
    assert other.rough == laplace(plain.problem)
    assert other.fingerprint != replace(other, rejected=True).fingerprint
