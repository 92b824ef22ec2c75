"""A prediction read back from its folder; `fit.predict` makes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import final

import pandas as pd

from lcopa_bayes.results.newdrive import BANDS, DRIVES, NAME
from lcopa_bayes.results.stored import StoredResult


@final
@dataclass(frozen=True, eq=False)
class SavedPrediction(StoredResult):
    """Bands of every response axis under one drive."""

    verb, file, beside = "predict", NAME, (f"tables/{BANDS}", f"tables/{DRIVES}")

    def summary(self) -> pd.DataFrame:
        """One row per response axis, as `Prediction.summary`."""
        return pd.DataFrame(self.values["axes"])
