"""What each verb of the command line does with its options: the values it tells, and the words."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, final

import numpy as np

from lcopa_bayes.audit.audit import audit
from lcopa_bayes.bench.campaign import write_campaign
from lcopa_bayes.bench.plan import load_plan
from lcopa_bayes.calibration.calibrate import calibrate
from lcopa_bayes.calibration.summary import results as calibration_results
from lcopa_bayes.calibration.summary import tables
from lcopa_bayes.comparison.candidatefile import load_candidates
from lcopa_bayes.comparison.candidates import candidates_of
from lcopa_bayes.comparison.compare import compare
from lcopa_bayes.cores import cores
from lcopa_bayes.files import writable_folder
from lcopa_bayes.fit import fit
from lcopa_bayes.paper.auditclaims import load_audit
from lcopa_bayes.paper.claims import judge
from lcopa_bayes.paper.comparisonclaims import load_comparison
from lcopa_bayes.paper.identify import identify, results, scannable, words_of
from lcopa_bayes.paper.intervals import MOST_TERMS, Interval, Scan
from lcopa_bayes.paper.opticsplan import OpticsPlan
from lcopa_bayes.paper.staticoptics import static_optics
from lcopa_bayes.paper.steptable import load_posterior, step_table
from lcopa_bayes.paper.verdict import Evidence
from lcopa_bayes.paper.virtualcomparison import virtual_comparison
from lcopa_bayes.provenance import provenance
from lcopa_bayes.report import write_report
from lcopa_bayes.report.auditpage import write_audit
from lcopa_bayes.report.calibrationpage import is_calibration, write_calibration
from lcopa_bayes.report.comparisonpage import is_comparison, write_comparison
from lcopa_bayes.report.paperpages import write_claims, write_identification, write_optics
from lcopa_bayes.rival import integer_rival
from lcopa_bayes.runfolder import save_fit, save_json, save_table
from lcopa_bayes.study import Study
from lcopa_bayes.studyfile import load_study


@final
@dataclass(frozen=True)
class Told:
    """Outcome of a verb."""

    values: dict[str, Any]
    """What ``--json`` prints."""
    words: tuple[str, ...] = ()
    """Lines for a reader."""


def run(options: argparse.Namespace, command: list[str]) -> Told:
    """All stages of a study; the fit comes first and feeds the others."""
    study = _study(options)
    return _fitted(options, command, study, frozenset(study.stages))


def fit_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Posterior, bands and step metrics, with a report."""
    return _fitted(options, command, _study(options), frozenset({"fit"}))


def _fitted(options: argparse.Namespace, command: list[str], study: Study, stages: frozenset[str]) -> Told:
    """A fit and what the stages add to it, saved and reported."""
    folder, jobs = options.out or Path("reports") / study.name, options.jobs or cores()
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
    return _with_report(told, write_report(folder), told["verdict"])


def audit_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Identifiability of every parameter, after the fit it rests on, with a page of its own."""
    study = _study(options)
    folder, jobs = options.out or Path("reports") / study.name, options.jobs or cores()
    made = fit(
        study, jobs=jobs, folder=folder, resume=options.resume, quick=options.quick, quiet=options.quiet
    )
    save_fit(made, folder, command)
    write_report(folder)
    values = audit(made, jobs=jobs).as_json()
    save_json(values, folder / "audit.json")
    words = [f"{'parameter':16}{'verdict':30}why"]
    words += [f"{row['name']:16}{row['verdict']:30}{row['reason']}" for row in values["parameters"]]
    return _with_report(values, write_audit(folder), *words)


def compare_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Candidates derived from a study, scored and decided, with a page of its own."""
    study = _study(options)
    folder, jobs = options.out or Path("reports") / study.name, options.jobs or cores()
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
    return _with_report(values, write_comparison(folder), values["why"], values["fractional"]["sentence"])


def report(options: argparse.Namespace, command: list[str]) -> Told:
    """The report of a run folder, drawn again."""
    folder = options.folder
    if is_comparison(folder):
        return _with_report({}, write_comparison(folder))
    return _with_report({}, write_calibration(folder) if is_calibration(folder) else write_report(folder))


