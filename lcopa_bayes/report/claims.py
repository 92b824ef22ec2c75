"""The page of `claims`: verdicts, and figures of their evidence: step response, crosstalk, delays, tilt,
lobes, steering."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.paper.modelclaims import (
    integer_rival,
)
from lcopa_bayes.paper.numericsclaims import delay_costs
from lcopa_bayes.plot.paper import (
    crosstalk_figure,
    delays_figure,
    steady_figure,
    steering_figure,
    tilt_law_figure,
)
from lcopa_bayes.report.formatting import figures
from lcopa_bayes.report.page import Drawings
from lcopa_bayes.report.svg import drawing


def drawn(folder: Path, values: Mapping[str, Any]) -> Drawings:
    """A title and a figure for each family of claims."""
    stated = PAPER
    rival, costs = integer_rival(stated), delay_costs(stated)
    shown = (
        (
            "M2, M3: steady state and settling",
            "steady",
            steady_figure,
            "The step of Fig. 13 through Eq. 65, over a record and beyond it, with 2 and 5 % bands "
            "about the value it tends to; the integer-order model closest to it over the record "
            f"(RMSE {figures(rival.rmse)} rad); the measured steady value.",
        ),
        (
            "X1 to X3: crosstalk and two axes",
            "crosstalk",
            crosstalk_figure,
            "Left: b / k of the coupling paths against the printed crosstalk gains. Middle: y over x "
            "with x driven, at rest and at the end of the record, against the measured ratio. Right: "
            "steady values of both axes driven together.",
        ),
        (
            "N2: delays in whole blocks",
            "delay",
            delays_figure,
            "Shift of the other parameters when the delay is held at the nearest camera period, for "
            f"the printed delay of {figures(costs[0].delay, 4)} ms and for the worst delay, "
            f"{figures(costs[1].delay, 4)} ms.",
        ),
        (
            "S1: tilt law",
            "tilt",
            tilt_law_figure,
            "Mean tilt in a uniform and a self-consistent field, and Eq. 24; right: about the knee.",
        ),
        (
            "S2 to S4: lobes, linearised steering, geometry",
            "steering",
            steering_figure,
            "Left: strongest grating lobe over the main lobe. Middle: size of the error of Eq. 26, "
            "and the steady-state error the paper claims. Right: angle by Eq. 5 for the pitch of "
            "Section 2 and for the pitch that the measured step implies.",
        ),
    )
    families = [(title, drawing(f"claim_{stem}", draw(stated), said)) for title, stem, draw, said in shown]
    return {"verdict": None, "claims": families}
