"""The loop on an oscillator with a cubic spring under a drive that was sampled while it moved."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.noise import White
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.model.effects.catalogue import catalogue

AXIS = (Axis("x", "V"),)
OMEGA, DAMPING, CUBIC, PERIOD = 0.44, 0.045, 4.0, 1.6
"""Resonance [rad/ms], damping [-], cubic stiffness over the linear one [1/V^2], sampling period [ms]."""
NOISE, OUTPUT = 2e-4, 0.053
"""Noise and response, standard deviations [V]."""
_FINE = 8
"""Steps of the reference simulation per sample [-]."""


@cache
def multisine(name, seed, n, *, cubic=CUBIC, size=0.022, read_from=0):
    """Samples of ``y''/w^2 + 2 zeta y'/w + y + cubic y^3 = u`` by Runge-Kutta of order 4, long after it
    started."""
    rng = np.random.default_rng(seed)
    h, lead = PERIOD / _FINE, 250
    t = (np.arange(2 * (n + lead) * _FINE) * 0.5 - lead * _FINE) * h
    lines = 2 * np.pi * np.linspace(0.002, 0.3, 120) / PERIOD
    u = sum(np.cos(w * t + p) for w, p in zip(lines, rng.uniform(0, 2 * np.pi, lines.size), strict=True))
    u *= size / u.std()

    def slope(state, drive):
        y, v = state
        return np.array([v, OMEGA**2 * (drive - y - cubic * y**3) - 2 * DAMPING * OMEGA * v])

    state, y = np.zeros(2), np.empty(t.size // 2)
    for k in range(y.size):
        y[k] = state[0]
        first, middle, last = u[2 * k], u[2 * k + 1], u[min(2 * k + 2, u.size - 1)]
        a = slope(state, first)
        b = slope(state + 0.5 * h * a, middle)
        c = slope(state + 0.5 * h * b, middle)
        d = slope(state + h * c, last)
        state = state + h * (a + 2 * b + 2 * c + d) / 6
    drive, response = u[:: 2 * _FINE][lead:], y[::_FINE][lead:].copy()
    response += NOISE * rng.standard_normal(n)
    response[:read_from] = np.nan
    return Record(name, np.arange(n) * PERIOD, drive[:, None], response[:, None], AXIS, AXIS, "ms")


def study_of(terms, *, n=800, read_from=200, **more):
    fit, other = (
        multisine(name, seed, n, read_from=read_from, **more) for name, seed in (("fit", 1), ("other", 2))
    )
    return Study("spring", None, "ms", 3, (fit,), (other,), ModelSettings(terms=terms))


def test_a_search_keeps_a_damping_term_faster_than_the_samples_resolve():
    """Beyond 1 in its order a term must be resolved: a search that took it there ended without density."""
    posterior = problem_of(study_of(2, cubic=0.0)).posterior
    table = posterior.table
    start = table.draw(1, np.random.default_rng(0))[0]
    start[table.at("time", 0, 0)], start[table.at("order", 0, 0)] = 1 / OMEGA, 2.0
    start[table.at("time", 0, 1)], start[table.at("order", 0, 1)] = 2 * DAMPING / OMEGA, 1.0
    start[table.at("delay", 0)] = 0.1 * PERIOD
    assert start[table.at("time", 0, 1)] < table.resolution
    least = LeastSquares(replace(posterior, noise=White()))
    low, high = least.bounds_around(start)
    order, time = (least.columns.index(table.at(kind, 0, 1)) for kind in ("order", "time"))
    assert high[order] == 1.0
    assert low[time] < np.log(start[table.at("time", 0, 1)])
    steep = start.copy()
    steep[table.at("order", 0, 1)], steep[table.at("time", 0, 1)] = 1.4, 2 * table.resolution
    low, high = least.bounds_around(steep)
    assert high[order] > 1.4
    assert low[time] == pytest.approx(np.log(table.resolution))
    found, *_ = find_optima(least.posterior, np.random.default_rng(1), starts=1, near=[start])
    assert found.values[table.at("sigma", 0)] < 0.3 * OUTPUT


def test_a_cubic_spring_is_named_beside_a_drive_that_was_sampled():
    """The delay cannot fall below 0: half a period less of it does not take the place of the drive's. What
    remains is above the noise, so that not all may be explained."""
    names = ("sampled_drive", "cubic_stiffness", "unmodelled_linear")
    library = [catalogue()[name] for name in names]
    found = loop(study_of(1, n=400, read_from=100), library=library, sample=False, quick=True, as_stated=True)
    assert {effect.name for effect in found.effects} == {"sampled_drive", "cubic_stiffness"}
    assert found.verdict.kind in ("explained", "partly explained")
    assert found.after.fit[0].rmse > 1.5 * NOISE
    refit = found.rounds[0].chosen
    assert refit.added == ("sampled_drive",)
    assert refit.optimum.x[refit.model.names.index("delay")] < 0.01 * PERIOD
    assert found.after.unseen[0].rmse < 0.1 * found.before.unseen[0].rmse
    c = found.after.state.optimum.x[-1] / found.after.state.model.effected.ranges.response[0] ** 2
    assert c == pytest.approx(CUBIC, rel=0.1)
