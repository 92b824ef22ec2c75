"""Coverage of the default settings at stated truths: noise, orders, delays, terms and kinds of noise.

    python studies/calibration/defaults.py [--replicas N] [--jobs N] [--seed N] [--cells PATTERN ...]

Every cell is a step response of 240 samples, 0.2 ms apart, measured on the virtual bench at one truth; every
replica is fitted with default settings, default priors derived from its own record. Cells differ in the level
of the noise relative to the step, in the order, in whether command plus delay falls on a sample, in the
number of viscous terms and in the kind of noise. The band of a row is exact and simultaneous over all rows of
the table (Clopper and Pearson 1934, Bonferroni). Priors are wide beside the posteriors, so that coverage at a
fixed truth is close to nominal for what the record determines; the noise of the default kind is known in part
by its prior alone, and stands apart. Where a response of order below 1 begins on a sample the likelihood has
an edge: shorter delays are excluded by that sample alone, the truth lies at the end of its own posterior, and
no interval with equal tails holds it as often as stated, whatever the numerics. Cells with the onset anywhere
average over it and have to cover. Finished replicas are kept in --store: the same command goes on where it
stopped, and a larger --replicas adds to what is there.
"""

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.calibration.calibrate import Calibration, calibrate
from lcopa_bayes.calibration.ranks import LEVELS, Coverage
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.files import save_json, writable_folder, write_text
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings, NoiseSettings, SamplerSettings
from lcopa_bayes.data.study import Study
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.plot.theme import BAND, HELD_OUT, NOISE, blank, look
from lcopa_bayes.report.svg import svg_of
from lcopa_bayes.verbs.calibrate import results

CAMERA, DURATION, COMMAND = 0.2, 48.0, 2.0
"""Sampling period, length of the record, and time of the step [ms]."""
ON, OFF = 1.0, 1.07
"""Delays [ms]; with the first, the response begins on a sample."""
ANY = (0.9, 1.1)
"""Ends between which delays are drawn evenly: every phase of the samples [ms]."""
EDGE = "on a sample at an order below 1"
"""Where the likelihood has an edge at the truth."""
SIMULTANEOUS = 0.95
"""Probability that all rows of a table whose intervals cover as stated lie within their bands [-]."""
PLANT = ("gain", "time", "order", "delay", "offset")
ONE = ((3.4,), (0.9,))
TWO = ((3.4, 8.0), (1.6, 0.6))
"""Time constants [ms] and orders [-]."""
SHARES = {"white": {"sigma": 1.0}, "ar1": {"sigma": 1.0}, "student": {"sigma": 1.0}}
SHARES |= {"white+ar1": {"sigma": 0.8, "sigma_ar": 0.6}}
"""Parameters of a noise that are its level times these [-]."""
SHAPES = {"white": {}, "ar1": {"rho": 0.4}, "student": {"nu": 5.0}, "white+ar1": {"rho": 0.7}}


@dataclass(frozen=True)
class Cell:
    """One truth."""

    level: float
    """Noise over the height of the step [-]."""
    delay: float | tuple[float, float]
    """[ms]; two ends to draw it from evenly."""
    times: tuple[float, ...]
    """[ms]"""
    orders: tuple[float, ...]
    noise: str = "white+ar1"

    @property
    def name(self) -> str:
        orders = "-".join(f"{order:g}" for order in self.orders)
        delay = f"{self.delay:g}" if isinstance(self.delay, float) else "-any"
        return f"{self.noise}_{100 * self.level:g}pc_order{orders}_delay{delay}"

    @property
    def truth(self) -> dict[str, float | tuple[float, float]]:
        out: dict[str, float | tuple[float, float]] = {"gain": 1.0, "delay": self.delay, "offset": 0.0}
        for k, (time, order) in enumerate(zip(self.times, self.orders, strict=True), start=1):
            out |= {f"time_{k}": time, f"order_{k}": order}
        return (
            out
            | {name: share * self.level for name, share in SHARES[self.noise].items()}
            | SHAPES[self.noise]
        )

    @property
    def onset(self) -> str:
        if self.delay == ON and max(self.orders) < 1:
            return EDGE
        return {ON: "on a sample", OFF: "between samples"}.get(self.delay, "anywhere")

    def study(self, seed: int) -> Study:
        path = TransferPath.of_times(1.0, float(np.mean(self.delay)), self.times, self.orders)
        device = Device(((path,),), (Axis("u", "V"),), (Axis("y", "rad"),), (0.0,))
        bench = Bench(camera=CAMERA, noise_sd=self.level)
        rng = np.random.default_rng(seed)
        record = simulate(device, bench, step(1.0, at=COMMAND), duration=DURATION, name="step", rng=rng)
        # several terms are more often sampled by ensembles: few walkers do for 400 effective draws
        sampler = SamplerSettings(walkers=32) if len(self.times) > 1 else SamplerSettings()
        return Study(
            self.name,
            None,
            "ms",
            seed,
            (record,),
            model=ModelSettings(terms=len(self.times)),
            noise=NoiseSettings(self.noise),
            sampler=sampler,
        )


