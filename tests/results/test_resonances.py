"""Ringing that the samples do not resolve: confirmed by held-out records of a plant, not by a disturbance."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small import draws_of, problem, ringing

from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.results.resonances import (
    CONFIRMED,
    is_disturbance,
    resonances,
    ringing_confirmed,
    unresolved,
)
from lcopa_bayes.sampling.draws import Draws

TIME, ORDER, DELAY = 0.4, 1.97, 2.2
PHASES = np.arange(16) * np.pi / 8


def known(*held_out: Record) -> tuple[Problem, Draws]:
    """A study of a plant that rings, and draws at its truth."""
    fitted, values = ringing(TIME, ORDER, DELAY, seed=1)
    own = problem(fitted, held_out=held_out, noise="white")
    return own, draws_of(own.posterior.table, np.tile(values, (2, 1)))


def test_a_plant_of_which_held_out_records_ring_as_predicted_is_one():
    held = replace(ringing(TIME, ORDER, DELAY, seed=2)[0], name="held")
    made, draws = known(held)
    assert ringing_confirmed(made, draws, 0) == pytest.approx(1.0, abs=0.1)
    assert unresolved(made, draws) == ()
    assert list(resonances(made, draws)) == []


def test_without_held_out_records_nothing_confirms_it():
    made, draws = known()
    assert np.isnan(ringing_confirmed(made, draws, 0))
    (limitation,) = resonances(made, draws)
    assert limitation.level == "unusable"


def test_an_optimum_is_a_disturbance_as_its_draws_are():
    held = replace(ringing(TIME, ORDER, DELAY, seed=2)[0], name="held")
    for records, disturbance in (((), True), ((held,), False)):
        made, draws = known(*records)
        optimum = Optimum(draws.flat[0], np.eye(made.posterior.dimension), 0.0)
        assert is_disturbance(made, optimum) == disturbance


def test_a_sinusoid_that_follows_no_drive_does_not():
    """Under a drive that changes with every sample its phase does not matter."""
    held = replace(ringing(TIME, ORDER, DELAY, seed=3)[0], name="held")
    at_once = np.concatenate([held.drive[:2, 0], held.drive[:-2, 0]])
    for phase in PHASES[::4]:
        hum = np.cos(held.time / TIME + phase)
        made, draws = known(replace(held, response=(at_once + hum)[:, None]))
        assert ringing_confirmed(made, draws, 0) < 0
        assert len(unresolved(made, draws)) == 1


def test_after_a_single_step_a_sinusoid_of_any_phase_rarely_does():
    """``2 cos(phase) - 1`` of one as large: one phase in seven is taken for a plant."""
    quiet = replace(ringing(TIME, ORDER, DELAY, seed=4)[0], name="held")
    since = quiet.time - 20.0 - DELAY
    found = []
    for phase in PHASES:
        response = np.where(since > 0, 1.0 - np.cos(since / TIME + phase), 0.0)
        drive = (quiet.time >= 20.0).astype(float)
        made, draws = known(replace(quiet, drive=drive[:, None], response=response[:, None]))
        values = draws.flat.copy()
        values[:, made.posterior.table.names.index("order_1")] = 2.0 - 1e-6  # does not fade either
        found.append(ringing_confirmed(made, draws_of(made.posterior.table, values), 0))
    assert np.mean(found) == pytest.approx(-1.0, abs=0.3)
    assert np.mean(np.array(found) > CONFIRMED) <= 3 / 16
    assert max(found) > 0
