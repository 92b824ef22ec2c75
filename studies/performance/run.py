"""Speed of the package: whole verbs, forward responses, samplers, each against what else does the same.

    python studies/performance/run.py [--quick] [--json] [--out FOLDER] [--parts forward samplers verbs]
        [--verbs VERB ...] [--studies STUDY ...] [--jobs N] [--seconds S] [--machine WORDS]
        [--before RESULTS.json] [--against CHECKOUT]

The full study takes many hours and wants a quiet machine; `--quick` takes five minutes at most and shows
orders of magnitude. Libraries that are compared come with `pip install '.[performance]'`; one that is missing
leaves a gap with its name. `verbs.py`, `forward.py` and `samplers.py` say what is measured and how.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import forward
import page
import plots
import samplers
import verbs
from comparison import plain
from threadpoolctl import threadpool_limits

from lcopa_bayes.core.parallel import cores

PARTS = ("forward", "samplers", "verbs")
QUICK = 290.0
"""Wall time of a quick run [s]."""
SAMPLERS = 0.4
"""Share of it that samplers may take."""


def measured(options: argparse.Namespace, folder: Path) -> dict[str, Any]:
    """Results of all parts, as they are stored."""
    seconds = options.seconds or (QUICK if options.quick else float("inf"))
    end = time.perf_counter() + seconds
    libraries = {"numpy": version("numpy"), "scipy": version("scipy")} | samplers.versions()
    named = ", ".join(f"{name} {number}" for name, number in libraries.items())
    out: dict[str, Any] = {
        "quick": options.quick,
        "machine": options.machine or f"{platform.machine()}, {cores()} processors.",
        "software": f"Python {platform.python_version()}, {named}.",
    }
    if "forward" in options.parts:
        with threadpool_limits(1):
            out["forward"] = forward.measured(quick=options.quick)
    if "samplers" in options.parts:
        share = SAMPLERS if "verbs" in options.parts else 1.0
        out["settings"] = samplers.SETTINGS
        out["samplers"] = samplers.measured(quick=options.quick, seconds=share * seconds)
    if "verbs" in options.parts:
        remaining = end - time.perf_counter()
        out["verbs"] = verbs.measured(
            folder,
            quick=options.quick,
            jobs=options.jobs,
            seconds=remaining,
            against=options.against,
            only=(options.verbs, options.studies),
        )
    stored: dict[str, Any] = plain(out)
    return stored


def write(results: dict[str, Any], folder: Path, before: dict[str, Any] | None) -> None:
    """Report, figures and numbers."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "results.json").write_text(json.dumps(results, indent=1, allow_nan=False) + "\n")
    (folder / "report.md").write_text(page.page(results, before), encoding="utf-8")
    for name in PARTS:
        if name in results:
            getattr(plots, name)(results[name], folder / f"{name}.svg")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="five minutes; orders of magnitude only")
    parser.add_argument("--json", action="store_true", help="print the results as one JSON object")
    parser.add_argument("--out", type=Path, help="folder for report, figures and results.json")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument("--verbs", nargs="+", default=(), help="of the part `verbs`, only these")
    parser.add_argument("--studies", nargs="+", default=(), help="of the part `verbs`, only these")
    parser.add_argument("--seconds", type=float, help=f"wall time (default of a quick run: {QUICK:g})")
    parser.add_argument("--machine", help="what it runs on and what else runs there, in words")
    parser.add_argument("--before", type=Path, help="results.json of an earlier run, to compare verbs with")
    parser.add_argument("--against", type=Path, help="another checkout; verbs of both run in turn")
    parser.add_argument("--jobs", type=int, default=1, help="processes of a verb; plants are counted with 1")
    options = parser.parse_args()
    before = json.loads(options.before.read_text()) if options.before else None
    with tempfile.TemporaryDirectory() as folder:
        results = measured(options, Path(folder))
    if options.out:
        write(results, options.out, before)
    if options.json:
        print(json.dumps(results, allow_nan=False))
    else:
        print(page.page(results, before))


if __name__ == "__main__":
    sys.exit(main())
