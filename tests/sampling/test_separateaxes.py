"""A plant whose response axes share nothing is sampled axis by axis."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small import path, record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.device import Device
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling import sampler, separateaxes
from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.evidence import evidence_of
from lcopa_bayes.sampling.marginal import Search
from lcopa_bayes.sampling.run import Run, SamplePlan
from lcopa_bayes.sampling.sampler import by_search, sample
from lcopa_bayes.sampling.separateaxes import separated
from lcopa_bayes.sampling.weighted import Weighted
from lcopa_bayes.sampling.weightedrun import weighted_run

PAIR = Device(
    ((path(1.0, 0.3, (1.2,), (0.9,)),), (path(0.5, 0.8, (2.5,), (1.0,)),)),
    (Axis("u", "V"),),
    (Axis("x", "rad"), Axis("y", "rad")),
    (0.0, 0.1),
)
ORDERS = {"order_1_x_u": 0.9, "order_1_y_u": 1.0}


def posterior(**model: object) -> Posterior:
    campaign = study(
        record(1, device=PAIR, command=on_off([1.0], hold=5.0, at=0.35), camera=0.3),
        **{"priors": ORDERS} | model,
    )
    return problem_of(campaign).posterior


@pytest.fixture(scope="module")
def whole() -> Posterior:
    return posterior()


@pytest.fixture(scope="module")
def run(whole: Posterior) -> Run:
    return sample(whole, plan())


def plan(seed: int = 3) -> SamplePlan:
    return SamplePlan.of(8, seed=seed, method="auto", target_ess=400)


def test_the_density_is_the_product_of_those_of_the_axes(whole: Posterior) -> None:
    """Up to the priors of fixed parameters: differences of log densities add up."""
    values = whole.table.draw(6, np.random.default_rng(0))
    factors = separated(whole, values[0])
    assert len(factors) == 2
    assert sorted(k for one in factors for k in one.sampled) == list(whole.sampled)
    assert sum(one.size for one in factors) == whole.size
    total = sum(one.log_density(one.coordinates(values)) for one in factors)
    np.testing.assert_allclose(total, whole.log_density(whole.coordinates(values)), rtol=1e-9)


def test_what_shares_a_parameter_is_not_separated() -> None:
    for sharing in ({"share": "all", "priors": {}}, {"delay": "shared"}):
        shared = posterior(**sharing)
        assert separated(shared, shared.table.draw(1, np.random.default_rng(0))[0]) == ()


def test_draws_of_the_axes_are_those_of_the_whole(
    whole: Posterior, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Against the same posterior sampled at once."""
    assert run.weighted is not None
    assert len(run.weighted.factors) == 2
    monkeypatch.setattr(sampler, "by_axis", lambda *given: None)
    other = sample(whole, plan(4))
    assert other.weighted is not None
    assert other.weighted.factors == ()
    agree(whole, run, other)


@pytest.mark.parametrize("searched", [False, True])
def test_draws_from_the_optima_of_the_whole_are_made_axis_by_axis_too(
    whole: Posterior, run: Run, searched: bool
) -> None:
    """Importance draws around them, and those of a search that begins there."""
    optima = find_optima(whole, np.random.default_rng(6), starts=4)
    if searched:
        found = by_search(whole, plan(5), optima)
    else:
        found, _ = weighted_run(whole, plan(5), optima=optima) or (None, None)
    assert found is not None
    assert found.weighted is not None
    assert len(found.weighted.factors) == 2
    agree(whole, run, found)


