"""Records that no plant follows as they are: no effect is named from them, and the loop says why."""

from dataclasses import replace

import numpy as np
import pytest
from small import TWO, record, study
from test_loop import study as study_at_rest

from lcopa_bayes.bench.command import on_off, step
from lcopa_bayes.data.record import Record
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.scores import fit_scores, pooled_coverage
from lcopa_bayes.effectsearch.summary import results, words
from lcopa_bayes.model.effects.catalogue import catalogue


def scaled(one: Record, factor: float) -> Record:
    """The same sensor with another gain about the level at rest."""
    rest = np.array([column[np.isfinite(column)][0] for column in one.response.T])
    return replace(one, response=rest + factor * (one.response - rest))


def of_two_axes(seed: int, to: tuple[float, float]) -> Record:
    command = on_off(to, hold=5.0, at=0.35, rest=(0.0, 0.2))
    return record(seed, device=TWO, command=command, name=f"r{seed}", camera=0.4)


ON = record(1, name="on", camera=0.4)
HALF = record(2, name="half", command=step(0.5, at=0.35), camera=0.4)
LATE = record(3, command=step(1.0, at=5.0), duration=20.0, name="early")
FIRST, SECOND, THIRD = (
    of_two_axes(seed, to) for seed, to in enumerate(((1.0, 0.6), (-0.5, 1.0), (1.0, 0.2)))
)
LIBRARY = [catalogue()[name] for name in ("odd_curvature", "gain_drift", "unmodelled_smooth")]
CASES = {
    "unit": ((ON, scaled(HALF, 1e3)), (), "another unit than it states"),
    "unit of a held-out record": ((ON,), (scaled(HALF, 1e3),), "another unit than it states"),
    "sign": ((ON, replace(HALF, response=-HALF.response)), (), "check the signs of drive and response"),
    "clock": ((replace(LATE, drive=(LATE.time >= 7.0).astype(float)[:, None]),), (), "ahead of its drive"),
    "axes": (
        (FIRST, SECOND, replace(THIRD, response=THIRD.response[:, ::-1])),
        (),
        "with its responses 'x' and 'y' exchanged",
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_no_effect_is_named_from_records_that_no_plant_follows(name):
    fit, held_out, said = CASES[name]
    made = study(*fit, held_out=held_out)
    found = loop(made, library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert (found.verdict.kind, found.effects) == ("unexplained", ())
    assert said in found.verdict.sentence
    assert all(f"'{one}'" in found.verdict.sentence for one in found.contrary[0].records)
    assert str(found.contrary[0]) in found.cautions
    assert results(found)["next_measurement"] == "Correct the records that disagree first."


def test_bands_hold_what_a_plant_does_not_follow():
    """Noise that is measured at rest gives bands which hold one sample in sixty; those of one record are far
    outside the others, and bands for all hold 72 %."""
    made = study_at_rest(1)
    first, second, *others = made.fit
    found = loop(
        replace(made, fit=(first, replace(second, response=-second.response), *others)),
        library=[],
        sample=False,
        quick=True,
        as_stated=True,
    )
    assert (found.verdict.kind, found.rounds) == ("unexplained", ())
    assert found.base.noise_known
    assert pooled_coverage(found.after.fit) > 0.65
    narrow = replace(found.after.state, widening=None)
    assert pooled_coverage(fit_scores(narrow)) < 0.1


def test_records_of_two_plants_are_named_beside_what_is_traced():
    """20 standard errors apart: both records are named, whatever the verdict."""
    made = study(ON, scaled(HALF, 1.3))
    found = loop(made, library=LIBRARY, sample=False, quick=True, as_stated=True)
    (said,) = (one for one in found.cautions if one.startswith("records disagree"))
    assert "'half'" in said
    assert "'on'" in said
    assert found.verdict.confidence == "tentative"
    assert found.verdict.kind != "clean"
    assert any(said in line for line in words(results(found)))


def test_records_that_agree_are_not_called_contrary():
    found = loop(study(ON, HALF), library=LIBRARY, sample=False, quick=True, as_stated=True)
    assert found.verdict.kind == "clean"
    assert not any("disagree" in one for one in found.cautions)
