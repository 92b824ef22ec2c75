"""One verb of the command line, with CPU time by stage and plants simulated; runs in a process of its own.

    python probe.py RESULT.json counted|plain VERB ...

Modules are watched as they are loaded, so that a verb loads no more than it needs. Time counts for the
innermost stage that is under way, and within it either for the likelihood (densities, their expansions,
responses) or for the rest. Where a watched name is not there, the result says so and the rest is measured.
`plain` measures peak memory alone.
"""

from __future__ import annotations

import builtins
import importlib
import json
import resource
import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from functools import wraps
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any

LIKELIHOOD = {
    "lcopa_bayes.model.forward": ("ForwardModel.unit_responses", "ForwardModel.unit_slopes"),
    "lcopa_bayes.inference.simulation": ("Simulation.__call__", "Simulation.responses"),
    "lcopa_bayes.inference.posterior": (
        "Posterior.log_likelihood",
        "Posterior.pointwise",
        "Posterior.complete",
    ),
    "lcopa_bayes.inference.conditional": ("Conditional.expanded",),
    "lcopa_bayes.inference.leastsquares": ("LeastSquares.misfit", "LeastSquares.residual"),
    "lcopa_bayes.effectsearch.extendedmodel": ("ExtendedModel.predict", "ExtendedModel.tangents"),
}
"""Methods whose time is that of the likelihood, by module."""
PLANTS: dict[str, Callable[..., int]] = {
    "ForwardModel.unit_responses": lambda model, dynamics, *more, **wanted: dynamics.batch,
    "ForwardModel.unit_slopes": lambda model, dynamics, *more, **wanted: dynamics.batch,
    "Simulation.__call__": lambda simulation, values: len(values),
    "ExtendedModel.predict": lambda model, x: 1,
    "ExtendedModel.tangents": lambda model, x: 1,
}
"""How many plants one call simulates. Where one of these calls another, the outer one counts."""
SLOPES = ("ForwardModel.unit_slopes", "ExtendedModel.tangents")
"""Those that give derivatives too."""
STAGES = {
    "lcopa_bayes.verbs.sources": {"load_study": "reading"},
    "lcopa_bayes.results.fit": {
        "problem_of": "reading",
        "obstacles": "reading",
        "optima_of": "least squares",
        "resolved_optima": "refinement check",
        "weighted_run": "search and draws",
        "sample": "search and draws",
        "draws_of": "diagnostics",
        "evidence_of": "evidence",
        "discretisation": "refinement check",
        "study_bands": "predictive bands",
        "step_curves": "diagnostics",
        "step_metrics": "diagnostics",
        "residuals": "diagnostics",
        "limitations": "diagnostics",
        "sensitivity": "diagnostics",
        "Fit.save": "saving",
    },
    "lcopa_bayes.effectsearch.explained": {
        "weighted_run": "search and draws",
        "by_search": "search and draws",
    },
    "lcopa_bayes.results.predictive": {"frequency_response": "diagnostics"},
    "lcopa_bayes.results.discretisation": {"find_optima": "least squares"},
    "lcopa_bayes.sampling.marginal": {"Search._improved": "search", "Search._walked": "walkers"},
    "lcopa_bayes.report.pages": {"write_page_of": "page"},
}
"""Stage of each function, by the module that calls it."""
SAMPLING = ("search and draws", "search", "walkers")
"""Stages that sample."""


