"""Starts of several paths: no single draw beside the others is better, and an optimum is found that draws of
all paths at once miss."""

from __future__ import annotations

import numpy as np
import pytest
from small import TWO, problem, record

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.inference.pathstarts import beside_each_other
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.path import TransferPath

COUPLED = record(device=TWO, camera=0.5)
RINGING = TransferPath.of_times(1.0, 0.4, (2.0, 1.6), (2.0, 1.0))
"""Second order, damping 0.4."""
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


def two_oscillators() -> Record:
    """One response to two drives that step at times of their own."""
    rng = np.random.default_rng(5)
    time = np.linspace(0.0, 30.0, 250)
    drive, response = np.zeros((time.size, 2)), NOISE * rng.standard_normal(time.size)
    for j, changes in enumerate(time[[[40, 150], [85, 180]]]):
        for at, size in zip(changes, (1.0, -0.5), strict=True):
            drive[time >= at, j] += size
            since = time - at - RINGING.delay
            response += size * np.where(since > 0, unit_step(RINGING, np.maximum(since, 1e-9)), 0.0)
    drives = (Axis("u1", "V"), Axis("u2", "V"))
    return Record("on", time, drive, response[:, None], drives, (Axis("y", "V"),), "s")


@pytest.mark.parametrize("seed", [1, 2])
def test_two_oscillators_are_found(seed):
    """With the noise of the record; a plant whose one path takes the part of the other leaves five times
    that."""
    posterior = problem(two_oscillators(), terms=2, share="none", delay="path").posterior
    (best, *_) = find_optima(posterior, np.random.default_rng(seed), starts=4)
    white = posterior.table.of_kind("sigma")
    assert best.values[white] == pytest.approx(NOISE, rel=0.2)
