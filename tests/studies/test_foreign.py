"""Campaigns of plants outside the family: responses are exact, truths those of the records."""

from __future__ import annotations

import sys
from pathlib import Path

import mpmath as mp
import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "studies" / "undeclared-effects"))

import devicetruth
import foreign
import score
import scoresheet

from lcopa_bayes.model.layout import Layout
from lcopa_bayes.results.structure import with_least_terms

TIME, LAG = 2.0, 0.3


def transfer(kind: str, element: foreign.Element) -> object:
    """Of an element drawn with seed 3, from what its formula says."""
    rng = np.random.default_rng(3)
    if kind == "three lags":
        return lambda s: sum(
            w / (1 + s / r) for w, r in zip(element.weights.tolist(), element.rates.tolist(), strict=True)
        )
    if kind == "two lags":
        ratio = rng.uniform(0.2, 0.8)
        return lambda s: 1 / ((1 + TIME * s) * (1 + ratio * TIME * s))
    if kind == "oscillator":
        damping = rng.uniform(0.3, 0.7)
        return lambda s: 1 / (1 + 2 * damping * TIME * s + (TIME * s) ** 2)
    if kind == "wall":
        return lambda s: 1 / mp.cosh(mp.sqrt(3 * TIME * s))
    if kind == "layer":
        return lambda s: mp.tanh(mp.sqrt(3 * TIME * s)) / mp.sqrt(3 * TIME * s)
    return lambda s: 1 / (1 + sum(eta * s**order for order, eta in element.etas.items()))


@pytest.mark.parametrize("kind", foreign.PLANTS)
@pytest.mark.parametrize("lag", [0.0, LAG])
def test_a_step_response_is_that_of_its_transfer_function(kind: str, lag: float) -> None:
    element = foreign.PLANTS[kind](TIME, np.random.default_rng(3))
    of = transfer(kind, element)
    time = np.array([0.02, 1.0, 15.0])
    exact = [float(mp.invertlaplace(lambda s: of(s) / (s * (1 + lag * s)), t, method="dehoog")) for t in time]
    seen = element.lagging(lag) if lag else element
    np.testing.assert_allclose(seen.rises(time), exact, rtol=1e-6, atol=3e-8)
    np.testing.assert_allclose(seen.rises(np.array([-1.0, 0.0])), 0.0, atol=1e-12)


@pytest.mark.parametrize("kind", ["wall", "layer"])
def test_a_series_of_diffusion_is_as_exact_as_it_says(kind: str) -> None:
    element = foreign.PLANTS[kind](1 / 3, np.random.default_rng(0))
    late, early = np.geomspace(5e-5, 1e-3, 50), np.linspace(0.0, 5e-5, 200)

    def begins(time: np.ndarray) -> np.ndarray:  # as of a half-space, until the far face is felt
        return 2 * np.sqrt(time / np.pi) if kind == "layer" else np.zeros(time.size)

    np.testing.assert_allclose(element.rises(late), begins(late), atol=1e-12)
    np.testing.assert_allclose(element.rises(early), begins(early), atol=7e-4)


@pytest.mark.parametrize("seed", range(20))
def test_records_are_the_truth_with_noise(seed: int) -> None:
    made = foreign.campaign(foreign.KINDS[seed % len(foreign.KINDS)], foreign.EFFECTS[:1], seed)
    records = (*made.fit, *made.held_out)
    assert 3 <= len(made.fit) <= 5
    assert 1 <= len(made.held_out) <= 2
    dark = [one for one in made.fit if not one.drive.any()]
    assert len(dark) == 1
    assert not np.ptp(made.truth[dark[0].name], axis=0).any()
    errors = np.concatenate([(one.response - made.truth[one.name]) / made.noise for one in records])
    assert np.nanstd(errors) == pytest.approx(1.0, rel=0.2)
    spread = np.ptp(
        np.concatenate([made.truth[one.name] - made.truth[one.name][0] for one in records]), axis=0
    )
    assert np.all(made.noise < 0.035 * spread)
    axes = made.fit[0].drive_axes, made.fit[0].response_axes
    layout = Layout.of(*axes, with_least_terms(made.study(seed)).model)
    names = {f"{key}[{path}]" for _, _, path, _ in layout.paths for key in scoresheet.PATHS}
    assert set(foreign.truths(made, 10.0, ())) == names


