"""What every fitted posterior answers, whether just sampled or read back from its run folder."""

from __future__ import annotations

from abc import abstractmethod
from pathlib import Path

import pandas as pd
from numpy.typing import ArrayLike
from xarray import DataTree

from lcopa_bayes.core.errors import InputError
from lcopa_bayes.core.estimate import attributes
from lcopa_bayes.data.drive import Drive
from lcopa_bayes.data.record import Record
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.results.frequency import FrequencyResponse, frequency_response
from lcopa_bayes.results.newdrive import Level, Prediction, predict
from lcopa_bayes.results.result import Result, write_fit_page
from lcopa_bayes.results.steps import path_metrics
from lcopa_bayes.sampling.draws import Draws


class Predictive(Result):
    """A study with the draws of its posterior."""

    verb, file = "fit", "results.json"

    problem: Problem
    """The study prepared for inference."""
    draws: Draws
    """Posterior draws with their grade."""

    @property
    def study(self) -> Study:
        """The study that was fitted."""
        return self.problem.study

    def summary(self) -> pd.DataFrame:
        """One row per free parameter: median and ends of the 90 % interval [`unit`], effective sample size
        [draws], split R-hat [-] and grade."""
        qualities = {one.name: one for one in self.draws.qualities}
        return pd.DataFrame(
            [
                {
                    "parameter": one.name,
                    **attributes(one, "value", "lower", "upper", "unit", "ess"),
                    "rhat": qualities[one.name].rhat,
                    "grade": one.grade,
                }
                for one in self.draws.estimates()
            ]
        )

    def _write_page(self, folder: Path, jobs: int) -> Path:
        return write_fit_page(folder, None, jobs=jobs)

    @abstractmethod
    def to_datatree(self) -> DataTree:
        """Draws, data and prior in the ArviZ groups; see `datatree`."""

    def predict(self, driven: Drive | Record | Path | str, *, offset: Level = "fitted") -> Prediction:
        """Bands for a drive nobody has measured, or for a record; see `newdrive.predict`."""
        return predict(self.problem, self.draws, driven, offset=offset)

    def score(self, record: Record | Path | str) -> pd.DataFrame:
        """Error and coverage of a record this fit has not seen, one row per axis, without a new fit.

        The numbers are those of a fit that held the record out from the start. InputError as `predict`, and
        for a file without responses.
        """
        scored = self.predict(record)
        if not scored.scores:
            raise InputError(f"{record}: holds no response to score; `predict` takes drives alone")
        return pd.DataFrame(scored.scores)

    def frequency_response(self, frequencies: ArrayLike | None = None) -> FrequencyResponse:
        """Gain and phase of every path at `frequencies` [cycles / time unit]; see `frequency`."""
        scales, unit = self.problem.scales, self.study.time_unit
        return frequency_response(
            self.draws, frequencies, span=scales.span, period=scales.period, time_unit=unit
        )

    def step_metrics(self, path: str | None = None, *, span: float | None = None) -> pd.DataFrame:
        """Rise, settling, overshoot and steady state of a path or of all, one row each.

        `span` [time unit] is the time that is looked at, by default that of the longest fit record.
        InputError for a path the plant does not have and a span that is not positive.
        """
        over = self.problem.scales.span if span is None else span
        metrics = path_metrics(self.draws, span=over, time_unit=self.study.time_unit, path=path)
        return pd.DataFrame([one.as_json() for one in metrics])
