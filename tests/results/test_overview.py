"""What stands first on a page: the equation is that of the parameters, and each answer follows the fit."""

from __future__ import annotations

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from small import TWO, problem, record, study

from lcopa_bayes.bench.command import on_off
from lcopa_bayes.data.record import Record
from lcopa_bayes.results.fit import fit
from lcopa_bayes.results.summary import overview, plant

NUMBER = r"(-?[\d.]+(?:e-?\d+)?)"


def transfer(lines: list[str], s: complex) -> dict[str, complex]:
    """Every path of printed equations, evaluated at s."""
    elements = {}
    paths = {}
    for line in lines:
        name, _, right = line.partition(" = ")
        if " / " in name:
            paths[name] = right
        else:
            elements[name] = right
    out = {}
    for name, right in paths.items():
        gain, delay, below = re.fullmatch(rf"{NUMBER} \S+ exp\(-{NUMBER} s\) / (.*)", right).groups()
        terms = elements.get(
            below, below.removeprefix("(").removesuffix(")") if below not in elements else ""
        )
        found = re.findall(rf"\({NUMBER} s\)\^{NUMBER}", terms)
        total = 1 + sum((float(time) * s) ** float(order) for time, order in found)
        out[name] = float(gain) * np.exp(-float(delay) * s) / total
    return out


@pytest.mark.parametrize("share", ["paper", "none"])
def test_the_equation_is_that_of_the_parameters(share):
    """Printed, read and evaluated, against the transfer function of each path."""
    made = problem(record(device=TWO, camera=0.5), terms=2, share=share)
    table = made.posterior.table
    rng = np.random.default_rng(4)
    values = table.draw(1, rng)[0]
    s = 0.3 + 0.8j
    got = transfer(plant(table, values), s)
    for i, response in enumerate(table.layout.responses):
        for j, drive in enumerate(table.layout.drives):
            e = table.layout.element_of[i][j]
            times = [values[table.at("time", e, k)] for k in range(2)]
            orders = [values[table.at("order", e, k)] for k in range(2)]
            gain = values[table.at("gain", i, j)]
            delay = values[table.at("delay", table.layout.delay_of[i][j])]
            below = 1 + sum((t * s) ** a for t, a in zip(times, orders, strict=True))
            exact = gain * np.exp(-delay * s) / below
            assert_allclose(got[f"{response.name} / {drive.name}"], exact, rtol=0.02)


def test_answers_follow_the_fit():
    on = record(1, camera=0.2, name="on")
    late = Record(
        "on", on.time + 5.0, on.drive, on.response, on.drive_axes, on.response_axes, time_unit=on.time_unit
    )
    off = record(2, command=on_off(-0.7, hold=4.0, at=1.3), camera=0.5, name="off")
    tiny = {"target_ess": 50}
    fitted = fit(study(late, held_out=[off], priors={"delay": 0.73, "order_1": 0.8}, sampler=tiny))
    answers = {one["question"]: one["answer"] for one in overview(fitted)["answers"]}
    (band,) = (one for one in fitted.bands if not one.held_out)
    assert f"The residual of y is {band.rmse:.3g} rad rms" in answers["How good is the fit?"]
    (held,) = (one for one in fitted.bands if one.held_out)
    said = answers["Does it predict?"]
    assert f"off/y, has {100 * held.coverage(0.9):.0f} %" in said
    assert f"{held.rmse:.3g} rad rms" in said
    for one in fitted.draws.limitations:
        reason = one.reason[0].upper() + one.reason[1:]
        shown = any(text in answers["What is missing?"] for text in (one.reason, reason))
        assert shown == (one.level != "reliable")
    best = fitted.draws.flat[np.argmax(fitted.draws.log_density.ravel())]
    assert overview(fitted)["plant"] == plant(fitted.draws.table, best)
    grades = {one.name: one.grade for one in fitted.draws.estimates()}
    if len(set(grades.values())) > 1:
        for part in answers["Which numbers can be trusted?"].rstrip(".").split("; "):
            grade, _, names = part.lower().partition(": ")
            assert {name for name, own in grades.items() if own == grade} == set(names.split(", "))
    else:
        assert f"All {len(grades)} are" in answers["Which numbers can be trusted?"]
