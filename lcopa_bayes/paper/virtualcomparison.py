"""Models compared on the paper's experiment as the virtual bench does it: Eq. 65, Figs. 13, 16."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.bench.acquisition import PAPER_BENCH, simulate
from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Device
from lcopa_bayes.comparison.candidates import candidates_of
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.paper.printedmodel import RECORD_LENGTH, PrintedModel
from lcopa_bayes.problems import InputError
from lcopa_bayes.runfolder import save_json
from lcopa_bayes.settings import ModelSettings, NoiseSettings
from lcopa_bayes.stated import PAPER, Stated
from lcopa_bayes.study import Study

_SEED = 13


def virtual_study(stated: Stated = PAPER) -> Study:
    """The step of Fig. 13 to fit and that of Fig. 16 held out, x alone, from the model of Eq. 65.

    Noise is white, with the RMSE the paper gives for its fit. Three terms, default priors.
    """
    whole = PrintedModel(stated).device
    device = Device(((whole.paths[0][0],),), whole.drive_axes[:1], whole.response_axes[:1], (0.0,))
    bench = replace(PAPER_BENCH, noise_sd=stated.records.fractional_rmse)
    drives = {"step": stated.records.step_drive, "half_step": stated.records.single_axis_drive}
    rng = np.random.default_rng(_SEED)
    records = [
        simulate(device, bench, step(level), duration=RECORD_LENGTH, name=name, rng=rng)
        for name, level in drives.items()
    ]
    return Study(
        "paper-virtual",
        None,
        device.time_unit,
        _SEED,
        (records[0],),
        (records[1],),
        model=ModelSettings(terms=len(stated.plant.xx.orders), offset="none"),
        noise=NoiseSettings("white"),
    )


def virtual_comparison(folder: Path, *, jobs: int = 1, quiet: bool = True) -> Mapping[str, Any]:
    """Candidates compared on `virtual_study`; the comparison that `folder` holds where it is the same."""
    candidates = candidates_of(virtual_study())
    try:
        told = compare(candidates, jobs=jobs, folder=folder, resume=True, quiet=quiet)
    except InputError:  # what is there is of another version
        told = compare(candidates, jobs=jobs, folder=folder, quiet=quiet)
    save_json(told, folder / "compare.json")
    return told
