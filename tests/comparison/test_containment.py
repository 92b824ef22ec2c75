"""Nested candidates: which contains which, where the smaller's optimum lies in the larger, missed modes."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from small import TWO, path, problem, record, row_values, study

from lcopa_bayes.bench.command import prbs
from lcopa_bayes.bench.device import Device
from lcopa_bayes.comparison import candidatefit
from lcopa_bayes.comparison.candidatefit import Contender, highest
from lcopa_bayes.comparison.candidates import candidates_of, derived, known_settings
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.comparison.containment import Check, reached, share_of
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.nestedmodels import lifted
from lcopa_bayes.results.fit import fit

SHORT = record(camera=0.6)
COUPLED = record(device=TWO, camera=0.5)
TRIED = ("fractional-1", "fractional-2", "fractional-3", "first-order", "second-order", "integer-kept")


def posterior_of(name: str, source, **more):
    settings = known_settings(name, source)
    return problem_of(derived(source, replace(settings, **more)).study).posterior


def single(name: str, **more):
    return posterior_of(name, study(SHORT, terms=3, noise="white"), **more)


@pytest.mark.parametrize(
    ("large", "small", "contained"),
    [
        ("fractional-2", "fractional-1", True),
        ("fractional-3", "fractional-1", True),
        ("fractional-1", "fractional-2", False),
        ("fractional-1", "fractional-1", False),
        ("fractional-1", "first-order", True),
        ("fractional-2", "second-order", True),
        ("fractional-1", "second-order", False),
        ("second-order", "first-order", True),
        ("integer-kept", "second-order", True),
        ("second-order", "fractional-1", False),
    ],
)
def test_which_model_contains_which(large, small, contained):
    target, source = single(large), single(small)
    values = source.table.draw(3, np.random.default_rng(1))
    found = lifted(values, source, target, np.random.default_rng(2))
    assert (found is not None) is contained


def full(posterior, values):
    return np.sum([axis.sum(axis=1) for one in posterior.pointwise(values) for axis in one], axis=0)


TRUE = {"gain": 2.0, "time_1": 1.5, "order_1": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02}


@pytest.mark.parametrize("large", ["fractional-2", "fractional-3"])
def test_terms_that_are_added_hardly_change_the_likelihood(large):
    source, target = single("fractional-1"), single(large)
    values = np.repeat(row_values(source.table, TRUE)[None], 40, axis=0)
    found = lifted(values, source, target, np.random.default_rng(3))
    apart = full(target, found) - full(source, values)
    assert np.isfinite(target.log_density(target.coordinates(found))).mean() > 0.3
    assert apart.max() > -5.0  # one of the ways is all but exact
    assert np.median(apart) > -1000.0  # what a term of random time costs
    assert target.table.supported(found).mean() > 0.3


def test_a_term_of_hardly_any_order_is_not_split_into_parts_that_vanish():
    """A share of 0.3 to the power of 1 / order would be 0."""
    source, target = single("fractional-1"), single("fractional-2")
    values = np.repeat(row_values(source.table, TRUE | {"order_1": 1e-4})[None], 40, axis=0)
    found = lifted(values, source, target, np.random.default_rng(3))
    assert (found[:, target.table.of_kind("time")] > 0).all()


@pytest.mark.parametrize(
    ("noise", "small", "loss"),
    [
        ("ar1", "white", 3.0),
        ("white+ar1", "white", 3.0),
        ("student", "white", 12.0),
        ("white+ar1", "ar1", 3.0),
    ],
)
def test_a_noise_that_can_become_another_is_close_to_it(noise, small, loss):
    source, target = (single("fractional-1", noise=kind) for kind in (small, noise))
    reported = TRUE | ({"rho": 0.4} if small == "ar1" else {})
    values = row_values(source.table, reported)[None]
    found = lifted(values, source, target, np.random.default_rng(3))
    assert abs(full(target, found)[0] - full(source, values)[0]) < loss
    assert lifted(found, target, source, np.random.default_rng(3)) is None


def coupled(name: str, **more):
    return posterior_of(name, study(COUPLED, terms=1, noise="white", share="paper"), **more)


@pytest.mark.parametrize(
    ("large", "small"),
    [
        ("fractional-1-separate", "fractional-1"),
        ("fractional-1-separate-delays", "fractional-1-delays"),
        ("fractional-1-delays", "fractional-1"),
        ("fractional-1", "fractional-1-no-cross"),
        ("fractional-2-separate-delays", "fractional-1"),
    ],
)
def test_what_is_shared_less_contains_what_is_shared_more(large, small):
    source, target = coupled(small), coupled(large)
    values = source.table.draw(6, np.random.default_rng(4))
    found = lifted(values, source, target, np.random.default_rng(5))
    if "fractional-2" in large:
        assert found is not None
    else:
        np.testing.assert_allclose(full(target, found), full(source, values), rtol=1e-9)
    assert (
        lifted(target.table.draw(3, np.random.default_rng(6)), target, source, np.random.default_rng(7))
        is None
    )


def test_levels_shared_less_contain_those_shared_more():
    records = record(1, name="a", camera=0.6), record(2, name="b", camera=0.6)
    none, shared, own = (problem(*records, offset=kind).posterior for kind in ("none", "shared", "record"))
    rng = np.random.default_rng(4)
    for small, large in ((none, shared), (shared, own), (none, own)):
        values = small.table.draw(4, rng)
        found = lifted(values, small, large, rng)
        np.testing.assert_allclose(full(large, found), full(small, values), rtol=1e-9)
        assert lifted(large.table.draw(2, rng), large, small, rng) is None


# -- a mode that only the smaller model has found ---------------------------------------------------

FAST = Device(((path(1.0, 2.37, (0.15,), (0.9,)),),), TWO.drive_axes[:1], TWO.response_axes[:1], (0.0,))
FEW = {"ensembles": 2, "walkers": 16, "steps": 300, "thin": 2, "target_ess": 100}
ASTRAY = PriorSettings("delay", dist="uniform", parameters={"loc": 6.3, "scale": 0.5})


def binary():
    """A random binary drive: the likelihood has a local maximum at many delays; the true one is 2.37."""
    rng = np.random.default_rng(1)
    command = prbs(-1.0, 1.0, hold=0.8, duration=20.0, rng=rng)
    return record(device=FAST, command=command, camera=0.2, duration=21.0, noise_sd=0.05)


RIGHT = {"gain": 1.0, "time_1": 0.15, "order_1": 0.9, "delay": 2.37, "offset": 0.0, "sigma": 0.05}


def refused(self, starts, peaks):
    raise InputError("needle")


def card(name: str, values, optimum: float, parameters: int) -> dict:
    return {
        "name": name,
        "max_log_likelihood": optimum,
        "parameters": parameters,
        "refinement": 1,
        "fingerprint": name,
        "seconds": 0.0,
        "starts": {"optimum": values.tolist(), "draws": [values.tolist()] * 4},
    }


@pytest.mark.parametrize(("trapped", "again"), [(6.5, True), (None, False)])
def test_a_richer_model_starts_from_the_optimum_of_what_it_contains(monkeypatch, trapped, again):
    """Climbed from a wrong delay it stays below; from the contained optimum it reaches what that has. Only
    then is it sampled again, from there."""
    one, two = candidates_of(study(binary(), noise="white"), (), ["fractional-1", "fractional-2"])
    small, large = (problem_of(each.study) for each in (one, two))
    landscape = Landscape(small.posterior)
    true = row_values(small.posterior.table, RIGHT)
    top = landscape.maximise(true)
    wrong = true.copy()
    wrong[small.posterior.table.names.index("delay")] = trapped or 2.37
    found = lifted(wrong[None], small.posterior, large.posterior, np.random.default_rng(1))
    own = highest(Landscape(large.posterior), found)
    peak, draws = reached(large, one, card("fractional-1", top.values, top.log_likelihood, 6))
    assert peak.log_likelihood >= top.log_likelihood - 0.5
    assert len(draws)
    seen = []
    monkeypatch.setattr(Check, "_again", lambda self, starts, peaks: (seen.append(starts), ()))
    monkeypatch.setattr(Contender, "scored", lambda self, made, also=(): {"also": also})
    check = Check(
        Contender(two, two.study.sampler, None, quick=True, resume=False),
        card("fractional-2", own.values, own.log_likelihood if trapped else peak.log_likelihood, 8),
        ((one, card("fractional-1", top.values, top.log_likelihood, 6)),),
    )
    reported = check()
    assert reported["containment"]["sampled_again"] is again
    assert [row["missed"] for row in reported["containment"]["contains"]] == [again]
    assert bool(seen) is again
    if again:
        assert own.log_likelihood < top.log_likelihood - 20
        delay = large.posterior.table.names.index("delay")
        assert np.all(np.abs(seen[0][:, delay] - 2.37) < 0.3)
        monkeypatch.setattr(Check, "_again", refused)
        left = check()
        assert (left["usable"], left["grade"], left["containment"]["met"]) == (False, "unusable", False)
        assert left["grade_reason"] == "needle"
    resumed = replace(check, card=dict(check.card) | {"containment": reported["containment"]})
    assert resumed()["containment"] == reported["containment"]  # what was checked is not checked again


def test_the_share_of_modes_beside_any_evidence():
    """Of a posterior whose only mode they lie on: a half beside its own evidence, and all or nothing where
    that of the draws is thousands of nats away."""
    own = TRUE | {"time_1": ("lognorm", {"s": 0.3, "scale": 1.5})}
    fitted = fit(study(SHORT, priors=own, sampler={"target_ess": 100}), quick=True)
    own, starts = fitted.evidence, fitted.draws.thinned(64)
    assert own is not None
    shares = [
        share_of(
            SimpleNamespace(problem=fitted.problem, run=fitted.run, evidence=SimpleNamespace(value=level)),
            starts,
        )
        for level in (own.value - 5_000.0, own.value, own.value + 5_000.0)
    ]
    assert shares == [1.0, pytest.approx(0.5, abs=0.02), 0.0]


@pytest.fixture(scope="module")
def misled():
    """Both candidates; the ensembles of the richer one never leave a wrong delay at their first sampling."""
    source = study(binary(), noise="white", sampler=FEW)
    two = candidates_of(source, (), ["fractional-1", "fractional-2"])

    def astray(one, *, starts=None, **options):
        if one.model.terms == 2 and starts is None:
            wrong = fit(replace(one, priors=dict(one.priors) | {"delay": ASTRAY}), **options)
            own = problem_of(one)
            # its draws as those of the true posterior, of which they are a wrong local mode
            posterior = replace(own.posterior, model=wrong.problem.posterior.model)
            return replace(wrong, problem=replace(wrong.problem, posterior=posterior, study=one))
        return fit(one, starts=starts, **options)

    return two, astray


@pytest.mark.slow
def test_a_missed_mode_is_found_and_the_richer_model_sampled_again(misled, monkeypatch):
    two, astray = misled
    monkeypatch.setattr(candidatefit, "fit", astray)
    reported = compare(two, quick=True)
    one, richer = reported["models"]
    held = richer["containment"]
    (checked,) = held["contains"]
    assert checked["missed"]
    assert checked["own"] < one["max_log_likelihood"] - 20
    assert checked["reached"] > one["max_log_likelihood"] - 1
    assert held["sampled_again"]
    assert held["met"]
    assert richer["max_log_likelihood"] >= one["max_log_likelihood"] - 0.5
    delay = next(row for row in richer["estimates"] if row["name"] == "delay")
    assert delay["value"] == pytest.approx(2.37, abs=0.1)
    (flag,) = [flag for flag in reported["flags"] if flag["kind"] == "missed mode"]
    assert flag["model"] == "fractional-2"
    assert "fractional-1, which it contains" in flag["sentence"]
    assert not one["containment"]["contains"]


@pytest.mark.slow
def test_a_model_that_does_not_meet_the_mode_is_ranked_nowhere(misled, monkeypatch):
    two, astray = misled
    monkeypatch.setattr(candidatefit, "fit", lambda one, *, starts=None, **options: astray(one, **options))
    reported = compare(two, quick=True)
    row = reported["models"][1]
    assert not row["containment"]["met"]
    assert row["grade"] == "unusable"
    assert "stays below" in row["grade_reason"]
    assert row["probability"] is row["elpd"] is None
    assert "fractional-2" in [one["name"] for one in reported["unranked"]]
    assert "fractional-2 is not ranked" in reported["why"] or len(reported["unranked"]) == 2
