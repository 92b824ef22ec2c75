"""How the command line is read: wrong words name the nearest right one, and JSON is answered in JSON.

The options of every verb of the command line.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NoReturn, TypeAlias, final

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

    @property
    def options(self) -> list[str]:
        """Long forms of its options."""
        return re.findall(r"--[\w-]+", self.format_help().partition("example: ")[0])

    def error(self, message: str) -> NoReturn:
        """Print what is wrong with the command line and exit."""
        verb = next((one for one in self.given if not one.startswith("-")), "")
        unknown = re.search(r"unrecognized arguments: (--?\S+)", message)
        if verb and self.verbs and verb not in self.verbs:
            message = f"{verb!r} is not a verb{nearest(verb, self.verbs)}"
        elif unknown and verb in self.verbs:
            options = {name: parser.options for name, parser in self.verbs.items()}
            elsewhere = any(unknown[1] in own for own in options.values())  # no misspelt word
            example = str(self.verbs[verb].epilog).partition("\n")[0]
            meant = f"; {example}" if elsewhere else nearest(unknown[1], options[verb])
            message = f"{unknown[1]} is not an option of {verb}{meant}"
        elif not verb and self.verbs and self.given:
            message = f"{self.given[0]} is not an option{nearest(self.given[0], self.options)}"
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
Option: TypeAlias = tuple[str, Mapping[str, Any]]
"""Name and, as argparse takes them, what it means."""


@final
@dataclass(frozen=True)
class Usage:
    """What a verb does, a command line of it without the verb, and its options."""

    text: str
    example: str
    options: tuple[Option, ...]


def _option(name: str, words: str, **how: Any) -> Option:
    return name, {"help": words, **how}


def _flag(name: str, words: str) -> Option:
    return _option(name, words, action="store_true")


def _path(name: str, words: str, **how: Any) -> Option:
    return _option(name, words, type=Path, **how)


def _number(name: str, words: str, **how: Any) -> Option:
    """A number, or several; what is not given has the default of the calculation."""
    return _option(name, words, **{"type": float, "default": argparse.SUPPRESS} | how)


def _choice(name: str, words: str, *known: str, **how: Any) -> Option:
    """One of several words, the first by default."""
    return _option(name, words, choices=known, default=known[0], **how)


def _whole(least: int) -> Callable[[str], int]:
    """Reads a whole number of at least `least`."""

    def read(text: str) -> int:
        if not (text.removeprefix("-").isdecimal() and int(text) >= least):
            raise argparse.ArgumentTypeError(f"must be a whole number of at least {least}; got {text!r}")
        return int(text)

    return read


_ENDS: Mapping[str, Any] = {"nargs": 2, "metavar": ("LOW", "HIGH"), "default": None}
_COLUMN = "by header or number, perhaps with a new name: 'heater [%%]=Column B'"
_QUICK = _flag("--quick", "a quarter of the steps or replicas: to see that it runs")
_JOBS = _option("--jobs", "processes, at most one per core (default: all cores)", type=_whole(1))
_DASK = _option("--dask", "scheduler of a Dask cluster that does the work in their place", metavar="ADDRESS")
_OVERWRITE = _flag("--overwrite", "replace files that are there")


def _about(out: str = "runs/<study>") -> tuple[Option, ...]:
    """Options of verbs about a study."""
    return (
        _path("source", "study folder or file, record files, or the run folder of a fit", nargs="+"),
        _path("--held-out", "records not to fit", nargs="+", default=[]),
        _path("--out", f"run folder (default: {out})"),
        _option("--seed", "seed in place of the study's", type=_whole(0)),
    )


def _parallel(out: str = "runs/<study>") -> tuple[Option, ...]:
    """Options of verbs about a study that use several processes."""
    return (*_about(out), _JOBS, _DASK)


def _sampled(out: str = "runs/<study>") -> tuple[Option, ...]:
    """Options of verbs that sample."""
    return (*_parallel(out), _flag("--resume", "go on with an interrupted run"), _QUICK)


_FIT = (
    *_sampled(),
    _flag(
        "--cross-check", "sample by a second, independent method too; where they disagree, grades are lowered"
    ),
)
USAGES: Mapping[str, Usage] = {
    "new": Usage(
        "records and a study from spreadsheets and loggers' tables",
        "oven step1.xlsx step2.csv --drive 'Heater [%]'",
        (
            _path("folder", "folder for the records and their study"),
            _path("files", "tables: text of any separator, or workbooks", nargs="+"),
            _path("--held-out", "tables not to fit", nargs="+", default=[]),
            _option("--time", "the time column", default="", metavar="COLUMN"),
            _option("--drive", f"drives, {_COLUMN}", nargs="+", default=[], dest="drives", metavar="COLUMN"),
            _option(
                "--response",
                f"responses, {_COLUMN}",
                nargs="+",
                default=[],
                dest="responses",
                metavar="COLUMN",
            ),
            _option("--time-unit", "unit of a numeric time column", default=""),
            _option("--decimal", "decimal sign, . or ,", default=""),
            _option("--time-format", "format of time stamps, as '%%d.%%m.%%Y %%H:%%M:%%S'", default=""),
            _flag("--drive-until", "the drive of a row acted until it, not from it on"),
            _option("--sheet", "sheet of a workbook"),
            _option(
                "--average",
                "samples whose mean is written in their place (default: 1)",
                type=_whole(1),
                default=1,
                metavar="N",
            ),
            _OVERWRITE,
        ),
    ),
    "check": Usage("what was understood of a study, without fitting it", "oven", _about()),
    "look": Usage("least squares and residual within seconds, before sampling", "oven", _about()),
    "run": Usage("all stages the study names, then the report", "studies/paper-step", _FIT),
    "fit": Usage(
        "posterior, bands and step metrics, with a report", "on.csv off.csv --held-out both.csv", _FIT
    ),
    "audit": Usage("what the records determine, parameter by parameter", "runs/paper-step", _sampled()),
    "design": Usage(
        "which drive to measure next",
        "runs/paper-step --time 1000",
        (
            *_sampled(),
            _number(
                "--time",
                "bench time [time unit of the study] (default: 40 spans)",
                dest="bench_time",
                default=None,
            ),
            _option("--repeats", "records to take (default: 1)", type=int, default=1),
            _number(
                "--amplitude",
                "largest deviation from rest [drive unit] (default: the records')",
                default=None,
            ),
            _number("--refresh", "time between drive changes (default: 10 samples)", default=None),
            _flag("--with-prior", "count the priors as information"),
        ),
    ),
    "compare": Usage(
        "integer against fractional orders, number of terms",
        "studies/paper-step --pick fractional-2 second-order",
        (
            *_sampled(),
            _path(
                "--candidates",
                "[compare] and [[candidates]] (TOML)",
                default=(),
                dest="described",
                metavar="FILE",
            ),
            _option("--pick", "candidates by name", nargs="+", dest="candidates", metavar="NAME"),
        ),
    ),
    "loop": Usage(
        "what the model lacks: residual, effect, errors after",
        "studies/undeclared --quick",
        (*_parallel(), _QUICK, _flag("--as-stated", "keep the number of viscous terms the study states")),
    ),
    "calibrate": Usage(
        "simulation-based calibration and coverage of the whole inference of a study, with a report",
        "studies/paper-step-x --replicas 20 --quick",
        (
            *_sampled("runs/calibration/<study>"),
            _option("--replicas", "simulated studies (default: 100)", type=int, default=100),
            _path("--around", "draw truths from the posterior of a fit, not the prior", metavar="RUNFOLDER"),
            _option(
                "--truth",
                "true values in every replica, or LOW:HIGH to draw them from, in the units of the study",
                nargs="+",
                default=[],
                metavar="NAME=VALUE",
            ),
            _choice(
                "--engine",
                "importance sampling, the ensembles where it does not hold; or always the ensembles",
                "importance",
                "sampling",
            ),
        ),
    ),
    "fleet": Usage(
        "one verb over the studies of many devices, and the population they come from",
        "devices --jobs 2",
        (
            _path("folder", "folder with a study of each device"),
            _choice("--verb", "what is done with every device", "fit", "audit", "loop", "compare", dest="of"),
            _path("--out", "run folder (default: runs/<folder>); devices finished there are kept"),
            _JOBS,
            _DASK,
            _flag("--resume", "go on within devices that were interrupted"),
            _QUICK,
        ),
    ),
    "predict": Usage(
        "bands for a drive nobody has measured, by a finished fit",
        "runs/paper-step drive.csv",
        (
            _path("folder", "run folder of a fit", metavar="RUNFOLDER"),
            _path("drive", "record file without responses; with responses it is scored too"),
            _path("--out", "folder (default: RUNFOLDER/predict/<drive>)"),
            _choice(
                "--offset", "add the offset of the fit records to the response, or none", "fitted", "zero"
            ),
        ),
    ),
    "identify": Usage(
        "the paper's own least-squares scan, with a report",
        "studies/paper-step-x",
        (
            *_parallel(),
            _number("--alpha", "scanned interval of the largest order, within (0, 2]", **_ENDS),
            _number("--beta", "scanned interval of the second order, within (0, 2]", **_ENDS),
            _number("--gamma", "scanned interval of the third order, within (0, 2]", **_ENDS),
            _number("--delay", "scanned interval of the delay [time unit of the study]", **_ENDS),
            _number("--order-step", "spacing of scanned orders (default: 0.1)"),
            _flag("--any-delay", "refine the delay below a whole block"),
            _number("--stiffness", "values of k; the first is reported", nargs="+"),
            _number("--rounds", "refinements around the best (default: 4)", type=int),
            _path("--posterior", "run folder of a fit, to show its intervals beside"),
        ),
    ),
    "optics": Usage(
        "far field, director, chain from volts to angle, with figures",
        "--targets 1 2 3",
        (
            _path("--out", "folder for the page", default=RUNS / "optics"),
            _number("--elements", "elements along an axis (default: the paper's 32)", type=int),
            _number("--pitch", "distance of elements [m] (default: 1.2 wavelengths)"),
            _number("--wavelength", "wavelength [m] (default: the paper's 1064e-9)"),
            _number("--fill-factor", "element width over pitch, for the lobe table (default: 1)"),
            _number(
                "--targets",
                "steering angles [deg] (default: Fig. 3)",
                dest="targets_deg",
                nargs="+",
                metavar="DEG",
            ),
            _number("--voltages", "[V] (default: 1 to 5)", nargs="+", metavar="V"),
            _number("--pretilt", "tilt at the plates [rad] (default: 0)"),
            _choice("--field", "how the voltage spreads over the cell", "uniform", "self-consistent"),
        ),
    ),
    "claims": Usage(
        "the paper's claims, each with a computed verdict",
        "--out runs/claims",
        (
            _path("--out", "folder for the page", default=RUNS / "claims"),
            _path(
                "--audit",
                "run folders of audits, to decide I1-I6 (default: those of the bundled studies)",
                nargs="+",
                metavar="RUNFOLDER",
            ),
            _path(
                "--compare",
                "run folder of a comparison, to decide M1, M2, M4 and I5 (default: of a bundled study)",
                metavar="RUNFOLDER",
            ),
        ),
    ),
    "explain": Usage(
        "what a term means, with an example from the last fit",
        "R-hat",
        (_option("term", "a word of a page or a message", nargs="+"),),
    ),
    "report": Usage(
        "render the pages of a run folder again", "runs/paper-step", (_path("folder", "run folder"),)
    ),
    "simulate": Usage(
        "measure a campaign file on the virtual bench",
        "studies/paper-step/campaign.toml --out bench",
        (
            _path("campaign", "campaign file (TOML)"),
            _path("--out", "folder for the records and their study", required=True),
            _option("--seed", "seed in place of the campaign's", type=_whole(0)),
            _OVERWRITE,
        ),
    ),
}
"""Every verb by name, in the order of the help."""
