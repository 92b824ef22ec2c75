"""Claims that wait for evidence, and what is known of M1 without any."""

from __future__ import annotations

from collections.abc import Callable

from lcopa_bayes.model.literature import Stated
from lcopa_bayes.paper.printedmodel import integer_rival
from lcopa_bayes.paper.verdict import Evidence, Kind, Verdict

Test = Callable[[Stated, Evidence], Verdict]


def needs_audit(question: str) -> Test:
    """A test that waits for an identifiability audit, with what the audit has to answer."""

    def test(stated: Stated, evidence: Evidence) -> Verdict:
        missing = "No audit is among the evidence"
        return Verdict(Kind.UNDECIDED, None, "-", f"{missing}; it has to answer: {question}")

    return test


def needs_comparison(question: str) -> Test:
    """A test that waits for a comparison of models, with what the comparison has to answer."""

    def test(stated: Stated, evidence: Evidence) -> Verdict:
        missing = "No comparison is among the evidence"
        return Verdict(Kind.UNDECIDED, None, "-", f"{missing}; it has to answer: {question}")

    return test


def uncompared(stated: Stated, evidence: Evidence) -> Verdict:
    """M1: undecided until a comparison; the number is what integer orders miss of Eq. 65 itself."""
    waiting = needs_comparison("do held-out scores and evidence prefer fractional orders, and by how much?")
    rmse = integer_rival(stated).rmse
    reason = waiting(stated, evidence).how
    how = (
        f"{reason} Known already: the integer-order model closest to the step "
        f"response of Eq. 65 misses it by {rmse:.2g} rad RMS, where more than "
        f"{stated.records.integer_rmse:g} rad is stated; the raw records are not at hand."
    )
    return Verdict(Kind.UNDECIDED, rmse, "rad", how)