def cells() -> tuple[Cell, ...]:
    """All cells; a new one goes to the end, since its place decides its seed."""
    out = [
        Cell(level, delay, (3.4,), (order,))
        for level in (0.005, 0.002, 0.01)
        for order in (0.9, 0.6, 1.2, 1.8)
        for delay in (ON, OFF)
    ]
    out += [Cell(level, ON, *ONE, "white") for level in (0.005, 0.002)]
    out += [Cell(0.005, delay, *ONE, kind) for kind in ("ar1", "student") for delay in (ON, OFF)]
    out += [Cell(0.002, delay, *TWO, kind) for kind in ("white+ar1", "white") for delay in (ON, OFF)]
    out += [
        Cell(level, ANY, (3.4,), (order,)) for level in (0.005, 0.002, 0.01) for order in (0.9, 0.6, 1.2, 1.8)
    ]
    return tuple(out)


def row_of(cell: Cell, calibration: Calibration) -> dict[str, Any]:
    """What a cell gave: hits by parameter and level, and what the replicas say of themselves."""
    result = results(calibration)
    names = [quantity.name for quantity in calibration.replication.quantities if quantity.kind == "parameter"]
    inside = np.array([outcome.inside for outcome in calibration.outcomes])[:, : len(names)].sum(axis=0)
    return {
        "cell": cell.name,
        "noise": cell.noise,
        "level": cell.level,
        "orders": cell.orders,
        "delay": cell.delay,
        "onset": cell.onset,
        "truth": cell.truth,
        "replicas": len(calibration.outcomes),
        "hits": {
            name: dict(zip(map(str, LEVELS), row.tolist(), strict=True))
            for name, row in zip(names, inside, strict=True)
        },
        **{key: result[key] for key in ("grades", "engine", "discretisation", "model_gap", "seconds")},
        "failures": result["failures"][:3],
    }


def kind_of(parameter: str) -> str:
    return parameter.rstrip("0123456789").rstrip("_")


