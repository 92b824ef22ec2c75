"""`audit`: what the records determine, parameter by parameter."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import final

import pandas as pd

from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.experiments.summary import next_measurement
from lcopa_bayes.identifiability.audit import audit as audited
from lcopa_bayes.results.stored import StoredResult, origin_of
from lcopa_bayes.verbs.fit import basis
from lcopa_bayes.verbs.sources import FitLike


@final
@dataclass(frozen=True, eq=False)
class AuditResult(StoredResult):
    """Identifiability of every free parameter, and what to measure next."""

    verb, file = "audit", "audit.json"
    rests_on_fit = True

    def summary(self) -> pd.DataFrame:
        """One row per free parameter: verdict, ends of the 90 % profile-likelihood interval [`unit`], None
        where open, and the reason."""
        return pd.DataFrame(
            [
                {
                    "parameter": row["name"],
                    "verdict": row["verdict"],
                    "lower": row["profile"]["lower"],
                    "upper": row["profile"]["upper"],
                    "unit": row["unit"],
                    "reason": row["reason"],
                }
                for row in self.values["parameters"]
            ]
        )


@on_one_thread
def audit(
    source: FitLike,
    *,
    jobs: int = 1,
    folder: Path | str | None = None,
    resume: bool = False,
    quick: bool = False,
    quiet: bool = True,
) -> AuditResult:
    """Say for every free parameter whether the records determine it, and why not where they do not.

    Verdicts join symmetries of the model, curvature, profile likelihoods and draws. Parameters: `source`, a
    fit, the run folder of one, or a study, which is fitted first, with `resume`, `quick` and `quiet` as in
    `fit`; `jobs`, processes to use; `folder`, a run folder to write into. InputError as `fit`.
    """
    fitted = basis(source, jobs=jobs, folder=folder, resume=resume, quick=quick, quiet=quiet)
    values = audited(fitted, jobs=jobs).as_json()
    values["next_measurement"] = next_measurement(fitted, values["parameters"])
    return AuditResult(values, origin_of(fitted, "audit"), fit=fitted).kept(folder)
