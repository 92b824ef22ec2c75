"""Records that contradict each other are recognised, and records that do not are not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from shapes import SHAPES
from small import ONE, TWO, path, record, study

from lcopa_bayes.bench.command import Command, joint, on_off, prbs, staircase, step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.core.arrays import Matrix
from lcopa_bayes.data.agreement import _SIGN, _Ratio, disagreements
from lcopa_bayes.data.drive import moved_with_drive
from lcopa_bayes.data.record import Record
from lcopa_bayes.inference.observations import Samples
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.results.firstlook import first_look
from lcopa_bayes.verbs.check import check


def pair(noise_sd: float = 0.02) -> tuple[Record, Record]:
    """Two steps of one plant."""
    on = record(1, name="on", noise_sd=noise_sd)
    return on, record(2, name="half", command=step(0.5, at=0.35), noise_sd=noise_sd)


def changed(one: Record, response: Matrix) -> Record:
    return replace(one, response=response)


def scaled(one: Record, factor: float) -> Record:
    """The same sensor with another gain about the level at rest."""
    rest = np.array([column[np.isfinite(column)][0] for column in one.response.T])
    return changed(one, rest + factor * (one.response - rest))


@pytest.mark.parametrize("name", SHAPES)
def test_records_of_one_plant_agree(name: str) -> None:
    campaign = SHAPES[name].study(3)
    assert disagreements((*campaign.fit, *campaign.held_out)) == ()


def test_another_unit_is_recognised_whichever_record_has_it() -> None:
    on, half = pair()
    for records in ((on, scaled(half, 1e3)), (scaled(on, 1e-3), half)):
        (one,) = disagreements(records)
        assert one.gross
        assert set(one.records) == {"on", "half"}
        assert "unit" in one.remedy
        assert abs(np.log(one.ratio)) == pytest.approx(np.log(1e3), abs=0.02)


def test_a_drive_in_another_unit_is_recognised() -> None:
    on, half = pair()
    (one,) = disagreements((on, replace(half, drive=half.drive / 1e3)))
    assert one.gross
    assert abs(np.log(one.ratio)) == pytest.approx(np.log(1e3), abs=0.02)


def test_a_reversed_connection_is_recognised() -> None:
    on, half = pair()
    (one,) = disagreements((on, changed(half, -half.response)))
    assert one.gross
    assert "signs" in one.remedy


@pytest.mark.parametrize(
    ("ratio", "reversed_sign"), [(-1.2, True), (-0.4, True), (-0.08, False), (-11.0, False)]
)
def test_a_reversed_sign_has_about_the_size_that_is_predicted(ratio: float, reversed_sign: bool) -> None:
    """A twelfth of it with the other sign is a prediction from drives that do not show the plant."""
    seen = _Ratio(0, ratio, 0.01, misfit=0.2, size=1.0, missed=1.0, unknown=0.0)
    assert (seen.remedy == _SIGN) is reversed_sign
    assert bool(seen.remedy) is reversed_sign


def test_two_plants_are_a_contradiction_and_chance_is_not() -> None:
    on, half = pair()
    (one,) = disagreements((on, scaled(half, 1.3)))
    assert not one.gross
    assert abs(np.log(one.ratio)) == pytest.approx(np.log(1.3), abs=0.02)
    assert not disagreements((on, scaled(half, 1.04)))  # below what counts


def test_another_gain_of_a_plant_that_oscillates_is_a_contradiction() -> None:
    """Its description must miss far less than the difference, of which noise is a hundredth."""
    device = replace(ONE, paths=((TransferPath(0.13, 2.8, (2.5, 1.0), (1.7, 0.9), 1.0),),))
    on, off, half = (
        record(
            number,
            device=device,
            duration=25.0,
            noise_sd=3e-4,
            name=name,
            command=step(to, at=2.0, rest=rest),
        )
        for number, (name, rest, to) in enumerate((("on", 0.0, 1.5), ("off", 1.5, 0.0), ("half", 0.0, 0.8)))
    )
    assert disagreements((on, off, half)) == ()
    (one,) = disagreements((scaled(on, 1.3), off, half))
    assert one.records[0] == "on"
    assert one.ratio == pytest.approx(1.3, abs=0.03)


def test_the_standard_error_of_a_ratio_is_its_scatter() -> None:
    sizes, errors = [], []
    for seed in range(20):
        on = record(seed, name="on")
        half = scaled(record(100 + seed, name="half", command=step(0.5, at=0.35)), 1.3)
        for one in disagreements((on, half)):
            sizes.append(max(one.ratio, 1 / one.ratio))
            errors.append(float(one.reason.split("standard error ")[1].rstrip(")")) / one.ratio * sizes[-1])
    assert len(sizes) == 20
    assert np.mean(sizes) == pytest.approx(1.3, abs=0.02)
    assert 0.5 < np.std(sizes) / np.mean(errors) < 2.0  # of 20 seeds: known to 0.16


def test_the_odd_record_of_several_is_named_once() -> None:
    records = [record(seed, name=f"r{seed}", command=step(0.4 + 0.2 * seed, at=0.35)) for seed in range(4)]
    records[2] = scaled(records[2], 1e3)
    (one,) = disagreements(records)
    assert one.records[0] == "r2"


@pytest.mark.parametrize("role", ["response", "drive"])
def test_exchanged_axes_are_recognised(role: str) -> None:
    first, second = (
        record(seed, device=TWO, command=on_off(to, hold=5.0, at=0.35, rest=(0.0, 0.2)), name=f"r{seed}")
        for seed, to in ((1, (1.0, 0.6)), (2, (-0.5, 1.0)))
    )
    third = record(3, device=TWO, command=on_off((1.0, 0.2), hold=4.0, at=0.5, rest=(0.0, 0.2)), name="r3")
    assert disagreements((first, second, third)) == ()
    wrong = replace(third, **{role: getattr(third, role)[:, ::-1]})
    (one,) = disagreements((first, second, wrong))
    assert one.gross
    assert "exchanged" in one.reason
    assert f"{role}s 'x' and 'y'" in one.reason


def device_of(*, similar: bool) -> Device:
    """Two drives of one response."""
    first, second = path(2.0, 0.7, (1.5,), (0.9,)), path(1.9 if similar else -0.6, 0.7, (1.5,), (0.9,))
    return replace(ONE, paths=((first, second),), drive_axes=TWO.drive_axes)


def one_at_a_time(*, similar: bool) -> list[Record]:
    """Each drive alone in two records."""
    device = device_of(similar=similar)
    return [
        record(seed, device=device, command=on_off(to, hold=hold, at=0.35), duration=20.0, name=f"r{seed}")
        for seed, (to, hold) in enumerate(
            (((1.0, 0.0), 5.0), ((0.5, 0.0), 9.0), ((0.0, 1.0), 4.0), ((0.0, 0.6), 8.0))
        )
    ]


def test_drives_that_move_one_after_the_other_and_act_alike_are_not_exchanged() -> None:
    """What one drive does predicts what another does, but each has records that show it is the other."""
    assert disagreements(one_at_a_time(similar=True)) == ()
    assert disagreements(one_at_a_time(similar=True)[1:3]) == ()  # nothing tells
    rng = np.random.default_rng(0)  # a drive that tells the two so badly that another one is predicted better
    both = joint(*(prbs(0.0, 1.5, hold=hold, duration=20.0, rng=rng, start=0.35) for hold in (3, 4)))
    switched = record(9, device=device_of(similar=True), command=both, duration=20.0, name="switched")
    assert disagreements([*one_at_a_time(similar=True), switched]) == ()
    records = one_at_a_time(similar=False)
    assert disagreements(records) == ()
    wrong = replace(records[1], drive=records[1].drive[:, ::-1])
    (said,) = disagreements([records[0], wrong, *records[2:]])
    assert said.records[0] == "r1"
    assert "drives 'x' and 'y' exchanged" in said.reason


def three_drives(changes: int, seed: int) -> list[Record]:
    """Four records of one response in which each of three drives moves so often, at any time."""
    rng = np.random.default_rng(seed)
    device = replace(
        ONE,
        paths=(
            tuple(path(gain, 0.7, (tau,), (0.9,)) for gain, tau in ((0.3, 1.0), (1.1, 1.3), (-0.5, 1.6))),
        ),
        drive_axes=tuple(replace(ONE.drive_axes[0], name=name) for name in "xyz"),
    )

    def moved() -> Command:
        """One drive."""
        times = np.sort(rng.uniform(2.0, 19.5, changes))
        return Command(times, rng.choice([-1.0, 0.0, 1.0], (changes, 1)), np.zeros(1))

    commands = [joint(moved(), moved(), moved()) for _ in range(4)]
    return [
        record(10 * seed + k, device=device, command=command, duration=20.0, name=f"r{k}")
        for k, command in enumerate(commands)
    ]


def test_predictions_of_which_little_is_known_show_no_exchange() -> None:
    """A drive that moves once, just before the end of the other records, is hardly known from them: of 56
    such campaigns these five were taken for exchanged by what is missed alone."""
    for seed in (15, 16, 24, 30, 51):
        assert disagreements(three_drives(1, seed)) == ()
    records = three_drives(6, 1)
    assert disagreements(records) == ()
    records[2] = replace(records[2], drive=records[2].drive[:, [1, 0, 2]])
    (said,) = disagreements(records)
    assert said.records[0] == "r2"
    assert "drives 'x' and 'y' exchanged" in said.reason


@settings(max_examples=6, deadline=None)
@given(ahead=st.floats(1.5, 3.0), seed=st.integers(0, 99))
def test_a_response_ahead_of_its_drive_is_recognised_with_its_lead(ahead: float, seed: int) -> None:
    one = record(seed, command=step(1.0, at=5.0), duration=20.0)
    early = replace(one, time=one.time.copy(), drive=np.where(one.time >= 5.0 + ahead, 1.0, 0.0)[:, None])
    (lead,) = disagreements((early,))
    assert lead.gross
    assert "ahead of its drive" in lead.reason
    stated = float(lead.reason.split("about ")[1].split()[0])
    assert ahead - 1.2 < stated < ahead + 0.3  # the plant's delay of 0.73 hides a part, rows are 0.2 apart


def led_by_a_row(seed: int, order: float, *, rows: int, noise_sd: float = 0.01) -> Record:
    """A step whose rows state the drive that acted until them, where `rows` is 1; without a delay."""
    device = replace(ONE, paths=((path(2.0, 0.0, (1.5,), (order,)),),))
    one = record(seed, device=device, command=step(1.0, at=5.0), duration=20.0, noise_sd=noise_sd)
    return replace(one, drive=np.concatenate([one.drive[:1]] * rows + [one.drive])[: len(one.drive)])


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 999), order=st.sampled_from([0.5, 0.8, 1.0]))
def test_a_drive_that_acted_until_its_row_is_recognised(seed: int, order: float) -> None:
    late, own = (led_by_a_row(seed, order, rows=rows) for rows in (1, 0))
    (said,) = disagreements((late,))
    assert "in the very row" in said.reason
    assert not said.gross
    assert disagreements((own,)) == ()
    rest = Samples.of(own, 0.2).quiet(0).values
    assert_array_equal(Samples.of(late, 0.2).quiet(0).values, rest)  # without the sample that has moved
    assert moved_with_drive(late, 0) == late.response[late.drive[:, 0] != 0][0, 0] - rest.mean()


def test_what_is_no_movement_with_the_drive() -> None:
    late = led_by_a_row(1, 0.5, rows=1)
    at = int(np.argmax(late.drive[:, 0] != 0))
    other = late.response.copy()
    for change in (
        {"response": np.where(np.arange(len(other))[:, None] == at + 1, other[at - 1], other)},  # one outlier
        {"response": np.where(np.arange(len(other))[:, None] == at, np.nan, other)},
        {"response": np.where(np.arange(len(other))[:, None] < at - 7, np.nan, other)},  # too few at rest
        {"drive": np.zeros_like(late.drive)},
    ):
        assert moved_with_drive(replace(late, **change), 0) == 0.0


def test_noise_of_long_memory_is_no_response_ahead_of_its_drive() -> None:
    """An axis that hardly moves follows a later drive better by chance; the other says when the clock ran."""
    rng = np.random.default_rng(34)
    one = record(34, command=step(1.0, at=5.0), duration=40.0)
    noise = rng.standard_normal(one.time.size)
    for k in range(1, noise.size):
        noise[k] = 0.95 * noise[k - 1] + np.sqrt(1 - 0.95**2) * noise[k]
    strong = one.response[:, 0]
    weak = 0.1 * strong + 0.03 * noise
    axes = (*one.response_axes, replace(one.response_axes[0], name="weak"))
    both = replace(one, response=np.column_stack([strong, weak]), response_axes=axes)
    assert disagreements((both,)) == ()
    alone = replace(both, response=weak[:, None], response_axes=axes[1:])
    assert disagreements((alone,)) == ()  # it rests where the later drive would move it
    early = one.time < 5.0
    assert disagreements((replace(alone, response=np.where(early, np.nan, weak)[:, None]),))
    unrested = np.where(early[:, None], np.nan, both.response)
    assert disagreements((replace(both, response=unrested),)) == ()


@pytest.mark.parametrize("seed", [5, 9, 14])
def test_a_response_that_rings_to_a_limit_is_not_ahead_of_its_drive(seed: int) -> None:
    """No sum of lags follows it, and later drives follow it better by chance; but it rests before them."""
    rng = np.random.default_rng(seed)
    time, damping = rng.uniform(0.4, 1.5), rng.uniform(0.2, 0.5)
    device = replace(ONE, paths=((path(2.0, 0.3, (time, 2 * damping * time), (2.0, 1.0)),),))
    levels, hold, start = [*rng.uniform(-1, 1, 3), 0.0], rng.uniform(2, 5), rng.uniform(2, 4)
    command = staircase(levels, hold=hold, start=start)
    one = record(seed, device=device, command=command, duration=20.0, noise_sd=0.02)
    limit = 0.6 * np.nanmax(np.abs(one.response))
    assert disagreements((changed(one, np.clip(one.response, -limit, limit)),)) == ()


@settings(max_examples=6, deadline=None)
@given(
    seed=st.integers(0, 9), clock=st.sampled_from([1e-9, 1.0, 1e6]), unit=st.sampled_from([1e-12, 1.0, 1e9])
)
def test_no_unit_matters(seed: int, clock: float, unit: float) -> None:
    on, half = record(seed, name="on"), record(seed + 1, name="half", command=step(0.5, at=0.35))
    wrong = scaled(half, 1.3)
    stated = disagreements((on, wrong))
    other = disagreements(
        [replace(one, time=clock * one.time, response=unit * one.response) for one in (on, wrong)]
    )
    assert [one.ratio for one in other] == pytest.approx([one.ratio for one in stated], rel=1e-6)


def test_records_that_disagree_are_in_the_verdicts() -> None:
    on, half = pair()
    campaign = study(on, scaled(half, 1e3))
    seen = check(campaign)
    assert seen.values["grade"] == "tentative"
    assert "Records disagree" in seen.verdict
    assert "Records disagree" in first_look(campaign).verdict
    assert "Records disagree" not in check(study(on, half)).verdict
    alone = check(study(led_by_a_row(1, 0.5, rows=1))).verdict
    assert alone.startswith("The records can be fitted. Response 'y' of record ")
