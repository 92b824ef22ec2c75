"""Verbs about the paper and its device: optics, identify, claims."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from lcopa_bayes.core.files import save_json, writable_folder
from lcopa_bayes.paper.auditclaims import load_audit
from lcopa_bayes.paper.claims import judge
from lcopa_bayes.paper.comparisonclaims import load_comparison
from lcopa_bayes.paper.identify import identify, results, scannable, words_of
from lcopa_bayes.paper.intervals import MOST_TERMS, Interval, Scan
from lcopa_bayes.paper.opticsplan import OpticsPlan
from lcopa_bayes.paper.staticoptics import static_optics
from lcopa_bayes.paper.steptable import load_posterior, step_table
from lcopa_bayes.paper.verdict import Evidence
from lcopa_bayes.report.paperpages import write_claims, write_identification, write_optics
from lcopa_bayes.verbs.outcome import Told, place_of, study_of, with_report

BUNDLED = ("paper-step-x", "paper-step")
"""Studies of records like the paper's, whose run folders hold evidence on its claims."""


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
    return with_report(values, write_optics(folder, made), *made.words())


def identify_study(options: argparse.Namespace, command: list[str]) -> Told:
    """The paper's least-squares scan of every path, with the integer rival and Table 1."""
    plan = _scan(options)
    study = study_of(options)
    folder, jobs = place_of(options, study)
    posterior = load_posterior(options.posterior, study) if options.posterior else None
    scannable(study, plan)
    writable_folder(folder)
    found = identify(study, plan=plan, quiet=options.quiet, jobs=jobs)
    rows = step_table(study, found, posterior=posterior)
    values = results(study, found, plan) | {"step_metrics": [row.as_json() for row in rows]}
    save_json(values, folder / "identify.json")
    return with_report(values, write_identification(folder, study, found, rows), *words_of(values))


def claims(options: argparse.Namespace, command: list[str]) -> Told:
    """Every claim of the paper with its computed verdict."""
    audits = _run_folders(options.audit, "audit.json")
    compared = _run_folders([options.compare] if options.compare else None, "compare.json")
    judged = judge(
        evidence=Evidence(
            tuple(load_audit(folder) for folder in audits),
            next((load_comparison(folder) for folder in reversed(compared)), None),
        )
    )
    folder = writable_folder(options.out)
    values = {"claims": [each.as_json() for each in judged]}
    save_json(values, folder / "results.json")
    words = [f"{'claim':6}{'verdict':14}{'number':>12}  unit"]
    for each in judged:
        number = "-" if each.verdict.number is None else f"{each.verdict.number:.4g}"
        words.append(f"{each.claim.id:6}{each.verdict.kind.value:14}{number:>12}  {each.verdict.unit}")
    return with_report(values, write_claims(folder, judged), *words)


def _run_folders(given: Sequence[Path] | None, name: str) -> Sequence[Path]:
    """Run folders that were given; else those of the bundled studies where such a file is."""
    bundled = (Path("reports") / study for study in BUNDLED)
    return given if given is not None else [folder for folder in bundled if (folder / name).is_file()]


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
