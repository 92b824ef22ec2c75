"""Draws given orders and noise, and the search over these: normalisation, known shares, quadrature."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy import stats
from scipy.special import logsumexp
from small import TRUTH, Toy, problem, record

from lcopa_bayes.core.parallel import workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.inference.conditional import Conditional, Expanded
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.sampling import marginal, outer
from lcopa_bayes.sampling.conditionaldraws import Kept, kept
from lcopa_bayes.sampling.importanceweights import tempered
from lcopa_bayes.sampling.marginal import Search
from lcopa_bayes.sampling.mixture import Mixture
from lcopa_bayes.sampling.outer import Outer, PriorOrders, applies
from lcopa_bayes.sampling.proposal import Blend, Product, Seen, adapted, clustered, paraboloid
from lcopa_bayes.sampling.weighted import error_of

GAIN = {"gain": ("loguniform", {"a": 0.5, "b": 5.0})}
PLAIN_GAIN = {"gain": ("gamma", {"a": 4.0, "scale": 0.5})}
TIMES = {f"time_{k}": ("loguniform", {"a": 0.05, "b": 50.0}) for k in (1, 2, 3)}


@pytest.mark.parametrize("terms", [1, 2, 3])
@pytest.mark.parametrize("name", ["gain out", "gain by its logarithm", "gain", "a time fixed"])
def test_without_information_the_evidence_is_that_of_the_prior(terms, name):
    """Else the density of the draws is not what they are drawn from, in some subset of the terms."""
    own = {k: prior for k, prior in TIMES.items() if int(k[-1]) <= terms}
    priors = {"gain out": {}, "gain by its logarithm": GAIN, "gain": PLAIN_GAIN, "a time fixed": GAIN}[name]
    if name == "a time fixed":
        own["time_1"] = 0.7
    posterior = problem(record(camera=1.0), terms=terms, priors={**own, **priors, "sigma": 1.0}).posterior
    if not Conditional(posterior).columns:
        return
    conditional, rng, tries = Conditional(posterior), np.random.default_rng(terms), 400
    values = posterior.table.draw(25, rng)
    x = conditional.x(values)
    size = x.shape[1]
    nothing = np.zeros(25), np.zeros((25, size)), np.zeros((25, size, size))
    draw = kept(conditional, Expanded(values, x, *nothing, conditional.steepness(values)), tries, rng)
    exact = posterior.log_prior(posterior.coordinates(values))
    for k in conditional.columns:
        row = posterior.table.rows[k]
        exact -= row.log_prior(values[:, k]) + (np.log(values[:, k]) if row.log_scale else 0.0)
    ratio = np.exp(draw.log_evidence - exact)
    error = np.sqrt(np.mean((1 / draw.efficiency - 1) / tries) / 25)
    assert abs(ratio.mean() - 1) < 4 * error
    assert error < 0.1


def test_the_draw_kept_follows_the_conditional_posterior():
    """One time given the order, by quadrature; and its evidence."""
    fixed = {key: TRUTH[key] for key in ("gain", "delay", "offset")}
    posterior = problem(
        record(camera=1.0, noise_sd=0.5), priors=fixed | {"sigma": 0.5, "time_1": TIMES["time_1"]}
    ).posterior
    conditional, rng = Conditional(posterior), np.random.default_rng(5)
    values = np.repeat(posterior.table.draw(1, rng), 3_000, axis=0)
    values[:, posterior.table.at("order", 0)] = TRUTH["order_1"]
    at, _ = conditional.descended(values[:1], 12)
    many = Expanded(*(np.repeat(part, len(values), axis=0) for part in at))
    draw = kept(conditional, many, 16, rng)
    grid = np.linspace(np.log(0.05), np.log(50.0), 4_001)
    points = values[:1].repeat(len(grid), axis=0)
    points[:, posterior.table.at("time", 0)] = np.exp(grid)
    apart = conditional.x(points) - at.x
    surrogate = (
        at.log_likelihood + apart[:, 0] * at.gradient[0] - 0.5 * apart[:, 0] ** 2 * at.information[0, 0]
    )
    density = posterior.log_prior(posterior.coordinates(points)) + surrogate
    evidence = logsumexp(density) + np.log(grid[1] - grid[0])
    ratio = np.exp(draw.log_evidence - evidence)
    assert abs(ratio.mean() - 1) < 4 * ratio.std() / np.sqrt(ratio.size)
    weights = ratio / ratio.sum()
    times = draw.coordinates[:, posterior.sampled.index(posterior.table.at("time", 0))]
    exact = np.exp(density - logsumexp(density))
    mean, sd = exact @ grid, np.sqrt(exact @ (grid - exact @ grid) ** 2)
    worth = 1 / (weights @ weights)
    assert abs(weights @ times - mean) < 4 * sd / np.sqrt(worth)


def test_information_that_rounding_left_indefinite_gives_draws_of_the_rest(rng):
    """Of one plant of a batch, as where one of its terms is nearly all of it; the others stay as they are."""
    posterior = problem(
        record(camera=1.0),
        terms=2,
        priors={"time_1": TIMES["time_1"], "time_2": TIMES["time_2"], "sigma": 1.0},
    ).posterior
    conditional = Conditional(posterior)
    values = posterior.table.draw(4, rng)
    at = conditional.expanded(values)
    own, both = np.diagonal(at.information, axis1=1, axis2=2), conditional.elements[0].part
    information = at.information.copy()
    information[0, both, both] = (
        1e10 * np.array([[1.0, 1.03], [1.03, 1.0]]) * np.sqrt(np.outer(own[0], own[0]))
    )
    draws = [
        kept(conditional, e, 64, np.random.default_rng(1)) for e in (at, at._replace(information=information))
    ]
    assert draws[1].efficiency[0] > 0.0
    for one, other in zip(*draws, strict=True):
        assert np.array_equal(one[1:], other[1:])


def test_a_proposal_of_orders_from_their_prior_has_their_density(rng):
    posterior = problem(record(camera=1.0), terms=2).posterior
    searched = Outer(posterior)
    rest = Mixture(
        np.ones(1), np.zeros((1, np.sum(~searched.orders))), np.eye(np.sum(~searched.orders))[None]
    )
    proposal = PriorOrders(searched, np.arange(len(searched.columns)), rest)
    y = proposal.draw(4_000, rng)
    orders = y[:, searched.orders]
    assert (np.diff(orders, axis=1) <= 0).all()
    own = rest.log_density(y[:, ~searched.orders])
    # the two orders are uniform over half of a square of area 4
    assert_allclose(proposal.log_density(y) - own, -np.log(2.0), rtol=1e-12)
    assert abs(np.mean(orders[:, 0] < 1.0) - 0.25) < 4 * np.sqrt(0.25 * 0.75 / 4_000)


SHARE = 0.06
FAR, SMALL = np.array([4.0, -1.5]), np.array([0.35, 0.2])
WIDE = ("norm", {"loc": 0.0, "scale": 10.0})


def valley(y):
    """Log density of a curved valley and a narrow second mode beside it, normalised."""
    curved = stats.norm.logpdf(y[:, 0]) + stats.norm(0.5 * y[:, 0] ** 2, 0.2).logpdf(y[:, 1])
    narrow = stats.norm(FAR, SMALL).logpdf(y).sum(axis=1)
    return np.logaddexp(np.log(1 - SHARE) + curved, np.log(SHARE) + narrow)


BOTH = (np.arange(2),)


def search_of(log_density, seed: int, groups=BOTH) -> Search:
    """A search whose marginal density is known."""
    toy = Toy(log_density, dict.fromkeys("abcd"[: sum(map(len, groups))], WIDE))
    search = Search.__new__(Search)
    search.posterior, search._rng = toy, np.random.default_rng(seed)
    search._points, search._bar, search._pace = [], Progress(quiet=True), 0.0
    search._exact = None
    search._log_weights = np.empty(0)
    search._seeds, search._left = np.random.SeedSequence(seed), lambda: np.inf
    search._crew = SimpleNamespace(each=lambda task, inputs: [task(toy, one) for one in inputs])
    every = lambda y: np.ones(len(y), dtype=bool)  # noqa: E731
    search.outer = SimpleNamespace(
        values=lambda y: y, y=lambda y: y, inside=every, orders=np.zeros(0), groups=groups
    )
    search._evaluated = lambda y, values, starts: marginal._Point(
        y, y, log_density(y), y, log_density(y), log_density(y), np.ones(len(y))
    )
    return search


def whole(proposal: Mixture) -> Product:
    """Of one group."""
    return Product(BOTH, (proposal,))


@pytest.mark.slow
def test_a_narrow_mode_beside_a_curved_valley_has_its_share():
    """Over seeds: no bias, and the scatter is the reported error. Its short form is that of two groups, which
    has such a mode in each."""
    seeds = 6
    first = whole(Mixture(np.ones(1), np.array([[0.0, 1.0]]), 4.0 * np.eye(2)[None]))
    found, errors, evidence = [], [], []
    for seed in range(seeds):
        weighted = search_of(valley, seed)._improved(first, np.empty((0, 2)), 250)
        assert weighted is not None
        weights, inside = np.exp(weighted.log_weights), weighted.coordinates[:, 1] < -0.8
        share = float(weights @ inside)
        found.append(share)
        errors.append(float(np.sqrt(weights**2 @ (inside - share) ** 2)))
        evidence.append(weighted.log_evidence / weighted.log_evidence_sd)
    assert abs(np.mean(found) - SHARE) < 4 * np.mean(errors) / np.sqrt(seeds)
    low, high = stats.chi2(seeds - 1).ppf([1e-3, 1 - 1e-3]) / (seeds - 1)
    assert low < np.var(found, ddof=1) / np.mean(np.square(errors)) < high
    assert low < np.mean(np.square(evidence)) < high


@pytest.mark.parametrize("seeds", [1, pytest.param(8, marks=pytest.mark.slow)])
def test_two_groups_are_searched_each_where_the_other_is_likely(seeds):
    """Two valleys with a narrow mode each, from a proposal a tenth of which hits either: shares and evidence
    without bias, and a scatter as reported."""
    both = lambda y: valley(y[:, :2]) + valley(y[:, 2:])  # noqa: E731
    groups = (np.array([0, 1]), np.array([2, 3]))
    wide = Mixture(np.ones(1), np.array([[0.0, 1.0]]), 4.0 * np.eye(2)[None])
    found, errors, evidence = [], [], []
    for seed in range(seeds):
        search = search_of(both, seed, groups)
        weighted = search._improved(Product(groups, (wide, wide)), np.empty((0, 4)), 200 if seeds > 1 else 80)
        assert weighted is not None
        weights, inside = np.exp(weighted.log_weights), weighted.coordinates[:, [1, 3]] < -0.8
        found.append(weights @ inside)
        errors.append(np.sqrt(weights**2 @ (inside - found[-1]) ** 2))
        evidence.append(weighted.log_evidence / weighted.log_evidence_sd)
    apart = (np.array(found) - SHARE) / np.array(errors)
    assert abs(apart.mean()) < 4 / np.sqrt(2 * seeds)
    low, high = stats.chi2([2 * seeds, seeds]).ppf([[1e-3], [1 - 1e-3]]) / [2 * seeds, seeds]
    assert low[0] < np.mean(apart**2) < high[0]
    assert low[1] < np.mean(np.square(evidence)) < high[1]


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_an_easy_posterior_is_drawn_from_directly_and_a_mode_elsewhere_is_not_missed(share):
    """A normal around the optimum, alone or with another far away, which points of the first round show."""
    here, there = stats.norm(0.0, 0.5), stats.norm([6.0, -6.0], 0.3)

    def both(y):
        parts = np.stack([each.logpdf(y).sum(axis=1) for each in (here, there)], axis=1)
        return logsumexp(parts, axis=1, b=[1 - share, share])

    search = search_of(both, 3)
    prior = stats.norm(0.0, 10.0)
    search.posterior = Toy(lambda z: both(z) - prior.logpdf(z).sum(axis=1), {"a": WIDE, "b": WIDE})
    task = lambda task, inputs: [task(search.posterior, one) for one in inputs]  # noqa: E731
    search._crew = SimpleNamespace(each=task)
    first = whole(Mixture(np.ones(1), np.zeros((1, 2)), 5.0 * np.eye(2)[None]))
    optimum = Optimum(np.zeros(2), 0.25 * np.eye(2), float(both(np.zeros((1, 2)))[0]))
    weighted = search._improved(first, np.empty((0, 2)), 400, [optimum])
    assert weighted is not None
    assert share > 0.0 or len(search._points) == 1
    assert abs(weighted.log_evidence) < 4 * weighted.log_evidence_sd
    assert abs(np.exp(weighted.log_weights) @ (weighted.coordinates[:, 0] > 3) - share) < 0.3 * share + 1e-6


def test_a_search_of_a_rough_posterior_gives_draws_of_the_exact_one():
    """Whose mode is a third of a standard deviation away; of one six away it gives none."""

    def toy(centre):
        return Toy(lambda z: stats.norm(centre, 0.5).logpdf(z).sum(axis=1), {"a": WIDE, "b": WIDE})

    def crew(own):
        return SimpleNamespace(each=lambda task, inputs: [task(own, one) for one in inputs])

    first = whole(Mixture(np.ones(1), np.zeros((1, 2)), 5.0 * np.eye(2)[None]))
    for shift in (0.17, 3.0):
        exact, rough = toy(shift), toy(0.0)
        search = search_of(rough.log_density, 3)
        search.posterior, search._crew, search._exact = rough, crew(rough), (exact, crew(exact))
        optimum = Optimum(np.zeros(2), 0.25 * np.eye(2), float(rough.log_density(np.zeros((1, 2)))[0]))
        weighted = search._improved(first, np.empty((0, 2)), 400, [optimum])
        assert len(search._points) == 1
        if shift == 3.0:
            assert weighted is None
            continue
        assert weighted is not None
        weights = np.exp(weighted.log_weights)
        errors = np.sqrt(weights**2 @ (weighted.coordinates - shift) ** 2)
        assert (np.abs(weights @ weighted.coordinates - 100 / 100.25 * shift) < 4 * errors).all()
        assert (errors < 0.028).all()


def test_a_search_ends_with_what_it_has_when_its_time_is_over():
    """A narrow valley: after two rounds few draws count, and they are weighted as what they are."""
    first = whole(Mixture(np.ones(1), np.array([[0.0, 1.0]]), 4.0 * np.eye(2)[None]))
    search = search_of(valley, 5)
    search._left = lambda: np.inf if len(search._points) < 2 else -1.0
    weighted = search._improved(first, np.empty((0, 2)), 1e6)
    assert weighted is not None
    assert search.unfinished
    assert len(search._points) == 2
    assert weighted.count == 2 * 768
    assert abs(weighted.log_evidence) < 4.5 * weighted.log_evidence_sd < 1.0
    search = search_of(valley, 5)
    search._left = lambda: -1.0
    assert search._improved(first, np.empty((0, 2)), 1e6) is None


def test_a_search_gives_up_where_no_proposal_comes_near(monkeypatch):
    """Spikes a thousand times narrower than what a round can find."""
    monkeypatch.setattr(marginal, "_ROUNDS", 6)

    def spikes(y):
        return -0.5 * ((np.sin(500 * y[:, 0]) / 1e-3) ** 2 + (np.sin(500 * y[:, 1]) / 1e-3) ** 2)

    first = whole(Mixture(np.ones(1), np.zeros((1, 2)), np.eye(2)[None]))
    assert search_of(spikes, 1)._improved(first, np.empty((0, 2)), 500) is None


def test_a_region_met_after_many_draws_is_learned():
    """Draws that follow count anew, however many were drawn before."""
    first = whole(Mixture(np.ones(1), np.array([[0.0, 1.0]]), 4.0 * np.eye(2)[None]))
    search, answers = search_of(valley, 4), [True, False]
    search._misses = lambda *_: answers.pop(0)
    weighted = search._improved(first, np.empty((0, 2)), 25)
    assert not answers
    assert weighted is not None
    drawn = sum(len(point.y) for point in search._points)
    assert weighted.count <= drawn - 2 * marginal._LEARNING
    assert abs(weighted.log_evidence) < 4 * weighted.log_evidence_sd


def normal(mean: float, sd: float) -> Mixture:
    """One component of two dimensions."""
    return Mixture(np.ones(1), np.full((1, 2), mean), sd * np.eye(2)[None])


def target(y):
    """Log density of two independent normals, times 5."""
    return np.log(5.0) + stats.norm(0.5, 1.0).logpdf(y).sum(axis=1)


def test_draws_of_unequal_rounds_are_weighted_as_draws_of_their_mixture(rng):
    """A narrow proposal drawn from twenty times as often does not take the mass of the other's region."""
    seen = Seen()
    for proposal, count in ((normal(0.0, 2.0), 2_000), (normal(-1.0, 0.5), 40_000)):
        y = proposal.draw(count, rng)
        seen = seen.joined(proposal, count, y, target(y))
    raw = np.exp(seen.log_weights())
    assert abs(raw.mean() - 5.0) < 4 * raw.std() / np.sqrt(raw.size)
    weights, x = raw / raw.sum(), np.concatenate(seen.points)[:, 0]
    mean = weights @ x
    assert abs(mean - 0.5) < 4 * np.sqrt(weights**2 @ (x - mean) ** 2)
    assert np.sqrt(weights**2 @ (x - mean) ** 2) < 0.04


