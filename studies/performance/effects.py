"""What effects cost a likelihood: responses of many plants with each, over those of the plants alone.

    python studies/performance/effects.py [--rounds N] [--plants N] [--out FOLDER]

A campaign of the virtual bench, two axes and eight records, with plants within one percent of its own. Of
every effect that changes a response, and of some pairs: a plant among many that are simulated at once, over
one without effects and over one that is simulated by itself. Ratios are taken round by round, so that what
slows a machine slows all. Both ways must give the same responses.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from comparison import Spread, plain, ratio, table
from threadpoolctl import threadpool_limits

from lcopa_bayes.bench.device import Device
from lcopa_bayes.bench.undeclared import campaign
from lcopa_bayes.core.arrays import Array, Matrix, Vector
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.kinds import COEFFICIENTS
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.model.effects.catalogue import bundled
from lcopa_bayes.model.effects.effect import ScatterEffect

PAIRS = (
    ("clock_skew", "rise_fall_asymmetry"),
    ("voltage_knee", "cubic_stiffness"),
    ("viscosity_drift", "odd_curvature"),
    ("sensor_lag", "backflow"),
)
SIZE = 0.3
"""Coefficients over their prior standard deviations [-]."""
NEAR = 0.01
"""Standard deviation of other numbers of the plants over their values [-]."""
ALONE = 8
"""Plants that are simulated by themselves."""
SAME = 1e-4
"""Largest difference between both ways over the response [-]: where a force all but jumps, within a block."""


def tried() -> list[tuple[str, ...]]:
    """Effects that change a response, each by itself, and the pairs."""
    alone = [(name,) for name, kind in bundled().items() if not issubclass(kind, ScatterEffect)]
    return [*alone, *PAIRS]


@dataclass(frozen=True)
class Row:
    """One effect or pair."""

    names: tuple[str, ...]
    over_plain: Spread | None
    """Time of one plant among many over that of one without effects [-]."""
    over_alone: Spread | None
    """The same over that of one by itself [-]."""
    differs: float
    """Largest difference between both ways over the response [-]."""


def campaign_study(seed: int) -> tuple[Study, Device]:
    """The records of a campaign that hides nothing, and its device."""
    made = campaign((), np.random.default_rng(seed))
    settings = ModelSettings(terms={"direct": 2, "cross": 1})
    return Study("effects", None, "ms", seed, made.fit, (), settings), made.device


def near_device(table: ParameterTable, device: Device, count: int, rng: np.random.Generator) -> Matrix:
    """Table values of plants near a device, each with its own coefficients, (count, rows)."""
    values = table.draw(1, rng)[0]
    shapes = device.paths[0]  # of the direct and the cross element
    for k, row in enumerate(table.rows):
        if row.kind == "gain":
            values[k] = device.paths[row.place.first][row.place.second].steady
        elif row.kind == "delay":
            values[k] = shapes[0].delay
        elif row.kind in ("time", "order"):
            path, term = shapes[row.place.first], row.place.second
            order = path.orders[term]
            values[k] = order if row.kind == "order" else (path.etas[term] / path.stiffness) ** (1 / order)
        elif row.kind in COEFFICIENTS and row.prior is not None:
            values[k] = SIZE * row.prior.sd
    return table.canonical(values * (1 + NEAR * rng.standard_normal((count, values.size))))


def responses(posterior: Posterior, values: Matrix) -> list[Array]:
    """Of plants, per record (axes, batch, samples) [response unit]."""
    if posterior.simulation is not None:
        return posterior.simulation.responses(values)
    return posterior.model.unit_responses(posterior.table.dynamics(values))


def seconds(call: Callable[[], Any]) -> float:
    """Processor time of a call [s]."""
    begun = time.process_time()
    call()
    return time.process_time() - begun


def measured(names: tuple[str, ...], study: Study, device: Device, *, plants: int, rounds: int) -> Row:
    """One effect or pair beside the plant alone, round by round."""
    used = replace(study, effects=replace(study.effects, use=names))
    bare, posterior = problem_of(study).posterior, problem_of(used).posterior
    rng = np.random.default_rng(study.seed)
    own, values = (near_device(one.table, device, plants, rng) for one in (bare, posterior))
    each = np.array_split(values[:ALONE], ALONE)
    together = responses(posterior, values)
    singly = [responses(posterior, one) for one in each]
    differs = max(
        float(np.abs(many[:, k] - one[r][:, 0]).max() / np.abs(many).max())
        for k, one in enumerate(singly)
        for r, many in enumerate(together)
    )
    times: list[Vector] = []
    for _ in range(rounds):
        calls = (
            seconds(lambda: responses(bare, own)) / plants,
            seconds(lambda: responses(posterior, values)) / plants,
            seconds(lambda: [responses(posterior, one) for one in each]) / ALONE,
        )
        times.append(np.array(calls))
    without, many, alone = np.array(times).T.tolist()
    return Row(names, ratio(many, without), ratio(many, alone), differs)


def report(rows: list[Row], plants: int) -> str:
    """A table in Markdown."""
    head = ("effects", "over the plant alone", "over one at a time", "largest difference of both ways")
    cells = [(", ".join(one.names), one.over_plain, one.over_alone, f"{one.differs:.1g}") for one in rows]
    said = (
        f"Processor time of a plant, eight records and two axes, among {plants} at once: median of the "
        "rounds and quartiles. `studies/performance/effects.py` says how."
    )
    return f"# What effects cost a likelihood\n\n{said}\n\n{table(head, cells)}\n"


def stored(rows: list[Row]) -> list[Any]:
    """The same in plain values."""
    kept = ("names", "over_plain", "over_alone", "differs")
    values: list[Any] = plain([{name: getattr(one, name) for name in kept} for one in rows])
    return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--plants", type=int, default=64)
    parser.add_argument("--out", type=Path, help="folder for effects.md and effects.json")
    options = parser.parse_args()
    study, device = campaign_study(1)
    with threadpool_limits(1):
        rows = [
            measured(names, study, device, plants=options.plants, rounds=options.rounds) for names in tried()
        ]
    text = report(rows, options.plants)
    print(text)
    wrong = [", ".join(one.names) for one in rows if not one.differs < SAME]
    if wrong:
        raise SystemExit(f"responses of many plants at once are others than one by one: {'; '.join(wrong)}")
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "effects.md").write_text(text, encoding="utf-8")
        (options.out / "effects.json").write_text(json.dumps(stored(rows), indent=1, allow_nan=False) + "\n")


if __name__ == "__main__":
    main()