def test_an_axis_that_takes_more_than_its_share_ends_a_search_with_a_budget(
    whole: Posterior, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Half of the time for the first of two; all that is left for the second, whose draws count though its
    time was not enough."""
    shares = list[float]()
    drawn = SimpleNamespace(factors=(), ess=1.0)

    def searched(*given: Any) -> tuple[SimpleNamespace, SimpleNamespace]:
        shares.append(given[-1]())
        return SimpleNamespace(unfinished=late[len(shares) - 1]), drawn

    def joined(*given: Any) -> SimpleNamespace:
        return drawn

    monkeypatch.setattr(sampler, "_searched", searched)
    monkeypatch.setattr(separateaxes, "joined", joined)
    optima = find_optima(whole, np.random.default_rng(6), starts=1)
    budget = replace(plan(5), seconds=100.0)
    for late, expected in (([True, False], [50.0]), ([False, True], [50.0, 100.0])):
        shares.clear()
        found = by_search(whole, budget, optima)
        assert shares == pytest.approx(expected, abs=5.0)
        assert (found is None) == late[0]
    assert found is not None
    assert found.stopped_after is not None


def agree(whole: Posterior, run: Run, other: Run) -> None:
    """Means, spreads and evidence within their Monte Carlo errors."""
    ours, theirs = gather(whole, run), gather(whole, other)
    for name in whole.table.names:
        one, two = ours.column(name), theirs.column(name)
        if np.ptp(two) == 0.0:
            continue
        sd = float(two.std())
        assert one.mean() == pytest.approx(two.mean(), abs=4 * sd * np.sqrt(1 / ours.ess + 1 / theirs.ess))
        assert one.std() == pytest.approx(sd, rel=0.15)
    evidences = [evidence_of(whole, each, 1000.0) for each in (run, other)]
    assert evidences[0] is not None
    assert evidences[1] is not None
    error = np.hypot(evidences[0].sd, evidences[1].sd)
    assert evidences[0].value == pytest.approx(evidences[1].value, abs=4 * error)
    assert error < 0.2


def test_a_killed_run_goes_on_from_the_axes_it_has(
    whole: Posterior, run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed while the second axis is searched: the first one is stored, and not searched again."""
    searched, search = list[str](), Search.run

    def killed(self: Search, wanted: float, **options: bool) -> Weighted | None:
        searched.append(self.posterior.table.names[self.posterior.sampled[0]])
        if len(searched) == 2:
            raise KeyboardInterrupt
        return search(self, wanted, **options)

    def go(*, resume: bool) -> Run:
        return sample(whole, plan(), chain_file=tmp_path / "chain.h5", fingerprint="it", resume=resume)

    monkeypatch.setattr(Search, "run", killed)
    with pytest.raises(KeyboardInterrupt):
        go(resume=False)
    resumed = go(resume=True)
    assert len(searched) == 3
    assert searched[1] == searched[2] != searched[0]
    again = go(resume=True)
    assert len(searched) == 3
    for one in (resumed, again):
        assert one.weighted is not None
        assert run.weighted is not None
        np.testing.assert_array_equal(one.weighted.coordinates, run.weighted.coordinates)
        np.testing.assert_array_equal(one.weighted.centre_ess, run.weighted.centre_ess)
    with pytest.raises(InputError, match="other records"):
        sample(whole, plan(), chain_file=tmp_path / "chain.h5", fingerprint="other", resume=True)


@pytest.mark.slow
def test_ensembles_of_an_axis_stand_beside_the_draws_of_another(
    whole: Posterior, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where a search of one axis gives none: means are those of both searches, and no draw counts twice."""
    second = separated(whole, whole.table.draw(1, np.random.default_rng(0))[0])[1].sampled
    search = Search.run

    def half(self: Search, wanted: float, **options: bool) -> Weighted | None:
        return None if self.posterior.sampled == second else search(self, wanted, **options)

    monkeypatch.setattr(Search, "run", half)
    mixed = sample(whole, replace(plan(), target_ess=200.0))
    assert mixed.weighted is None
    assert len(mixed.ensembles) == 4
    one = mixed.ensembles[0]
    np.testing.assert_allclose(one.log_density[3], whole.log_density(one.chain[3]), rtol=1e-9)
    ours, theirs = gather(whole, mixed), gather(whole, run)
    for k in whole.sampled:
        first, other = ours.column(whole.table.names[k]), theirs.column(whole.table.names[k])
        error = float(other.std()) * np.sqrt(1 / ours.ess + 1 / theirs.ess)
        assert first.mean() == pytest.approx(other.mean(), abs=4 * error)
    stays = np.array([k for k, row in enumerate(whole.sampled) if row not in second])
    places = {tuple(point) for point in one.chain[..., stays].reshape(-1, stays.size)}
    assert len(places) < one.chain.shape[0] * one.chain.shape[1]


def test_effective_sizes_are_those_of_the_axis(whole: Posterior, run: Run) -> None:
    weighted = run.weighted
    assert weighted is not None
    for one, own in weighted.factors:
        np.testing.assert_array_equal(weighted.centre_ess[own], one.centre_ess)
        np.testing.assert_array_equal(weighted.tail_ess[own], one.tail_ess)
    assert weighted.ess == min(one.ess for one, _ in weighted.factors)
    assert weighted.log_evidence == pytest.approx(sum(one.log_evidence for one, _ in weighted.factors))
    np.testing.assert_allclose(
        weighted.batch_evidence, sum(one.batch_evidence for one, _ in weighted.factors), rtol=1e-9
    )
    np.testing.assert_allclose(
        weighted.log_density[:50], whole.log_density(weighted.coordinates[:50]), rtol=1e-9
    )


def test_the_axes_are_drawn_independently_of_each_other(whole: Posterior, run: Run) -> None:
    assert run.weighted is not None
    (_, first), (_, second) = run.weighted.factors
    cross = np.corrcoef(run.weighted.sampled.T)[np.ix_(first, second)]
    assert np.abs(cross).max() < 5 / np.sqrt(len(run.weighted.sampled))
