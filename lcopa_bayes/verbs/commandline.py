"""How the command line is read: wrong words name the nearest right one, and JSON is answered in JSON.

The options of every verb of the command line.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import NoReturn, final

from lcopa_bayes.core.errors import nearest

PROGRAM = "lcopa-bayes"
"""Name of the command and of the distribution."""
USAGE_ERROR = 2
"""Exit code for input that cannot be used."""


def refused(problems: Sequence[str], *, as_json: bool) -> int:
    """Print what is wrong with the input; the exit code."""
    if as_json:
        print(json.dumps({"errors": list(problems)}))
    else:
        for problem in problems:
            print(f"error: {problem}", file=sys.stderr)
    return USAGE_ERROR


@final
class CommandParser(argparse.ArgumentParser):
    """A parser that names the nearest known word, and complains in JSON where JSON was asked for."""

    given: Sequence[str] = ()
    """The command line."""
    verbs: Mapping[str, CommandParser] = MappingProxyType({})
    """Parsers of the verbs, where this one knows them."""

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the command line and exit."""
        verb = next((one for one in self.given if not one.startswith("-")), "")
        unknown = re.search(r"unrecognized arguments: (--?\S+)", message)
        if verb and self.verbs and verb not in self.verbs:
            message = f"{verb!r} is not a verb{nearest(verb, self.verbs)}"
        elif unknown and verb in self.verbs:
            options = re.findall(r"--[\w-]+", self.verbs[verb].format_help())
            message = f"{unknown[1]} is not an option of {verb}{nearest(unknown[1], options)}"
        elif "--json" not in self.given:
            self.print_usage(sys.stderr)
        raise SystemExit(refused([message], as_json="--json" in self.given))


@final
class Version(argparse.Action):
    """Prints the version, which is looked up when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print it and exit."""
        from importlib.metadata import version

        print(f"{PROGRAM} {version(PROGRAM)}")
        parser.exit()


RUNS = Path("runs")
"""Where run folders go unless `--out` names another."""
EXAMPLES: Mapping[str, str] = {
    "new": "oven step1.xlsx step2.csv --drive 'Heater [%]'",
    "check": "oven",
    "look": "oven",
    "run": "studies/paper-step",
    "fit": "on.csv off.csv --held-out both.csv",
    "audit": "runs/paper-step",
    "design": "runs/paper-step --time 1000",
    "compare": "studies/paper-step --pick fractional-2 second-order",
    "loop": "studies/undeclared --quick",
    "calibrate": "studies/paper-step-x --replicas 20 --quick",
    "predict": "runs/paper-step drive.csv",
    "identify": "studies/paper-step-x",
    "optics": "--targets 1 2 3",
    "claims": "--out runs/claims",
    "explain": "R-hat",
    "report": "runs/paper-step",
    "simulate": "studies/paper-step/campaign.toml --out bench",
}
"""A command line of every verb, without the verb."""


def _whole(least: int) -> Callable[[str], int]:
    """Reads a whole number of at least `least`."""

    def read(text: str) -> int:
        if not (text.removeprefix("-").isdecimal() and int(text) >= least):
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}; got {text!r}")
        return int(text)

    return read


def study(parser: argparse.ArgumentParser, out: str = "runs/<study>") -> None:
    """Of verbs about a study."""
    parser.add_argument(
        "source", nargs="+", type=Path, help="study folder or file, record files, or the run folder of a fit"
    )
    parser.add_argument("--held-out", nargs="+", type=Path, default=[], help="records not to fit")
    parser.add_argument("--out", type=Path, help=f"run folder (default: {out})")
    parser.add_argument("--seed", type=_whole(0), help="seed in place of the study's")


def parallel(parser: argparse.ArgumentParser, out: str = "runs/<study>") -> None:
    """Of verbs about a study that use several processes."""
    study(parser, out)
    parser.add_argument("--jobs", type=_whole(1), help="processes, at most one per core (default: all cores)")


def sampled(parser: argparse.ArgumentParser, out: str = "runs/<study>") -> None:
    """Of verbs that sample."""
    parallel(parser, out)
    parser.add_argument("--resume", action="store_true", help="go on with an interrupted run")
    _quick(parser)


def _quick(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--quick", action="store_true", help="a quarter of the steps or replicas: to see that it runs"
    )


def fit(parser: argparse.ArgumentParser) -> None:
    """Of `fit` and `run`."""
    sampled(parser)
    parser.add_argument(
        "--cross-check",
        action="store_true",
        help="sample by a second, independent method too; where they disagree, grades are lowered",
    )


def compare(parser: argparse.ArgumentParser) -> None:
    """Of `compare`."""
    sampled(parser)
    parser.add_argument(
        "--candidates",
        type=Path,
        default=(),
        dest="described",
        metavar="FILE",
        help="[compare] and [[candidates]] (TOML)",
    )
    parser.add_argument("--pick", nargs="+", dest="candidates", metavar="NAME", help="candidates by name")


def loop(parser: argparse.ArgumentParser) -> None:
    """Of `loop`."""
    parallel(parser)
    _quick(parser)
    parser.add_argument(
        "--as-stated", action="store_true", help="keep the number of viscous terms the study states"
    )


