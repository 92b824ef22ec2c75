"""Settings of the sampler, versions and inputs of the run."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Column, Section, Table

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


def section(run: SavedRun) -> Section:
    """Sampler summary, command, seed, versions and hashes of the inputs."""
    provenance = run.provenance
    origin = [
        ("command", shlex.join(str(word) for word in provenance["command"])),
        ("seed", str(provenance["seed"])),
        ("python", str(provenance["python"])),
        *((name, str(version)) for name, version in provenance["versions"].items()),
    ]
    hashes = tuple((str(name), str(value)) for name, value in provenance["inputs_sha256"].items())
    return Section(
        "Sampler and provenance",
        tables=(
            _pairs("sampler", run.results["sampler"]),
            Table((Column("origin"), Column("value", "code")), tuple(origin)),
            Table((Column("input"), Column("SHA-256", "code")), hashes),
        ),
    )


def _pairs(title: str, values: Mapping[str, Any]) -> Table:
    rows = tuple((_WORDS.get(key, key.replace("_", " ")), _cell(key, value)) for key, value in values.items())
    return Table((Column(title), Column("value", "number")), rows)


def _cell(key: str, value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if key == "largest_rhat" else figures(value)
    return "–" if value is None else str(value)  # noqa: RUF001
