"""Figures of the study, of its results as `run.py` stores them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure

COLOURS = ("#0072b2", "#56b4e9", "#d55e00", "#e69f00", "#cc79a7", "#009e73", "#1a1a1a", "#8a8a8a")
"""Okabe and Ito 2008."""
LIKELIHOOD, REST = COLOURS[0], "#c9c9c9"


def save(figure: Figure, path: Path) -> None:
    figure.savefig(path, format="svg", metadata={"Date": None})


def forward(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Time against the number of blocks, and against the error reached."""
    figure = Figure(figsize=(9.6, 4.8), layout="constrained")
    by_size, by_error = figure.subplots(1, 2)
    methods = list(dict.fromkeys(row["method"] for row in rows))
    for method, colour in zip(methods, COLOURS, strict=False):
        own = [row for row in rows if row["method"] == method and row["reason"] is None]
        if not own:
            continue
        size, cpu = [row["blocks"] for row in own], [row["cpu_s"]["median"] for row in own]
        low, high = ([row["cpu_s"]["quartiles"][k] for row in own] for k in (0, 1))
        for panel, x in ((by_size, size), (by_error, [row["error_rms"] for row in own])):
            panel.plot(x, cpu, "o-", color=colour, ms=3.5, lw=1.1, label=method)
            panel.vlines(x, low, high, color=colour, lw=2.5, alpha=0.4)
    for panel in (by_size, by_error):
        panel.set(xscale="log", yscale="log", ylabel="CPU time of a response [s]")
        panel.grid(alpha=0.25)
    by_size.set_xlabel("blocks [-]")
    by_error.set_xlabel("root mean square error [share of the steady response]")
    by_error.invert_xaxis()
    handles = by_size.get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    save(figure, path)


def samplers(posteriors: Mapping[str, Mapping[str, Any]], path: Path) -> None:
    """Effective draws per CPU second, stated and shown, of every method."""
    figure = Figure(figsize=(9.6, 0.9 + 0.42 * max(len(each["methods"]) for each in posteriors.values())))
    figure.set_layout_engine("constrained")
    panels = figure.subplots(1, len(posteriors), squeeze=False)[0]
    for panel, (name, comparison) in zip(panels, posteriors.items(), strict=True):
        rows = comparison["methods"]
        for height, row in enumerate(reversed(rows)):
            stated = row["stated_per_cpu_s"]
            if stated is not None:
                panel.plot(stated["quartiles"], [height + 0.1] * 2, color=COLOURS[0], lw=2.5, alpha=0.5)
                panel.plot(stated["median"], height + 0.1, "o", color=COLOURS[0], ms=5)
            if row.get("shown_per_cpu_s") is not None:
                panel.plot(row["shown_per_cpu_s"], height - 0.1, "D", color=COLOURS[2], ms=5)
        panel.set(xscale="log", xlabel="effective draws per CPU second", title=name)
        panel.set_ylim(-0.6, len(rows) - 0.4)
        panel.set_yticks(range(len(rows)), [row["method"] for row in reversed(rows)])
        panel.grid(alpha=0.25, axis="x")
    panels[0].plot([], [], "o", color=COLOURS[0], label="stated")
    panels[0].plot([], [], "D", color=COLOURS[2], label="shown by errors")
    panels[0].legend(fontsize=8, frameon=False)
    save(figure, path)


def verbs(result: Mapping[str, Any], path: Path) -> None:
    """CPU time of every verb, one panel per study, the share of the likelihood in colour."""
    done = [row for row in result["rows"] if row["runs"]]
    names = list(dict.fromkeys(row["study"] for row in done))
    columns = 3
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(9.6, 2.6 * lines), layout="constrained")
    panels = figure.subplots(lines, columns, squeeze=False).ravel()
    for panel in panels[len(names) :]:
        panel.remove()
    for panel, name in zip(panels, names, strict=False):
        bars(panel, [row for row in done if row["study"] == name])
        panel.set_title(name or "without a study", fontsize=9)
    save(figure, path)


def bars(panel: Axes, rows: Sequence[Mapping[str, Any]]) -> None:
    for height, row in enumerate(reversed(rows)):
        cpu, share = row["cpu_s"]["median"], row.get("likelihood_share") or 0.0
        panel.barh(height, cpu * share, color=LIKELIHOOD, height=0.6)
        panel.barh(height, cpu * (1 - share), left=cpu * share, color=REST, height=0.6)
        panel.plot(row["cpu_s"]["quartiles"], [height] * 2, color="#1a1a1a", lw=1.2)
    panel.set_yticks(range(len(rows)), [row["verb"] for row in reversed(rows)], fontsize=8)
    panel.set_xlabel("CPU time [s]; blue: likelihood", fontsize=8)
    panel.tick_params(labelsize=8)
