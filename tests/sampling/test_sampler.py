"""Ensembles: the same draws however they are computed, and the right distribution."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy import stats
from small import ONE, TRUTH, TWO, Toy, problem, record

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling import sampler
from lcopa_bayes.sampling.chainfile import Chain, load_chain, save_chain
from lcopa_bayes.sampling.convergence import qualities
from lcopa_bayes.sampling.draws import gather
from lcopa_bayes.sampling.ensemble import Ensemble, advance
from lcopa_bayes.sampling.mixturemoves import learned
from lcopa_bayes.sampling.run import Run, SamplePlan, _sampled_values, _settled, finished
from lcopa_bayes.sampling.sampler import sample

ROUND, SWEEPS = 8, 20
"""Of the runs that are compared with one another, whatever they sample; a run as shipped takes more."""
SHIPPED = {name: getattr(sampler, name) for name in ("_ROUND", "_SWEEPS")}
POSTERIOR = problem(
    record(camera=0.6), priors={"delay": TRUTH["delay"], "order_1": TRUTH["order_1"]}
).posterior


def plan(**changes: int) -> SamplePlan:
    reported = {"ensembles": 2, "walkers": 10, "steps": 4 * ROUND, "thin": 1, "target_ess": 1e9, "seed": 3}
    return SamplePlan(**(reported | changes))


def assert_same(a: Run, b: Run) -> None:
    assert len(a.ensembles) == len(b.ensembles)
    for one, other in zip(a.ensembles, b.ensembles, strict=True):
        for name in ("chain", "log_density", "position", "position_log_density", "accepted", "trail"):
            assert_array_equal(getattr(one, name), getattr(other, name))
        assert (one.steps, one.tempering_moves) == (other.steps, other.tempering_moves)
        assert_array_equal(one.random[1], other.random[1])
        assert one.random[2:] == other.random[2:]


@pytest.fixture(scope="module", autouse=True)
def brief() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sampler, "_ROUND", ROUND)
        patch.setattr(sampler, "_SWEEPS", SWEEPS)
        yield


@pytest.fixture
def shipped(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in SHIPPED.items():
        monkeypatch.setattr(sampler, name, value)


@pytest.fixture(scope="module")
def uninterrupted() -> Run:
    return sample(POSTERIOR, plan())


def test_the_shape_of_a_run(uninterrupted):
    assert [e.chain.shape for e in uninterrupted.ensembles] == [(4 * ROUND, 10, 2)] * 2
    assert [e.steps for e in uninterrupted.ensembles] == [4 * ROUND] * 2
    first, second = uninterrupted.ensembles
    assert not np.isin(first.chain, second.chain).any()
    assert 0.05 < first.acceptance < 0.9
    for e in uninterrupted.ensembles:
        assert_array_equal(e.chain[-1], e.position)
        assert_allclose(POSTERIOR.log_density(e.position), e.position_log_density, rtol=1e-9)
    kept, log_density = uninterrupted.kept()
    first_kept = 4 * ROUND * 2 // 5
    assert kept.shape == (2, 10, 4 * ROUND - first_kept, 2)
    assert_array_equal(kept[1, 3], second.chain[first_kept:, 3])
    assert_array_equal(log_density[1, 3], second.log_density[first_kept:, 3])


def test_same_seed_same_draws_other_seed_other_draws(uninterrupted):
    assert_same(uninterrupted, sample(POSTERIOR, plan()))
    other = sample(POSTERIOR, plan(seed=4, steps=2 * ROUND))
    assert not np.isin(other.ensembles[0].chain, uninterrupted.ensembles[0].chain).any()


def test_the_number_of_processes_changes_nothing(uninterrupted):
    assert_same(uninterrupted, sample(POSTERIOR, plan(), jobs=2))


def test_a_longer_plan_begins_like_a_shorter_one(uninterrupted):
    short = sample(POSTERIOR, plan(steps=2 * ROUND))
    for one, other in zip(short.ensembles, uninterrupted.ensembles, strict=True):
        assert_array_equal(one.chain, other.chain[: 2 * ROUND])


@pytest.mark.parametrize("saves", [2, *(pytest.param(saves, marks=pytest.mark.slow) for saves in (1, 4))])
def test_a_killed_run_resumes_to_the_same_draws(tmp_path, monkeypatch, uninterrupted, saves):
    path, saved = tmp_path / "chain.h5", []

    def killed(*arguments):
        if len(saved) == saves:
            raise KeyboardInterrupt
        saved.append(1)
        save_chain(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(sampler, "save_chain", killed)
        with pytest.raises(KeyboardInterrupt):
            sample(POSTERIOR, plan(), chain_file=path, fingerprint="it")
    steps = {e.steps for e in load_chain(path, "it").ensembles}
    assert steps < {k * ROUND for k in range(4)}  # whole rounds, and not all of them
    assert_same(uninterrupted, sample(POSTERIOR, plan(), chain_file=path, fingerprint="it", resume=True))
    assert [p.name for p in tmp_path.iterdir()] == ["chain.h5"]


def test_a_finished_run_resumes_to_itself_and_without_resume_starts_anew(tmp_path):
    path = tmp_path / "chain.h5"
    sample(POSTERIOR, plan(steps=2 * ROUND), chain_file=path, fingerprint="it")
    again = sample(POSTERIOR, plan(steps=2 * ROUND), chain_file=path, fingerprint="it", resume=True)
    assert again.ensembles[0].steps == 2 * ROUND
    assert_same(again, Run(load_chain(path, "it").ensembles, plan()))
    sample(POSTERIOR, plan(steps=2 * ROUND, seed=9), chain_file=path, fingerprint="other")
    assert not np.array_equal(load_chain(path, "other").ensembles[0].chain, again.ensembles[0].chain)


def stored(run: Run, path: Path) -> bytes:
    save_chain(path, Chain(run.ensembles), "it")
    return path.read_bytes()


def test_a_chain_reads_back_exactly(tmp_path, uninterrupted):
    path = tmp_path / "chain.h5"
    stored(uninterrupted, path)
    assert_same(uninterrupted, Run(load_chain(path, "it").ensembles, plan()))
    assert load_chain(tmp_path / "none.h5", "it").ensembles == ()


def test_a_foreign_chain_is_refused(tmp_path, uninterrupted):
    path = tmp_path / "chain.h5"
    stored(uninterrupted, path)
    with pytest.raises(InputError, match="written with other records, settings or seed") as caught:
        load_chain(path, "another")
    assert "--resume" in caught.value.problems[0]
    with pytest.raises(InputError, match=r"chain\.h5"):
        sample(POSTERIOR, plan(), chain_file=path, fingerprint="another", resume=True)
    with h5py.File(path, "w") as file:
        file["data"] = np.ones(3)
    with pytest.raises(InputError, match="not a chain this program wrote"):
        load_chain(path, "it")


def test_a_damaged_chain_is_refused(tmp_path, uninterrupted):
    path = tmp_path / "chain.h5"
    whole = stored(uninterrupted, path)
    for content in (b"", b"text", whole[:100], whole[: len(whole) // 2], whole[:-1000]):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"chain\.h5"):
            load_chain(path, "it")
    with h5py.File(path, "w") as file:
        file.attrs["fingerprint"] = "it"
        file.create_group("ensemble_0")
    with pytest.raises(InputError, match="not a chain"):
        load_chain(path, "it")


def test_flipped_bits_are_noticed_or_harmless(tmp_path, uninterrupted):
    path = tmp_path / "chain.h5"
    whole, rng = stored(uninterrupted, path), np.random.default_rng(0)
    noticed = 0
    for at in rng.integers(0, len(whole), size=60):
        damaged = bytearray(whole)
        damaged[at] ^= 0xFF
        path.write_bytes(bytes(damaged))
        try:
            assert_array_equal(load_chain(path, "it").ensembles[0].chain, uninterrupted.ensembles[0].chain)
        except InputError:
            noticed += 1
    assert noticed > 20


@pytest.mark.slow
def test_steps_are_rounded_up_to_whole_rounds_and_at_least_two():
    assert sample(POSTERIOR, plan(steps=1)).ensembles[0].steps == 2 * ROUND
    assert sample(POSTERIOR, plan(steps=2 * ROUND + 1, thin=1)).ensembles[0].steps == 3 * ROUND


@pytest.mark.slow
@pytest.mark.usefixtures("shipped")
def test_sampling_stops_once_the_target_is_reached():
    run = sample(POSTERIOR, plan(ensembles=4, steps=5000, thin=3, walkers=16, target_ess=100))
    assert run.ensembles[0].steps < 5000
    assert finished(POSTERIOR, run)
    draws = gather(POSTERIOR, run)
    assert draws.ess >= 100
    assert draws.grade.level == "reliable"


def test_a_plan_has_walkers_enough_for_its_dimension():
    for dimension in (1, 10, 50):
        assert SamplePlan.of(dimension, seed=0).walkers >= 2 * dimension + 2
    assert SamplePlan.of(10, seed=0, walkers=4).walkers == 22
    assert SamplePlan.of(10, seed=0, walkers=40).walkers == 40
    assert SamplePlan.of(4, seed=0, steps=10, thin=2).thin == 2


def ensemble_at(posterior, position: np.ndarray, seed: np.random.SeedSequence) -> Ensemble:
    """A new ensemble at a position of the test's choice."""
    walkers, dimension = position.shape
    state = tuple(np.random.RandomState(np.random.MT19937(seed)).get_state())
    nothing = np.empty((0, walkers, dimension)), np.empty((0, walkers))
    log_density = posterior.log_density(position)
    return Ensemble(*nothing, position, log_density, np.zeros(walkers), 0, state, position, 0)


