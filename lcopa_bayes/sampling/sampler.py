"""Importance draws of a search, or independent ensembles advanced in rounds until they agree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from math import inf
from pathlib import Path
from time import monotonic

import numpy as np

from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.core.parallel import Workers, workers
from lcopa_bayes.core.progress import Progress
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.aroundoptima import without_search
from lcopa_bayes.sampling.chainfile import Chain, load_chain, save_chain
from lcopa_bayes.sampling.ensemble import Birth, Ensemble, Round
from lcopa_bayes.sampling.knownmodes import around
from lcopa_bayes.sampling.learning import due, taught
from lcopa_bayes.sampling.marginal import Search
from lcopa_bayes.sampling.outer import Outer, applies, unsearched
from lcopa_bayes.sampling.proposal import weighty
from lcopa_bayes.sampling.run import SURPLUS, Run, SamplePlan, filling_modes, finished
from lcopa_bayes.sampling.separateaxes import Drawn, by_axis, importance_by_axis
from lcopa_bayes.sampling.weighted import Weighted

_ROUND = 20
"""Draws kept per round and walker."""
_SWEEPS = 80
"""Most moves of every walker at each temperature of the tempering path."""
_LEAST = 5
"""Rounds before sampling may stop: the draws kept of them come after the proposal was first adapted."""
_FEWEST = 2
"""Rounds before a budget may end sampling."""
_AS_LONG = 0.4
"""Least share of the moves of tempering that sampling takes: modes that are hard to reach fill slowly [-]."""
_MAPPED = 13
"""Most orders, delays and noise parameters that a search is tried on [-]: with more of them, some thousand
points meet the posterior by chance alone."""
_NEAR_WALKERS, _NEAR_PER_DIMENSION = 48, 2
"""Most walkers of an ensemble that begins around optima, or over two per sampled coordinate if these are
more: they are tempered as one population, by ..."""
_NEAR_SWEEPS, _NEAR_THIN, _NEAR_ROUNDS = 10, 2, 10
"""... so many moves at each temperature, and take so many steps per kept draw and, without a budget of time,
rounds at most: few walkers that go far, since those that remember their start say nothing."""
_AXIS_STEPS = 1_500
"""Most steps of an ensemble of one axis of several: it begins at points of a search, or around optima."""
_TRAIL = 1_500
"""Draws per ensemble that the first mixture is learned from, where a search gave them."""


def sample(
    posterior: Posterior,
    plan: SamplePlan,
    *,
    jobs: int = 1,
    chain_file: Path | None = None,
    fingerprint: str = "",
    resume: bool = False,
    quiet: bool = True,
    starts: Matrix | None = None,
    optima: Sequence[Optimum] = (),
    rough: Posterior | None = None,
) -> Run:
    """Sample a posterior, as the plan allows by importance draws from a search over orders, delays and noise
    (`marginal`). Where their weights do not converge, rounds of emcee go on from the points of the search;
    importance draws around where the walkers have been are tried where a mode filled during them, unless the
    search came nowhere near the posterior. Where it did not, or cannot for the number of parameters that it
    maps, a limited number of rounds begins with a population tempered from around the optima. Where orders or
    noise are stated, so that nothing is searched, importance draws around optima are tried. Populations
    tempered from the prior begin where no search is possible or the plan asks for ensembles.

    The draws depend on the arguments alone, not on `jobs` nor on interruptions: with `resume`, a run killed
    at any moment continues from the last complete round in `chain_file`, or, of axes sampled apart, from the
    files beside it that end in their numbers. `starts`, table values (starts,
    rows), are modes known from elsewhere, which moves propose too (`knownmodes`); InputError when none lies
    inside the prior. With a budget of `plan.seconds` they depend on the speed of the machine too, and
    sampling goes on, resumed, for as long again. `optima` are least-squares optima that a search begins with,
    by default its own; it tries `rough` first, a cheaper posterior that hardly differs.
    """
    begin = monotonic()

    left = partial(_left, plan, begin)

    def spent(more: float = 0.0) -> float | None:
        """Time taken, where the budget ends within half of what `more` takes [s]."""
        return monotonic() - begin if left() < 0.5 * more else None

    known = None if starts is None else around(posterior, starts, plan.seed)
    stored = load_chain(chain_file, fingerprint) if resume and chain_file else Chain()
    if stored.weighted is not None:
        return Run(stored.ensembles, plan, stored.weighted)
    ensembles = stored.ensembles
    wanted = SURPLUS * plan.target_ess
    searched = plan.method == "auto" and applies(posterior)

    runs = list[Run]()

    def of_axis(factor: Posterior, own: Sequence[Optimum], seed: int, share: float) -> Drawn:
        alone = replace(plan, seed=seed, seconds=None if plan.seconds is None else share * left())
        few = max(_NEAR_WALKERS, _NEAR_PER_DIMENSION * factor.dimension + 2)
        alone = replace(alone, walkers=min(plan.walkers, few), steps=min(plan.steps, _AXIS_STEPS))
        number = len(runs) + 1
        place = chain_file and chain_file.with_stem(f"{chain_file.stem}_{number}")
        go = partial(sample, jobs=jobs, resume=resume, quiet=quiet, optima=own)
        runs.append(go(factor, alone, chain_file=place, fingerprint=f"{fingerprint} {number}"))
        return runs[-1].ensembles, runs[-1].weighted

    if searched and known is None and not ensembles:
        separate = by_axis(posterior, optima, of_axis, plan.delivered, plan.seed)
        if separate is not None:
            late = any(run.stopped_after is not None for run in runs)
            unconfirmed = tuple(name for run in runs for name in run.unconfirmed)
            stopped = monotonic() - begin if late else None
            return Run(separate[0], plan, separate[1], unconfirmed, stopped_after=stopped)
    with workers(posterior, jobs=jobs) as crew:
        seeds = np.random.SeedSequence(plan.seed).spawn(plan.ensembles)
        mapped = searched and _mapped(posterior)
        if not ensembles and mapped and known is None:
            with _points(quiet) as bar:
                search, weighted = _searched(posterior, plan, crew, jobs, bar, optima, rough, left)
            if weighted is not None:
                stopped = monotonic() - begin if search.unfinished else None
                if stopped is None:
                    _store(chain_file, Chain((), weighted), fingerprint)
                return Run((), plan, weighted, stopped_after=stopped)
            ensembles = _begun(search, plan, seeds)
        elif not ensembles and known is None and plan.method == "auto" and unsearched(posterior):
            with _points(quiet) as bar:
                bar.set_description("drawing around optima")
                rng = np.random.default_rng(np.random.SeedSequence(plan.seed, spawn_key=(7_001,)))
                weighted = without_search(posterior, crew, optima, rng, wanted, lambda: left() <= 0.0)
            if weighted is not None:
                _store(chain_file, Chain((), weighted), fingerprint)
                return Run((), plan, weighted)
        if not ensembles:
            around_optima = tuple(weighty(optima)) if searched and known is None else ()
            begun = "from around the optima" if around_optima else "from the prior"
            with Progress(total=0, unit="ensemble", quiet=quiet, desc=begun):
                if around_optima:
                    walkers = max(_NEAR_WALKERS, _NEAR_PER_DIMENSION * posterior.dimension + 2)
                    birth = Birth(
                        min(plan.walkers, walkers) * plan.ensembles, _NEAR_SWEEPS, left(), around_optima
                    )
                    (whole,) = crew.each(birth, seeds[:1])
                    ensembles = whole.parted([seed.spawn(1)[0] for seed in seeds])
                else:
                    ensembles = tuple(crew.each(Birth(plan.walkers, _SWEEPS, left()), seeds))
        near = ensembles[0].near
        thin = min(plan.thin, _NEAR_THIN) if near else plan.thin
        rounds = max(2, -(-plan.steps // (_ROUND * thin)))
        rounds = min(rounds, _NEAR_ROUNDS) if near and plan.seconds is None else rounds
        done = ensembles[0].steps // (_ROUND * thin)
        if not done:
            _store(chain_file, Chain(ensembles), fingerprint)
        with Progress(total=rounds, initial=done, unit="round", quiet=quiet, desc="sampling") as bar:
            mixture = taught(posterior, ensembles, _ROUND, plan.seed, known)
            hardest = max(ensemble.tempering_moves for ensemble in ensembles)
            least = max(_LEAST, round(_AS_LONG * hardest / (_ROUND * thin)))
            lasted = 0.0
            while True:
                run = Run(ensembles, plan)
                stopped = spent(lasted) if done >= _FEWEST else None
                if stopped is not None:
                    return replace(run, stopped_after=stopped)
                last = done >= rounds or (done >= least and finished(posterior, run, bar))
                filling = filling_modes(posterior, run) if searched and last else ()
                if filling and mapped and (known is not None or not hardest):
                    with _points(quiet) as beside:
                        search = Search(posterior, plan.seed + done, crew, beside)
                        weighted = search.around(run.visited, wanted)
                    if weighted is not None:
                        _store(chain_file, Chain(ensembles, weighted), fingerprint)
                        return replace(run, weighted=weighted)
                if last:
                    return replace(run, unconfirmed=filling)
                if due(done):
                    mixture = taught(posterior, ensembles, _ROUND, plan.seed, known)
                at = monotonic()
                ensembles = tuple(crew.each(Round(_ROUND, thin, mixture), ensembles))
                done, lasted = done + 1, monotonic() - at
                _store(chain_file, Chain(ensembles), fingerprint)
                bar.update()


def by_search(
    posterior: Posterior,
    plan: SamplePlan,
    optima: Sequence[Optimum],
    *,
    jobs: int = 1,
    rough: Posterior | None = None,
    begin: float | None = None,
) -> Run | None:
    """The importance draws that `sample` begins with, of every axis by itself where axes share nothing; None
    where no search is possible or gives any. `optima`, one or more, and `rough` as there; the time of the
    plan runs from `begin` (`time.monotonic`), by default from now. One axis of several has its share of what
    is left, and where that is not enough no other is searched: all of them would take longer."""
    begin, unfinished = monotonic() if begin is None else begin, False
    rng = np.random.default_rng(np.random.SeedSequence(plan.seed, spawn_key=(1_003,)))

    def drawn(factor: Posterior, own: Sequence[Optimum], share: float) -> Weighted | None:
        nonlocal unfinished
        if not (applies(factor) and _mapped(factor)):
            return None
        until = monotonic() + share * _left(plan, begin)
        alone, wider = replace(plan, seed=int(rng.integers(2**31))), rough if factor is posterior else None
        with workers(factor, jobs=jobs) as crew, _points(quiet=True) as bar:
            search, weighted = _searched(
                factor, alone, crew, jobs, bar, own, wider, lambda: until - monotonic()
            )
        unfinished |= search.unfinished
        return None if search.unfinished and share < 1.0 else weighted

    weighted = importance_by_axis(posterior, optima, drawn, plan.delivered, rng)
    if weighted is None:
        return None
    return Run((), plan, weighted, stopped_after=monotonic() - begin if unfinished else None)


def _left(plan: SamplePlan, begin: float) -> float:
    """What is left of a budget of time [s]."""
    return inf if plan.seconds is None else begin + plan.seconds - monotonic()


def _mapped(posterior: Posterior) -> bool:
    """Whether a search is tried on so many orders, delays and noise parameters."""
    return len(Outer(posterior).columns) <= _MAPPED


def _searched(
    posterior: Posterior,
    plan: SamplePlan,
    crew: Workers[Posterior],
    jobs: int,
    bar: Progress,
    optima: Sequence[Optimum],
    rough: Posterior | None,
    left: Callable[[], float],
) -> tuple[Search, Weighted | None]:
    """A search, and the importance draws it gives if any; of a `rough` posterior first, where that is
    another."""
    wanted, scouted = SURPLUS * plan.target_ess, rough is not None and rough is not posterior
    if rough is not None and scouted:
        with workers(rough, jobs=jobs) as scouts:
            search = Search(rough, plan.seed, scouts, bar, optima, left, (posterior, crew))
            weighted = search.run(wanted)
        if weighted is not None:
            return search, weighted
    search = Search(posterior, plan.seed, crew, bar, optima, left)
    return search, search.run(wanted, direct=not scouted)


def _points(quiet: bool) -> Progress:
    """Progress of a search, which counts points."""
    return Progress(total=0, unit="point", quiet=quiet, desc="searching for modes")


def _begun(search: Search, plan: SamplePlan, seeds: Sequence[np.random.SeedSequence]) -> tuple[Ensemble, ...]:
    """Ensembles at independent parts of the points of a search; none where these are too few."""
    populations = search.population(plan.ensembles, max(_TRAIL, plan.walkers))
    return tuple(
        Ensemble.started(z[: plan.walkers], density[: plan.walkers], z, seed)
        for (z, density), seed in zip(populations, seeds, strict=False)
    )


def _store(chain_file: Path | None, chain: Chain, fingerprint: str) -> None:
    if chain_file:
        save_chain(chain_file, chain, fingerprint)
