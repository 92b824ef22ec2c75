"""Claims N1 and N2: what wavelets add to block pulses, and what whole-block delays cost."""

from __future__ import annotations

from functools import lru_cache

from lcopa_bayes.model.literature import PAPER, Stated
from lcopa_bayes.model.wavelets import FormCost, form_cost
from lcopa_bayes.paper.printedmodel import RECORD_LENGTH
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict
from lcopa_bayes.paper.wholeblocks import DelayRounding, delay_rounding

SAME_ANSWER = 1e-9
"""Relative difference of two responses below which they are the same answer [-]; rounding gives 1e-14."""
WAVELET_BLOCKS = 256
"""The power of two next to the 250 samples of a record [-]."""
TOLERATED_SHIFT = 0.25
"""Bias that is let pass [sd]: a 90 % interval displaced by it still covers 89 %."""


def wavelets(stated: Stated, evidence: Evidence) -> Verdict:
    """N1: the same response in wavelet and in block-pulse coordinates, and the time each takes.

    Wavelets are better if they change the answer, simpler if they cost less.
    """
    cost = wavelet_cost(stated)
    better, cheaper = cost.difference > SAME_ANSWER, cost.ratio < 1
    how = (
        f"At N = {cost.n} both forms of Eq. 61 give one response to {cost.difference:.0e} of it, for "
        "P = Psi F inverse(Psi) is a change of coordinates; the wavelet form "
        f"{'costs less' if cheaper else 'costs more'} because its matrices are "
        f"{'not full' if cheaper else 'full where those of block pulses are triangular'}. The printed "
        f"wavelets are not orthogonal either: inner products up to {cost.largest_overlap:.2f}. Number: "
        "relative difference of the responses."
    )
    return Verdict(Kind.of(better or cheaper), cost.difference, "-", how)


@lru_cache(maxsize=4)
def wavelet_cost(stated: Stated = PAPER, blocks: int = WAVELET_BLOCKS) -> FormCost:
    """Both forms of the response of the direct path to the step of Fig. 13."""
    return form_cost(stated.plant.xx, stated.records.step_drive, RECORD_LENGTH, blocks)


def whole_blocks(stated: Stated, evidence: Evidence) -> Verdict:
    """N2: bias of the other parameters when the delay is a whole number of camera periods.

    For the delay that fits worst, half a period off, and for the printed one.
    """
    printed, worst = delay_costs(stated)
    coarse = stated.plant.xx.delay * WAVELET_BLOCKS / RECORD_LENGTH
    how = (
        f"With the delay held half a camera period off, the other parameters move by up to "
        f"{worst.largest_shift:.2f} sd (tolerated {TOLERATED_SHIFT:g} sd) and, held too, the fit loses "
        f"{worst.loss:.0f} nat of log likelihood; the printed {printed.delay:g} ms against "
        f"{printed.rounded:g} ms: {printed.largest_shift:.2f} sd, {printed.loss:.0f} nat. The printed delay "
        f"is {coarse:.3f} blocks of {RECORD_LENGTH:g}/{WAVELET_BLOCKS} ms, so it looks quantised itself."
    )
    return Verdict(Kind.of(worst.largest_shift <= TOLERATED_SHIFT), worst.largest_shift, "sd", how)


@lru_cache(maxsize=4)
def delay_costs(stated: Stated = PAPER) -> tuple[DelayRounding, DelayRounding]:
    """Rounding the printed delay to camera periods, and the worst delay next to it."""
    path, records = stated.plant.xx, stated.records
    period = 1 / records.camera_rate
    blocks = round(RECORD_LENGTH / period)
    worst = (round(path.delay / period) + 0.5) * period
    printed, off = (
        delay_rounding(
            path,
            blocks=blocks,
            delay=delay,
            drive=records.step_drive,
            span=RECORD_LENGTH,
            period=period,
            noise_sd=records.fractional_rmse,
        )
        for delay in (path.delay, worst)
    )
    return printed, off