def test_a_proposal_is_as_efficient_as_draws_of_it_are(rng):
    wide, own = normal(0.0, 3.0), normal(0.5, 1.0)
    y = wide.draw(20_000, rng)
    seen = Seen().joined(wide, 20_000, y, target(y))
    drawn = own.draw(20_000, rng)
    raw = target(drawn) - own.log_density(drawn)
    by_draws = np.exp(2 * logsumexp(raw) - logsumexp(2 * raw)) / 20_000
    assert seen.efficiency(own, seen.log_weights()) == pytest.approx(by_draws, rel=0.1)
    # what it does not cover shows although no draw of it lies there
    elsewhere = normal(-3.0, 0.3)
    assert seen.efficiency(elsewhere, seen.log_weights()) < 0.01
    # one that is narrow about the only point has more effective draws than draws by that estimate
    one = Seen().joined(wide, 1, np.zeros((1, 2)), np.zeros(1))
    assert one.efficiency(normal(0.0, 1e-300), one.log_weights()) == 1.0


def test_a_blend_has_the_density_of_its_draws(rng):
    blend = Blend(normal(0.0, 1.0), normal(6.0, 0.5), 0.25)
    y = blend.draw(40_000, rng)
    assert abs(np.mean(y[:, 0] > 3.5) - 0.25) < 0.015
    raw = target(y) - blend.log_density(y)
    assert abs(np.exp(raw).mean() - 5.0) < 4 * np.exp(raw).std() / 200


