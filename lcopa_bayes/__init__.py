"""Posteriors, identifiability and model criticism for coupled fractional-order systems with delay.

import lcopa_bayes as lb

study = lb.load_study("studies/paper-step")
fit = lb.fit(study, jobs=2)
fit.summary()

`docs/python.md` is a session with its output, which the tests run.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lcopa_bayes import plot as plot
    from lcopa_bayes.core.errors import InputError as InputError
    from lcopa_bayes.core.parallel import on_cluster as on_cluster
    from lcopa_bayes.data.drive import Drive as Drive
    from lcopa_bayes.data.record import Record as Record
    from lcopa_bayes.data.record import load_record as load_record
    from lcopa_bayes.data.study import Study as Study
    from lcopa_bayes.data.studyfile import load_study as load_study
    from lcopa_bayes.results.fit import Fit as Fit
    from lcopa_bayes.results.frequency import FrequencyResponse as FrequencyResponse
    from lcopa_bayes.results.newdrive import Prediction as Prediction
    from lcopa_bayes.results.savedfit import SavedFit as SavedFit
    from lcopa_bayes.verbs.audit import AuditResult as AuditResult
    from lcopa_bayes.verbs.audit import audit as audit
    from lcopa_bayes.verbs.calibrate import CalibrationResult as CalibrationResult
    from lcopa_bayes.verbs.calibrate import calibrate as calibrate
    from lcopa_bayes.verbs.check import CheckResult as CheckResult
    from lcopa_bayes.verbs.check import check as check
    from lcopa_bayes.verbs.compare import Comparison as Comparison
    from lcopa_bayes.verbs.compare import compare as compare
    from lcopa_bayes.verbs.design import DesignResult as DesignResult
    from lcopa_bayes.verbs.design import design as design
    from lcopa_bayes.verbs.explain import explain as explain
    from lcopa_bayes.verbs.fit import fit as fit
    from lcopa_bayes.verbs.fleet import FleetResult as FleetResult
    from lcopa_bayes.verbs.fleet import fleet as fleet
    from lcopa_bayes.verbs.look import LookResult as LookResult
    from lcopa_bayes.verbs.look import look as look
    from lcopa_bayes.verbs.loop import LoopResult as LoopResult
    from lcopa_bayes.verbs.loop import loop as loop
    from lcopa_bayes.verbs.new import NewStudy as NewStudy
    from lcopa_bayes.verbs.new import new as new
    from lcopa_bayes.verbs.simulate import Simulation as Simulation
    from lcopa_bayes.verbs.simulate import simulate as simulate
    from lcopa_bayes.verbs.stored import load_result as load_result

_PLACES = {
    "core.errors": ("InputError",),
    "core.parallel": ("on_cluster",),
    "data.drive": ("Drive",),
    "data.record": ("Record", "load_record"),
    "data.study": ("Study",),
    "data.studyfile": ("load_study",),
    "results.fit": ("Fit",),
    "results.frequency": ("FrequencyResponse",),
    "results.newdrive": ("Prediction",),
    "results.savedfit": ("SavedFit",),
    "verbs.audit": ("AuditResult", "audit"),
    "verbs.calibrate": ("CalibrationResult", "calibrate"),
    "verbs.check": ("CheckResult", "check"),
    "verbs.compare": ("Comparison", "compare"),
    "verbs.design": ("DesignResult", "design"),
    "verbs.explain": ("explain",),
    "verbs.fit": ("fit",),
    "verbs.fleet": ("FleetResult", "fleet"),
    "verbs.look": ("LookResult", "look"),
    "verbs.loop": ("LoopResult", "loop"),
    "verbs.new": ("NewStudy", "new"),
    "verbs.simulate": ("Simulation", "simulate"),
    "verbs.stored": ("load_result",),
}
"""Modules of the public names; a module is imported when one of its names is first used."""
_OF = {name: place for place, names in _PLACES.items() for name in names}
__all__ = sorted({*_OF, "plot"})


def __getattr__(name: str) -> Any:
    if name == "plot":
        return import_module(f"{__name__}.plot")
    if name not in _OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
