"""The command line: `lcopa-bayes VERB ...`; every verb is a public function and its options."""

from __future__ import annotations

import argparse
import gc
import json
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from errno import ENAMETOOLONG
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import lcopa_bayes

# verbs are imported when they run, so that help and refusals come at once
from lcopa_bayes.core.errors import InputError, refusal_of
from lcopa_bayes.verbs.commandline import PROGRAM, RUNS, USAGES, CommandParser, Version, refused

if TYPE_CHECKING:
    from lcopa_bayes.paper.intervals import Scan
    from lcopa_bayes.results.result import Result
    from lcopa_bayes.verbs.sources import FitLike

_CODES = (
    "exit codes: 0 done, 1 unforeseen error, 2 the input cannot be used (nothing is written), 130 interrupted"
)
_COLLECTED = (100_000, 20, 100)
"""Thresholds of the garbage collector: modules and figures are hundreds of thousands of objects that stay,
and to look through them again and again takes a sixth of the time of imports and pages."""
FAILED = 1
"""Exit code after an error that is no fault of the input."""
INTERRUPTED = 130
"""Exit code after an interrupt from the keyboard."""
PUBLISHED = Path("reports")
"""Where a checkout of the package keeps the audits and comparisons that its claims rest on."""
BUNDLED = ("paper-step-x", "paper-step")
"""Studies of records like the paper's, whose run folders hold evidence on its claims."""


_PAGE = "report.html"
"""The page of a fit."""
_MODULES = {"run": "fit", "identify": "papers"}
"""Modules of verbs that have another name."""


Derived = Callable[[argparse.Namespace, Any], object]
"""An argument of a public function from the options and the study or fit."""


Outcome = tuple[Mapping[str, Any], str]
"""What a verb prints: values with ``--json``, a text for a reader."""


def keep_one_thread() -> None:
    """Let this process and those it starts keep linear algebra to one thread, unless the environment states
    otherwise: work is shared out to processes, whose threads would wait for each other."""
    for library in ("OMP", "OPENBLAS", "MKL"):
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one verb; returns the exit code."""
    keep_one_thread()
    given = list(sys.argv[1:] if arguments is None else arguments)
    options = _parser(given).parse_args(given)
    gc.set_threshold(*_COLLECTED)
    try:
        values, text = _outcome(options, [PROGRAM, *given])
        if options.json or not options.quiet:
            _print(json.dumps(values, allow_nan=False) if options.json else text)
    except InputError as error:
        return refused(error.problems, as_json=options.json)
    except FloatingPointError as error:  # a prior that reaches where the model cannot be computed
        return refused([f"{error}; narrow the priors that allow these values"], as_json=options.json)
    except BrokenPipeError:  # who reads the output has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except KeyboardInterrupt:
        resume = "; the same command with --resume goes on where it stopped" * hasattr(options, "resume")
        print(f"interrupted{resume}", file=sys.stderr)
        return INTERRUPTED
    except Exception as error:
        if isinstance(error, OSError) and error.errno == ENAMETOOLONG:
            return refused([str(refusal_of(error))], as_json=options.json)
        said = refusal_of(error) or f"unforeseen {type(error).__name__}: {error}"
        refused([f"{said}; {_details([PROGRAM, *given])}"], as_json=options.json)
        return FAILED
    return 0


def _print(text: str) -> None:
    """Print at once; InputError where there is no room for it."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        raise
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for what is printed at the end
        raise InputError(f"the output cannot be written ({error.strerror})") from None


def _details(command: Sequence[str]) -> str:
    """Where the command, the versions and the trace of the exception at hand are written, in words."""
    from importlib.metadata import version

    kept = "what was finished before is kept"
    try:
        handle, path = tempfile.mkstemp(prefix=f"{PROGRAM}-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8") as file:
            file.write(f"{' '.join(command)}\n{sys.version}\n{PROGRAM} {version(PROGRAM)}\n\n")
            traceback.print_exc(file=file)
    except OSError:
        return kept
    return f"details are in {path}, and {kept}"


def _outcome(options: argparse.Namespace, command: Sequence[str]) -> Outcome:
    if hasattr(options, "jobs"):  # libraries take seconds to load: workers load them meanwhile
        from lcopa_bayes.core.parallel import imported_ahead

        if not (options.quiet or options.json):
            print(f"{options.verb}: loading", file=sys.stderr, flush=True)
        if options.jobs != 1:
            imported_ahead(_module(options.verb), "lcopa_bayes.report.pages")
    from lcopa_bayes.core.files import commanded, trusting
    from lcopa_bayes.core.parallel import on_cluster

    with (
        commanded(command),
        trusting(options.trust),
        on_cluster(getattr(options, "dask", None)) as options.processes,
    ):
        return VERBS[options.verb](options)


