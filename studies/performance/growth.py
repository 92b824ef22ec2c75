"""How response, memory and fit grow with the length of a record, from 1e3 to 1e6 samples.

    python studies/performance/growth.py [--quick] [--seconds S] [--out FOLDER]

One drive and one response of one viscous term, sampled at 10 kHz; the drive changes every 500 ms, so that 1e6
samples are 100 s with 200 changes. Every measurement runs in a process of its own, on one thread, and its
memory is the most that this process ever held. A fit takes all samples up to 20 000 of them, else means of
so many that as many are left (`data.averaging`); what these lose is measured against the likelihood of all.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from plots import COLOURS, save
from probe import peak_memory

import lcopa_bayes as lb
from lcopa_bayes.bench.command import staircase
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.data.averaging import averaged
from lcopa_bayes.data.record import Axis, Record, load_record, save_record
from lcopa_bayes.data.study import Study
from lcopa_bayes.identifiability.averagingloss import averaging_losses
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.model.path import TransferPath

SIZES, QUICK_SIZES = (1_000, 10_000, 100_000, 1_000_000), (1_000, 4_000)
PERIOD, HOLD = 0.1, 500.0
"""[ms]"""
WHOLE = 20_000
"""Samples up to which a fit takes all [-]."""
LIMITS = {"response_s": 0.6, "memory_MB": 1000.0, "fit_s": 600.0}
"""What 1e6 samples may take."""
DEVICE = Device(
    ((TransferPath.of_times(2.0, 7.33, (40.0,), (0.8,)),),), (Axis("u", "V"),), (Axis("y", "rad"),), (0.3,)
)


def record(samples: int) -> Record:
    """Of so many samples, with white noise of a twentieth of the step response."""
    duration = samples * PERIOD
    hold = min(HOLD, duration / 2)
    levels = [[1.0 - k % 2] for k in range(max(1, int(duration / hold)))]
    bench = Bench(camera=PERIOD, noise_sd=0.1)
    command = staircase(levels, hold=hold, start=10.35)
    return simulate(
        DEVICE, bench, command, duration=duration, name="long", rng=np.random.default_rng(samples)
    )


def study(samples: int) -> Study:
    return Study(fit=record(samples), terms=1, seed=3)


def response(samples: int) -> dict[str, float]:
    """A response alone, and with its derivatives."""
    posterior = problem_of(study(samples)).posterior
    at = posterior.table.dynamics(posterior.table.draw(1, np.random.default_rng(0)))
    spent = {
        "response_s": median_of(lambda: posterior.model.unit_responses(at)),
        "slopes_s": median_of(lambda: posterior.model.unit_slopes(at)),
    }
    return spent | {"memory_MB": peak_memory()}


def reading(samples: int, suffix: str) -> dict[str, float]:
    """Reading a record's file; memory beside that of the record just written."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"long{suffix}"
        save_record(record(samples), path)
        before, begin = peak_memory(), time.process_time()
        load_record(path)
        return {"read_s": time.process_time() - begin, "memory_MB": peak_memory(), "before_MB": before}


