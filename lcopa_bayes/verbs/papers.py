"""Functions about the paper and its device: `optics`, `identify`, `claims`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import final

import pandas as pd

from lcopa_bayes.core.estimate import attributes, plain
from lcopa_bayes.core.files import csv_of
from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.paper.auditclaims import load_audit
from lcopa_bayes.paper.claims import CLAIMS, judge
from lcopa_bayes.paper.comparisonclaims import load_comparison
from lcopa_bayes.paper.identify import identify as identified
from lcopa_bayes.paper.identify import results, scannable
from lcopa_bayes.paper.intervals import Scan
from lcopa_bayes.paper.staticoptics import OpticsPlan, static_optics
from lcopa_bayes.paper.steptable import load_posterior, panels, step_table
from lcopa_bayes.paper.verdict import Evidence, Kind
from lcopa_bayes.results.runfolder import opened, provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.results.structure import settled
from lcopa_bayes.verbs.sources import FitLike, study_of


@final
@dataclass(frozen=True, eq=False)
class OpticsResult(StoredResult):
    """Far field, director and the chain from volts to angle."""

    verb, file = "optics", "optics.json"

    def summary(self) -> pd.DataFrame:
        """One row per lobe: target [deg], order, angle [deg], and intensity over the main lobe, of point
        elements and of elements as wide as the fill factor says."""
        return pd.DataFrame(self.values["grating_lobes"])

    def __str__(self) -> str:
        return f"{pd.DataFrame(self.values['mean_tilt']).to_string(index=False)}\n\n{super().__str__()}"


@final
@dataclass(frozen=True, eq=False)
class IdentifyResult(StoredResult):
    """The paper's identification of every path, with the integer rival and its Table 1."""

    verb, file, beside = "identify", "identify.json", ("tables/identify_*.csv",)

    def summary(self) -> pd.DataFrame:
        """One row per model of each path: orders, delay [time unit], steady gain, RMSE, and unit of the
        response."""
        return pd.DataFrame(
            [
                {
                    "path": path["path"],
                    "model": model["method"],
                    "orders": ", ".join(f"{order:.3g}" for order in model["orders"]),
                    "delay": model["delay"],
                    "steady": model["steady"],
                    "rmse": model["output_rmse"],
                    "unit": path["response_unit"],
                }
                for path in self.values["paths"]
                for model in path["models"]
            ]
        )


@final
@dataclass(frozen=True, eq=False)
class ClaimsResult(StoredResult):
    """The paper's claims with their verdicts."""

    verb, file = "claims", "claims.json"

    def summary(self) -> pd.DataFrame:
        """One row per claim: id, verdict, the number that decides [`unit`], and the calculation."""
        return pd.DataFrame(self.values["claims"])

    def __str__(self) -> str:
        table = self.summary()[["id", "verdict", "number", "unit"]]
        return f"{table.to_string(index=False, justify='left', na_rep='-')}\n\n{self.verdict}"


def optics(plan: OpticsPlan | None = None) -> OpticsResult:
    """Far field, director and the chain from volts to angle; `plan` by default the paper's."""
    return OpticsResult(static_optics(plan or OpticsPlan()).values, provenance(None, "optics"))


@on_one_thread
def identify(
    study: FitLike,
    *,
    scan: Scan | None = None,
    posterior: Path | str | None = None,
    folder: Path | str | None = None,
    jobs: int = 1,
    quiet: bool = True,
) -> IdentifyResult:
    """The paper's least-squares scan of every path, with the integer rival and its Table 1.

    Parameters: `study`, or a fit of it; `scan`, intervals and spacing; `posterior`, the run folder of a fit
    whose intervals are shown too; `folder`, a run folder to write into; `jobs`, processes to use; `quiet`, no
    progress bar. InputError when records, intervals or folders cannot be used.
    """
    wanted, plan = settled(study_of(study), jobs=jobs), scan or Scan()
    beside = None if posterior is None else load_posterior(Path(posterior), wanted)
    scannable(wanted, plan)
    origin = provenance(wanted, "identify")
    with opened(folder, origin):
        models = identified(wanted, plan=plan, quiet=quiet, jobs=jobs)
        shown, texts = [], {}
        for number, (entry, samples) in enumerate(panels(wanted, models), start=1):
            stem = re.sub(r"[^A-Za-z0-9_-]+", "_", f"identify_{number:02d}_{entry['record']}_{entry['axis']}")
            shown.append(entry | {"samples": f"tables/{stem}.csv"})
            texts[f"tables/{stem}.csv"] = csv_of(samples, float_format="%.9g")
        table = step_table(wanted, models, posterior=beside)
        values = results(wanted, models, plan) | {"step_metrics": table, "records": shown}
        return IdentifyResult(values, origin, texts).kept(folder)


def claims(*, audits: Sequence[Path | str] = (), comparison: Path | str | None = None) -> ClaimsResult:
    """Every claim of the paper with its computed verdict.

    Parameters: `audits`, run folders of audits, which decide claims I1 to I6; `comparison`, the run folder of
    a comparison, which decides M1, M2, M4 and I5. Without them these are undecided. InputError when one
    cannot be used.
    """
    evidence = Evidence(
        tuple(load_audit(Path(folder)) for folder in audits),
        None if comparison is None else load_comparison(Path(comparison)),
    )
    verdicts = judge(evidence)
    rows = [
        {"id": claim.id, "verdict": verdict.kind.value}
        | plain(attributes(verdict, "number", "unit", "how") | attributes(claim, "text", "source"))
        for claim, verdict in zip(CLAIMS, verdicts.values(), strict=True)
    ]
    counts = Counter(row["verdict"] for row in rows)
    said = ", ".join(f"{counts[kind.value]} {kind.value}" for kind in Kind)
    values = {"verdict": f"{len(rows)} claims of Ta et al. 2026: {said}.", "claims": rows}
    return ClaimsResult(values, provenance(None, "claims"))
