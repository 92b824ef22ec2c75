"""A drive as a record without responses, for the bench to play and fill in."""

from __future__ import annotations

import numpy as np

from lcopa_bayes.bench.command import Command
from lcopa_bayes.data.study import Study
from lcopa_bayes.experiments.limits import Limits


def template(study: Study, limits: Limits, command: Command, time: float) -> str:
    """A record table (CSV) of a drive for `time` [time unit] with empty responses.

    One row a camera period before time 0 under the resting drive, then one per camera sample; drives change
    only at rows. Filled in, the file is a record of the study.
    """
    ticks = np.arange(-1, max(2, round(time / limits.period)))
    at = np.round(limits.period * ticks, 9)
    drive = command.at(at + 1e-6 * limits.period)
    heads = [f"time_{study.time_unit}"]
    heads += [f"drive_{axis.name}_{axis.unit}" for axis in study.drive_axes]
    heads += [f"response_{axis.name}_{axis.unit}" for axis in study.response_axes]
    empty = "," * len(study.response_axes)
    rows = [
        ",".join(repr(float(value)) for value in (moment, *levels)) + empty
        for moment, levels in zip(at, drive, strict=True)
    ]
    return "\n".join([",".join(heads), *rows]) + "\n"