class Probe:
    """Time by stage, in and outside the likelihood, and plants simulated."""

    def __init__(self, clock: Callable[[], float] = time.process_time) -> None:
        self.seconds: Counter[tuple[str, bool]] = Counter()
        self.plants: Counter[str] = Counter()
        self.missing: list[str] = []
        self._clock, self._last = clock, 0.0
        self._stages, self._depth, self._simulating = ["start"], 0, 0
        self._pass_on()

    def _pass_on(self) -> None:
        """Give the time since the last event to what was under way."""
        now = self._clock()
        self.seconds[self._stages[-1], self._depth > 0] += now - self._last
        self._last = now

    def stage(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted for a stage."""

        @wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            self._pass_on()
            self._stages.append(name)
            depth, self._depth = self._depth, 0
            try:
                return function(*args, **options)
            finally:
                self._pass_on()
                self._stages.pop()
                self._depth = depth

        return call

    def likelihood(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, its time counted for the likelihood, and the plants that it simulates."""
        count = PLANTS.get(name)

        @wraps(function)
        def call(*args: Any, **options: Any) -> Any:
            self._pass_on()
            self._depth += 1
            if count is not None:
                if not self._simulating:
                    self.plants["slopes" if name in SLOPES else "values"] += count(*args, **options)
                self._simulating += 1
            try:
                return function(*args, **options)
            finally:
                self._pass_on()
                self._depth -= 1
                self._simulating -= count is not None

        return call

    def watch(self, module: Any) -> None:
        """Replace what is listed of a module."""
        for name in LIKELIHOOD.get(module.__name__, ()):
            self._replace(module, name, lambda own, name=name: self.likelihood(name, own))
        for name, stage in STAGES.get(module.__name__, {}).items():
            self._replace(module, name, lambda own, stage=stage: self.stage(stage, own))

    def _replace(self, module: Any, name: str, change: Callable[[Any], Any]) -> None:
        *owners, last = name.split(".")
        owner = module
        for each in owners:
            owner = getattr(owner, each, None)
        if owner is None or not hasattr(owner, last):
            self.missing.append(f"{module.__name__}: {name}")
        else:
            setattr(owner, last, change(getattr(owner, last)))

    def install(self) -> None:
        """Watch modules as they are loaded, and count the time of loading for the stage `import`."""
        probe, watched = self, {*LIKELIHOOD, *STAGES}

        class Watching(MetaPathFinder):
            def find_spec(self, name: str, path: Any, target: Any = None) -> Any:
                if name not in watched:
                    return None
                others = (
                    finder.find_spec(name, path, target) for finder in sys.meta_path if finder is not self
                )
                spec = next(spec for spec in others if spec is not None)
                load = spec.loader.exec_module

                def loaded(module: Any) -> None:
                    load(module)
                    probe.watch(module)

                spec.loader.exec_module = loaded
                return spec

        sys.meta_path.insert(0, Watching())
        plain, loading = builtins.__import__, self.stage("import", builtins.__import__)

        def outermost(name: str, *more: Any, **options: Any) -> Any:
            there = name in sys.modules or self._stages[-1] == "import"
            return (plain if there else loading)(name, *more, **options)

        builtins.__import__ = outermost
        importlib.import_module = self.stage("import", importlib.import_module)

    def results(self) -> dict[str, Any]:
        """Seconds by stage, [outside the likelihood, in it], and plants."""
        self._pass_on()
        stages: dict[str, list[float]] = {}
        for (stage, inside), spent in self.seconds.items():
            stages.setdefault(stage, [0.0, 0.0])[inside] += spent
        return {
            "stages": stages,
            "likelihood_s": sum(inside for _, inside in stages.values()),
            "process_s": sum(map(sum, stages.values())),
            "plants": sum(self.plants.values()),
            "plants_with_slopes": self.plants["slopes"],
            "missing": self.missing,
        }


def main(arguments: Sequence[str]) -> int:
    place, kind, *verb = arguments
    probe = Probe() if kind == "counted" else None
    if probe is not None:
        probe.install()
    from lcopa_bayes.cli import main as command

    code = command(verb)
    results = {} if probe is None else probe.results()
    Path(place).write_text(json.dumps(results | {"peak_MB": peak_memory()}), encoding="utf-8")
    return code


def peak_memory() -> float:
    """Most resident memory of this process, or of one that it started if that took more [MB]."""
    status = Path("/proc/self/status")
    workers = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    if not status.is_file():
        return max(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, workers) / 1024
    # unlike the usage, this does not count what the process was before it became this program
    own = next(line for line in status.read_text().splitlines() if line.startswith("VmHWM"))
    return max(int(own.split()[1]), workers) / 1024


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
