"""The claims: every verdict follows from numbers, and another number gives another verdict."""

from __future__ import annotations

import json
from dataclasses import replace
from math import asin, pi

import numpy as np
import pytest

from lcopa_bayes.bench.inversion import step_response
from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.claims import CLAIMS, judge
from lcopa_bayes.paper.modelclaims import RECORD_LENGTH, PrintedModel, crosstalk_rules, integer_rival
from lcopa_bayes.paper.numericsclaims import delay_costs, wavelet_cost
from lcopa_bayes.paper.opticsclaims import tilt_checks
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict
from lcopa_bayes.verbs.papers import claims

BY_ID = {claim.id: claim for claim in CLAIMS}
SUPPORTED, CONTRADICTED, UNDECIDED = Kind.SUPPORTED, Kind.CONTRADICTED, Kind.UNDECIDED


def verdict(claim: str, stated: Stated = PAPER, evidence: Evidence | None = None) -> Verdict:
    return BY_ID[claim].test(stated, evidence or Evidence())


def records(**fields: object) -> Stated:
    return replace(PAPER, records=replace(PAPER.records, **fields))


def optics(**fields: object) -> Stated:
    return replace(PAPER, optics=replace(PAPER.optics, **fields))


def plant(**paths: TransferPath) -> Stated:
    return replace(PAPER, plant=replace(PAPER.plant, **paths))


WHOLE = TransferPath(0.1, 3.0, (16.0, 12.0), (2.0, 1.0), 5.0)
"""A path of integer orders: no slow tail, and its own rival."""


def at_rest(path: TransferPath) -> Stated:
    steady = path.gain / path.stiffness * PAPER.records.step_drive
    own = plant(xx=path)
    return replace(own, records=replace(own.records, measured=replace(own.records.measured, steady=steady)))


# -- the list --------------------------------------------------------------------------------------


def test_every_claim_has_a_row():
    identifiers = [*(f"I{k}" for k in range(1, 7)), *(f"M{k}" for k in range(1, 5))]
    identifiers += ["X1", "X2", "X3", "N1", "N2", "S1", "S2", "S3", "S4"]
    assert [claim.id for claim in CLAIMS] == identifiers


@pytest.fixture(scope="module")
def judged():
    return judge()


def test_the_paper_as_printed(judged):
    found = {name: each.kind for name, each in judged.items()}
    assert {n for n, kind in found.items() if kind is UNDECIDED} == {
        *("I1", "I2", "I3", "I4", "I5", "I6"),
        *("M1", "M4"),
    }
    assert {n for n, kind in found.items() if kind is SUPPORTED} == {"X1", "S3"}


def test_rows_are_plain_json():
    rows = json.loads(json.dumps(claims().to_json()["claims"], allow_nan=False))
    for row in rows:
        assert {"id", "verdict", "number", "unit", "how"} <= set(row)
        assert row["how"]
        assert (row["number"] is None) <= (row["verdict"] == "undecided")


@pytest.mark.parametrize(("claim", "word"), [("I4", "audit"), ("M4", "comparison"), ("M1", "comparison")])
def test_what_waits_for_other_stages_says_so(claim, word):
    assert f"No {word} is among the evidence" in verdict(claim).how


# -- another number, another verdict ---------------------------------------------------------------

SMALLER = replace(PAPER.records.measured, steady=float(np.arcsin(1 / 4.8)))
CHANGED = {
    "M2": at_rest(WHOLE),
    "M3": records(fractional=replace(PAPER.records.fractional, settling=15.0)),
    "X1": records(crosstalk_gains=(0.00125, 0.00185)),
    "X2": records(crosstalk_measured=0.064),
    "X3": records(two_axis_steady=(0.0194, 0.0121)),
    "N2": records(fractional_rmse=0.002),
    "S2": optics(pitch_in_wavelengths=0.6),
    "S3": records(measured=SMALLER),
    "S4": records(measured=SMALLER),
}


@pytest.mark.parametrize("claim", CHANGED)
def test_another_number_turns_the_verdict(claim):
    before, after = verdict(claim), verdict(claim, CHANGED[claim])
    assert {before.kind, after.kind} == {SUPPORTED, CONTRADICTED}
    assert before.how != after.how


def test_a_tilt_law_that_fits_is_supported():
    """Every bound that the claim names can be the one that fails."""
    loose = {"tilt_fit_r_squared": 0.9, "tilt_fit_error": 100.0}
    assert verdict("S1", optics(**loose)).kind is CONTRADICTED  # the jump alone
    jumpless = PAPER.optics.tilt_slope_low * 3 - PAPER.optics.tilt_slope_high * 3
    continuous = {"tilt_intercept_high": jumpless, **loose}
    assert verdict("S1", optics(**continuous)).kind is SUPPORTED
    assert verdict("S1", optics(**{**continuous, "tilt_fit_error": 0.012})).kind is CONTRADICTED
    assert verdict("S1", optics(**{**continuous, "tilt_fit_r_squared": 0.995})).kind is CONTRADICTED