@pytest.mark.parametrize("following", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_ensembles_sample_a_known_normal_density(following):
    """Without and with a mixture to follow, learned from where the walkers start, which is too wide."""
    scales = np.diag([1.0, 0.01, 30.0])
    mean = np.array([1.0, -0.2, 50.0])
    covariance = scales @ np.array([[1, 0.9, 0], [0.9, 1, -0.3], [0, -0.3, 1]]) @ scales
    widths = np.sqrt(np.diagonal(covariance))
    wide = [("uniform", {"loc": m - 40 * w, "scale": 70 * w}) for m, w in zip(mean, widths, strict=True)]
    target = Toy(stats.multivariate_normal(mean, covariance).logpdf, dict(zip("abc", wide, strict=True)))
    chains, draws = [], 400 if following else 200
    for child in np.random.SeedSequence(1).spawn(4):
        place, walk = child.spawn(2)
        start = mean + 3 * widths * np.random.default_rng(place).normal(size=(20, 3))
        mixture = learned(target, [start], 1) if following else None
        moved = advance(target, ensemble_at(target, start, walk), draws, 4, mixture)
        chains.append(moved.chain[draws // 4 :].swapaxes(0, 1))
    kept = np.array(chains)
    found = qualities("abc", kept)
    flat = kept.reshape(-1, 3)
    for k, quality in enumerate(found):
        assert quality.rhat < 1.02
        assert abs(flat[:, k].mean() - mean[k]) < 4 * widths[k] / np.sqrt(quality.ess)
        assert abs(flat[:, k].std() / widths[k] - 1) < 4 / np.sqrt(2 * quality.ess)
    assert np.corrcoef(flat.T)[0, 1] == pytest.approx(0.9, abs=4 * 0.19 / np.sqrt(found[0].ess))


PRIORS = {
    "one term": {},
    "two terms": {"terms": 2},
    "terms that cannot be exchanged": {
        "terms": 2,
        "priors": {
            "time_1": ("lognorm", {"s": 1.0, "scale": 3.0}),
            "order_1": ("norm", {"loc": 1.4, "scale": 0.3}),
        },
    },
    "a gain by its logarithm": {"terms": 2, "priors": {"gain": ("loguniform", {"a": 0.5, "b": 5.0})}},
    "two axes": {"share": "all"},
}

SHORT = (("two axes", False), ("two terms", True))
FOLLOWING = [
    pytest.param(name, following, marks=() if (name, following) in SHORT else pytest.mark.slow)
    for name in PRIORS
    for following in (False, True)
]


@pytest.mark.parametrize("draws", [40, pytest.param(1500, marks=pytest.mark.slow)])
@pytest.mark.parametrize(("name", "following"), FOLLOWING)
def test_without_information_every_move_leaves_the_prior(name, following, draws):
    """Noise a million times the record: every parameter keeps its prior, or a proposal's volume is wrong.

    The mixture that is followed was learned from prior draws on one side of the median delay.
    """
    options = PRIORS[name]
    device = TWO if name == "two axes" else ONE
    loud = {f"sigma{axis}": 1e6 for axis in (("_x", "_y") if device is TWO else ("",))}
    known = {f"nu{axis}": 5.0 for axis in (("_x", "_y") if device is TWO else ("",))}
    priors = loud | known | options.get("priors", {})
    posterior = problem(
        record(device=device, camera=1.0), **(options | {"priors": priors, "noise": "student", "blocks": 8})
    ).posterior
    assert posterior.linear == ()
    walkers, chains, mixture = 4 * posterior.dimension + 8, [], None
    if following:
        seen = posterior.coordinates(posterior.table.draw(900, np.random.default_rng(12)))
        delay = seen[:, posterior.sampled.index(posterior.table.at("delay", 0))]
        mixture = learned(posterior, [seen[delay < np.median(delay)]], 12)
    for child in np.random.SeedSequence(11).spawn(2):
        place, walk = child.spawn(2)
        start = posterior.coordinates(posterior.table.draw(walkers, np.random.default_rng(place)))
        moved = advance(posterior, ensemble_at(posterior, start, walk), draws, 8, mixture)
        chains.append(moved.chain.swapaxes(0, 1))
    coordinates = np.array(chains)
    names = [posterior.table.names[k] for k in posterior.sampled]
    values = posterior.values(coordinates.reshape(-1, len(names)))[:, posterior.sampled]
    found = qualities(names, values.reshape(*coordinates.shape))
    exact = posterior.table.draw(50_000, np.random.default_rng(0))[:, posterior.sampled]
    for k, quality in enumerate(found):
        rank = np.sort(exact[:, k]).searchsorted(values[:, k]) / len(exact)
        count = min(quality.ess_bulk, quality.ess_tail, rank.size)
        assert count > draws, (quality, "too few effective draws to tell")
        assert abs(rank.mean() - 0.5) < 4.5 * np.sqrt(1 / 12 / count), quality.name
        assert abs(((rank - 0.5) ** 2).mean() - 1 / 12) < 4.5 * np.sqrt(1 / 180 / count), quality.name


GAIN = ("gennorm", {"beta": 2.0, "loc": 1.0, "scale": 2.0 * np.sqrt(2)})
"""A normal density under another name, so that the gain is sampled and not integrated out."""


def exact_gain(posterior: Posterior) -> tuple[float, float]:
    """Mean and standard deviation of the gain when it alone is unknown, prior normal(1, 2)."""
    seen = posterior.samples[0].axes[0]
    values = posterior.values(np.zeros((1, 1)))
    unit = posterior.model.unit_responses(posterior.table.dynamics(values))[0][0, 0, seen.index]
    precision = unit @ unit / 0.3**2 + 1 / 4
    return float((unit @ (seen.values - TRUTH["offset"]) / 0.3**2 + 1 / 4) / precision), float(
        precision**-0.5
    )


@pytest.mark.usefixtures("shipped")
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 6))])
def test_a_whole_run_samples_a_known_posterior(seed):
    fixed = {name: TRUTH[name] for name in ("time_1", "order_1", "delay", "offset")} | {"sigma": 0.3}
    posterior = problem(record(camera=0.6, noise_sd=0.3), priors=fixed | {"gain": GAIN}).posterior
    mean, sd = exact_gain(posterior)
    ensembles, target = (4, 500) if seed else (2, 100)
    run = sample(
        posterior,
        SamplePlan.of(1, seed=seed, ensembles=ensembles, walkers=16, thin=4, target_ess=target),
    )
    draws = gather(posterior, run)
    assert draws.grade.level == "reliable"
    gain = draws.column("gain")
    assert abs(gain.mean() - mean) < 4 * sd / np.sqrt(min(draws.ess, gain.size))
    assert abs(gain.std() / sd - 1) < 4 / np.sqrt(2 * min(draws.ess, gain.size))


