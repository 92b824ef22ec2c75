"""Verbs that make numbers from a study or records from a bench: fit, calibrate, simulate, report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lcopa_bayes.bench.campaign import write_campaign
from lcopa_bayes.bench.campaignfile import load_plan
from lcopa_bayes.calibration.calibrate import calibrate
from lcopa_bayes.calibration.summary import results as calibration_results
from lcopa_bayes.calibration.summary import tables
from lcopa_bayes.calibration.truths import Stated
from lcopa_bayes.core.checks import refuse_if
from lcopa_bayes.core.files import save_json, save_table, writable_folder
from lcopa_bayes.core.parallel import cores
from lcopa_bayes.data.study import Study
from lcopa_bayes.report import write_report
from lcopa_bayes.report.audit import write_audit
from lcopa_bayes.report.calibrate import is_calibration, write_calibration
from lcopa_bayes.report.compare import write_comparison
from lcopa_bayes.report.design import write_design
from lcopa_bayes.report.loop import write_loop
from lcopa_bayes.report.predict import write_prediction
from lcopa_bayes.results.fit import fit
from lcopa_bayes.results.integerrival import integer_rival
from lcopa_bayes.results.newdrive import NAME as PREDICTED
from lcopa_bayes.results.provenance import provenance
from lcopa_bayes.results.runfolder import save_fit
from lcopa_bayes.results.savedfit import load_fit
from lcopa_bayes.verbs.outcome import Told, place_of, study_of, with_report

_PAGES = {
    "audit.json": write_audit,
    "design.json": write_design,
    "compare.json": write_comparison,
    "loop.json": write_loop,
    PREDICTED: write_prediction,
}
"""Pages beside the report of a fit, by what they are drawn from."""


def run(options: argparse.Namespace, command: list[str]) -> Told:
    """All stages of a study; the fit comes first and feeds the others."""
    study = study_of(options)
    return _fitted(options, command, study, frozenset(study.stages))


def fit_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Posterior, bands and step metrics, with a report."""
    return _fitted(options, command, study_of(options), frozenset({"fit"}))


def _fitted(options: argparse.Namespace, command: list[str], study: Study, stages: frozenset[str]) -> Told:
    """A fit and what the stages add to it, saved and reported."""
    folder, jobs = place_of(options, study)
    made = fit(
        study,
        jobs=jobs,
        folder=folder,
        resume=options.resume,
        quick=options.quick,
        cross_check=options.cross_check,
        quiet=options.quiet,
    )
    rival = None
    if "rival" in stages:
        rival = integer_rival(made, jobs=jobs, quick=options.quick, quiet=options.quiet)
    told = save_fit(made, folder, command, rival=rival)
    return with_report(told, write_report(folder), told["verdict"])


def report(options: argparse.Namespace, command: list[str]) -> Told:
    """Every page of a run folder, drawn again from what is stored there."""
    folder = options.folder
    if is_calibration(folder):
        return with_report({}, write_calibration(folder))
    pages = [write(folder) for name, write in _PAGES.items() if (folder / name).is_file()]
    if (folder / "results.json").is_file() or not pages:
        pages.insert(0, write_report(folder))
    return with_report({"pages": [str(page) for page in pages]}, pages[0])


def predict(options: argparse.Namespace, command: list[str]) -> Told:
    """Bands for a drive, or scores of a record, by the fit of a run folder, without a new fit."""
    fitted = load_fit(options.folder)
    found = fitted.predict(options.drive, offset=options.offset)
    folder = options.out or options.folder / "predict" / options.drive.stem
    values = found.save(folder, provenance=provenance(fitted.study, command))
    return with_report(values, write_prediction(folder), found.verdict)


def simulate(options: argparse.Namespace, command: list[str]) -> Told:
    """Records of a campaign file, measured on the virtual bench."""
    plan = load_plan(options.campaign)
    seed = plan.seed if options.seed is None else options.seed
    records = plan.run(np.random.default_rng(seed))
    paths = write_campaign(
        options.out,
        records,
        held_out=plan.held_out,
        name=plan.name,
        seed=seed,
        settings=plan.settings,
        overwrite=options.overwrite,
    )
    verdict = f"{len(records)} records in {options.out}"
    return Told({"verdict": verdict, "files": [str(path) for path in paths]}, (verdict,))


def stated_values(words: Sequence[str]) -> dict[str, Stated]:
    """Values by name from words such as ``delay=1.0``, or ranges such as ``delay=0.9:1.1``; InputError where
    a word is neither or a name occurs twice."""
    out: dict[str, Stated] = {}
    problems = []
    for word in words:
        name, _, value = word.partition("=")
        try:
            ends = [float(end) for end in value.split(":")]
        except ValueError:
            ends = []
        sound = len(ends) in (1, 2) and bool(np.isfinite(ends).all()) and ends == sorted(ends)
        if not (name and sound) or name in out:
            problems.append(f"--truth {word}: give NAME=VALUE or NAME=LOW:HIGH in numbers, each name once")
        elif len(ends) == 1:
            out[name] = ends[0]
        else:
            out[name] = (ends[0], ends[1])
    refuse_if(problems)
    return out


def calibrate_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Coverage and ranks of truths over many simulated replicas of a study, with a report."""
    study = study_of(options)
    folder = options.out or Path("reports/calibration") / study.name
    made = calibrate(
        study,
        replicas=options.replicas,
        around=options.around,
        truth=stated_values(options.truth),
        engine=options.engine,
        jobs=options.jobs or cores(),
        dask=options.dask,
        folder=folder,
        resume=options.resume,
        quick=options.quick,
        quiet=options.quiet,
    )
    values = calibration_results(made)
    writable_folder(folder / "tables")
    for name, table in tables(made).items():
        save_table(table, folder / "tables" / f"{name}.csv")
    save_json(provenance(study, command), folder / "provenance.json")
    save_json(values, folder / "results.json")
    return with_report(values, write_calibration(folder), values["verdict"])