def test_a_product_has_the_density_of_its_draws(rng):
    """Columns of a group need not be next to each other."""
    product = Product((np.array([0, 2]), np.array([1])), (normal(0.5, 1.0), one_dimension(-3.0, 0.5)))
    y = product.draw(40_000, rng)
    assert_allclose(y.mean(axis=0), [0.5, -3.0, 0.5], atol=0.05)
    exact = stats.norm(0.5, 1.0).logpdf(y[:, [0, 2]]).sum(axis=1) + stats.norm(-3.0, 0.5).logpdf(y[:, 1])
    raw = np.exp(exact - product.log_density(y))
    assert abs(raw.mean() - 1.0) < 4 * raw.std() / 200


def one_dimension(mean: float, sd: float) -> Mixture:
    return Mixture(np.ones(1), np.array([[mean]]), np.array([[[sd]]]))


def test_weights_since_a_proposal_are_those_of_the_later_ones_alone(rng):
    seen, later = Seen(), Seen()
    for k, proposal in enumerate((normal(4.0, 0.1), normal(0.0, 2.0), normal(0.4, 1.5))):
        y = proposal.draw(500, rng)
        seen = seen.joined(proposal, 500, y, target(y))
        later = later.joined(proposal, 500, y, target(y)) if k else later
    assert_allclose(seen.log_weights(1), later.log_weights(), rtol=1e-12)
    assert_allclose(seen.last_weights(), later.last_weights(), rtol=1e-12)


