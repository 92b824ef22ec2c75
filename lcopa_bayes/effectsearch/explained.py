"""The study that a loop ends with: its effects declared, so that everything else can be asked of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from time import monotonic

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.covariance import root_of
from lcopa_bayes.data.settings import PriorSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.drawsabout import CHANCE
from lcopa_bayes.effectsearch.extendedmodel import ExtendedModel
from lcopa_bayes.effectsearch.outliers import NAME, Outlying
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.declared import coefficient_prior
from lcopa_bayes.inference.noise import GaussianNoise, Noise
from lcopa_bayes.inference.optimum import Optimum, again, known_optimum, nearly_white
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.effects.catalogue import catalogue
from lcopa_bayes.model.effects.effect import Effect, Ranges
from lcopa_bayes.model.effects.records import Outliers
from lcopa_bayes.results.discretisation import discretisation, resolved_optima
from lcopa_bayes.results.fit import plan_of, weighted_start
from lcopa_bayes.sampling.draws import Draws, draws_of
from lcopa_bayes.sampling.run import Run
from lcopa_bayes.sampling.sampler import by_search
from lcopa_bayes.sampling.separateaxes import separated
from lcopa_bayes.sampling.weightedrun import weighted_run

_DRAWS, _STREAM = 100, 13
"""Normal draws about an optimum [-], and the mark of their randomness."""
LIMIT = 150.0
"""Time for draws of a plant without effects, where the study states none [s]. A search of three response
axes took 77 s with two processes and gave reliable ones; ended after 40 s it gave none, and what is tried
then took longer."""
AROUND = 75.0
"""The same of a plant with effects [s]: what is drawn by then is used, and proposals for jitter of every
record were fitted for ten minutes without coming close."""
_SEARCHED = 6_000
"""Most samples of a plant that is searched [-]: of 10 700 of two axes a search took seven minutes of one
processor, and ended without draws of the second axis."""


def explained_study(study: Study, model: ExtendedModel, outliers: Outlying | None = None) -> Study:
    """The study with the effects of a model declared, named as the study and ``-explained``.

    Scales and priors of the effects are stated as the loop used them; their internal constants, which it
    chose from a list and moved, are free about where they came to lie (`constant_about`). With `outliers`
    the samples that were left out return, and the noise is declared to hold them, unless the study states
    such noise already.
    """
    ranges, effects = model.effected.ranges, model.effects
    priors: dict[str, PriorSettings] = {}
    for effect in effects:
        for one in effect.coefficients(ranges):
            wide = replace(one, scale=one.scale * model.wider.get(effect.name, 1.0))
            prior, name = coefficient_prior(wide), f"{effect.name}.{one.name}"
            priors[name] = PriorSettings(name, dist=prior.dist, parameters=prior.parameters)
        for key, value in effect.constants.items():
            name = f"{effect.name}.{key}"
            priors[name] = constant_about(effect, key, float(value), ranges)
    names = tuple(effect.name for effect in effects)
    if outliers is not None:
        study = outliers.returned(study)
        names += (NAME,) if study.noise.kind != Outliers.noise else ()
    declared = replace(
        study.effects,
        use=names,
        deflection=dict(zip(ranges.names, ranges.response.tolist(), strict=True)) if effects else {},
        speed=ranges.speed if effects else None,
    )
    own = {name: prior for name, prior in study.priors.items() if "." not in name}
    name = study.name.removesuffix("-explained") + "-explained"
    return replace(study, name=name, effects=declared, priors=own | priors)


def constant_about(effect: Effect, key: str, value: float, ranges: Ranges) -> PriorSettings:
    """Prior of an internal constant of an effect that was found at `value`.

    Flat over two of the values that the loop tries to either side: others are other effects. Held where
    nothing but the noise depends on it, or where commands jump with it (`timed`), and without others to try.
    """
    name = f"{effect.name}.{key}"
    internal = {one.name: one for one in effect.internal(ranges)}
    tried = [float(getattr(one, key)) for one in effect.grid(ranges)]
    listed = np.unique([*tried, internal[key].low, internal[key].high])
    first = int(np.searchsorted(listed, value)) - 2
    last = int(np.searchsorted(listed, value, "right")) + 1
    low, high = listed[max(first, 0)], listed[min(last, listed.size - 1)]
    fixed = {one.name for one in internal.values() if one.kind == "choice" or one.high <= one.low}
    if effect.card.disturbance or effect.timed or key in fixed or not low <= value <= high or low == high:
        return PriorSettings(name, fixed=value)
    return PriorSettings(name, dist="uniform", parameters={"loc": float(low), "scale": float(high - low)})


def declarable(study: Study, effects: Sequence[Effect]) -> bool:
    """Whether a study can name the effects: those of the catalogue and of its own files."""
    known = {name: _place(kind) for name, kind in catalogue(study.effects.add, study.folder).items()}
    return all(known.get(effect.name) == _place(type(effect)) for effect in effects)


def _place(kind: type[Effect]) -> tuple[str, str]:
    """Where a class is defined: one of a study's own file is another object each time the file is read."""
    return kind.__module__, kind.__qualname__


