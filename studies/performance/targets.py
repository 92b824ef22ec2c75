"""How long the jobs take that users wait for, beside what is wanted of them.

    taskset -c 0,1 python studies/performance/targets.py [--machine WORDS] [--out FOLDER]

Each job runs alone by the command line with two processes and default settings, from a fresh process to its
page. Jobs on measured records need them (`LCOPA_BAYES_DATA`); where they are not there, the rows are missing.
"""

from __future__ import annotations

import argparse
import json
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any

from verbs import Cell, Workshop, sources

from lcopa_bayes.core.files import write_text
from lcopa_bayes.core.parallel import cores

JOBS = 2
WANTED: tuple[tuple[str, str, float, str], ...] = (
    ("fit", "lcd_panel_p_from000_to153", 5, ""),
    ("fit", "hair_dryer", 5, ""),
    ("fit", "heating_system", 5, ""),
    ("fit", "tclab_2x2", 20, ""),
    ("fit", "paper-step-x", 30, ""),
    ("fit", "paper-step", 75, ""),
    ("fit", "rich", 120, ""),
    ("audit", "lcd_panel_p_from000_to153", 20, "after its fit"),
    ("audit", "paper-step-x", 20, "after its fit"),
    ("compare", "hair_dryer", 3, "fits"),
    ("compare", "paper-step-x", 3, "fits"),
    ("loop", "hair_dryer", 60, ""),
    ("loop", "correlated", 60, ""),
    ("loop", "rich", 60, ""),
    ("design", "paper-step-x", 30, "after its fit"),
)
"""Verb, study, what is wanted [s], or the multiple of the time of the study's fit that it is."""


def measured(folder: Path) -> list[dict[str, Any]]:
    """A row for each job."""
    known, shop = {one.name: one for one in sources()}, Workshop(folder, jobs=JOBS)
    for name in dict.fromkeys(study for _, study, _, _ in WANTED):
        if name in known and known[name].folder is None:
            shop.measured(Cell("simulate", known[name]), 600, 600)
    rows: list[dict[str, Any]] = []
    for verb, study, wanted, unit in WANTED:
        if study not in known:
            continue
        one = shop.measured(Cell(verb, known[study]), 36_000, 3_600)
        print(f"{verb} {study}: {one.wall:.1f} s, {one.outcome} {one.message}", file=sys.stderr)
        fits = [row["wall"] for row in rows if row["verb"] == "fit" and row["study"] == study]
        times = one.wall / fits[0] if unit == "fits" else one.wall
        reached = {"wanted": wanted, "took": times, "unit": unit, "outcome": one.outcome}
        grade = {key: one.results.get(key) for key in ("grade", "smallest_ess", "target_ess")}
        rows.append({"verb": verb, "study": study, "wall": one.wall, "cpu": one.cpu} | reached | grade)
    return rows


def text_of(rows: list[dict[str, Any]], described: str) -> str:
    """The rows as a page."""
    lines = [
        "# Time of jobs\n",
        f"Measured on: {described} Two processes, default settings, each job alone, from a fresh process to "
        "its page.\n",
        "| verb | study | wanted | took | wall s | CPU s | grade | effective draws |",
        "|---|---|---:|---:|---:|---:|---|---:|",
    ]
    for row in rows:
        unit = "fits" if row["unit"] == "fits" else f"s {row['unit']}".rstrip()
        draws = "" if row["smallest_ess"] is None else f"{row['smallest_ess']:.0f} of {row['target_ess']:.0f}"
        outcome = row["grade"] or (row["outcome"] if row["outcome"] != "done" else "")
        cells = (
            row["verb"],
            row["study"],
            f"{row['wanted']:g} {unit}",
            f"{row['took']:.1f}",
            f"{row['wall']:.1f}",
            f"{row['cpu']:.1f}",
            outcome,
            draws,
        )
        lines.append(f"| {' | '.join(cells)} |")
    reached = sum(row["took"] <= row["wanted"] and row["outcome"] == "done" for row in rows)
    return "\n".join([*lines, f"\n{reached} of {len(rows)} within what is wanted.\n"])


def main() -> int:
    """Write `targets.md` and `targets.json`; the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--out", type=Path, default=Path("reports/performance"))
    parser.add_argument("--machine", default="", help="what it runs on and what else runs there, in words")
    given = parser.parse_args()
    out: Path = given.out
    with tempfile.TemporaryDirectory() as folder:
        rows = measured(Path(folder))
    out.mkdir(parents=True, exist_ok=True)
    write_text(out / "targets.json", json.dumps(rows, indent=1) + "\n")
    write_text(
        out / "targets.md", text_of(rows, given.machine or f"{platform.machine()}, {cores()} processors.")
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
