"""`load_result`: a result read back from its run folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import final

import pandas as pd

from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.core.files import trusting
from lcopa_bayes.results.newdrive import BANDS, DRIVES, NAME
from lcopa_bayes.results.result import Result
from lcopa_bayes.results.runfolder import origins
from lcopa_bayes.results.savedfit import load_fit
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.verbs.audit import AuditResult
from lcopa_bayes.verbs.calibrate import CalibrationResult
from lcopa_bayes.verbs.check import CheckResult
from lcopa_bayes.verbs.compare import Comparison
from lcopa_bayes.verbs.design import DesignResult
from lcopa_bayes.verbs.fleet import FleetResult
from lcopa_bayes.verbs.look import LookResult
from lcopa_bayes.verbs.loop import LoopResult
from lcopa_bayes.verbs.papers import ClaimsResult, IdentifyResult, OpticsResult


@final
@dataclass(frozen=True, eq=False)
class SavedPrediction(StoredResult):
    """Bands of every response axis under one drive."""

    verb, file, beside = "predict", NAME, (f"tables/{BANDS}", f"tables/{DRIVES}")

    def summary(self) -> pd.DataFrame:
        """One row per response axis, as `Prediction.summary`."""
        return pd.DataFrame(self.values["axes"])


_KINDS: Mapping[str, type[StoredResult]] = {
    kind.verb: kind
    for kind in (
        *(CheckResult, LookResult),
        *(AuditResult, DesignResult, Comparison, LoopResult, CalibrationResult, FleetResult, SavedPrediction),
        *(OpticsResult, IdentifyResult, ClaimsResult),
    )
}


def load_result(folder: Path | str, verb: str | None = None, *, trust: bool = False) -> Result:
    """The result in the run folder `folder`: that of `verb`, by default the last one written there; `trust`
    as in `load_study`.

    It has the table, values, draws and pages that it had when it was made. InputError when there is no such
    result, or its files are missing, cut short or of another version.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such run folder; give the folder that a verb wrote")
    there = origins(folder)
    if not there:
        raise InputError(f"{folder}: holds no result; give the folder that a verb wrote")
    wanted = verb or list(there)[-1]
    if wanted not in there or wanted not in ("fit", *_KINDS):
        raise InputError(f"{folder}: holds no result of {wanted!r}{nearest(wanted, there)}")
    with trusting(trust):
        return load_fit(folder) if wanted == "fit" else _KINDS[wanted].load(folder)
