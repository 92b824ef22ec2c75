"""Verbs that ask more of a study: audit, design, compare, loop."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from lcopa_bayes.comparison.candidates import candidates_of
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.core.files import save_json, writable_folder
from lcopa_bayes.data.study import Study
from lcopa_bayes.data.studyfile import load_candidates
from lcopa_bayes.data.studywriter import write_study
from lcopa_bayes.effectsearch.loop import loop
from lcopa_bayes.effectsearch.summary import drawn, words
from lcopa_bayes.effectsearch.summary import results as loop_results
from lcopa_bayes.experiments.confirmation import REPLICAS, confirmed
from lcopa_bayes.experiments.design import DRAWS, checked, design
from lcopa_bayes.experiments.nextmeasurement import next_measurement
from lcopa_bayes.experiments.summary import as_json
from lcopa_bayes.experiments.template import write_template
from lcopa_bayes.identifiability.audit import audit
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.report import write_report
from lcopa_bayes.report.audit import write_audit
from lcopa_bayes.report.compare import write_comparison
from lcopa_bayes.report.design import NAME as DESIGN_PAGE
from lcopa_bayes.report.design import write_design
from lcopa_bayes.report.loop import write_loop
from lcopa_bayes.results.fit import Fit, fit
from lcopa_bayes.results.provenance import provenance
from lcopa_bayes.results.runfolder import save_fit
from lcopa_bayes.verbs.outcome import Told, place_of, study_of, with_report

_QUICK = 4
"""How many times fewer draws a quick design takes."""

EXPLAINED = "explained.toml"
"""The study with what a loop found, beside its results."""


def audit_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Identifiability of every parameter, after the fit it rests on, with a page of its own."""
    made, folder, jobs = _basis(options, command, study_of(options))
    values = audit(made, jobs=jobs).as_json()
    values["next_measurement"] = next_measurement(made, values["parameters"])
    save_json(values, folder / "audit.json")
    words = [f"{'parameter':16}{'verdict':30}why"]
    words += [f"{row['name']:16}{row['verdict']:30}{row['reason']}" for row in values["parameters"]]
    return with_report(values, write_audit(folder), *words)


def design_study(options: argparse.Namespace, command: list[str]) -> Told:
    """What to measure next, after the fit it rests on: the winning drive, confirmed, and its template."""
    study = study_of(options)
    wanted = {key: getattr(options, key) for key in ("time", "repeats", "amplitude", "refresh")}
    checked(problem_of(study), **wanted)  # before a long fit
    made, folder, jobs = _basis(options, command, study)
    wanted |= {"with_prior": options.with_prior, "quick": options.quick}
    values, words = plan_next(made, folder, jobs=jobs, **wanted)
    return with_report(values, folder / DESIGN_PAGE, *words)


def _basis(options: argparse.Namespace, command: list[str], study: Study) -> tuple[Fit, Path, int]:
    """The fit that an audit or a design rests on, saved and reported; its folder, and processes to use."""
    folder, jobs = place_of(options, study)
    made = fit(
        study, jobs=jobs, folder=folder, resume=options.resume, quick=options.quick, quiet=options.quiet
    )
    save_fit(made, folder, command)
    write_report(folder)
    return made, folder, jobs


def compare_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Candidates derived from a study, scored and decided, with a page of its own."""
    study = study_of(options)
    folder, jobs = place_of(options, study)
    if study.effects.use:  # its candidates have them or not, but never without their priors
        problem_of(study)
    chosen, extra = load_candidates(options.candidates) if options.candidates else (None, ())
    values = compare(
        candidates_of(study, extra, options.pick or chosen),
        jobs=jobs,
        folder=folder,
        resume=options.resume,
        quick=options.quick,
        quiet=options.quiet,
    )
    save_json(values | {"provenance": provenance(study, command)}, folder / "compare.json")
    return with_report(values, write_comparison(folder), values["why"], values["fractional"]["sentence"])


def loop_study(options: argparse.Namespace, command: list[str]) -> Told:
    """What the base model lacks, traced to an effect, with errors before and after, and a page of its own."""
    study = study_of(options)
    folder, jobs = place_of(options, study)
    problem_of(study)  # what is wrong with the study is said before anything is written
    writable_folder(folder)
    found = loop(study, jobs=jobs, quick=options.quick, as_stated=options.as_stated)
    values = loop_results(found)
    save_json(provenance(study, command), folder / "provenance.json")
    save_json(drawn(found), folder / "loop_curves.json")
    save_json(values, folder / "loop.json")
    write_study(found.study, folder / EXPLAINED, note=f"{study.name} with what `loop` found declared.")
    values |= {"explained": str(folder / EXPLAINED)}
    return with_report(values, write_loop(folder), *words(values))


def plan_next(
    fit: Fit, folder: Path, *, jobs: int = 1, quick: bool = False, **options: Any
) -> tuple[dict[str, Any], list[str]]:
    """Write `design.json`, `design.html` and `design/next.csv`; returns the values and lines for a reader.

    `options` are those of `design.design`; when `quick`, fewer draws and replicas are taken. Without a
    winner there is no `next.csv`.
    """
    made = design(fit, draws=DRAWS // _QUICK if quick else DRAWS, **options)
    trials = confirmed(made, jobs=jobs, replicas=REPLICAS // 2 if quick else REPLICAS)
    values = as_json(made) | trials | {"template": None}
    if values["winner"] is not None:
        path = writable_folder(folder / "design") / "next.csv"
        write_template(fit.study, made.limits, made.winner.candidate.command, made.time, path)
        values["template"] = f"{path.parent.name}/{path.name}"
    save_json(values, folder / "design.json")
    write_design(folder)
    words = [f"{'parameter':16}{'best drive':28}{'relative sd':>12}  bench time for 10 %"]
    for row in values["parameters"]:
        spread = row["relative_sd"] and row["relative_sd"]["value"]
        number = "-" if spread is None else f"{spread:.3g}"
        told = row["reason"] or row["time_words"]
        words.append(f"{row['name']:16}{row['best_drive'] or '-':28}{number:>12}  {told}")
    return values, [*words, values["verdict"], values["confirmed"]["sentence"]]