def _parser(given: Sequence[str]) -> argparse.ArgumentParser:
    """All verbs with their options."""
    raw = argparse.RawDescriptionHelpFormatter
    about = str(lcopa_bayes.__doc__).partition("\n")[0]
    parser = CommandParser(prog=PROGRAM, description=about, epilog=_CODES, formatter_class=raw)
    parser.given = given
    if given[:1] == ["--print-completion"]:
        import shtab

        shtab.add_argument_to(parser, ["--print-completion"])
    parser.add_argument("--version", action=Version, nargs=0, help="print the version")
    verbs = parser.add_subparsers(required=True, metavar="VERB", dest="verb", parser_class=CommandParser)
    for name, usage in USAGES.items():
        example = f"example: {PROGRAM} {name} {usage.example}"
        own = verbs.add_parser(
            name,
            help=usage.text,
            description=usage.text,
            epilog=f"{example}\n\n{_CODES}",
            formatter_class=raw,
        )
        own.given = given
        parser.verbs = {**parser.verbs, name: own}
        own.add_argument("--quiet", action="store_true", help="no progress, no closing words")
        own.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
        trusted = "let studies run effects of their own and read files outside their folder"
        own.add_argument("--trust", action="store_true", help=trusted)
        for option, how in usage.options:
            own.add_argument(option, **how)
    return parser


def _module(verb: str) -> str:
    """Where the public function of a verb is."""
    return f"lcopa_bayes.verbs.{_MODULES.get(verb, verb)}"


def _reported(result: Result, folder: Path, jobs: int = 1, page: Path | None = None) -> Outcome:
    """What a verb prints of a result, with its page, written where it is not there."""
    page = page or result.report(folder, jobs=jobs)
    return result.to_json() | {"report": str(page)}, f"{result}\n\nreport: {page}"


def _source(options: argparse.Namespace) -> FitLike:
    """The study asked for, with the seed of the command line if one is given, or a finished fit; several of
    these for `compare`."""
    from lcopa_bayes.verbs.sources import finished, several, study_of

    if options.verb == "compare" and several(options.source):
        if options.held_out or options.seed is not None:
            raise InputError("--held-out and --seed change one study; state them in each of several")
        return several(options.source)  # type: ignore[return-value]
    fitted = finished(options.source)
    if fitted is None:
        study = study_of(options.source, held_out=options.held_out)
        return study if options.seed is None else study.with_seed(options.seed)
    if options.held_out or options.seed is not None:
        raise InputError(
            f"{options.source[0]}: is the run folder of a finished fit, which --held-out and --seed do not "
            "change; score a record with `predict`, or name the study to fit it again"
        )
    return fitted


def _folder(options: argparse.Namespace, source: FitLike, *inside: str) -> Path:
    """The run folder: as asked for, that of the finished fit, else by the name of the study."""
    from lcopa_bayes.results.savedfit import SavedFit
    from lcopa_bayes.verbs.sources import several, study_of

    if options.out is not None:
        return Path(options.out)
    if isinstance(source, SavedFit):
        return source.folder
    first = (several(source) or (source,))[0]
    return RUNS.joinpath(*inside, study_of(first).name)


def _jobs(options: argparse.Namespace) -> int:
    """Processes to use: as asked for, but no more than there are processors; with a cluster what that is
    worth."""
    from lcopa_bayes.core.parallel import cores

    return options.processes if getattr(options, "dask", None) else min(options.jobs or cores(), cores())


def _on_study(
    verb: str, *keys: str, page: str = "", inside: str = "", anew: bool = False, **derived: Derived
) -> Callable[[argparse.Namespace], Outcome]:
    """What runs a public function of a study or a finished fit.

    `keys` are options that it takes by their names, `derived` gives others from the options and the source,
    `page` is the file of the page that it draws itself; `anew` calls it with the study alone, and the run
    folder is then one `inside` another by the name of the study.
    """

    def perform(options: argparse.Namespace) -> Outcome:
        from lcopa_bayes.verbs.sources import study_of

        jobs = _jobs(options) if hasattr(options, "jobs") else 1
        source = _source(options)
        source = study_of(source) if anew else source
        function = getattr(import_module(_module(verb)), verb)
        given = _given(options, *keys) | {key: of(options, source) for key, of in derived.items()}
        given |= {"jobs": jobs} if hasattr(options, "jobs") else {}
        given |= {"page": True} if page else {}
        folder = _folder(options, source, *filter(None, [inside]))
        result = function(source, folder=folder, **given)
        return _reported(result, folder, jobs, folder / page if page else None)

    return perform


def _rival(options: argparse.Namespace, study: Any) -> bool:
    return "rival" in study.stages


def _truth(options: argparse.Namespace, study: Any) -> object:
    from lcopa_bayes.calibration.truths import stated_values

    return stated_values(options.truth)


def _given(options: argparse.Namespace, *keys: str) -> dict[str, Any]:
    """Those of these options that are given, by the names under which a public function takes them."""
    return {key: getattr(options, key) for key in keys if hasattr(options, key)}


def _new(options: argparse.Namespace) -> Outcome:
    keys = ("held_out", "time", "drives", "responses", "time_unit", "decimal", "time_format", "drive_until")
    result = lcopa_bayes.new(
        options.folder,
        options.files,
        overwrite=options.overwrite,
        **_given(options, *keys, "sheet", "average"),
    )
    after = f"lcopa-bayes check {options.folder}"
    return result.to_json() | {"folder": str(options.folder)}, f"{result}\n\nnext: {after}"


