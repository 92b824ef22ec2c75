"""The table of parameters: median, interval and grade."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import NONE, figures, interval, percent, to_spread
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Section, Table


def section(run: SavedRun) -> Section:
    """Free parameters with intervals and grades, parameters with several modes, and fixed parameters."""
    free, fixed = run.results["parameters"], run.results["fixed"]
    kind = ", ".join(dict.fromkeys(f"{percent(row['level'])} {row['interval']}" for row in free))
    tables = [
        Table.of(
            free,
            ("name", "code", "name"),
            ("median", "number", lambda row: to_spread(row["value"], row["sd"])),
            ("unit", "text", "unit"),
            (
                "90 % interval" if all(row["level"] == 0.9 for row in free) else "interval",
                "number",
                lambda row: interval(row["lower"], row["upper"], row["sd"]),
            ),
            ("mean", "number", lambda row: to_spread(row["mean"], row["sd"])),
            ("sd", "number", lambda row: figures(row["sd"], 2)),
            ("ESS", "number", _ess),
            ("R-hat", "number", lambda row: NONE if row.get("rhat") is None else f"{row['rhat']:.3f}"),
            ("grade", "grade", "grade"),
            caption=f"Intervals are {kind}. Digits end at the second significant digit of the standard "
            "deviation. ESS is the smaller of the effective sample sizes of bulk and tails; R-hat compares "
            "independent sets of draws.",
        )
    ]
    if run.results["modes"]:
        tables.append(_modes(run.results["modes"]))
    if fixed:
        tables.append(
            Table.of(
                fixed,
                ("fixed parameter", "code", "name"),
                ("value", "number", lambda row: figures(row["value"], 6)),
                ("unit", "text", "unit"),
            )
        )
    text = () if fixed else ("No parameter was fixed.",)
    return Section("Parameters", text, tables=tuple(tables))


def _modes(rows: list[Mapping[str, Any]]) -> Table:
    """Shares of the modes of parameters whose marginal has several."""
    return Table.of(
        rows,
        ("several modes in", "code", "parameter"),
        ("split at", "number", lambda row: ", ".join(figures(end) for end in row["boundaries"])),
        ("unit", "text", "unit"),
        ("shares of all draws", "interval", _shares),
        (
            "range over sets of draws",
            "interval",
            lambda row: ", ".join(f"{min(s):.2f} to {max(s):.2f}" for s in zip(*row["shares"], strict=True)),
        ),
        ("grade", "grade", "grade"),
        ("statement", "prose", "sentence"),
        caption="The draws of these parameters lie in separate modes; medians and intervals mix them. "
        "± is the Monte Carlo standard error.",
    )


def _shares(row: Mapping[str, Any]) -> str:
    pairs = zip(row["pooled"], row["pooled_mcse"], strict=True)
    return ", ".join(f"{share:.2f} ± {error:.2f}" for share, error in pairs)


def _ess(row: Mapping[str, Any]) -> str:
    return figures(row["ess"]) if (row["ess"] or 0) < 100 else f"{row['ess']:.0f}"
