"""The table of parameters: median, interval and how far to trust them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import figures, interval, percent, to_spread
from lcopa_bayes.report.savedrun import SavedRun
from lcopa_bayes.report.section import Column, Section, Table


def section(run: SavedRun) -> Section:
    """Free parameters with intervals and grades, those with several ridges, and the fixed ones."""
    free, fixed = run.results["parameters"], run.results["fixed"]
    kind = ", ".join(dict.fromkeys(f"{percent(row['level'])} {row['interval']}" for row in free))
    tables = [
        Table(
            (
                *(Column("name", "code"), Column("median", "number"), Column("unit")),
                *(Column("90 % interval" if _all_at(free, 0.9) else "interval", "number"),),
                *(Column("mean", "number"), Column("sd", "number"), Column("ESS", "number")),
                *(Column("R-hat", "number"), Column("grade", "grade")),
            ),
            tuple(_row(row) for row in free),
            f"Intervals are {kind}. Digits go to the second significant one of the standard deviation. "
            "ESS is the smaller of the effective sample sizes of bulk and tails; R-hat compares independent "
            "ensembles.",
        )
    ]
    if run.results["ridges"]:
        tables.append(_ridges(run.results["ridges"]))
    if fixed:
        tables.append(
            Table(
                (Column("fixed parameter", "code"), Column("value", "number"), Column("unit")),
                tuple((str(row["name"]), figures(row["value"], 6), str(row["unit"])) for row in fixed),
            )
        )
    text = () if fixed else ("No parameter was fixed.",)
    return Section("Parameters", text, tables=tuple(tables))


def _ridges(rows: list[Mapping[str, Any]]) -> Table:
    """Shares of the hills of parameters whose marginal has several."""
    columns = (
        *(Column("several ridges in", "code"), Column("split at", "number"), Column("unit")),
        *(Column("shares of all draws", "interval"), Column("between populations", "interval")),
        *(Column("grade", "grade"), Column("in words", "prose")),
    )
    shown = []
    for row in rows:
        pooled = zip(row["pooled"], row["pooled_mcse"], strict=True)
        hills = zip(*row["shares"], strict=True)
        shown.append(
            (
                *(str(row["parameter"]), ", ".join(figures(end) for end in row["boundaries"])),
                *(str(row["unit"]), ", ".join(f"{share:.2f} ± {error:.2f}" for share, error in pooled)),
                ", ".join(f"{min(hill):.2f} to {max(hill):.2f}" for hill in hills),
                *(str(row["grade"]), str(row["sentence"])),
            )
        )
    return Table(
        columns,
        tuple(shown),
        "The draws of these parameters lie on separate hills; medians and intervals mix them. "
        "± is the Monte Carlo standard error.",
    )


def _row(row: Mapping[str, Any]) -> tuple[str, ...]:
    sd = row["sd"]
    rhat = row.get("rhat")
    return (
        str(row["name"]),
        to_spread(row["value"], sd),
        str(row["unit"]),
        interval(row["lower"], row["upper"], sd),
        to_spread(row["mean"], sd),
        figures(sd, 2),
        figures(row["ess"]) if (row["ess"] or 0) < 100 else f"{row['ess']:.0f}",
        "–" if rhat is None else f"{rhat:.3f}",  # noqa: RUF001
        str(row["grade"]),
    )


def _all_at(rows: list[Mapping[str, Any]], level: float) -> bool:
    return all(row["level"] == level for row in rows)