def new(parser: argparse.ArgumentParser) -> None:
    """Of `new`."""
    parser.add_argument("folder", type=Path, help="folder for the records and their study")
    parser.add_argument("files", nargs="+", type=Path, help="tables: text of any separator, or workbooks")
    parser.add_argument("--held-out", nargs="+", type=Path, default=[], help="tables not to fit")
    column = "by header or number, perhaps with a new name: 'heater [%%]=Column B'"
    parser.add_argument("--time", default="", metavar="COLUMN", help="the time column")
    parser.add_argument(
        "--drive", nargs="+", default=[], dest="drives", metavar="COLUMN", help=f"drives, {column}"
    )
    parser.add_argument(
        "--response", nargs="+", default=[], dest="responses", metavar="COLUMN", help=f"responses, {column}"
    )
    parser.add_argument("--time-unit", default="", help="unit of a numeric time column")
    parser.add_argument("--decimal", default="", help="decimal sign, . or ,")
    parser.add_argument(
        "--time-format", default="", help="format of time stamps, as '%%d.%%m.%%Y %%H:%%M:%%S'"
    )
    parser.add_argument("--sheet", help="sheet of a workbook")
    parser.add_argument("--overwrite", action="store_true", help="replace files that are there")


def explain(parser: argparse.ArgumentParser) -> None:
    """Of `explain`."""
    parser.add_argument("term", nargs="+", help="a word of a page or a message")


def claims(parser: argparse.ArgumentParser) -> None:
    """Of `claims`."""
    parser.add_argument("--out", type=Path, default=RUNS / "claims", help="folder for the page")
    parser.add_argument(
        "--audit",
        type=Path,
        nargs="+",
        metavar="RUNFOLDER",
        help="run folders of audits, to decide I1-I6 (default: those of the bundled studies)",
    )
    parser.add_argument(
        "--compare",
        type=Path,
        metavar="RUNFOLDER",
        help="run folder of a comparison, to decide M1, M2, M4 and I5 (default: of a bundled study)",
    )


def predict(parser: argparse.ArgumentParser) -> None:
    """Of `predict`."""
    parser.add_argument("folder", type=Path, metavar="RUNFOLDER", help="run folder of a fit")
    parser.add_argument(
        "drive", type=Path, help="record file without responses; with responses it is scored too"
    )
    parser.add_argument("--out", type=Path, help="folder (default: RUNFOLDER/predict/<drive>)")
    parser.add_argument(
        "--offset",
        choices=["fitted", "zero"],
        default="fitted",
        help="add the offset of the fit records to the response, or none",
    )


def report(parser: argparse.ArgumentParser) -> None:
    """Of `report`."""
    parser.add_argument("folder", type=Path, help="run folder")


def simulate(parser: argparse.ArgumentParser) -> None:
    """Of `simulate`."""
    parser.add_argument("campaign", type=Path, help="campaign file (TOML)")
    parser.add_argument("--out", type=Path, required=True, help="folder for the records and their study")
    parser.add_argument("--seed", type=_whole(0), help="seed in place of the campaign's")
    parser.add_argument("--overwrite", action="store_true", help="replace records that are there")


def design(parser: argparse.ArgumentParser) -> None:
    """Of `design`."""
    sampled(parser)
    parser.add_argument(
        "--time",
        type=float,
        dest="bench_time",
        help="bench time [time unit of the study] (default: 40 spans)",
    )
    parser.add_argument("--repeats", type=int, default=1, help="records to take (default: 1)")
    parser.add_argument(
        "--amplitude", type=float, help="largest deviation from rest [drive unit] (default: the records')"
    )
    parser.add_argument("--refresh", type=float, help="time between drive changes (default: 10 samples)")
    parser.add_argument("--with-prior", action="store_true", help="count the priors as information")


def calibrate(parser: argparse.ArgumentParser) -> None:
    """Of `calibrate`."""
    sampled(parser, "runs/calibration/<study>")
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


def identify(parser: argparse.ArgumentParser) -> None:
    """Of `identify`."""
    from lcopa_bayes.paper.intervals import Scan

    plan = Scan()
    parallel(parser)
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


def optics(parser: argparse.ArgumentParser) -> None:
    """Of `optics`."""
    from lcopa_bayes.optics.director import Field
    from lcopa_bayes.paper.staticoptics import OpticsPlan

    plan = OpticsPlan()
    parser.add_argument("--out", type=Path, default=RUNS / "optics", help="folder for the page")
    parser.add_argument(
        "--elements", type=int, default=plan.elements, help="elements along an axis (default: the paper's 32)"
    )
    parser.add_argument("--pitch", type=float, help="distance of elements [m] (default: 1.2 wavelengths)")
    parser.add_argument(
        "--wavelength",
        type=float,
        default=plan.wavelength,
        help="wavelength [m] (default: the paper's 1064e-9)",
    )
    parser.add_argument(
        "--fill-factor",
        type=float,
        default=plan.fill_factor,
        help="element width over pitch, for the lobe table",
    )
    parser.add_argument(
        "--targets",
        dest="targets_deg",
        nargs="+",
        type=float,
        metavar="DEG",
        default=plan.targets_deg,
        help="steering angles [deg] (default: Fig. 3)",
    )
    parser.add_argument("--voltages", nargs="+", type=float, metavar="V", default=plan.voltages, help="[V]")
    parser.add_argument("--pretilt", type=float, default=plan.pretilt, help="tilt at the plates [rad]")
    parser.add_argument(
        "--field",
        choices=[field.value for field in Field],
        default=plan.field,
        help="how the voltage spreads over the cell",
    )