def explained_draws(
    study: Study,
    usable: Callable[[Draws, Noise], bool],
    *,
    near: Mapping[str, float] | None = None,
    along: Sequence[Mapping[str, float]] = (),
    jobs: int = 1,
    quick: bool = False,
) -> tuple[Draws, Noise] | None:
    """Draws of an explained study, of the posterior that a fit of it samples and limited by the width of its
    blocks as there, and its noise; None where neither a search over orders, delays and noise nor importance
    sampling around optima holds, and a fit takes ensembles. Parameters by name `near` an optimum spare the
    search for it; `along` are those of further points about which the posterior is.

    Where normal draws about its optimum are not `usable` these are returned: the posterior is around there,
    and takes some ten thousand simulations.
    """
    problem, optima = problem_of(study), tuple[Optimum, ...]()
    known = known_optimum(problem.posterior, _values(problem.posterior, near)) if near else None
    if known is not None:
        narrow, optima = resolved_optima(problem, [known])
        if narrow is problem:  # else it was descended to there
            optima = again(problem.posterior, optima)
        problem = narrow
    if not optima:
        problem, optima = weighted_start(problem_of(study), quick=quick)
    noise = problem.posterior.noise
    about = normal_draws(problem.posterior, optima[0], study.seed) if optima else None
    if about is not None and not usable(about, noise):
        return about, noise
    points = (known_optimum(problem.posterior, _values(problem.posterior, one)) for one in along)
    optima = (*optima, *(one for one in points if one is not None))
    result = _sampled(problem, optima, jobs=jobs, quick=quick)
    if result is None:
        return None
    run, draws = result
    width = discretisation(problem, draws, surrogate=run.surrogate, jobs=jobs)
    return draws.limited(width.limitations), noise


def _sampled(
    problem: Problem, optima: Sequence[Optimum], *, jobs: int, quick: bool
) -> tuple[Run, Draws] | None:
    """Importance draws around optima. Of a plant without effects those of a search, where a first proposal
    around the optima is not close to the posterior: it costs as much as three such proposals, and fails less
    often. It takes minutes, and is left to a fit, of many samples and under noise that is not Gaussian, where
    gains and offsets are searched too."""
    posterior, plan, begin = problem.posterior, plan_of(problem, quick=False), monotonic()
    limit = LIMIT if posterior.simulation is None else AROUND
    limit = limit if plan.seconds is None else plan.seconds
    plan = replace(plan, seconds=limit)
    # what is tried next has the time that those before it left
    around = partial(weighted_run, posterior, jobs=jobs, quick=quick, optima=optima, begin=begin)
    plain = posterior.simulation is None and isinstance(posterior.noise, GaussianNoise)
    if not (plain and optima):
        return around(plan)
    first = around(plan, attempts=1)
    if posterior.size > _SEARCHED or (first is not None and first[1].grade.level == "reliable"):
        return first
    began = monotonic()
    run = by_search(posterior, plan, optima, jobs=jobs, rough=problem.rough, begin=begin)
    if run is not None:
        return run, draws_of(posterior, run)
    # one axis of several may have ended it: the others would have taken as long
    others = max(len(separated(posterior, optima[0].values)) - 1, 0)
    return around(replace(plan, seconds=max(limit - others * (monotonic() - began), 0.0)))


def _values(posterior: Posterior, known: Mapping[str, float]) -> Vector:
    """Table values, (rows,), with parameters by name; noise that is free is nearly white."""
    values = np.array([known.get(row.name, row.value) for row in posterior.table.rows])
    return np.asarray(nearly_white(posterior, values[None])[0])


def normal_draws(posterior: Posterior, optimum: Optimum, seed: int) -> Draws | None:
    """Normal draws about an optimum inside the prior that follow the records; None with fewer than two.

    Along a ridge most normal draws are plants that the records reject, and predict others badly wherever the
    posterior is.
    """
    rng = np.random.default_rng([seed, _STREAM])
    centre, root = posterior.coordinates(optimum.values[None]), root_of(optimum.covariance)
    z = centre + rng.standard_normal((_DRAWS, len(root))) @ root.T
    z = np.vstack([centre, z[posterior.log_prior(z) > -np.inf]])
    z = z[posterior.log_density(z) >= optimum.log_density - chi2.isf(CHANCE, len(root)) / 2]
    if len(z) < 2:
        return None
    values = posterior.complete(z, rng)[None]
    return Draws(posterior.table, values, np.zeros(values.shape[:2]), (), float(len(z)))


def coordinates_of(model: ExtendedModel, draws: Draws) -> Matrix:
    """Draws in the coordinates of a model, (draws, coordinates)."""
    rows = model.posterior.table.rows
    columns = [(draws.column(rows[k].name), rows[k].log_scale) for k in model.columns]
    return np.stack([np.log(column) if log else column for column, log in columns], axis=1)
