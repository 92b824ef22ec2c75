"""Undamped resonances faster than the samples resolve: a periodic disturbance, not a plant, unless records
held out ring as it predicts.

Between one command and the next such a resonance is a sinusoid that does not fade. Records of a few commands
cannot distinguish it from a disturbance of that frequency. Where the drive changes with every sample they
can, and held-out records say so: there a disturbance has another phase.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.assembly import Problem
from lcopa_bayes.inference.optimum import Optimum
from lcopa_bayes.inference.parameter import Parameter
from lcopa_bayes.model.powerseries import denominator
from lcopa_bayes.results.prediction import responses
from lcopa_bayes.sampling.convergence import Limitation
from lcopa_bayes.sampling.draws import Draws

RESONANCE_PEAK = 10.0
"""Response at a resonance over that at rest from which it is undamped [-]: that of one term is
``1 / (2 |cos(pi order / 4)|)``, 10 at an order of 1.936."""
RESONANCE_SHARE = 0.05
"""Share of the draws with such a resonance from which it limits the numbers [-]: one tail of an interval."""
DISTURBANCE_SHARE = 0.5
"""Share from which the numbers describe a disturbance, not a plant [-]."""
CONFIRMED = 0.8
"""Share of its predicted power from which the ringing of held-out records is that of a plant [-]: of a
sinusoid as large, but of another phase, it is ``2 cos(phase) - 1``."""
_AT_ONCE = 1e-3
"""Time constants of an element that follows its drive at once [sampling periods]."""
_SPAN = 200.0
"""Highest over lowest frequency that is searched [-]."""
_FREQUENCY_STEP = 0.01
"""Relative step of the frequencies [-]: a peak of 10 is a tenth of its frequency wide."""
_DRAWS = 400


@final
@dataclass(frozen=True)
class Resonance:
    """An undamped resonance of one element that the samples do not resolve."""

    name: str
    """Name of the element; empty when the plant has one."""
    parameters: tuple[str, ...]
    """Times and orders of the element, and the gains of its paths."""
    share: float
    """Share of the draws that have it [-]."""
    samples: float
    """Median of its period over the sampling period [-]."""

    def concerns(self, row: Parameter) -> bool:
        """Whether a parameter is one of the disturbance."""
        return row.name in self.parameters

    def sentence(self, period: float, time_unit: str) -> str:
        """What it is, without a full stop."""
        of = f"element {self.name}" if self.name else "the element"
        return (
            f"in {100 * self.share:.0f} % of the draws {of} has an order near 2 and a resonance of period "
            f"{self.samples * period:.3g} {time_unit}, {self.samples:.2g} sampling periods: a periodic "
            "disturbance faster than the sampling resolves, not a plant"
        )


def unresolved(problem: Problem, draws: Draws) -> tuple[Resonance, ...]:
    """Resonances in at least `RESONANCE_SHARE` of the draws that turn by more than a radian between samples.

    None that held-out records confirm. For one term that is a time constant below the sampling period. Such
    an oscillation has at most 6.3 samples a period and, without damping, adds to every sample what the drive
    did long before: with its phase free it follows any disturbance of that frequency.
    """
    period, dynamics = problem.scales.period, draws.table.dynamics(draws.thinned(_DRAWS))
    out = []
    layout, rows = draws.table.layout, draws.table.rows
    for number, slot in enumerate(layout.elements):
        peak, at = peaks(dynamics.times[number] / period, dynamics.orders[number])
        undamped = peak >= RESONANCE_PEAK
        share = float(undamped.mean())
        if share >= RESONANCE_SHARE and not ringing_confirmed(problem, draws, number) > CONFIRMED:
            own = tuple(
                row.name
                for k, row in enumerate(rows)
                if k in draws.table.terms[number].every
                or (row.kind == "gain" and layout.element_of[row.place.first][row.place.second] == number)
            )
            out.append(Resonance(slot.name, own, share, float(2 * np.pi / np.median(at[undamped]))))
    return tuple(out)


def peaks(times: Matrix, orders: Matrix) -> tuple[Vector, Vector]:
    """Largest ``|1 / (sum (i w T)^order + 1)|`` at angular frequencies above one, (batch,) [-], and where, in
    the reciprocal of the unit of `times`, (batch, terms)."""
    frequency = np.exp(np.arange(0.0, np.log(_SPAN), _FREQUENCY_STEP))
    below = denominator(times, orders, frequency)
    at = np.argmin(np.abs(below), axis=1)
    return 1 / np.abs(below[np.arange(at.size), at]), frequency[at]


def resonances(problem: Problem, draws: Draws) -> Iterator[Limitation]:
    """Limitations of every number by resonances that the samples do not resolve."""
    for one in unresolved(problem, draws):
        yield Limitation(
            "unusable" if one.share >= DISTURBANCE_SHARE else "tentative",
            "numbers describe a plant only if this does: "
            + one.sentence(problem.scales.period, problem.study.time_unit),
            "sample faster, keep the priors of the times above the sampling period, hold out a record, or "
            "let `loop` trace the disturbance",
        )


def is_disturbance(problem: Problem, optimum: Optimum) -> bool:
    """Whether the plant at an optimum describes a disturbance, so that no draws about it are usable."""
    values = optimum.values[None, None]
    return bool(unresolved(problem, Draws(problem.posterior.table, values, np.zeros((1, 1)), (), 1.0)))


def ringing_confirmed(problem: Problem, draws: Draws, element: int) -> float:
    """Squared error on held-out records that the ringing of an element takes away, over what it would if it
    were there exactly as predicted [-]; NaN without held-out records or without ringing.

    1 for a plant; of a sinusoid of another phase between -3 and 1, on average over phases -1. Each record has
    its own level. The prediction is that of the draw of largest density.
    """
    table, layout = draws.table, draws.table.layout
    samples, model = problem.simulated(problem.study.held_out)
    best = draws.flat[int(draws.log_density.argmax())]
    still = best.copy()  # follows its drive at once
    for time, order in zip(*table.terms[element], strict=True):
        still[time], still[order] = _AT_ONCE * problem.scales.period, 1.0
    both = responses(table, model, np.stack([best, still]))
    gained = power = 0.0
    for record, simulated in zip(samples, both, strict=True):
        for axis, observed in enumerate(record.axes):
            if element not in layout.element_of[axis] or observed.values.size == 0:
                continue
            error = observed.values - simulated[axis][:, observed.index]
            error = error - error.mean(axis=1, keepdims=True)
            ringing, (with_it, without) = error[1] - error[0], (error**2).sum(axis=1)
            gained, power = gained + without - with_it, power + float(ringing @ ringing)
    return gained / power if power > 0 else np.nan
