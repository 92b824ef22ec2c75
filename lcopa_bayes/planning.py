"""What a design leaves in a run folder: its numbers, its page and the drive to play."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from lcopa_bayes.design.confirmation import REPLICAS, confirmed
from lcopa_bayes.design.design import DRAWS, design
from lcopa_bayes.design.template import write_template
from lcopa_bayes.design.told import as_json
from lcopa_bayes.files import writable_folder
from lcopa_bayes.fit import Fit
from lcopa_bayes.report.designpage import NAME as DESIGN_PAGE
from lcopa_bayes.report.designpage import write_design
from lcopa_bayes.runfolder import save_json

__all__ = ["DESIGN_PAGE", "plan_next"]
_QUICK = 4
"""How many times fewer draws a quick design takes."""


def plan_next(
    fit: Fit, folder: Path, *, jobs: int = 1, quick: bool = False, **options: Any
) -> tuple[dict[str, Any], list[str]]:
    """Write `design.json`, `design.html` and `design/next.csv`; returns the values and lines for a reader.

    `options` are those of `design.design`; when `quick`, fewer draws and replicas are taken. Without a
    winner there is no `next.csv`.
    """
    made = design(fit, draws=DRAWS // _QUICK if quick else DRAWS, **options)
    trials = confirmed(made, jobs=jobs, replicas=REPLICAS // 2 if quick else REPLICAS)
    values = as_json(made) | trials | {"template": None}
    if values["winner"] is not None:
        path = writable_folder(folder / "design") / "next.csv"
        write_template(fit.study, made.limits, made.winner.candidate.command, made.time, path)
        values["template"] = f"{path.parent.name}/{path.name}"
    save_json(values, folder / "design.json")
    write_design(folder)
    words = [f"{'parameter':16}{'best drive':28}{'relative sd':>12}  bench time for 10 %"]
    for row in values["parameters"]:
        spread = row["relative_sd"] and row["relative_sd"]["value"]
        number = "-" if spread is None else f"{spread:.3g}"
        told = row["reason"] or row["time_words"]
        words.append(f"{row['name']:16}{row['best_drive'] or '-':28}{number:>12}  {told}")
    return values, [*words, values["verdict"], values["confirmed"]["sentence"]]
