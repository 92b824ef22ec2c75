"""What the draws rest on: evidence, a second method, settings, versions and inputs."""

from __future__ import annotations

import shlex
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from lcopa_bayes.report.formatting import NONE, figures
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.sections.parameters import density_axis, marginals
from lcopa_bayes.report.theme import BAND, HELD_OUT, Drawing, paged

_PER_FIGURE = 12
"""Parameters on one figure."""
_WORDS = {
    "batches": "independent batches of draws",
    "draws": "draws of the proposal",
    "pareto_k": "Pareto k of the weights [-]",
    "weights_ess": "effective sample size of the weights [draws]",
    "steps": "steps taken",
    "most_steps": "steps allowed",
    "thin": "thinning [steps per draw]",
    "acceptance": "mean acceptance [-]",
    "smallest_ess": "smallest effective sample size [draws]",
    "largest_rhat": "largest R-hat [-]",
    "target_ess": "effective sample size wanted [draws]",
}


def drawn(run: SavedRun) -> Drawings:
    """Marginals by both methods where a second one was run; the sampler's summary and the command."""
    checked: tuple[Drawing, ...] = ()
    if run.results["cross_check"] is not None:
        names = list(dict.fromkeys(run.tables["cross_check_density"]["name"]))
        caption = (
            "Marginals by both methods, over 99.8 % of their draws. Where the axis is logarithmic, densities "
            "are per natural logarithm of the parameter."
        )
        checked = paged("cross_check", names, _PER_FIGURE, lambda part: marginals(run, part, _panel), caption)
    sampler = {
        _WORDS.get(key, key.replace("_", " ")): _cell(key, v) for key, v in run.results["sampler"].items()
    }
    command = shlex.join(str(word) for word in run.provenance["command"])
    return {"cross_check": checked, "sampler": sampler, "command": command}


def _panel(panel: Axes, run: SavedRun, name: str) -> None:
    whole = run.tables["cross_check_density"]
    own = whole[whole["name"] == name]
    edges = np.append(own["left"].to_numpy(), own["right"].to_numpy()[-1])
    panel.stairs(own["ensembles"].to_numpy(), edges, fill=True, color=BAND, alpha=0.5, label="ensembles")
    panel.stairs(own["nested"].to_numpy(), edges, color=HELD_OUT, linewidth=1.1, label="nested sampling")
    density_axis(panel, log=bool(own["log_scale"].any()))


def _cell(key: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if key == "largest_rhat" else figures(value)
    return NONE if value is None else str(value)