def test_parameters_are_grouped_by_element_and_by_axis():
    posterior = problem(record(camera=1.0), terms=2).posterior
    outer = Outer(posterior)
    named = [[posterior.table.names[outer.columns[column]] for column in group] for group in outer.groups]
    assert named == [["order_1", "order_2"], ["sigma"]]


def test_a_few_heavy_draws_far_from_all_others_are_covered(rng):
    """As of a narrow mode met for the first time, after many draws of a wide one."""
    y = np.concatenate([rng.standard_normal((4_000, 2)), [4.0, -1.5] + 0.1 * rng.standard_normal((3, 2))])
    log_weights = np.log(np.append(np.full(4_000, 0.9 / 4_000), np.full(3, 0.1 / 3)))
    there = y[-3:]
    assert (adapted(y, log_weights, 1).log_density(there) > -5.0).all()
    assert (clustered(y, log_weights, 1).log_density(there) < -7.0).all()


def test_a_quadratic_finds_a_mode_that_no_draw_is_near(rng):
    """From draws twenty standard deviations away: a little nearer each time, then exactly."""
    mean, factor = np.array([3.0, -2.0]), np.array([[0.3, 0.0], [0.27, 0.1]])
    log_density = lambda y: -0.5 * (np.linalg.solve(factor, (y - mean).T) ** 2).sum(axis=0)  # noqa: E731
    y = 0.3 * rng.standard_normal((400, 2))
    for _ in range(16):
        single = paraboloid(y, log_density(y))
        y = np.concatenate([y, single.draw(200, rng)])
    assert_allclose(single.means[0], mean, atol=1e-6)
    assert_allclose(single.factors[0] @ single.factors[0].T, factor @ factor.T, rtol=1e-6)
    assert paraboloid(y[:20], log_density(y[:20])) is None


