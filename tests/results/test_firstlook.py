"""The first look: intervals against closed form, the weights of its draws, its residual, its files."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import path, record, study

import lcopa_bayes as lb
from lcopa_bayes.bench.command import on_off
from lcopa_bayes.bench.device import Device
from lcopa_bayes.cli import main
from lcopa_bayes.data.record import Axis, Record, save_record
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.optimum import find_optima
from lcopa_bayes.results import firstlook
from lcopa_bayes.results.firstlook import first_look

ON = record(1, camera=0.2, name="on")
OFF = record(2, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.5, name="off")
KNOWN = {"delay": 0.73, "order_1": 0.8, "sigma": 0.02}


def test_intervals_of_a_gaussian_posterior_are_those_of_its_covariance():
    seen = first_look(study(ON, priors=KNOWN))  # the logarithm of one time constant is sampled
    (column,) = seen.problem.posterior.sampled
    logs = np.log(seen.draws.flat[:, column])
    sd = float(np.sqrt(seen.optimum.covariance[0, 0]))
    assert seen.share > 0.9
    assert_allclose(logs.mean(), np.log(seen.optimum.values[column]), atol=5 * sd / np.sqrt(logs.size))
    assert_allclose(logs.std(), sd, rtol=5 / np.sqrt(2 * logs.size))
    # and of the gain, which is drawn given the time constant: a second search of a posterior that samples it
    sampled = first_look(study(ON, priors=KNOWN | {"gain": ("lognorm", {"s": 3.0, "scale": 2.0})}))
    at = [row.name for row in sampled.problem.posterior.table.rows].index("gain")
    pairs = [one.draws.flat[:, at] for one in (seen, sampled)]
    assert_allclose(pairs[0].mean(), pairs[1].mean(), atol=5 * pairs[0].std() / np.sqrt(400))
    assert_allclose(pairs[0].std(), pairs[1].std(), rtol=0.2)


@pytest.mark.parametrize("widened", [1.0, 4.0, 16.0])
def test_the_share_of_too_wide_a_gaussian_is_that_of_closed_form(widened):
    """Of draws with `s` times the variance: sqrt(2 s - 1) / s for one coordinate; the draws follow the
    posterior all the same."""
    posterior = problem_of(study(ON, priors=KNOWN)).posterior
    best = find_optima(posterior, np.random.default_rng(1), starts=1)[0]
    wide = replace(best, covariance=widened * best.covariance)
    draws, share = firstlook._near(posterior, wide, np.random.default_rng(2))
    assert_allclose(share, np.sqrt(2 * widened - 1) / widened, rtol=0.1)
    spread = np.log(draws.flat[:, posterior.sampled[0]]).std() / np.sqrt(best.covariance[0, 0])
    assert_allclose(spread, 1.0, rtol=0.2)


def test_draws_outside_the_priors_are_not_shown():
    narrow = KNOWN | {"time_1": ("uniform", {"loc": 1.0, "scale": 0.502})}
    seen = first_look(study(ON, priors=narrow))
    times = seen.draws.flat[:, seen.problem.posterior.table.names.index("time_1")]
    assert times.max() <= 1.502
    assert np.isfinite(seen.draws.log_density).all()


def test_the_residual_is_that_of_the_optimum():
    seen = first_look(study(ON, held_out=[OFF]))
    posterior = seen.problem.posterior
    values = seen.optimum.values[None]
    misfit = posterior.residual(0, 0, posterior.samples[0].axes[0], values, posterior.responses(values)[0])[0]
    (fitted,) = (one for one in seen.residuals if not one.held_out)
    assert_allclose(fitted.values, misfit, atol=1e-9)
    assert [one.held_out for one in seen.residuals] == [False, True]
    assert "compatible" in seen.verdict


def test_a_plant_outside_the_family_shows_in_the_verdict():
    bent = Record(
        "on", ON.time, ON.drive, ON.response + 0.3 * np.sin(ON.time)[:, None],
        ON.drive_axes, ON.response_axes, time_unit=ON.time_unit,
    )  # fmt: skip
    assert "does not explain the residual" in first_look(study(bent)).verdict


def test_two_drives_of_one_response_have_delays_of_their_own():
    """By one delay for both neither was within its interval: 3.86 (3.74 to 3.95) where 4 and 10 are true."""
    slow, quick = path(1.0, 0.4, (1.5,), (0.9,)), path(-0.6, 1.4, (1.0,), (1.0,))
    plant = Device(((slow, quick),), (Axis("u", "V"), Axis("v", "V")), (Axis("y", "rad"),), (0.1,))
    command = on_off((1.0, 0.0), hold=5.0, at=0.35, rest=(0.0, 0.0))
    other = on_off((0.0, 1.0), hold=5.0, at=0.35, rest=(0.0, 0.0))
    records = [
        record(seed, device=plant, command=each, camera=0.1, name=name)
        for seed, each, name in ((1, command, "u"), (2, other, "v"))
    ]
    rows = {row["name"]: row for row in first_look(study(*records)).to_json()["parameters"]}
    for name, truth in (("delay_y_u", 0.4), ("delay_y_v", 1.4), ("gain_y_u", 1.0), ("gain_y_v", -0.6)):
        half = rows[name]["upper"] - rows[name]["lower"]
        assert rows[name]["lower"] - half < truth < rows[name]["upper"] + half
        assert half < 0.4


def test_a_look_is_saved_read_back_and_drawn_again(tmp_path, capsys):
    save_record(ON, tmp_path / "on.csv")
    save_record(OFF, tmp_path / "off.csv")
    run = tmp_path / "run"
    given = ["look", str(tmp_path / "on.csv"), "--held-out", str(tmp_path / "off.csv"), "--out", str(run)]
    assert main(given) == 0
    assert "look.html" in capsys.readouterr().out
    page = (run / "look.html").read_bytes()
    seen = lb.load_result(run)
    assert isinstance(seen, lb.LookResult)
    assert seen.to_json() == json.loads((run / "look.json").read_text())
    assert list(seen.summary()["parameter"])[:2] == ["gain", "time_1"]
    first = seen.to_json()["overview"]
    gain = seen.summary()["value"][0]
    assert float(first["plant"][0].split()[4]) == pytest.approx(gain, rel=0.05)
    assert {one["question"] for one in first["answers"]} >= {"How good is the fit?", "What next?"}
    assert b"At the best optimum" in page
    (run / "look.html").unlink()
    assert main(["report", str(run)]) == 0
    assert (run / "look.html").read_bytes() == page
    (run / "tables" / "look_bands.csv").unlink()
    capsys.readouterr()
    assert main(["report", str(run)]) == 2
    message = capsys.readouterr().err
    assert "look_bands.csv" in message
    assert "run `look` again" in message


@pytest.mark.usefixtures("undrawn")
def test_a_fit_in_a_folder_begins_with_a_look_unless_it_is_quiet(tmp_path, capsys):
    tiny = {"target_ess": 50}
    plain = study(ON, priors=KNOWN, sampler=tiny)
    lb.fit(plain, folder=tmp_path / "loud", quiet=False)
    assert f"first look: {tmp_path / 'loud' / 'look.html'}" in capsys.readouterr().err
    assert (tmp_path / "loud" / "look.html").is_file()
    lb.fit(plain, folder=tmp_path / "quiet")
    assert not (tmp_path / "quiet" / "look.html").exists()
    assert lb.load_result(tmp_path / "loud").verb == "fit"


def test_bad_input_is_refused_as_by_a_fit(tmp_path, capsys):
    dark = Record(
        "dark", ON.time, 0 * ON.drive, ON.response, ON.drive_axes, ON.response_axes, time_unit=ON.time_unit
    )
    with pytest.raises(lb.InputError) as refused:
        lb.look(study(dark))
    with pytest.raises(lb.InputError) as by_fit:
        lb.fit(study(dark))
    assert str(refused.value) == str(by_fit.value)
    assert main(["look", str(tmp_path / "none.csv"), "--out", str(tmp_path / "run")]) == 2
    assert not (tmp_path / "run").exists()
