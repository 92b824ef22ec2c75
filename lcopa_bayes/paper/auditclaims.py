"""Claims I1 to I6: what an identifiability audit of a record like the paper's says of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from lcopa_bayes.model.literature import Stated
from lcopa_bayes.paper.verdict import Evidence, Kind, Test, Verdict, undecided, waiting
from lcopa_bayes.results.stored import stored_values

COLLINEAR = 10.0
"""Collinearity index from which sensitivities count as coupled [-] (Brun et al. 2001)."""
DELAY_DIGIT = 1e-3
"""Last digit of the printed delays, by which they can differ at most [ms]."""
_NEEDS = ("study", "grade", "parameters", "printed_form", "spectrum", "local", "delays")
_CLAIMED = ("gain", "time", "order", "delay")
"""Kinds of parameters that the claim is about; a time constant counts as a viscosity."""

Reading = Callable[[Stated, Mapping[str, Any]], Verdict]


def load_audit(folder: Path) -> Mapping[str, Any]:
    """`audit.json` of a run folder; InputError when there is none or it cannot be used."""
    return stored_values(folder, "audit", _NEEDS)


def from_audit(reading: Reading, question: str) -> Test:
    """A test that reads the audits in turn, and names the missing audit where there is none."""

    def test(stated: Stated, evidence: Evidence) -> Verdict:
        verdict = waiting("audit", question)
        for audit in evidence.audits:
            result = reading(stated, audit)
            how = f"Audit of the study {audit['study']} (draws: {audit['grade']}): {result.how}"
            verdict = Verdict(result.kind, result.number, result.unit, how)
            if verdict.kind is not Kind.UNDECIDED:
                break
        return verdict

    return test


def unique_map(stated: Stated, audit: Mapping[str, Any]) -> Verdict:
    """I1: contradicted by any direction of the printed parameters that changes no sample."""
    form = audit["printed_form"]
    if form is None or not form["certain"]:
        return undecided("it has no certain rank of a single path in its printed form.")
    blind = form["parameters"] - form["rank"]
    said = "; ".join(symmetry["sentence"] for symmetry in form["symmetries"])
    how = (
        f"of the {form['parameters']} numbers of Eqs. 16, 21 and 28 for one path, {form['rank']} act on the "
        f"response{': ' + said if said else ''}. Number: directions without any effect; the claim holds at 0."
    )
    return Verdict(Kind.of(blind == 0), float(blind), "-", how)


def full_excitation(stated: Stated, audit: Mapping[str, Any]) -> Verdict:
    """I2: contradicted by directions of which the data know less than the prior."""
    open_directions = [row for row in audit["spectrum"] if row["prior_knows_more"]]
    directions = "; ".join(", ".join(row["direction"]) for row in open_directions)
    how = (
        f"{len(open_directions)} of {len(audit['spectrum'])} directions of the Fisher information at the "
        "maximum are less precise from the record than from the "
        f"prior{f' ({directions})' if directions else ''}. Number: these directions; the claim holds at 0."
    )
    return Verdict(Kind.of(not open_directions), float(len(open_directions)), "-", how)


def uncoupled(stated: Stated, audit: Mapping[str, Any]) -> Verdict:
    """I3: by the collinearity index of all sensitivities."""
    local = audit["local"]
    if local is None:
        return undecided("no plant parameter was free in it.")
    index, alike = local["collinearity"], local["most_alike"]
    pair = (
        f"; most alike are {' and '.join(alike[0]['pair'])}, cosine {alike[0]['cosine']:.3f}" if alike else ""
    )
    said = "infinite (one sensitivity is a combination of the others)" if index is None else f"{index:.3g}"
    how = (
        f"collinearity index of the sensitivities at the maximum of the likelihood {said}{pair}. The claim "
        f"holds below {COLLINEAR:g}."
    )
    return Verdict(Kind.of(index is not None and index < COLLINEAR), index, "-", how)


def all_determined(stated: Stated, audit: Mapping[str, Any]) -> Verdict:
    """I4: by the share of parameters whose verdict is "identified"."""
    rows = [row for row in audit["parameters"] if row["name"].split("_")[0] in _CLAIMED]
    lost = [f"{row['name']} ({row['verdict']})" for row in rows if row["verdict"] != "identified"]
    how = (
        f"{len(rows) - len(lost)} of {len(rows)} free times, orders, delays and gains are identified"
        f"{'; not: ' + ', '.join(lost) if lost else ''}. Number: their share; the claim holds at 1."
    )
    return Verdict(Kind.of(not lost), 1 - len(lost) / max(len(rows), 1), "-", how)


def dominant_order(stated: Stated, audit: Mapping[str, Any]) -> Verdict:
    """I5: by whether the profile of the largest order is bounded on both sides and contains the stated
    order."""
    names = ("order_1", "order_1_direct")
    row = next((row for row in audit["parameters"] if row["name"] in names), None)
    if row is None:
        return undecided("it has no free largest order.")
    lower, upper = row["profile"]["lower"], row["profile"]["upper"]
    wanted = stated.records.dominant_order
    ends = ["open" if end is None else f"{end:.3g}" for end in (lower, upper)]
    closed = lower is not None and upper is not None
    holds = closed and lower <= wanted <= upper
    searched = row["profile"]["searched"]
    width = (searched[1] if upper is None else upper) - (searched[0] if lower is None else lower)
    how = (
        f"profile interval of the largest order ({100 * row['profile']['level']:g} %) from {ends[0]} to "
        f"{ends[1]} within {searched[0]:.2g} to {searched[1]:.2g}; stated {wanted:g}. The data set the order "
        "when both sides are closed about it. Number: the remaining width, an open side to its end."
    )
    return Verdict(Kind.of(holds), width, "-", how)


def separate_delays(stated: Stated, audit: Mapping[str, Any]) -> Verdict:
    """I6: by the smallest difference of two path delays that the record resolves."""
    delays = audit["delays"]
    unit = delays["paths"][0]["unit"] if delays["paths"] else "-"
    if not delays["separations"] or unit != "ms":
        return undecided(f"{delays['sentence']}; a record of several paths is needed.")
    smallest = [separation["smallest_difference"] for separation in delays["separations"]]
    worst = None if None in smallest else max(smallest)
    how = (
        f"{delays['sentence']}. The printed delays differ by less than {DELAY_DIGIT:g} ms; the claim holds "
        "when such a difference is resolved for all pairs. Number: that of the worst pair."
    )
    return Verdict(Kind.of(worst is not None and worst < DELAY_DIGIT), worst, "ms", how)