def test_records_superpose_the_responses_to_every_change() -> None:
    made = foreign.campaign("two lags", (), 3)  # two responses to two drives
    for record in made.fit:
        jumps = np.diff(record.drive, axis=0)
        for i, row in enumerate(made.paths):
            expected = np.zeros(record.time.size)
            for j, path in enumerate(row):
                for k in np.flatnonzero(jumps[:, j]):
                    since = record.time - record.time[k + 1] - path.delay
                    expected += np.where(since > 0, jumps[k, j] * path.gain * path.element.rises(since), 0.0)
            moved = made.truth[record.name][:, i]
            np.testing.assert_allclose(moved - moved[0], expected, atol=1e-12 * made.noise[i] / 0.005)


def test_a_sensor_that_lags_is_in_the_truth_until_it_is_named() -> None:
    made = foreign.campaign("two lags", ("sensor_lag",), 5)
    lag = made.hidden[0].numbers["Ts"]
    slow, quick = foreign.truths(made, 1e3 * lag, ()), foreign.truths(made, 1e3 * lag, ("sensor_lag",))
    assert slow["rise_10_90[y1]"] > quick["rise_10_90[y1]"]
    assert slow["steady_state[y1]"] == quick["steady_state[y1]"]


def test_a_rise_ends_where_a_response_that_rings_first_reaches_it() -> None:
    ring = np.sqrt(1 - 0.3**2)
    element = foreign.Modes(np.array([1 - 0.3j / ring]), np.array([0.3 - 1j * ring]))
    time = np.linspace(0.0, np.pi / ring, 100_001)  # up to the first peak
    curve = 1 - np.exp(-0.3 * time) * (np.cos(ring * time) + 0.3 / ring * np.sin(ring * time))
    low, high = time[np.searchsorted(curve, [0.1, 0.9])]
    rise = devicetruth.step_truth(element.rises, 1.0, 0.0, 30.0)["rise_10_90"]
    assert rise == pytest.approx(high - low, abs=1e-4)


def test_a_truth_that_is_not_reached_lies_in_an_interval_that_is_open() -> None:
    values = np.append(np.linspace(1.0, 2.0, 93), np.full(7, np.inf))
    assert 0 > devicetruth.place(values, np.inf) > -1.645
    assert devicetruth.place(values[:-4], np.inf) < -1.645


def rows() -> list[dict]:
    """Four foreign campaigns: a clean one, one in which a name is wrong, one that is not explained, one in
    which sums of lags are all that is missing."""
    common = {"kind": "foreign", "drives": "foreign", "seed": 0, "crashed": "", "effects": [], "truth": []}
    common |= {"disturbance": False, "survival": {}, "refits": [], "coverage_after": 0.9, "plant": "wall"}
    common |= {key: {"held_out_truth_over_noise": 0.5} for key in ("before", "after")}
    figures = {"steady_state[y1]": 1.0, "delay[y1]": -2.0, "value_at_end[y1]": 0.1, "rise_10_90[y1]": 1.6}
    lags = f"{scoresheet.LINEAR}sums of 3 lags follow y1 as well as any effect."
    said = [
        ("clean", [], ""),
        ("explained", ["cross_fade"], ""),
        ("unexplained", [], ""),
        ("unexplained", [], lags),
    ]
    return [
        common | {"verdict": one, "named": names, "sentence": words, "plant_after": figures}
        for one, names, words in said
    ]


def test_lines_of_foreign_plants_are_counted() -> None:
    (line,) = scoresheet.plants(rows())
    assert (line["bare"], line["clean"], line["named"]) == (4, 1, 1)
    assert line["held"] == {
        "steady_state": [3, 3],
        "delay": [0, 3],
        "value_at_end": [3, 3],
        "rise_10_90": [3, 3],
    }
    targets = score.frozen()["targets"]
    lines = {one["measure"]: one for one in scoresheet.sheet(rows(), targets, 0.1)}
    assert lines["an effect named, foreign plants"]["value"] == pytest.approx(1 / 4)
    assert lines["90 % intervals of the delays, foreign plants"]["value"] == 0.0
    assert lines["50 % intervals of the values at record end, foreign plants"]["value"] == 1.0
    assert lines["90 % intervals of the delays, nothing hidden"]["trials"] == 0


def test_one_foreign_campaign_of_four_hides_an_effect_and_every_plant_has_some() -> None:
    options = dict.fromkeys(("controls", "each", "outsiders", "pairs", "sampled", "cells"), 0)
    listed = score.tasks(score.argparse.Namespace(seed=7, foreign=160, **options))
    assert [one.kind for one in listed] == ["foreign"] * 160
    assert sum(bool(one.effects) for one in listed) == 40
    assert {one.plant for one in listed if one.effects} == set(foreign.KINDS)
    assert {name for one in listed for name in one.effects} == set(foreign.EFFECTS)
