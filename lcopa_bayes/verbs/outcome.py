"""What every verb gives back, and the study it is about."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

from lcopa_bayes.core.parallel import cores
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_study


@final
@dataclass(frozen=True)
class Told:
    """Outcome of a verb."""

    values: dict[str, Any]
    """What ``--json`` prints."""
    words: tuple[str, ...] = ()
    """Lines for a reader."""


def with_report(values: dict[str, Any], path: Path, *words: str) -> Told:
    """What a verb tells, with the page it wrote."""
    return Told(values | {"report": str(path)}, (*words, f"report: {path}"))


def study_of(options: argparse.Namespace) -> Study:
    """The study asked for, with the seed of the command line if one is given."""
    study = load_study(options.source, held_out=options.held_out)
    return study if options.seed is None else study.with_seed(options.seed)


def place_of(options: argparse.Namespace, study: Study) -> tuple[Path, int]:
    """Run folder of a study, and processes to use."""
    return options.out or Path("reports") / study.name, options.jobs or cores()
