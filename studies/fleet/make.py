"""A fleet on the virtual bench: devices drawn from a stated population, the last three of them odd.

    python studies/fleet/make.py FOLDER [--devices N] [--seed N]

Every device is a folder with one record of 250 samples and a study of one term; `truth.csv` beside them holds
what was drawn. `lcopa-bayes fleet FOLDER` should give the population back, and name the odd devices.
"""

import argparse
import math
from pathlib import Path

import numpy as np
import pandas as pd

from lcopa_bayes.bench.command import step
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.core.files import save_table
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studywriter import write_folder
from lcopa_bayes.model.path import TransferPath

MEAN = {"gain": 2.0, "time_1": math.log(1.5), "order_1": 0.8, "delay": 0.7}
"""On the sampled scale: the logarithm of the time constant [ms], the others in rad/V, - and ms."""
SPREAD = {"gain": 0.04, "time_1": 0.05, "order_1": 0.01, "delay": 0.02}
"""Standard deviation over the devices, on the same scale."""
ODD = ({"gain": 0.5}, {"time_1": 0.7}, {"delay": 0.4})
"""Shifts of the last devices from what was drawn for them, on the same scale."""
NOISE = 0.02
"""Standard deviation of the noise [rad]."""
SETTINGS = '[model]\nterms = 1\n\n[noise]\nkind = "white"\n'


def population(devices: int, rng: np.random.Generator) -> pd.DataFrame:
    """One row per device: gain [rad/V], time constant [ms], order [-], delay [ms], and whether it is odd."""
    rows = pd.DataFrame({name: rng.normal(MEAN[name], SPREAD[name], devices) for name in MEAN})
    for number, shift in enumerate(ODD, start=devices - len(ODD)):
        for name, change in shift.items():
            rows.loc[number, name] += change
    rows["time_1"] = np.exp(rows["time_1"])
    names = [f"device-{number:03d}" for number in range(1, devices + 1)]
    return rows.assign(odd=rows.index >= devices - len(ODD)).set_index(pd.Index(names, name="device"))


def make(folder: Path, devices: int, seed: int) -> pd.DataFrame:
    """Write the fleet; returns its truth, `population`."""
    rng = np.random.default_rng(seed)
    truth = population(devices, rng)
    bench = Bench(camera=0.05, noise_sd=NOISE, noise_correlation=0.0)
    for name, row in truth.iterrows():
        path = TransferPath.of_times(row["gain"], row["delay"], (row["time_1"],), (row["order_1"],))
        device = Device(((path,),), (Axis("u", "V"),), (Axis("y", "rad"),), (0.3,))
        record = simulate(device, bench, step(1.0, at=0.5), duration=12.45, name="step", rng=rng)
        study = Study(str(name), seed=seed, fit=record)
        write_folder(folder / str(name), study, settings=SETTINGS, overwrite=True)
    save_table(truth.reset_index(), folder / "truth.csv")
    return truth


def main() -> None:
    """Write the fleet that the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--devices", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    make(given.folder, given.devices, given.seed)


if __name__ == "__main__":
    main()
