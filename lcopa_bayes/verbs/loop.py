"""`loop`: what a study's model lacks, traced to an effect, with errors before and after."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import final

import pandas as pd

from lcopa_bayes.core.estimate import plain
from lcopa_bayes.core.parallel import on_one_thread
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study
from lcopa_bayes.data.studywriter import write_study
from lcopa_bayes.effectsearch.loop import loop as searched
from lcopa_bayes.effectsearch.summary import drawn, results, words
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.results.runfolder import opened, provenance
from lcopa_bayes.results.stored import StoredResult
from lcopa_bayes.results.structure import with_least_terms
from lcopa_bayes.verbs.sources import FitLike, study_of

CURVES = "loop_curves.json"
"""File of the residuals and views that the page draws."""
EXPLAINED = "explained.toml"
"""File of the study with the effects that a loop identified."""


@final
@dataclass(frozen=True, eq=False)
class LoopResult(StoredResult):
    """What the model of a study lacks."""

    study: Study | None = None
    """The study with the identified effects declared, named as the study and ``-explained``: what `fit`,
    `audit` and `compare` take."""

    verb, file, beside = "loop", "loop.json", (CURVES,)

    @property
    def verdict(self) -> str:
        """What is missing, with the confidence in it."""
        values = self.values
        return f"{values['verdict']} ({values['confidence']}): {values['sentence']}"

    def summary(self) -> pd.DataFrame:
        """One row per parameter of an effect that was named: value and ends of the 90 % interval [`unit`],
        grade, and the effects it is confounded with; no row when none was."""
        columns = ["effect", "place", "parameter", "value", "lower", "upper", "unit", "grade"]
        rows = [
            {"effect": effect["name"], "place": effect["place"], "parameter": one["name"]}
            | {key: one[key] for key in columns[3:]}
            | {"confounded_with": ", ".join(effect["group"][1:])}
            for effect in self.values["effects"]
            for one in effect["parameters"]
        ]
        return pd.DataFrame(rows, columns=pd.Index([*columns, "confounded_with"]))

    def save(self, folder: Path | str) -> Path:
        """Write the result into a run folder, with `explained.toml`, the study with the identified effects,
        and its records; returns the folder. InputError as `StoredResult.save`."""
        with opened(folder, self.origin) as path:
            if self.study is not None:
                write_study(
                    self.study,
                    path / EXPLAINED,
                    note=f"{self.values['study']} with the effects that `loop` identified.",
                )
            return super().save(path)

    @classmethod
    def load(cls, folder: Path) -> LoopResult:
        """The result in a run folder; InputError when it is not there or cannot be read."""
        return replace(super().load(folder), study=load_study(folder / EXPLAINED))

    def __str__(self) -> str:
        return "\n".join(words(dict(self.values)))


@on_one_thread
def loop(
    study: FitLike,
    *,
    as_stated: bool = False,
    jobs: int = 1,
    folder: Path | str | None = None,
    quick: bool = False,
    quiet: bool = True,
) -> LoopResult:
    """Hold the residual of a study's fit against the catalogue of effects, refit with the best, and score
    both.

    Parameters: `study`, or a fit of it; `as_stated`, keep the number of viscous terms that the study states;
    `jobs`, processes to use; `folder`, a run folder to write into; `quick`, fewer chance residuals and
    shorter ensembles; `quiet`, no word of what is being done. InputError as `fit`.
    """
    wanted = with_least_terms(study_of(study))  # the search chooses its structure itself
    problem_of(wanted)  # what is wrong with the study is said before anything is written
    origin = plain(provenance(wanted, "loop"))
    with opened(folder, origin):
        outcome = searched(wanted, jobs=jobs, quick=quick, as_stated=as_stated, quiet=quiet)
        curves = json.dumps(plain(drawn(outcome)), indent=1, allow_nan=False) + "\n"
        values = results(outcome) | {"explained": EXPLAINED}
        return LoopResult(values, origin, {CURVES: curves}, study=outcome.study).kept(folder)
