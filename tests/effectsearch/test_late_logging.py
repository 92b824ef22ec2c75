"""Changes of a drive that happen between two rows and are written with the second one."""

from types import SimpleNamespace

import numpy as np
import pytest

from lcopa_bayes.core.estimate import quantile
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.effectsearch.acceptance import leader
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.loopresult import Loop
from lcopa_bayes.effectsearch.verdict import MARGIN
from lcopa_bayes.model.effects.commands import RefreshHold
from lcopa_bayes.model.effects.records import LateLogging, TriggerJitter

GAINS, TIMES, DELAYS = (3.0, -1.2), (4.0, 2.0), (1.5, 1.0)
CHANGES, NOISE = (0.0, 6.0), 0.02
VALVE, HEATER = Axis("valve", "pct"), Axis("heater", "kW")


def logged(seed: int, heights: tuple[float, float], late: float) -> Record:
    """Two drives of one response, each a lag with a delay; no row follows a change of the second drive before
    so long."""
    rng = np.random.default_rng(seed)
    time = np.sort(np.concatenate((np.linspace(-3.0, 0.0, 12), rng.uniform(0.0, 40.0, 100))))
    time = time[~((time > CHANGES[1] - 0.2) & (time < CHANGES[1] + late))]
    time = np.sort(np.append(time, CHANGES[1] + late))
    response = NOISE * rng.standard_normal(time.size)
    for gain, lag, delay, at, height in zip(GAINS, TIMES, DELAYS, CHANGES, heights, strict=True):
        response += gain * height * -np.expm1(-np.maximum(time - at - delay, 0.0) / lag)
    drive = np.stack([height * (time >= at) for at, height in zip(CHANGES, heights, strict=True)], axis=1)
    return Record(f"r{seed}", time, drive, response[:, None], (VALVE, HEATER), (Axis("level", "cm"),), "min")


@pytest.fixture(scope="module")
def found() -> Loop:
    heights, late = ((1.0, 0.5), (-1.0, 1.0), (0.5, -1.0), (0.8, 0.8)), (0.1, 1.0, 0.5, 0.0)
    records = [logged(k, *one) for k, one in enumerate(zip(heights, late, strict=True))]
    model = ModelSettings(offset="shared", share="none")
    study = Study("late", None, "min", 1, tuple(records[:3]), tuple(records[3:]), model)
    return loop(
        study, library=[RefreshHold, LateLogging, TriggerJitter], sample=False, quick=True, as_stated=True
    )


def test_it_is_named_beside_a_hold_that_explains_as_much(found: Loop):
    """A refresh finds a period and a phase for the delays of three records, and predicts the others worse."""
    assert found.verdict.kind == "disturbance"
    assert found.groups == (("late_logging", "refresh_hold"),)
    late, hold = found.rounds[0].refits
    assert late.log_bayes_factor - hold.log_bayes_factor < MARGIN < late.left_out - hold.left_out


def test_shared_coefficients_lead_where_records_left_out_do_not_say_otherwise(found: Loop):
    late, hold = found.rounds[0].refits
    assert leader([late, hold]) is late
    level = SimpleNamespace(
        log_bayes_factor=hold.log_bayes_factor, left_out=late.left_out - 1.0, new=hold.new
    )
    assert leader([late, level]) is level
    behind = SimpleNamespace(**vars(level) | {"log_bayes_factor": late.log_bayes_factor - MARGIN - 1.0})
    assert leader([late, behind]) is late
    assert leader([]) is None


def test_delays_are_those_of_the_plant(found: Loop):
    """With a hold in its place they are from the next refresh, a minute or so less."""
    names = found.after.state.model.names
    for name, truth in (("delay_level_valve", DELAYS[0]), ("delay_level_heater", DELAYS[1])):
        values = found.number(names.index(name)).values
        assert quantile(values, 0.05) < truth < quantile(values, 0.95), name


def test_changes_move_by_part_of_the_interval_before_them():
    rows = SimpleNamespace(times=np.array([0.0, 1.0, 1.5, 4.0]))
    drive = AxisDrive(np.array([0.0, 1.5, 4.0]), np.array([1.0, 0.5, 2.0]))
    moved, rest = LateLogging().commands(drive, 0.3, 1, rows, np.array([0.9, 0.5]))
    np.testing.assert_allclose(moved.times, [0.0, 1.25, 2.75])
    np.testing.assert_array_equal(moved.values, drive.values)
    assert rest == 0.3


def test_a_change_between_rows_was_not_late_by_more_than_since_the_last():
    rows = SimpleNamespace(times=np.array([0.0, 1.0, 2.0]))
    moved, _ = LateLogging().commands(AxisDrive(np.array([1.4]), np.ones(1)), 0.0, 0, rows, np.ones(1))
    np.testing.assert_allclose(moved.times, [1.0])
