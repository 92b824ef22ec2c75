"""Functions about the paper and its device: `optics`, `identify`, `claims`."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, final

import pandas as pd

from lcopa_bayes.core.files import save_json, writable_folder
from lcopa_bayes.paper.auditclaims import load_audit
from lcopa_bayes.paper.claims import judge
from lcopa_bayes.paper.comparisonclaims import load_comparison
from lcopa_bayes.paper.identify import identify as identified
from lcopa_bayes.paper.identify import results, scannable, words_of
from lcopa_bayes.paper.intervals import Scan
from lcopa_bayes.paper.opticsplan import OpticsPlan
from lcopa_bayes.paper.staticoptics import static_optics
from lcopa_bayes.paper.steptable import load_posterior, step_table
from lcopa_bayes.paper.verdict import Evidence
from lcopa_bayes.report.paperpages import write_claims, write_identification, write_optics
from lcopa_bayes.results.result import notebook_table
from lcopa_bayes.verbs.sources import FitLike, study_of


@final
@dataclass(frozen=True, eq=False)
class PaperResult:
    """What was calculated after the paper, as values, table and page."""

    values: Mapping[str, Any]
    """What `to_json` gives."""
    file: str
    """File that `save` writes."""
    rows: Sequence[Mapping[str, Any]]
    """Rows of the summary."""
    lines: Sequence[str]
    """The result in words."""
    page: Callable[[Path], Path]
    """Writes the page into a folder."""

    def summary(self) -> pd.DataFrame:
        """The main table: steering angles [deg] of `optics`, step metrics of `identify`, verdicts of
        `claims`."""
        return pd.DataFrame(self.rows)

    def to_json(self) -> dict[str, Any]:
        """Every number as plain values."""
        return dict(self.values)

    def save(self, folder: Path | str) -> Path:
        """Write the values into a folder, which is returned; InputError when it cannot be written to."""
        path = writable_folder(Path(folder))
        save_json(self.values, path / self.file)
        return path

    def report(self, folder: Path | str) -> Path:
        """`save`, then the page; returns its path."""
        return self.page(self.save(folder))

    def __str__(self) -> str:
        return "\n".join(self.lines)

    def _repr_html_(self) -> str:
        return notebook_table(self.summary())


def optics(plan: OpticsPlan | None = None) -> PaperResult:
    """Far field, director and the chain from volts to angle; `plan` by default the paper's."""
    calculated = static_optics(plan or OpticsPlan.of())
    values = calculated.as_json()
    rows = next((value for value in values.values() if isinstance(value, list)), [])
    return PaperResult(
        values, "results.json", rows, calculated.words(), partial(write_optics, calculated=calculated)
    )


def identify(
    study: FitLike,
    *,
    scan: Scan | None = None,
    posterior: Path | str | None = None,
    folder: Path | str | None = None,
    jobs: int = 1,
    quiet: bool = True,
) -> PaperResult:
    """The paper's least-squares scan of every path, with the integer rival and its Table 1.

    Parameters: `study`, or a fit of it; `scan`, intervals and spacing; `posterior`, the run folder of a fit
    whose intervals stand beside; `folder`, to be written to afterwards; `jobs`, processes to use; `quiet`, no
    progress bar. InputError when records, intervals or folders cannot be used.
    """
    wanted, plan = study_of(study), scan or Scan()
    beside = None if posterior is None else load_posterior(Path(posterior), wanted)
    scannable(wanted, plan)
    if folder is not None:
        writable_folder(Path(folder))
    found = identified(wanted, plan=plan, quiet=quiet, jobs=jobs)
    rows = step_table(wanted, found, posterior=beside)
    table = [row.as_json() for row in rows]
    values = results(wanted, found, plan) | {"step_metrics": table}
    page = partial(write_identification, study=wanted, identified=found, rows=rows)
    return PaperResult(values, "identify.json", table, words_of(values), page)


def claims(*, audits: Sequence[Path | str] = (), comparison: Path | str | None = None) -> PaperResult:
    """Every claim of the paper with its computed verdict.

    Parameters: `audits`, run folders of audits, which decide claims I1 to I6; `comparison`, the run folder of
    a comparison, which decides M1, M2, M4 and I5. Without them these are undecided. InputError when one
    cannot be used.
    """
    evidence = Evidence(
        tuple(load_audit(Path(folder)) for folder in audits),
        None if comparison is None else load_comparison(Path(comparison)),
    )
    judged = judge(evidence=evidence)
    rows = [each.as_json() for each in judged]
    lines = [f"{'claim':6}{'verdict':14}{'number':>12}  unit"]
    for each in judged:
        number = "-" if each.verdict.number is None else f"{each.verdict.number:.4g}"
        lines.append(f"{each.claim.id:6}{each.verdict.kind.value:14}{number:>12}  {each.verdict.unit}")
    return PaperResult({"claims": rows}, "results.json", rows, lines, partial(write_claims, judged=judged))
