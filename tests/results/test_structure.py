"""A study that leaves its structure to its records gets the one that made them, where they can show it."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from math import log
from pathlib import Path

import numpy as np
import pytest
from small import ONE, TWO, U, Y, path, record, study

from lcopa_bayes.bench.command import on_off, step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.study import Study
from lcopa_bayes.results.fit import fit as sampled
from lcopa_bayes.results.structure import settled, structure_of, with_least_terms
from lcopa_bayes.verbs.check import check
from lcopa_bayes.verbs.fit import fit
from lcopa_bayes.verbs.look import look

LAGS = Device(((path(2.0, 0.4, (1.2, 2.5), (1.6, 0.7)),),), (U,), (Y,), (0.0,))
"""Two terms that steps of 12 ms tell apart."""
QUICK = {"target_ess": 50}


def steps(device: Device, noise_sd: float = 0.01) -> Study:
    on, half = (
        record(k, device=device, command=step(height, at=0.35), name=f"r{k}", noise_sd=noise_sd)
        for k, height in ((1, 1.0), (2, -0.5))
    )
    return study(on, half, terms="auto")


def test_what_is_looked_at_is_said_unless_quiet(capsys: pytest.CaptureFixture[str]) -> None:
    study = replace(steps(ONE), priors={"order_1": 1.0})
    found = structure_of(study, quiet=False)
    lines = capsys.readouterr().err.splitlines()
    assert lines[0].startswith("choosing how many terms, by least squares: 0 structures")
    assert found is not None
    assert f": {len(found.looked)} structures" in lines[-1]


def test_a_structure_that_is_stated_stays() -> None:
    stated = study(record(), terms=3)
    assert structure_of(stated) is None
    assert settled(stated) is stated
    assert with_least_terms(stated) is stated


def test_bic_is_that_of_its_definition_and_the_least_one_is_chosen(
    capsys: pytest.CaptureFixture[str],
) -> None:
    structure = structure_of(steps(ONE))
    assert capsys.readouterr().err == ""
    assert structure is not None
    assert structure.chosen.study.model.terms == 1
    for one in structure.looked:
        samples = sum(int(np.isfinite(r.response).sum()) for r in one.study.fit)
        table = one.problem.posterior.table
        free = [row.name for row in table.rows if row.prior is not None]
        assert one.parameters == len(free)
        assert one.bic == pytest.approx(len(free) * log(samples) - 2 * one.max_log_likelihood)
    values = [one.bic for one in structure.looked]
    assert structure.chosen is structure.looked[int(np.argmin(values))]
    assert values[-1] > min(values)  # looking stops at the first that is not worth its parameters


APART = Device(
    (
        (path(1.0, 0.3, (1.2,), (0.9,)), path(0.3, 1.5, (1.2,), (0.9,))),
        (path(0.3, 1.5, (1.2,), (0.9,)), path(1.5, 0.3, (1.2,), (0.9,))),
    ),
    (Axis("x", "V"), Axis("y", "V")),
    (Axis("x", "rad"), Axis("y", "rad")),
    (0.0, 0.0),
)
"""Of four paths with delays of their own; that these are found the next test shows too."""


@pytest.mark.parametrize(
    ("device", "rest", "delay"),
    [pytest.param(APART, 0.0, "path", marks=pytest.mark.slow), (TWO, 0.2, "shared")],
)
def test_paths_that_share_no_delay_are_recognised(device: Device, rest: float, delay: str) -> None:
    moves = [on_off(to, hold=5.0, at=0.35, rest=(0.0, rest)) for to in ((1.0, rest), (0.0, 1.0))]
    records = [
        record(k, device=device, command=move, name=f"r{k}", camera=0.4)
        for k, move in enumerate(moves, start=1)
    ]
    assert settled(study(*records, terms="auto")).model.delay == delay


def test_paths_that_share_nothing_are_recognised_before_terms_are_added() -> None:
    """A second term follows the records better than one that paths share, and is not what made them."""
    apart = Device(
        (
            (path(1.0, 0.3, (1.0,), (1.0,)), path(0.6, 1.5, (3.0,), (1.0,))),
            (path(0.5, 2.0, (6.0,), (1.0,)), path(1.5, 0.9, (2.0,), (1.0,))),
        ),
        (Axis("x", "V"), Axis("y", "V")),
        (Axis("x", "rad"), Axis("y", "rad")),
        (0.0, 0.0),
    )
    campaign = study(
        *(
            record(k, device=apart, command=on_off(to, hold=5.0, at=0.35, rest=(0.0, 0.0)), name=f"r{k}")
            for k, to in ((1, (1.0, 0.0)), (2, (0.0, 1.0)))
        ),
        terms="auto",
    )
    structure = structure_of(campaign)
    assert structure is not None
    assert structure.chosen.name == "1 term, elements: 4, delays: 4"
    models = [one.study.model for one in structure.looked]
    assert all(models.count(model) == 1 for model in models)
    assert all(isinstance(model.terms, int) for model in models)  # no element by itself needs another one
    beside = {one.name for one in structure.looked}
    assert {"2 terms, elements: 4, delays: 4", "1 term, elements: 2, delays: 4"} <= beside


def test_a_term_is_chosen_for_the_element_that_needs_it() -> None:
    """The first response rings and creeps, the second is a lag: one term of all is worse, and so are two."""
    paths = ((path(1.0, 0.5, (1.0, 2.0), (1.9, 0.7)),), (path(1.0, 0.5, (1.5,), (0.9,)),))
    device = Device(paths, (Axis("u", "V"),), TWO.response_axes, (0.0, 0.0))
    moves = (on_off(1.0, hold=9.0, at=0.5), on_off(-0.5, hold=4.0, at=0.5))
    records = [
        record(k, device=device, command=move, camera=0.25, duration=20.0, noise_sd=0.004, name=f"r{k}")
        for k, move in enumerate(moves)
    ]
    structure = structure_of(study(*records, terms="auto"))
    assert structure is not None
    assert structure.chosen.name == "2 terms in x_u, and 1 in the others, elements: 2, delays: 2"
    assert structure.chosen.study.model.terms == {"x_u": 2, "y_u": 1}
    others = [one for one in structure.looked if one is not structure.chosen]
    assert all(one.bic > structure.chosen.bic for one in others)
    richer = next(one for one in others if one.study.model.terms == 2)
    assert richer.max_log_likelihood >= structure.chosen.max_log_likelihood - 0.5
    assert richer.parameters == structure.chosen.parameters + 2


def test_priors_need_terms_and_unknown_ones_are_refused() -> None:
    made = steps(ONE)
    both = replace(made, priors=study(record(), terms=2, priors={"order_2": 0.5}).priors)
    assert with_least_terms(both).model.terms == 2
    structure = structure_of(both)
    assert structure is not None
    assert all(one.study.model.most_terms >= 2 for one in structure.looked)
    unknown = study(record(), terms="auto", priors={"delya": 0.5})
    for verb in (structure_of, check, look):
        with pytest.raises(InputError, match="delya"):
            verb(unknown)


def test_fixed_orders_leave_nothing_to_choose() -> None:
    with pytest.raises(InputError, match="needs free orders"):
        study(record(), terms="auto", orders=[1.0])
    assert study(record(), orders=[2.0, 1.0], terms=2).model.most_terms == 2
    assert Study(fit=[record()], model={"orders": [2.0, 1.0]}).model.terms == 2


@pytest.mark.slow
def test_a_fit_says_what_was_chosen_of_what(tmp_path: Path) -> None:
    campaign = replace(steps(LAGS), sampler=study(record(), sampler=QUICK).sampler)
    fitted = fit(campaign, folder=tmp_path)
    assert fitted.study.model.terms == 2
    assert fitted.structure is not None
    values = json.loads((tmp_path / "results.json").read_text())["structure"]
    assert values["chosen"] == "2 terms"
    assert [row["name"] for row in values["candidates"]] == ["1 term", "2 terms", "3 terms"]
    assert "The records chose a structure by BIC: 2 terms" in fitted.verdict
    assert 'id="structure"' in fitted.report(tmp_path).read_text()
    with pytest.raises(ValueError, match="not settled"):
        sampled(campaign)


@pytest.mark.parametrize("seed", [0, *(pytest.param(one, marks=pytest.mark.slow) for one in (1, 2))])
def test_a_richer_structure_is_never_less_likely(seed: int) -> None:
    structure = structure_of(replace(steps(LAGS), seed=seed))
    assert structure is not None
    assert structure.chosen.study.model.terms == 2
    for fewer, more in pairwise(structure.looked):
        assert more.max_log_likelihood >= fewer.max_log_likelihood - 0.5