def test_tempered_weights_have_the_effective_draws_wanted(rng):
    log_weights = 10 * rng.standard_normal(500)
    weights = tempered(log_weights, 40)
    assert 40 <= 1 / (weights @ weights) < 60
    equal = tempered(np.zeros(500), 40)
    assert_allclose(equal, 1 / 500)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_a_search_agrees_with_quadrature(seed):
    """An order, a time and a gain: the first two on a grid, the gain integrated out in closed form."""
    fixed = {key: TRUTH[key] for key in ("delay", "offset")} | {"sigma": 0.1, "time_1": TIMES["time_1"]}
    posterior = problem(record(camera=0.6, noise_sd=0.1), priors=fixed).posterior
    with workers(posterior) as crew:
        weighted = Search(posterior, seed, crew, Progress(quiet=True)).run(800)
    assert weighted is not None
    place = posterior.sampled.index(posterior.table.at("order", 0))
    times, orders = np.linspace(np.log(0.06), np.log(45.0), 200), np.linspace(0.02, 1.99, 160)
    z = np.stack([axis.ravel() for axis in np.meshgrid(times, orders)], axis=1)
    z = z if place == 1 else z[:, ::-1]
    density = posterior.log_density(z)
    cell = (times[1] - times[0]) * (orders[1] - orders[0])
    assert abs(weighted.log_evidence - logsumexp(density) - np.log(cell)) < 4 * weighted.log_evidence_sd
    exact, weights = np.exp(density - logsumexp(density)), np.exp(weighted.log_weights)
    for column in range(2):
        mean = exact @ z[:, column]
        sd = np.sqrt(exact @ (z[:, column] - mean) ** 2)
        own = weighted.coordinates[:, column]
        assert abs(weights @ own - mean) < 4 * sd / np.sqrt(weighted.centre_ess[column])
        apart = (own - mean) ** 2 / sd**2  # a tail of 6e-4 of the mass reaches ten times as far as the rest
        assert abs(weights @ apart - 1) < 4 * error_of(weights, apart)


