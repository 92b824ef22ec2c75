"""Means of samples in place of the samples: what they are, and what they lose against all samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from small import ONE, record

import lcopa_bayes as lb
from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.device import Bench, truth
from lcopa_bayes.data.averaging import averaged
from lcopa_bayes.data.drive import axis_drives
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.identifiability.averagingloss import averaging_losses
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.discretisation import optima_of

COMMAND = on_off((1.0,), hold=3.1, at=0.35)


def clean(period: float, exposure: float = 0.0) -> Record:
    return truth(ONE, Bench(camera=period, exposure=exposure), COMMAND, duration=8.0, name="a")


def exact(means: Record, exposure: float) -> np.ndarray:
    """What the bench, which has numerics of its own, measures over that exposure."""
    rows = np.isfinite(means.response[:, 0])
    return means.response[rows] - ONE.response(COMMAND, means.time[rows], exposure=exposure)


@pytest.mark.parametrize("share", [0.0, 0.5])
def test_a_mean_is_a_sample_of_a_longer_exposure(share):
    """Nearly, of instants; exactly, of exposures that fill the period."""
    errors = []
    for period, count in ((0.1, 5), (0.02, 25)):
        exposure = share * period
        study = averaged(Study(fit=clean(period, exposure), model={"exposure_ms": exposure}), count)
        assert study.exposure == pytest.approx(0.5)
        errors.append(np.abs(exact(study.fit[0], 0.5)))
    assert errors[0].max() < 4e-3  # where the response sets in
    assert np.median(errors[1]) < np.median(errors[0]) / 15  # second order: 25
    filled = averaged(Study(fit=clean(0.1, 0.1), model={"exposure_ms": 0.1}), 5)
    assert np.abs(exact(filled.fit[0], 0.5)).max() < 1e-8


def test_drive_changes_stay_and_what_fills_no_mean_is_left_out():
    whole = clean(0.1)
    response = whole.response.copy()
    rows = np.flatnonzero(np.isfinite(response[:, 0]))
    response[rows[7]] = np.nan
    means = averaged(Study(fit=replace(whole, response=response)), 3).fit[0]
    ours, theirs = axis_drives(means)[0], axis_drives(whole)[0]
    assert_array_equal(ours.times, theirs.times)
    assert_array_equal(ours.jumps, theirs.jumps)
    sampled = np.isfinite(means.response[:, 0])
    assert np.count_nonzero(sampled) == rows.size // 3 - 1
    assert_allclose(np.diff(means.time[sampled])[[0, 1, 2]], [0.3, 0.6, 0.3])
    assert_allclose(means.response[sampled][0], response[rows[:3]].mean(axis=0), rtol=1e-12)
    assert means.time[sampled][0] == pytest.approx(whole.time[rows[2]] + 0.05)


def test_what_has_no_means_is_refused():
    whole = clean(0.1)
    with pytest.raises(lb.InputError, match="2 samples or more; got 1"):
        averaged(Study(fit=whole), 1)
    with pytest.raises(lb.InputError, match="80 samples are no two means of 41"):
        averaged(Study(fit=whole), 41)
    uneven = replace(whole, time=whole.time + 0.02 * np.sin(whole.time))
    with pytest.raises(lb.InputError, match="not equidistant"):
        averaged(Study(fit=uneven), 2)
    with pytest.raises(lb.InputError, match=r"'b' is sampled every 0.05 ms, 'a' every 0.1 ms"):
        averaged(Study(fit=[whole, replace(clean(0.05), name="b")]), 2)


@pytest.mark.parametrize("seed", [7, 9])
def test_the_loss_is_the_distance_of_two_optima(seed):
    """Each found by a search of its own, the gain and the offset integrated out there."""
    seen = record(seed, camera=0.005, duration=12.0, noise_sd=0.01)
    whole = Study(fit=seen, noise={"kind": "white"}, terms=1)
    (reported,) = averaging_losses(whole, (20,))
    problems = [problem_of(study).refined(factor) for study, factor in ((whole, 1), (averaged(whole, 20), 4))]
    alone, means = (optima_of(problem)[0] for problem in problems)
    posterior = problems[0].posterior
    at = [posterior.coordinates(one.values[None])[0] for one in (alone, means)]
    for column, k in enumerate(posterior.sampled):
        name = posterior.table.names[k]
        if name in reported.names:
            sd, wider = (np.sqrt(one.covariance[column, column]) for one in (alone, means))
            place = reported.names.index(name)
            assert wider / sd == pytest.approx(reported.widening[place], rel=0.03), name
            assert (at[1] - at[0])[column] / sd == pytest.approx(reported.shift[place], abs=0.1), name
    assert np.abs(reported.shift).max() > 0.3


def test_the_loss_is_that_of_the_posterior_of_all_samples():
    whole = Study(fit=record(camera=0.01, duration=12.0, noise_sd=0.03), noise={"kind": "white"}, terms=1)
    reported = {one.count: one for one in averaging_losses(whole, (50, 25))}
    both = [lb.fit(study, quick=True) for study in (whole, averaged(whole, 25))]
    for name, widening, shift in zip(
        reported[25].names, reported[25].widening, reported[25].shift, strict=True
    ):
        draws = [fit.draws.column(name) for fit in both]
        sampled, means = map(np.log, draws) if name.startswith("time") else draws
        assert means.std() / sampled.std() == pytest.approx(widening, rel=0.13), name  # 4 Monte Carlo errors
        assert (means.mean() - sampled.mean()) / sampled.std() == pytest.approx(shift, abs=0.3), name
    assert reported[25].widening.max() > 1.2
    assert reported[50].widening.max() > 1.1 * reported[25].widening.max()
    assert "Means of 25 samples make no standard deviation larger than 1." in str(reported[25])
