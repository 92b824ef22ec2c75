"""Sums of lags for one path beside another that rings, which no sum of lags for both can follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from effectsearch.test_integerplants import record
from inference.test_lagsum import lags
from scipy.optimize import least_squares

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.crew import Crew
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.basemodel import Base, fitted_base
from lcopa_bayes.effectsearch.lags import figures_with_lags, fitted_plant, lags_of, linear_dynamics
from lcopa_bayes.effectsearch.openeffects import Mixture, step_figures
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.results.sumsoflags import Alternative, lags_beside, sentence_of, with_draws

RING = TransferPath.of_times(1.0, 0.4, (2.0, 0.8), (2.0, 1.0))
"""Second order, damping 0.2."""
WEIGHTS, TIMES, DELAY = (0.5, 0.4), (0.3, 4.0), 0.2
"""Of a path of two lags a decade apart, which no single fractional term is."""


def rung(since: Vector, path: TransferPath) -> Vector:
    """Response of a resonance to a unit step."""
    return np.where(since > 0, path.gain * unit_step(path, np.maximum(since, 1e-9)), 0.0)


def steps(one: Record, drive: int) -> list[tuple[float, float]]:
    """Times and sizes of the changes of a drive."""
    jumps = np.diff(one.drive[:, drive], prepend=one.drive[0, drive])
    return [(float(one.time[k]), float(jumps[k])) for k in np.flatnonzero(jumps)]


def mixed(seed: int) -> Record:
    """The second drive acts through lags in place of the resonance that `record` gives it."""
    one = record(f"run{seed}", (RING, replace(RING, gain=0.0)), seed)
    read = one.response[:, 0].copy()
    for at, size in steps(one, 1):
        read += size * lags(one.time - at, WEIGHTS, TIMES, DELAY)
    return replace(one, response=read[:, None])


@cache
def based() -> Base:
    """A fit whose first search ends beside the resonance, at 80 times the noise, as most do."""
    model = ModelSettings(terms={"y_u1": 2, "y_u2": 1}, share="none", delay="path")
    study = Study("mixed", None, "s", 3, (mixed(5), mixed(6)), (), model)
    return fitted_base(study, (), as_stated=True, draws=100)


def of_best_kind(found: Sequence[Alternative]) -> tuple[Alternative, ...]:
    """Without the other kinds, whose draws take as long again each."""
    return tuple(replace(one, searches=one.searches[:1]) for one in found)


@cache
def found() -> tuple[Alternative, ...]:
    return of_best_kind(lags_of(based().start, based().problem))


def test_a_search_that_ends_beside_the_resonance_is_made_again():
    optimum = based().fit.optimum
    assert 2 * optimum.cost < 3 * optimum.residual.size
    assert based().fit.stands_out  # the lags that it lacks are more than noise


def test_the_path_that_is_no_element_has_lags_and_the_one_that_rings_none():
    (one,) = found()
    assert [path.name for path in one.paths] == ["y_u2"]
    assert [path.name for path in one.beside] == ["y_u1"]
    assert one.support == "lags"
    assert one.search.best.lags == len(TIMES)
    for values, true in ((one.draws.gains[:, 0], sum(WEIGHTS)), (one.draws.delays[:, 0], DELAY)):
        low, high = np.quantile(values, (0.005, 0.995))
        assert low <= true <= high
    assert "y_u2, beside the other paths as they are fitted, follow" in sentence_of([one])


def test_lags_for_all_paths_do_not_follow():
    plant = fitted_plant(based().start, based().problem)
    (every,) = lags_beside(plant, single=False)
    assert every.support == "plant"
    assert every.beside == ()


def test_the_square_beside_other_paths_is_that_of_a_joint_fit():
    """Second method: the closed forms of both paths, fitted together under the noise that the loop has. The
    other path moves along its slopes where the plant has it, which the lags push off by some deviations."""
    (one,) = found()
    records, sd = based().problem.study.fit, float(based().start.whitening.noise[0].sd)

    def residual(x: Vector) -> Vector:
        gain, inertia, drag, late, first, second, fast, slow, delay, *offsets = x
        ring = TransferPath.of_times(gain, 0.0, (inertia, drag), (2.0, 1.0))
        out = []
        for each, offset in zip(records, offsets, strict=True):
            read = each.response[:, 0] - offset
            for at, size in steps(each, 0):
                read = read - size * rung(each.time - at - late, ring)
            for at, size in steps(each, 1):
                read = read - size * lags(each.time - at, (first, second), (fast, slow), delay)
            out.append(read / sd)
        return np.concatenate(out)

    joint = least_squares(residual, [1.0, 2.0, 0.8, 0.4, *WEIGHTS, *TIMES, DELAY, 0.02, 0.02], x_scale="jac")
    assert 0.0 <= one.search.fits[1].square - 2 * joint.cost < 6.0
    assert one.square - 2 * joint.cost > 100.0


def test_figures_of_the_path_are_over_the_lags_and_those_of_the_other_are_not():
    state, layout = based().start, based().problem.posterior.table.layout
    own = step_figures(state, Mixture([state.optimum.x[None]], np.ones(1)), span=20.0, time_unit="s")
    over = {one.name: one for one in figures_with_lags(own, found(), layout, span=20.0, time_unit="s")}
    assert len(over["steady_state[y_u2]"].parts) == 2
    assert len(over["steady_state[y_u1]"].parts) == 1


def test_linear_dynamics_of_one_path_are_named_as_such():
    dynamics = linear_dynamics(based().start, found(), based().fit.noise_samples, 0.0)
    assert dynamics is not None
    assert "lags follow y_u2" in dynamics.said


def test_axes_that_are_searched_side_by_side_have_the_same_lags():
    paths = (TransferPath.of_times(gain, 0.4, (time,), (1.0,)) for gain, time in ((1.0, 2.0), (0.5, 0.7)))
    one, other = (record("run", (path,), seed) for seed, path in enumerate(paths))
    both = np.hstack([one.response, other.response])
    run = replace(
        one,
        time=one.time[::2],
        drive=one.drive[::2],
        response=both[::2],
        response_axes=(Axis("x", "V"), Axis("y", "V")),
    )
    base = fitted_base(Study("both", None, "s", 3, (run,), ()), (), as_stated=True, draws=100)
    alone = of_best_kind(lags_of(base.start, base.problem))
    with Crew(2) as crew:
        together = with_draws(of_best_kind(lags_of(base.start, base.problem, crew)), crew)
    assert [each.search.axis for each in alone] == [0, 1]
    assert [each.as_json() for each in together] == [each.as_json() for each in alone]
    assert all(each.drawn is None for each in alone)
    for own, asked in zip(together, alone, strict=True):
        assert own.drawn is own.draws
        np.testing.assert_array_equal(own.draws.gains, asked.draws.gains)
        np.testing.assert_array_equal(own.draws.delays, asked.draws.delays)
    rejected = replace(alone[0], advantage=-1e3)
    assert with_draws([rejected]) == (rejected,)  # draws that nothing asks for