def test_what_a_search_cannot_divide_is_left_to_ensembles():
    assert applies(problem(record(camera=1.0)).posterior)
    nothing = {key: TRUTH[key] for key in ("order_1", "time_1", "delay", "sigma", "offset")}
    fixed = problem(record(camera=1.0), priors=nothing | GAIN).posterior
    assert not applies(fixed)


def test_a_proposal_is_learned_where_hardly_a_draw_has_any_weight(rng):
    """As far from a narrow posterior: weights of all but a few draws are 0 to the last digit."""
    y = rng.standard_normal((80, 10))
    y[:25] *= 0.1
    log_weights = np.where(np.arange(80) < 25, 0.0, -1e6)
    proposal = clustered(y, log_weights, 1)
    best, others = proposal.log_density(y[:25]), proposal.log_density(y[25:])
    assert np.isfinite(best).all()
    assert best.min() > others.max()


def test_a_search_without_a_single_draw_gives_nothing(monkeypatch):
    def none(conditional, at, tries, rng):
        size, least = conditional.posterior.dimension, np.full(len(at.values), -np.inf)
        return Kept(np.full((least.size, size), np.nan), least, least, np.zeros(least.size))

    monkeypatch.setattr(outer, "kept", none)
    posterior = problem(record(camera=1.0), terms=1, priors={"sigma": 0.05}).posterior
    with workers(posterior) as crew:
        search = Search(posterior, 1, crew, Progress(quiet=True))
        assert search.run(100.0) is None
        assert search.population(4, 10) == []
