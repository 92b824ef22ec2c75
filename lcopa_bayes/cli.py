"""The command line: `lcopa-bayes VERB STUDY_OR_CSVS [options]`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import lcopa_bayes
from lcopa_bayes.core.errors import InputError
from lcopa_bayes.optics.cell import Field
from lcopa_bayes.paper.intervals import Scan
from lcopa_bayes.verbs import papers, questions, runs
from lcopa_bayes.verbs.outcome import Told

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
    except FloatingPointError as error:  # a prior that reaches where the model cannot be computed
        print(f"error: {error}; narrow the priors that allow these values", file=sys.stderr)
        return USAGE_ERROR
    except KeyboardInterrupt:
        print("interrupted; the same command with --resume goes on where it stopped", file=sys.stderr)
        return INTERRUPTED
    if options.json:
        print(json.dumps(told.values, allow_nan=False))
    elif not options.quiet:
        print("\n".join(told.words))
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="lcopa-bayes",
        description=lcopa_bayes.__doc__,
    )
    verb = parser.add_subparsers(required=True, metavar="VERB")
    told = argparse.ArgumentParser(add_help=False)
    told.add_argument("--quiet", action="store_true", help="no progress, no closing words")
    told.add_argument("--json", action="store_true", help="print one JSON object and nothing else")

    def add(name: str, does: Callable[..., Told], parents: list[Any], text: str) -> Any:
        made = verb.add_parser(name, parents=[*parents, told], help=text, description=text)
        made.set_defaults(verb=does)
        return made

    study, sampled = _study_options(), _sampler_options()
    checked = _check_options()
    add("run", runs.run, [study, sampled, checked], "all stages the study names, then the report")
    add("fit", runs.fit_study, [study, sampled, checked], "posterior, bands and step metrics, with a report")
    add(
        "audit", questions.audit_study, [study, sampled], "what the records determine, parameter by parameter"
    )
    _design_options(add("design", questions.design_study, [study, sampled], "which drive to measure next"))
    compared = add(
        "compare",
        questions.compare_study,
        [study, sampled],
        "integer against fractional orders, number of terms",
    )
    compared.add_argument(
        "--candidates", type=Path, metavar="FILE", help="[compare] and [[candidates]] (TOML)"
    )
    compared.add_argument("--pick", nargs="+", metavar="NAME", help="candidates by name")
    looped = add(
        "loop", questions.loop_study, [study, sampled], "what the model lacks: residual, effect, errors after"
    )
    looped.add_argument(
        "--as-stated", action="store_true", help="keep the number of viscous terms the study states"
    )
    _calibrate_options(
        add(
            "calibrate",
            runs.calibrate_study,
            [_study_options("reports/calibration/<study>"), sampled],
            "simulation-based calibration and coverage of the whole inference of a study, with a report",
        )
    )
    _identify_options(
        add("identify", papers.identify_study, [study], "the paper's own least-squares scan, with a report")
    )
    _optics_options(
        add("optics", papers.optics, [], "far field, director, the chain from volts to angle, with figures")
    )
    claims = add("claims", papers.claims, [], "the paper's claims, each with a computed verdict")
    claims.add_argument("--out", type=Path, default=Path("reports/claims"), help="folder for the page")
    claims.add_argument(
        "--audit",
        type=Path,
        nargs="+",
        metavar="RUNFOLDER",
        help="run folders of audits, to decide I1-I6 (default: those of the bundled studies)",
    )
    claims.add_argument(
        "--compare",
        type=Path,
        metavar="RUNFOLDER",
        help="run folder of a comparison, to decide M1, M2, M4 and I5 (default: of a bundled study)",
    )
    predicted = add("predict", runs.predict, [], "bands for a drive nobody has measured, by a finished fit")
    predicted.add_argument("folder", type=Path, metavar="RUNFOLDER", help="run folder of a fit")
    predicted.add_argument(
        "drive", type=Path, help="record file without responses; with responses it is scored too"
    )
    predicted.add_argument("--out", type=Path, help="folder (default: RUNFOLDER/predict/<drive>)")
    predicted.add_argument(
        "--offset",
        choices=["fitted", "zero"],
        default="fitted",
        help="add the offset of the fit records to the response, or none",
    )
    report = add("report", runs.report, [], "render the report of a run folder again")
    report.add_argument("folder", type=Path, help="run folder")
    bench = add("simulate", runs.simulate, [], "measure a campaign file on the virtual bench")
    bench.add_argument("campaign", type=Path, help="campaign file (TOML)")
    bench.add_argument("--out", type=Path, required=True, help="folder for the records and their study")
    bench.add_argument("--seed", type=int, help="seed in place of the campaign's")
    bench.add_argument("--overwrite", action="store_true", help="replace records that are there")
    return parser


def _study_options(out: str = "reports/<study>") -> argparse.ArgumentParser:
    study = argparse.ArgumentParser(add_help=False)
    study.add_argument("source", nargs="+", type=Path, help="study folder or file, or record files")
    study.add_argument("--held-out", nargs="+", type=Path, default=[], help="records not to fit")
    study.add_argument("--out", type=Path, help=f"run folder (default: {out})")
    study.add_argument("--seed", type=int, help="seed in place of the study's")
    study.add_argument("--jobs", type=int, default=None, help="processes (default: all cores)")
    return study


def _sampler_options() -> argparse.ArgumentParser:
    sampled = argparse.ArgumentParser(add_help=False)
    sampled.add_argument("--resume", action="store_true", help="go on with an interrupted run")
    sampled.add_argument("--quick", action="store_true", help="a quarter of the steps")
    return sampled


def _check_options() -> argparse.ArgumentParser:
    checked = argparse.ArgumentParser(add_help=False)
    checked.add_argument(
        "--cross-check",
        action="store_true",
        help="sample by a second, independent method too; where they disagree, grades are lowered",
    )
    return checked


def _design_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--time", type=float, help="bench time [time unit of the study] (default: 40 spans)")
    parser.add_argument("--repeats", type=int, default=1, help="records to take (default: 1)")
    parser.add_argument(
        "--amplitude", type=float, help="largest deviation from rest [drive unit] (default: the records')"
    )
    parser.add_argument("--refresh", type=float, help="time between drive changes (default: 10 samples)")
    parser.add_argument("--with-prior", action="store_true", help="count the priors as information")


def _calibrate_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--replicas", type=int, default=100, help="simulated studies (default: 100)")
    parser.add_argument(
        "--around",
        type=Path,
        metavar="RUNFOLDER",
        help="draw truths from the posterior of a fit, not the prior",
    )
    parser.add_argument(
        "--truth",
        nargs="+",
        default=[],
        metavar="NAME=VALUE",
        help="true values in every replica, or LOW:HIGH to draw them from, in the units of the study",
    )
    parser.add_argument(
        "--engine",
        choices=["importance", "sampling"],
        default="importance",
        help="importance sampling, the ensembles where it does not hold; or always the ensembles",
    )
    parser.add_argument(
        "--dask", metavar="ADDRESS", help="scheduler of a Dask cluster that does the replicas"
    )


def _identify_options(parser: argparse.ArgumentParser) -> None:
    plan = Scan()
    for name, which in (("alpha", "largest"), ("beta", "second"), ("gamma", "third")):
        parser.add_argument(
            f"--{name}",
            nargs=2,
            type=float,
            metavar=("LOW", "HIGH"),
            help=f"scanned interval of the {which} order, within (0, 2]",
        )
    parser.add_argument(
        "--delay",
        nargs=2,
        type=float,
        metavar=("LOW", "HIGH"),
        help="scanned interval of the delay [time unit of the study]",
    )
    parser.add_argument("--order-step", type=float, default=plan.order_step, help="spacing of scanned orders")
    parser.add_argument("--any-delay", action="store_true", help="refine the delay below a whole block")
    parser.add_argument(
        "--stiffness",
        nargs="+",
        type=float,
        default=plan.stiffness,
        help="values of k; the first is reported",
    )
    parser.add_argument("--rounds", type=int, default=plan.rounds, help="refinements around the best")
    parser.add_argument("--posterior", type=Path, help="run folder of a fit, to show its intervals beside")


def _optics_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, default=Path("reports/optics"), help="folder for the page")
    parser.add_argument("--elements", type=int, help="elements along an axis (default: the paper's 32)")
    parser.add_argument("--pitch", type=float, help="distance of elements [m] (default: 1.2 wavelengths)")
    parser.add_argument("--wavelength", type=float, help="wavelength [m] (default: the paper's 1064e-9)")
    parser.add_argument(
        "--fill-factor", type=float, default=1.0, help="element width over pitch, for the lobe table"
    )
    parser.add_argument(
        "--targets", nargs="+", type=float, metavar="DEG", help="steering angles [deg] (default: Fig. 3)"
    )
    parser.add_argument(
        "--voltages", nargs="+", type=float, metavar="V", default=[1.0, 2.0, 3.0, 4.0, 5.0], help="[V]"
    )
    parser.add_argument("--pretilt", type=float, default=0.0, help="tilt at the plates [rad]")
    parser.add_argument(
        "--field",
        choices=[field.value for field in Field],
        default=Field.UNIFORM.value,
        help="how the voltage spreads over the cell",
    )


if __name__ == "__main__":
    sys.exit(main())