def test_gathered_draws_are_those_kept_with_linear_parameters_added(uninterrupted):
    draws = gather(POSTERIOR, uninterrupted)
    assert draws.values.shape[0::2] == (2, 6)
    assert np.isfinite(draws.values).all()
    free = [row.name for row in POSTERIOR.table.rows if row.free]
    assert [quality.name for quality in draws.qualities] == free == ["gain", "time_1", "offset", "sigma"]
    chain = np.concatenate([e.chain[4 * ROUND * 2 // 5 :].reshape(-1, 2) for e in uninterrupted.ensembles])
    kept = POSTERIOR.values(chain)[:, POSTERIOR.sampled]
    drawn = draws.flat[:, POSTERIOR.sampled]
    assert {row.tobytes() for row in drawn} <= {row.tobytes() for row in kept}
    coordinates = POSTERIOR.coordinates(draws.flat)
    assert_allclose(POSTERIOR.log_density(coordinates), draws.log_density.ravel(), rtol=1e-9)
    assert_array_equal(gather(POSTERIOR, uninterrupted).values, draws.values)
    assert_array_equal(draws.thinned(7), draws.flat[np.linspace(0, len(draws.flat) - 1, 7).astype(int)])
    assert [estimate.name for estimate in draws.estimates()] == free
    assert draws.ess == min(quality.ess for quality in draws.qualities)


def test_a_posterior_with_two_modes_no_walker_crosses_between_is_not_reliable():
    """Each ensemble begins on one mode or the other; only comparing them shows it."""

    def log_density(coordinates: np.ndarray) -> np.ndarray:
        near, far = ((coordinates - at) ** 2 for at in (0.0, 200.0))
        return np.logaddexp(-0.5 * near.sum(axis=1), -0.5 * far.sum(axis=1))

    wide = ("uniform", {"loc": -100.0, "scale": 400.0})
    modes, chains = Toy(log_density, {"a": wide, "b": wide}), []
    for k, child in enumerate(np.random.SeedSequence(2).spawn(4)):
        start = 200.0 * (k % 2) + np.random.default_rng(k).normal(size=(12, 2))
        chains.append(advance(modes, ensemble_at(modes, start, child), 80, 4).chain[20:].swapaxes(0, 1))
    together = qualities("ab", np.array(chains))
    alone = qualities("ab", np.array([chains[0], chains[2]]))
    assert all(quality.grade(100).level == "unusable" for quality in together)
    assert all(quality.grade(100).level != "unusable" for quality in alone)


FILLED = {  # share of a mode that few walkers were in at the start, over the run
    "from the start": (lambda t: 0.3 + 0 * t, True),
    "early": (lambda t: 0.3 * np.minimum(1.0, 8 * t), True),
    "to the end": (lambda t: 0.3 * t, False),
}


@pytest.mark.parametrize("name", FILLED)
def test_a_run_is_settled_once_a_mode_no_longer_fills(name):
    """All ensembles alike, so that their agreement shows nothing."""
    share, settled = FILLED[name]
    toy = Toy(lambda z: np.zeros(len(z)), {"a": ("norm", {"loc": 0.0, "scale": 9.0})})
    rng, ensembles = np.random.default_rng(8), []
    for child in np.random.SeedSequence(5).spawn(4):
        inside = rng.random((400, 64)) < share(np.linspace(0, 1, 400))[:, None]
        chain = (np.where(inside, 8.0, 0.0) + rng.standard_normal((400, 64)))[..., None]
        ensemble = ensemble_at(toy, chain[-1], child)
        ensembles.append(replace(ensemble, chain=chain, log_density=np.zeros((400, 64))))
    run = Run(tuple(ensembles), plan())
    whole, kept = (_sampled_values(toy, run, kept=part) for part in (False, True))
    assert _settled(whole, kept) == settled
