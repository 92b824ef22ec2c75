"""The command line: `lcopa-bayes VERB STUDY_OR_CSVS [options]`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import lcopa_bayes
from lcopa_bayes.bench.campaign import write_campaign
from lcopa_bayes.bench.plan import load_plan
from lcopa_bayes.cores import cores
from lcopa_bayes.fit import fit
from lcopa_bayes.problems import InputError
from lcopa_bayes.report import write_report
from lcopa_bayes.runfolder import save_fit
from lcopa_bayes.study import Study
from lcopa_bayes.studyfile import load_study

USAGE_ERROR = 2
"""Exit code for input that cannot be used."""
INTERRUPTED = 130
"""Exit code after an interrupt from the keyboard."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser().parse_args(given)
    try:
        told = options.verb(options, ["lcopa-bayes", *given])
    except InputError as error:
        for problem in error.problems:
            print(f"error: {problem}", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("interrupted; the same command with --resume goes on where it stopped", file=sys.stderr)
        return INTERRUPTED
    if options.json:
        print(json.dumps(told, allow_nan=False))
    elif not options.quiet:
        print(told.get("verdict", ""))
        if "report" in told:
            print(f"report: {told['report']}")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lcopa-bayes",
        description=lcopa_bayes.__doc__,
    )
    verbs = parser.add_subparsers(required=True, metavar="VERB")
    study = argparse.ArgumentParser(add_help=False)
    study.add_argument("source", nargs="+", type=Path, help="study folder or file, or record files")
    study.add_argument("--held-out", nargs="+", type=Path, default=[], help="records not to fit")
    study.add_argument("--out", type=Path, help="run folder (default: reports/<study>)")
    study.add_argument("--seed", type=int, help="seed in place of the study's")
    study.add_argument("--jobs", type=int, default=None, help="processes (default: all cores)")
    study.add_argument("--resume", action="store_true", help="go on with an interrupted run")
    study.add_argument("--quick", action="store_true", help="a quarter of the steps")
    told = argparse.ArgumentParser(add_help=False)
    told.add_argument("--quiet", action="store_true", help="no progress, no closing words")
    told.add_argument("--json", action="store_true", help="print one JSON object and nothing else")

    def add(name: str, verb: Callable[..., dict[str, Any]], parents: list[Any], text: str) -> Any:
        made = verbs.add_parser(name, parents=[*parents, told], help=text, description=text)
        made.set_defaults(verb=verb)
        return made

    add("run", _run, [study], "all stages the study names, then the report")
    add("fit", _fit, [study], "posterior, bands and step metrics, with a report")
    report = add("report", _report, [], "render the report of a run folder again")
    report.add_argument("folder", type=Path, help="run folder")
    bench = add("simulate", _simulate, [], "measure a campaign file on the virtual bench")
    bench.add_argument("campaign", type=Path, help="campaign file (TOML)")
    bench.add_argument("--out", type=Path, required=True, help="folder for the records and their study")
    bench.add_argument("--seed", type=int, help="seed in place of the campaign's")
    bench.add_argument("--overwrite", action="store_true", help="replace records that are there")
    return parser


def _study(options: argparse.Namespace) -> Study:
    """The study asked for, with the seed of the command line if one is given."""
    study = load_study(options.source, held_out=options.held_out)
    return study if options.seed is None else study.with_seed(options.seed)


def _run(options: argparse.Namespace, command: list[str]) -> dict[str, Any]:
    """Stages run in the order of their dependence; the fit comes first and feeds the others."""
    return _fit(options, command)


def _fit(options: argparse.Namespace, command: list[str]) -> dict[str, Any]:
    study = _study(options)
    folder = options.out or Path("reports") / study.name
    made = fit(
        study,
        jobs=options.jobs or cores(),
        folder=folder,
        resume=options.resume,
        quick=options.quick,
        quiet=options.quiet,
    )
    told = save_fit(made, folder, command)
    return told | {"report": str(write_report(folder))}


def _report(options: argparse.Namespace, command: list[str]) -> dict[str, Any]:
    return {"report": str(write_report(options.folder))}


def _simulate(options: argparse.Namespace, command: list[str]) -> dict[str, Any]:
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
    return {"verdict": f"{len(records)} records in {options.out}", "files": [str(path) for path in paths]}


if __name__ == "__main__":
    sys.exit(main())