def covered(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """One coverage per cell, parameter and level, with bands simultaneous over all of them."""
    count = sum(len(hits) for row in rows for hits in row["hits"].values())
    confidence = 1 - (1 - SIMULTANEOUS) / count
    return [
        Coverage(
            name,
            "noise" if kind_of(name) not in PLANT else "edge" if row["onset"] == EDGE else "plant",
            level,
            hits,
            row["replicas"],
            confidence,
        ).as_json()
        | {"cell": row["cell"]}
        for row in rows
        for name, by_level in row["hits"].items()
        for level, hits in ((level, by_level[str(level)]) for level in LEVELS)
    ]


def pooled(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Coverage of each parameter over the one-term cells of the default noise together, by level of the noise
    and for all of them: a small bias everywhere shows here first."""
    default = [row for row in rows if row["noise"] == "white+ar1" and len(row["orders"]) == 1]
    smooth = [row for row in default if row["onset"] != EDGE]
    groups = {
        f"noise {100 * level:g} %": [r for r in smooth if r["level"] == level]
        for level in (0.01, 0.005, 0.002)
    }
    for where in dict.fromkeys(r["onset"] for r in default):
        groups |= {f"onset {where}": [r for r in default if r["onset"] == where]}
    groups |= {"all but the edge": smooth}
    names = list(dict.fromkeys(name for row in default for name in row["hits"]))
    filled = {group: chosen for group, chosen in groups.items() if chosen}
    confidence = 1 - (1 - SIMULTANEOUS) / max(1, len(filled) * len(names) * len(LEVELS))
    return [
        Coverage(
            name,
            "noise" if kind_of(name) not in PLANT else "edge" if group.endswith(EDGE) else "plant",
            level,
            sum(row["hits"][name][str(level)] for row in chosen),
            sum(row["replicas"] for row in chosen),
            confidence,
        ).as_json()
        | {"cells": group}
        for group, chosen in filled.items()
        for name in names
        for level in LEVELS
    ]


def sentence(coverage: Sequence[dict[str, Any]], kind: str, what: str) -> str:
    chosen = [row for row in coverage if row["kind"] == kind]
    outside = [row for row in chosen if not row["within"]]
    where = "; ".join(
        f"{row.get('cell', row.get('cells'))} {row['parameter']} at {row['level']:.0%} "
        f"({row['observed']:.3f}, band {row['lower']:.3f} to {row['upper']:.3f})"
        for row in outside
    )
    return f"Of {len(chosen)} {what}, {len(chosen) - len(outside)} lie within their band" + (
        f"; outside: {where}." if outside else "."
    )


def table_of(result: dict[str, Any]) -> str:
    """Markdown: coverage of 90 % intervals per cell, and pooled."""
    rows, by_cell = result["cells"], {}
    for row in result["coverage"]:
        if row["level"] == LEVELS[-1]:
            by_cell.setdefault(row["cell"], {})[row["parameter"]] = row
    names = list(dict.fromkeys(row["parameter"] for row in result["coverage"]))
    lines = [
        "# Coverage of 90 % intervals at default settings",
        "",
        *(f"{line}\n" for line in result["verdict"]),
    ]
    head = ["cell", "replicas", *names, "ensembles", "not reliable", "block shift", "s"]
    lines += [" | ".join(["", *head, ""]).strip(), "|" + "---|" * len(head)]
    for row in rows:
        shown = by_cell[row["cell"]]
        values = [
            (f"{shown[n]['observed']:.3f}" + ("" if shown[n]["within"] else " (outside)"))
            if n in shown
            else ""
            for n in names
        ]
        poor = sum(n for grade, n in row["grades"].items() if grade != "reliable")
        tail = [row["engine"]["sampling"], poor, f"{row['discretisation']['largest']:.3f}"]
        lines.append(
            "| "
            + " | ".join(
                map(str, [row["cell"], row["replicas"], *values, *tail, f"{row['seconds']['median']:.2f}"])
            )
            + " |"
        )
    lines += ["", "Pooled over one-term cells of the default noise:", ""]
    pool = [row for row in result["pooled"] if row["level"] == LEVELS[-1]]
    columns = list(dict.fromkeys(row["parameter"] for row in pool))
    lines += ["| cells | replicas | " + " | ".join(columns) + " |", "|" + "---|" * (len(columns) + 2)]
    for group in dict.fromkeys(row["cells"] for row in pool):
        own = {row["parameter"]: row for row in pool if row["cells"] == group}
        values = [f"{own[n]['observed']:.3f}" + ("" if own[n]["within"] else " (outside)") for n in columns]
        lines.append(f"| {group} | {own[columns[0]]['replicas']} | " + " | ".join(values) + " |")
    lines += [
        "",
        f"Replicas in all: {result['replicas']}, of them {result['sampled']} by ensembles, "
        f"{result['not_reliable']} not graded reliable, {result['failed']} failed. `block shift`: largest "
        "shift of a posterior mean by the width of the blocks over the replicas [posterior sd]; `s`: median "
        "processor time of a replica.",
        "",
    ]
    return "\n".join(lines)


def figure_of(result: dict[str, Any]) -> str:
    """Coverage of 90 % intervals with bands, one panel per parameter, one row per cell."""
    names = [n for n in dict.fromkeys(row["parameter"] for row in result["coverage"]) if kind_of(n) in PLANT]
    order = [row["cell"] for row in result["cells"]]
    with look():
        figure = blank(1.2 + 0.17 * len(order))
        panels = figure.subplots(1, len(names), sharey=True, squeeze=False)[0]
        for panel, name in zip(panels, names, strict=True):
            panel.axvline(LEVELS[-1], color=NOISE, lw=0.9, ls=(0, (4, 3)))
            for row in result["coverage"]:
                if row["parameter"] == name and row["level"] == LEVELS[-1]:
                    at, seen = order.index(row["cell"]), row["observed"]
                    ends = np.abs(np.array([[row["lower"]], [row["upper"]]]) - seen)
                    colour = BAND if row["within"] else HELD_OUT
                    panel.errorbar(seen, at, xerr=ends, fmt="o", ms=2.5, lw=0.9, color=colour)
            panel.set_title(name, loc="left")
            panel.set_xlabel("coverage [-]")
        panels[0].set_yticks(range(len(order)), order, fontsize=5)
        panels[0].set_ylim(len(order) - 0.5, -0.5)
        return svg_of(figure)


def summary(rows: Sequence[dict[str, Any]], seed: int) -> dict[str, Any]:
    coverage, together = covered(rows), pooled(rows)
    return plain(
        {
            "verdict": [
                sentence(coverage, "plant", "coverages of plant parameters cell by cell"),
                sentence(coverage, "edge", f"coverages of plant parameters with the onset {EDGE}"),
                sentence(coverage, "noise", "coverages of noise parameters cell by cell"),
                sentence(together, "plant", "pooled coverages of plant parameters"),
            ],
            "seed": seed,
            "simultaneous": SIMULTANEOUS,
            "replicas": sum(row["replicas"] for row in rows),
            "sampled": sum(row["engine"]["sampling"] for row in rows),
            "not_reliable": sum(
                n for row in rows for grade, n in row["grades"].items() if grade != "reliable"
            ),
            "failed": sum(row["grades"]["failed"] for row in rows),
            "cells": list(rows),
            "coverage": coverage,
            "pooled": together,
        }
    )


def stored(folder: Path) -> int:
    """Number of replicas in a store from the first on, none left out."""
    present = {int(path.stem) for path in (folder / "replicas").glob("[0-9]*.json")}
    return next(number for number in range(len(present) + 1) if number not in present)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--replicas", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--seed", type=int, default=20)
    parser.add_argument("--cells", nargs="+", metavar="PATTERN", help="cells whose name matches one of these")
    parser.add_argument("--out", type=Path, default=Path("reports/calibration/defaults"))
    parser.add_argument("--store", type=Path, default=Path(tempfile.gettempdir()) / "lcopa-defaults")
    parser.add_argument("--stored", action="store_true", help="the table of what is stored, no new replicas")
    options = parser.parse_args(arguments)
    rows = []
    for number, cell in enumerate(cells()):
        if options.cells and not any(fnmatchcase(cell.name, pattern) for pattern in options.cells):
            continue
        folder = options.store / cell.name
        replicas = stored(folder) if options.stored else options.replicas
        if replicas == 0:
            continue
        writable_folder(options.store)
        calibration = calibrate(
            cell.study(1000 * options.seed + number),
            replicas=replicas,
            truth=cell.truth,
            jobs=options.jobs,
            folder=folder,
            resume=True,
        )
        rows.append(row_of(cell, calibration))
        shown = {
            name: hits[str(LEVELS[-1])] / rows[-1]["replicas"] for name, hits in rows[-1]["hits"].items()
        }
        print(cell.name, rows[-1]["replicas"], {n: round(v, 3) for n, v in shown.items()}, flush=True)
        result = summary(rows, options.seed)
        out = writable_folder(options.out)
        save_json(result, out / "results.json")
        write_text(out / "table.md", table_of(result))
        write_text(out / "coverage.svg", figure_of(result))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
