"""Starts of several paths: no single draw beside the others is better, and an optimum is found that draws of
all paths at once miss."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import TWO, problem, record

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.pathstarts import beside_each_other
from lcopa_bayes.inference.poles import regressed
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.path import TransferPath

COUPLED = record(device=TWO, camera=0.5)
NOISE = 0.004


def squares(posterior: Posterior, values: np.ndarray) -> float:
    """Squared residual over the variance of each response, with gains and offsets by least squares."""
    out, model = 0.0, posterior.model
    units = model.unit_responses(posterior.table.dynamics(values[None]))
    for axis, row in enumerate(posterior.table.layout.unit_of):
        observed = [one.axes[axis] for one in posterior.samples]
        columns = [
            np.concatenate([u[k][0, o.index] for u, o in zip(units, observed, strict=True)]) for k in row
        ]
        for one in observed:
            columns.append(np.concatenate([np.full(o.values.size, float(o is one)) for o in observed]))
        y = np.concatenate([o.values for o in observed])
        matrix = np.stack(columns, axis=1)
        out += float(np.sum((y - matrix @ np.linalg.lstsq(matrix, y)[0]) ** 2)) / float(y.var())
    return out


@pytest.mark.parametrize("share", ["none", "paper"])
def test_no_path_has_a_better_draw_beside_the_others(share):
    """Every draw in place of that of a group of paths, by least squares of the simulated responses."""
    options = {"delay": "path"} if share == "none" else {"delay": "element"}
    posterior = problem(COUPLED, share=share, terms=1, **options).posterior
    table = posterior.table
    drawn = table.draw(70, np.random.default_rng(4))
    drawn = drawn[np.argsort([squares(posterior, one) for one in drawn])]
    found = beside_each_other(posterior, drawn, 2)
    assert 1 <= len(found) <= 2
    assert min(squares(posterior, one) for one in found) < 0.9 * squares(posterior, drawn[0])
    for values in found:
        least = squares(posterior, values)
        for element, slots in enumerate(table.terms):
            delay = next(
                d
                for row, own in zip(table.layout.element_of, table.layout.delay_of, strict=True)
                for e, d in zip(row, own, strict=True)
                if e == element
            )
            rows = [*slots.every, table.at("delay", delay)]
            for other in drawn:
                replaced = values.copy()
                replaced[rows] = other[rows]
                assert squares(posterior, replaced) >= least * (1 - 1e-6)


def test_paths_that_share_have_no_draws_of_their_own():
    for options in ({"share": "all"}, {"share": "none", "delay": "shared"}):
        posterior = problem(COUPLED, terms=1, **options).posterior
        drawn = posterior.table.draw(70, np.random.default_rng(4))
        assert beside_each_other(posterior, drawn, 2).shape == (0, drawn.shape[1])


def oscillators(times: tuple[float, ...], jitter: float) -> Record:
    """One response to drives that step at times of their own, each through a resonance of damping 0.4."""
    rng = np.random.default_rng(5)
    time = np.linspace(0.0, 60.0, 300)
    time[1:-1] += jitter * rng.uniform(-0.4, 0.4, 298) * time[1]
    drive, response = np.zeros((time.size, len(times))), NOISE * rng.standard_normal(time.size)
    for j, own in enumerate(times):
        path = TransferPath.of_times(1.0, 0.4, (own, 0.8 * own), (2.0, 1.0))
        for k, size in ((24 + 30 * j, 1.0), (150 + 36 * j, -0.6)):
            drive[time >= time[k], j] += size
            since = time - time[k] - path.delay
            response += size * np.where(since > 0, unit_step(path, np.maximum(since, 1e-9)), 0.0)
    drives = tuple(Axis(f"u{j + 1}", "V") for j in range(len(times)))
    return Record("on", time, drive, response[:, None], drives, (Axis("y", "V"),), "s")


@pytest.mark.parametrize(("times", "jitter"), [((2.0, 2.0), 0.0), ((2.0, 5.0), 0.0), ((2.0, 3.0), 1.0)])
@pytest.mark.parametrize("starts", [2, pytest.param(4, marks=pytest.mark.slow)])
def test_resonances_of_several_drives_are_found(times, jitter, starts):
    """With the noise of the record; a plant whose one path takes the part of the other leaves five times that
    or more."""
    posterior = problem(oscillators(times, jitter), terms=2, share="none", delay="path").posterior
    (best, *_) = find_optima(posterior, np.random.default_rng(1), starts=starts)
    assert best.values[posterior.table.of_kind("sigma")] == pytest.approx(NOISE, rel=0.2)


def test_poles_are_those_of_the_plant_on_any_clock():
    """A pair of some regression is that of the plant to a fifth, on an even clock, on a jittered one and with
    samples missing."""
    even, jittered = oscillators((2.0,), 0.0), oscillators((2.0,), 1.0)
    missing = np.where(np.arange(300)[:, None] % 7 == 3, np.nan, even.response)
    for record_ in (even, jittered, replace(even, response=missing)):
        posterior = problem(record_, terms=2).posterior
        found = regressed(posterior, posterior.table.draw(100, np.random.default_rng(0)))
        table = posterior.table
        first, second = (found[:, table.at("time", 0, k)] for k in (0, 1))
        assert (found[:, [table.at("order", 0, k) for k in (0, 1)]] == [2.0, 1.0]).all()
        off = np.maximum(np.abs(np.log(first / 2.0)), np.abs(np.log(second / 1.6)))
        assert off.min() < 0.2
