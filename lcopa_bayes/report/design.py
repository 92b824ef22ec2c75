"""The page of a design, drawn from `design.json` of its run folder alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.theme import BAND, HELD_OUT, INK, Drawing, grid, label, plain, svg_of


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """Drives by rank and precision against bench time of a design."""
    ranked = sorted(values["table"], key=lambda row: -(row["factor_over_step"] or 0.0))
    return {"curve": _curve(values), "ranked": ranked}


def _curve(results: Mapping[str, Any]) -> tuple[Drawing, ...]:
    curve = results["curve"]
    names = list(curve[0]["best"])
    if not names:
        return ()
    figure, panels = grid(len(names), columns=3, height=1.7)
    times = np.array([row["time"] for row in curve], dtype=float)
    for panel, name in zip(panels, names, strict=True):
        for key, colour, said in (("step", HELD_OUT, "plain step"), ("best", BAND, "best drive")):
            spread = np.array([row[key][name] for row in curve], dtype=float)
            panel.plot(times, spread, color=colour, marker=".", markersize=4, label=said)
        panel.axhline(0.1, color=INK, linewidth=0.7, linestyle=":")
        panel.set(xscale="log", yscale="log")
        panel.set_title(plain(name), fontsize=7.5)
        panel.set(xlabel=label("bench time", results["time_unit"]), ylabel="relative sd [-]")
    panels[0].legend()
    caption = (
        "Expected relative standard deviation (median over draws) after the best drive and after the plain "
        "step; dotted: 10 %. A gap: not determined at most draws."
    )
    return (Drawing("design_curve", svg_of(figure), caption),)