def _explain(options: argparse.Namespace) -> Outcome:
    term = " ".join(options.term)
    text = lcopa_bayes.explain(term, runs=RUNS)
    return {"term": term, "text": text}, text


def _fleet(options: argparse.Namespace) -> Outcome:
    jobs, keys = _jobs(options), _SAMPLING
    folder = options.out or RUNS / options.folder.resolve().name
    doing = {"verb": options.of, "folder": folder, "jobs": jobs}
    return _reported(lcopa_bayes.fleet(options.folder, **doing, **_given(options, *keys)), folder, jobs)


def _predict(options: argparse.Namespace) -> Outcome:
    from lcopa_bayes.results.savedfit import load_fit

    result = load_fit(options.folder).predict(options.drive, offset=options.offset)
    return _reported(result, options.out or options.folder / "predict" / options.drive.stem)


def _optics(options: argparse.Namespace) -> Outcome:
    from lcopa_bayes.paper.staticoptics import OpticsPlan
    from lcopa_bayes.verbs.papers import optics

    plan = OpticsPlan(**_given(options, *(one.name for one in fields(OpticsPlan))))
    return _reported(optics(plan), options.out)


def _claims(options: argparse.Namespace) -> Outcome:
    from lcopa_bayes.verbs.papers import claims

    audits = options.audit if options.audit is not None else _bundled("audit.json")
    comparison = options.compare or next(reversed(_bundled("compare.json")), None)
    return _reported(claims(audits=audits, comparison=comparison), options.out)


def _bundled(file: str) -> list[Path]:
    """Run folders of the bundled studies that hold a file, one's own before the published ones."""
    places = ([RUNS / name, PUBLISHED / name] for name in BUNDLED)
    matches = (next((place for place in each if (place / file).is_file()), None) for each in places)
    return [place for place in matches if place is not None]


def _report(options: argparse.Namespace) -> Outcome:
    from lcopa_bayes.results.runfolder import origins
    from lcopa_bayes.verbs.stored import load_result

    verbs = list(origins(options.folder))
    results = [load_result(options.folder, verb) for verb in verbs] or [load_result(options.folder)]
    pages = [str(result.report(options.folder)) for result in results]
    return {"pages": pages, "report": pages[0]}, "\n".join(f"report: {page}" for page in pages)


def _simulate(options: argparse.Namespace) -> Outcome:
    from lcopa_bayes.verbs.simulate import simulate

    simulation = simulate(options.campaign, seed=options.seed)
    paths = simulation.save(options.out, overwrite=options.overwrite)
    verdict = f"{len(simulation.records)} records in {options.out}"
    return {"verdict": verdict, "files": [str(path) for path in paths]}, verdict


def _scan(options: argparse.Namespace, study: Any) -> Scan:
    """The scan of the command line; an order without an interval is scanned up to the one above it."""
    from lcopa_bayes.paper.intervals import Interval, Scan

    stated = _given(options, "order_step", "stiffness", "rounds")
    least = stated.get("order_step", Scan.order_step)
    given: Sequence[Sequence[float] | None] = (options.alpha, options.beta, options.gamma)
    orders: list[Interval] = []
    for ends in given:
        top = orders[-1].high if orders else 2.0
        # an interval that ends below the smallest scanned order leaves nothing below it but itself
        orders.append(Interval(*ends) if ends else Interval(min(least, top), top))
    return Scan(
        orders=tuple(orders) if any(given) else None,
        delay=Interval(*options.delay) if options.delay else None,
        whole_blocks=not options.any_delay,
        **stated | ({"stiffness": tuple(stated["stiffness"])} if "stiffness" in stated else {}),
    )


_SAMPLING = ("resume", "quick", "quiet")
"""Options of every verb that samples."""
VERBS: Mapping[str, Callable[[argparse.Namespace], Outcome]] = {
    "new": _new,
    "check": _on_study("check", anew=True),
    "look": _on_study("look", anew=True),
    "run": _on_study("fit", *_SAMPLING, "cross_check", page=_PAGE, anew=True, rival=_rival),
    "fit": _on_study("fit", *_SAMPLING, "cross_check", page=_PAGE, anew=True),
    "audit": _on_study("audit", *_SAMPLING),
    "design": _on_study("design", *_SAMPLING, "bench_time", "repeats", "amplitude", "refresh", "with_prior"),
    "compare": _on_study("compare", *_SAMPLING, "candidates", "described"),
    "loop": _on_study("loop", "quick", "quiet", "as_stated"),
    "calibrate": _on_study(
        "calibrate",
        *(*_SAMPLING, "replicas", "around", "engine"),
        inside="calibration",
        anew=True,
        truth=_truth,
    ),
    "fleet": _fleet,
    "predict": _predict,
    "identify": _on_study("identify", "posterior", "quiet", scan=_scan),
    "optics": _optics,
    "claims": _claims,
    "explain": _explain,
    "report": _report,
    "simulate": _simulate,
}
"""What performs each verb."""


if __name__ == "__main__":
    sys.exit(main())