def test_overshoot_alone_contradicts_m3():
    swinging = plant(xx=replace(PAPER.plant.xx, etas=(16.02, 1.0, 1.0), orders=(2.0, 1.0, 0.6)))
    settles = PrintedModel(swinging).settled(PrintedModel(swinging).steady(pi / 2, 0)[0], 0.05, within=1000.0)
    stated = replace(
        swinging,
        records=replace(swinging.records, fractional=replace(PAPER.records.fractional, settling=settles)),
    )
    assert verdict("M3", stated).kind is CONTRADICTED
    allowed = replace(
        stated, records=replace(stated.records, fractional=replace(stated.records.fractional, overshoot=1.0))
    )
    assert verdict("M3", allowed).kind is SUPPORTED


def test_readings_that_disagree_leave_m2_open():
    """Measured exactly what Eq. 65 is at the end of the record, which is not what it tends to."""
    end = PrintedModel().at_end(PAPER.records.step_drive, 0.0)[0]
    stated = records(measured=replace(PAPER.records.measured, steady=end), steady_state_error=0.02)
    assert verdict("M2", stated).kind is UNDECIDED


def test_lobes_between_the_two_elements_are_undecided():
    near = optics(targets_1d_deg=(0.0, 5.0))
    assert verdict("S2", near).kind is UNDECIDED
    assert verdict("S2", near).number == pytest.approx(0.0136, abs=1e-3)


# -- the numbers, by hand --------------------------------------------------------------------------


def test_steady_numbers():
    model = PrintedModel()
    assert model.steady(pi / 2, 0.0)[0] == pytest.approx(0.100008 / 5.57 * pi / 2, rel=1e-14)
    assert model.at_end(pi / 2, 0.0)[0] == pytest.approx(0.01739526378981913 * pi / 2, rel=1e-9)
    assert verdict("M2").number == pytest.approx(0.01739526378981913 * pi / 2 / 0.0272 - 1, rel=1e-6)


def test_settling_numbers():
    model, steady = PrintedModel(), PrintedModel().steady(pi / 2, 0.0)[0]
    for band in (0.02, 0.05):
        time = model.settled(steady, band, within=1000.0)
        value = step_response(model.device.paths[0][0], np.array([time]))[0] * pi / 2
        assert value == pytest.approx(steady * (1 - band), rel=1e-5)
    assert model.settled(steady, 0.02, within=RECORD_LENGTH) == np.inf
    assert verdict("M3").number == pytest.approx(model.settled(steady, 0.05, within=1000.0))


def test_crosstalk_numbers():
    rules = crosstalk_rules(PAPER)
    assert rules["b / k"] == pytest.approx((0.003235 / 2.82, 0.005228 / 2.82), rel=1e-14)
    assert verdict("X1").number == pytest.approx(1 - 0.003235 / 2.82 / 0.00115, rel=1e-9)
    assert "b / k reproduces" in verdict("X1").how
    ratio = (0.003235 / 2.82) / (0.100008 / 5.57)
    assert f"{ratio:.4f} at rest" in verdict("X2").how
    x = 0.100008 / 5.57 * pi / 3 + 0.005228 / 2.82 * pi / 5
    assert f"{x:.5f}" in verdict("X3").how


def test_the_integer_rival_is_at_rest_when_the_record_ends():
    rival = integer_rival(PAPER)
    assert rival.model.orders == (2.0, 1.0)
    assert rival.rmse < 2e-4  # nothing like the 1.1e-3 rad of the text
    assert rival.steady == pytest.approx(0.02708, abs=5e-5)
    assert verdict("M1").number == rival.rmse


def test_a_model_of_integer_order_is_its_own_rival():
    rival = integer_rival(plant(xx=WHOLE))
    assert rival.rmse < 5e-6  # of 0.03 rad: the second-order error of 0.1 ms blocks
    assert rival.steady == pytest.approx(0.1 / 5.0 * pi / 2, rel=1e-3)


def test_geometry_numbers():
    pitch = 1064e-9 / (4 * np.sin(0.0272))
    assert verdict("S4").number == pytest.approx(pitch / (1.2 * 1064e-9), rel=1e-12)
    a = 1064e-9 / (2 * pi * pitch)
    largest = abs(asin(a) * pi / 2 / 0.0272 - 1)
    assert verdict("S3").number == pytest.approx(largest, rel=1e-6)


def test_numerics_numbers():
    assert wavelet_cost(PAPER).difference < 1e-12
    assert wavelet_cost(PAPER).ratio > 1
    printed, worst = delay_costs(PAPER)
    assert printed.rounded == pytest.approx(3.0)
    assert worst.delay - 3.0 == pytest.approx(0.05)
    assert worst.largest_shift == verdict("N2").number > printed.largest_shift


def test_tilt_numbers():
    uniform, consistent = tilt_checks(PAPER.optics)
    best = max(uniform.continuous[0].r_squared, consistent.continuous[0].r_squared)
    assert verdict("S1").number == best
    assert uniform.printed_jump == pytest.approx(0.095215 * 3 + 1.2058 - 0.4019 * 3)