def calibrate_study(options: argparse.Namespace, command: list[str]) -> Told:
    """Coverage and ranks of truths over many simulated replicas of a study, with a report."""
    study = _study(options)
    folder = options.out or Path("reports/calibration") / study.name
    made = calibrate(
        study,
        replicas=options.replicas,
        around=options.around,
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
    return _with_report(values, write_calibration(folder), values["verdict"])


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
        overwrite=options.overwrite,
    )
    verdict = f"{len(records)} records in {options.out}"
    return Told({"verdict": verdict, "files": [str(path) for path in paths]}, (verdict,))


def optics(options: argparse.Namespace, command: list[str]) -> Told:
    """Far field, director and the chain from volts to angle, with figures."""
    made = static_optics(
        OpticsPlan.of(
            elements=options.elements,
            pitch=options.pitch,
            wavelength=options.wavelength,
            fill_factor=options.fill_factor,
            targets_deg=options.targets,
            voltages=options.voltages,
            pretilt=options.pretilt,
            field=options.field,
        )
    )
    folder = writable_folder(options.out)
    values = made.as_json()
    save_json(values, folder / "results.json")
    return _with_report(values, write_optics(folder, made), *made.words())


def identify_study(options: argparse.Namespace, command: list[str]) -> Told:
    """The paper's least-squares scan of every path, with the integer rival and Table 1."""
    plan = _scan(options)
    study = _study(options)
    folder = options.out or Path("reports") / study.name
    posterior = load_posterior(options.posterior, study) if options.posterior else None
    scannable(study, plan)
    writable_folder(folder)
    found = identify(study, plan=plan, quiet=options.quiet, jobs=options.jobs or cores())
    rows = step_table(study, found, posterior=posterior)
    values = results(study, found, plan) | {"step_metrics": [row.as_json() for row in rows]}
    save_json(values, folder / "identify.json")
    return _with_report(values, write_identification(folder, study, found, rows), *words_of(values))


def claims(options: argparse.Namespace, command: list[str]) -> Told:
    """Every claim of the paper with its computed verdict."""
    audited = load_audit(options.audit) if options.audit else None
    compared = load_comparison(options.compare) if options.compare else None
    folder = writable_folder(options.out)
    if compared is None and not options.no_compare:
        jobs = options.jobs or cores()
        compared = virtual_comparison(folder / "comparison", jobs=jobs, quiet=options.quiet)
    judged = judge(evidence=Evidence(audited, compared))
    values = {"claims": [each.as_json() for each in judged]}
    save_json(values, folder / "results.json")
    words = [f"{'claim':6}{'verdict':14}{'number':>12}  unit"]
    for each in judged:
        number = "-" if each.verdict.number is None else f"{each.verdict.number:.4g}"
        words.append(f"{each.claim.id:6}{each.verdict.kind.value:14}{number:>12}  {each.verdict.unit}")
    return _with_report(values, write_claims(folder, judged), *words)


def _with_report(values: dict[str, Any], path: Path, *words: str) -> Told:
    return Told(values | {"report": str(path)}, (*words, f"report: {path}"))


def _study(options: argparse.Namespace) -> Study:
    """The study asked for, with the seed of the command line if one is given."""
    study = load_study(options.source, held_out=options.held_out)
    return study if options.seed is None else study.with_seed(options.seed)


def _scan(options: argparse.Namespace) -> Scan:
    """The scan of the command line; an order without an interval is scanned up to the one above it."""
    given: Sequence[Sequence[float] | None] = (options.alpha, options.beta, options.gamma)
    orders: list[Interval] = []
    for ends in given:
        top = orders[-1].high if orders else 2.0
        # an interval that ends below the smallest scanned order leaves nothing below it but itself
        orders.append(Interval(*ends) if ends else Interval(min(options.order_step, top), top))
    assert len(orders) == MOST_TERMS
    return Scan(
        orders=tuple(orders) if any(given) else None,
        order_step=options.order_step,
        delay=Interval(*options.delay) if options.delay else None,
        whole_blocks=not options.any_delay,
        stiffness=tuple(options.stiffness),
        rounds=options.rounds,
    )