def fitted(samples: int, quick: bool) -> dict[str, Any]:
    """A fit of all samples, or of means of `count` and what these lose."""
    whole, count = study(samples), -(-samples // WHOLE)
    out: dict[str, Any] = {"count": count}
    if count > 1:
        begin = time.process_time()
        out["losses"] = [str(one) for one in averaging_losses(whole, (count, 2 * count))]
        out["loss_s"], out["loss_MB"] = time.process_time() - begin, peak_memory()
        whole = averaged(whole, count)
    begin = time.process_time()
    fit = lb.fit(whole, quick=quick)
    return out | {
        "fit_s": time.process_time() - begin,
        "memory_MB": peak_memory(),
        "grade": fit.draws.grade.level,
        "least_ess": min(one.ess for one in fit.draws.estimates()),
    }


def median_of(work: Callable[[], object], times: int = 5) -> float:
    """CPU time of a call after a first one [s]."""
    work()
    spent = []
    for _ in range(times):
        begin = time.process_time()
        work()
        spent.append(time.process_time() - begin)
    return float(np.median(spent))


TASKS: dict[str, Callable[[int], dict[str, Any]]] = {
    "response": response,
    "csv": lambda samples: reading(samples, ".csv"),
    "parquet": lambda samples: reading(samples, ".parquet"),
    "quick fit": lambda samples: fitted(samples, quick=True),
    "fit": lambda samples: fitted(samples, quick=False),
}


def measured(tasks: Sequence[str], sizes: Sequence[int], seconds: float) -> list[dict[str, Any]]:
    """A row per task and number of samples; one that takes longer than `seconds` says so."""
    rows = []
    for samples in sizes:
        for task in tasks:
            row: dict[str, Any] = {"task": task, "samples": samples}
            command = [sys.executable, __file__, "--one", task, str(samples)]
            try:
                done = subprocess.run(
                    command,
                    capture_output=True,
                    text=True,
                    timeout=seconds,
                    check=True,
                    env=os.environ | {"OMP_NUM_THREADS": "1"},
                )
                row |= json.loads(done.stdout.splitlines()[-1])
            except subprocess.TimeoutExpired:
                row["reason"] = f"took more than {seconds:g} s"
            except subprocess.CalledProcessError as error:
                row["reason"] = error.stderr.strip().splitlines()[-1]
            rows.append(row)
            print(json.dumps(row), file=sys.stderr, flush=True)
    return rows


def page(rows: Sequence[dict[str, Any]]) -> str:
    """The numbers as a table, with the losses of means below."""
    head = "| task | samples | CPU s | with derivatives | peak MB | means of | effective draws | grade |"
    lines = [
        "# Long records",
        "",
        *(__doc__ or "").splitlines()[4:],
        "",
        head,
        "|---|" + "---:|" * 6 + "---|",
    ]
    for row in rows:
        spent = next((row[key] for key in ("response_s", "read_s", "fit_s") if key in row), None)
        cells = [
            row["task"],
            f"{row['samples']:,}",
            row.get("reason", "") if spent is None else f"{spent:.3g}",
        ]
        for key, form in (("slopes_s", ".3g"), ("memory_MB", ".0f"), ("count", "d"), ("least_ess", ".0f")):
            cells.append(format(row[key], form) if key in row else "")
        lines.append(f"| {' | '.join([*cells, row.get('grade', '')])} |")
    losses = [f"- {row['samples']:,} samples: {one}" for row in rows for one in row.get("losses", ())]
    lines += ["", "![Growth with the number of samples](growth.svg)", "", *dict.fromkeys(losses)]
    return "\n".join(lines) + "\n"


def drawn(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """CPU time and memory against the number of samples."""
    figure = Figure(figsize=(9.6, 4.2), layout="constrained")
    spent, held = figure.subplots(1, 2)
    tasks = list(dict.fromkeys(row["task"] for row in rows))
    for task, colour in zip(tasks, COLOURS, strict=False):
        for panel, keys in ((spent, ("response_s", "read_s", "fit_s")), (held, ("memory_MB",))):
            own = [
                (row["samples"], row[key])
                for row in rows
                for key in keys
                if key in row and row["task"] == task
            ]
            panel.plot(*zip(*own, strict=True), "o-", color=colour, ms=4, lw=1.1, label=task) if own else None
    spent.set(xscale="log", yscale="log", xlabel="samples [-]", ylabel="CPU time [s]")
    held.set(xscale="log", xlabel="samples [-]", ylabel="peak memory of the process [MB]")
    held.axhline(LIMITS["memory_MB"], color=COLOURS[-1], lw=0.8, ls="--")
    for panel in (spent, held):
        panel.grid(alpha=0.25)
    figure.legend(*spent.get_legend_handles_labels(), loc="outside lower center", ncols=5, frameon=False)
    save(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a minute: 1e3 and 4e3 samples, no whole fit")
    parser.add_argument("--seconds", type=float, default=1800.0, help="wall time of one measurement")
    parser.add_argument("--out", type=Path, help="folder for growth.md, growth.svg and growth.json")
    parser.add_argument("--one", nargs=2, metavar=("TASK", "SAMPLES"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(TASKS[options.one[0]](int(options.one[1]))))
        return
    tasks = [task for task in TASKS if not (options.quick and task == "fit")]
    rows = measured(tasks, QUICK_SIZES if options.quick else SIZES, options.seconds)
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "growth.json").write_text(json.dumps(rows, indent=1) + "\n")
        (options.out / "growth.md").write_text(page(rows), encoding="utf-8")
        drawn(rows, options.out / "growth.svg")
    print(page(rows))


if __name__ == "__main__":
    main()
