"""The claims of Ta et al. 2026 that are tested, each with the test that decides it (PAPER, Section 6)."""

from __future__ import annotations

from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.paper import auditclaims, comparisonclaims, modelclaims, numericsclaims, opticsclaims
from lcopa_bayes.paper.auditclaims import from_audit
from lcopa_bayes.paper.comparisonclaims import from_comparison, jointly, uncompared
from lcopa_bayes.paper.verdict import Claim, Evidence, Verdict

CLAIMS: tuple[Claim, ...] = (
    Claim(
        "I1",
        "Parameters map uniquely to the response; no two sets give the same response.",
        "Section 4.3",
        from_audit(auditclaims.unique_map, "are there symmetries, or sets of parameters with one response?"),
    ),
    Claim(
        "I2",
        "A step excites splay, twist and bend modes fully.",
        "Section 4.3",
        from_audit(
            auditclaims.full_excitation,
            "which directions of the parameters does the record of a step leave open?",
        ),
    ),
    Claim(
        "I3",
        "The parameters' sensitivities are uncoupled.",
        "Section 4.3",
        from_audit(
            auditclaims.uncoupled, "how strongly are the sensitivities correlated at the identified values?"
        ),
    ),
    Claim(
        "I4",
        "All viscosities, orders, delay and gains are uniquely determined from the measured record.",
        "Section 4.3",
        from_audit(
            auditclaims.all_determined,
            "which parameters have bounded profiles on a record like that of Fig. 13?",
        ),
    ),
    Claim(
        "I5",
        "The dominant order is 1.8, set by the data.",
        "Section 4.3",
        jointly(
            from_audit(
                auditclaims.dominant_order, "what interval of the largest order does such a record leave?"
            ),
            from_comparison(
                comparisonclaims.dominant_order, "do models of other numbers of terms give the same order?"
            ),
        ),
    ),
    Claim(
        "I6",
        "Four independent path delays can be distinguished, though all print as 3.027.",
        "Section 3.2, Eq. 31",
        from_audit(
            auditclaims.separate_delays,
            "are the intervals of the path delays narrower than their differences?",
        ),
    ),
    Claim(
        "M1",
        "Fractional beats integer order: RMSE up to 2e-4 against more than 1.1e-3 rad.",
        "Section 5.2",
        from_comparison(
            comparisonclaims.fractional_against_integer,
            "do held-out scores and evidence prefer fractional orders, and by how much?",
            none=uncompared,
        ),
    ),
    Claim(
        "M2",
        "Both orders reach the same, true steady state; steady-state error below 0.15 %.",
        "Section 5.2, abstract",
        from_comparison(
            comparisonclaims.same_steady_state,
            "do both models tend to the same value?",
            otherwise=modelclaims.steady_state,
        ),
    ),
    Claim(
        "M3", "The identified model settles in 10 ms without overshoot.", "Table 1", modelclaims.settling_time
    ),
    Claim(
        "M4",
        "Three viscous elements are needed.",
        "Section 3.1",
        from_comparison(
            comparisonclaims.three_needed,
            "how do evidence and held-out scores rank one, two and three viscous elements?",
        ),
    ),
    Claim(
        "X1",
        "Crosstalk gains 0.00115 and 0.00185 follow from Eq. 65.",
        "Section 4.3",
        modelclaims.crosstalk_gains,
    ),
    Claim(
        "X2",
        "The measured crosstalk of 8.3 % agrees with the identified gains.",
        "Section 5.2",
        modelclaims.measured_crosstalk,
    ),
    Claim(
        "X3",
        "The two-axis steady values 0.0184 and 0.0124 rad agree with the identified model.",
        "Section 5.2",
        modelclaims.two_axis_steady,
    ),
    Claim(
        "N1",
        "Legendre wavelets make the identification simpler or better than block pulses alone.",
        "Section 4.1",
        numericsclaims.wavelets,
    ),
    Claim(
        "N2",
        "A delay in whole blocks is enough at this sampling.",
        "Section 4.2",
        numericsclaims.whole_blocks,
    ),
    Claim(
        "S1",
        "Eq. 24 fits the director with R^2 > 0.995 and error < 1.2 %, and its jump at 3 V is physical.",
        "Section 3.2",
        opticsclaims.tilt_law,
    ),
    Claim(
        "S2",
        "High-order lobes are far weaker than the main lobe at d = 1.2 lambda.",
        "Section 2.1",
        opticsclaims.grating_lobes,
    ),
    Claim(
        "S3",
        "Pulling dphi out of the arcsine (Eq. 26) is harmless over the range used.",
        "Section 3.2",
        opticsclaims.linearised_steering,
    ),
    Claim(
        "S4",
        "One geometry serves both the simulations and the experiment.",
        "Sections 2.1, 5.1",
        opticsclaims.one_geometry,
    ),
)


def judge(evidence: Evidence | None = None) -> dict[str, Verdict]:
    """The verdict on each claim by its id, from the printed numbers and the evidence at hand."""
    return {claim.id: claim.test(PAPER, evidence or Evidence()) for claim in CLAIMS}
