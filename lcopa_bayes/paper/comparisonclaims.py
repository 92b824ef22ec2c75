"""Claims M1, M2, M4 and I5: what a comparison of models on a record like the paper's says of them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from math import hypot, log
from pathlib import Path
from typing import Any

from lcopa_bayes.model.literature import Stated
from lcopa_bayes.paper.modelclaims import integer_rival
from lcopa_bayes.paper.verdict import Evidence, Kind, Test, Verdict, undecided, waiting
from lcopa_bayes.results.stored import stored_values

STRONG = log(20)
"""Difference of log evidence from which a term is needed [nat] (Kass and Raftery 1995)."""
ERRORS = 2.0
"""Standard errors by which a difference must clear a limit [-]."""
_NEEDS = ("study", "models", "fractional", "order_is_integer", "preferred")
_LARGEST = ("order_1", "order_1_direct")
_STEADY = ("steady_state[x_x]", "steady_state[x]")

Model = Mapping[str, Any]


def load_comparison(folder: Path) -> Mapping[str, Any]:
    """`compare.json` of a run folder; InputError when there is none or it cannot be used."""
    return stored_values(folder, "compare", _NEEDS)


def from_comparison(
    reading: Callable[[Stated, Mapping[str, Any]], Verdict],
    question: str,
    *,
    none: Test | None = None,
    otherwise: Test | None = None,
) -> Test:
    """A test that reads the comparison.

    Without a comparison the verdict is that of `none`. `otherwise` is a second test of the claim: it must
    support the claim too, and decides alone where the comparison is undecided or absent.
    """

    def test(stated: Stated, evidence: Evidence) -> Verdict:
        if evidence.compare is None:
            known = none or otherwise
            return known(stated, evidence) if known else waiting("comparison", question)
        result = reading(stated, evidence.compare)
        how = f"Comparison on the study {evidence.compare['study']}: {result.how}"
        if otherwise is None:
            return replace(result, how=how)
        other = otherwise(stated, evidence)
        if result.kind is Kind.UNDECIDED or other.kind is Kind.CONTRADICTED:  # both must support the claim
            return replace(other, how=f"{other.how} {how}")
        return replace(result, how=f"{how} {other.how}")

    return test


def uncompared(stated: Stated, evidence: Evidence) -> Verdict:
    """M1: undecided until a comparison; the number is what integer orders miss of Eq. 65 itself."""
    question = "do held-out scores and evidence prefer fractional orders, and by how much?"
    reason = waiting("comparison", question)
    rmse = integer_rival(stated).rmse
    how = (
        f"{reason.how} Known already: the integer-order model closest to the step "
        f"response of Eq. 65 misses it by {rmse:.2g} rad RMS, where more than "
        f"{stated.records.integer_rmse:g} rad is stated; the raw records are not at hand."
    )
    return Verdict(Kind.UNDECIDED, rmse, "rad", how)


def fractional_against_integer(stated: Stated, compare: Mapping[str, Any]) -> Verdict:
    """M1: both errors on the stated sides of their limits, and fractional orders warranted."""
    pair = _rivals(compare)
    if pair is None:
        return undecided("no usable fractional and integer model is in it.")
    free, whole = pair
    records, errors = stated.records, [_rmse(model) for model in pair]
    if None in errors:
        return undecided("its responses are not in rad.")
    ours, theirs = (float(error or 0.0) for error in errors)
    holds = (
        ours <= records.fractional_rmse_two_axes
        and theirs > records.integer_rmse
        and compare["fractional"]["verdict"] == "warranted"
    )
    closest = integer_rival(stated).rmse
    how = (
        f"RMSE {ours:.3g} rad of {free['name']} and {theirs:.3g} rad of the fair integer rival "
        f"({whole['about']}), a ratio of {theirs / ours:.2f} where more than {records.integer_rmse:g} over "
        f"{records.fractional_rmse_two_axes:g} rad is stated; {compare['fractional']['sentence']} "
        "Without noise the integer model closest to Eq. 65 "
        f"misses it by {closest:.2g} rad. The claim holds when both errors are as stated and fractional "
        "orders are warranted. Number: the integer rival's error."
    )
    return Verdict(Kind.of(holds), theirs, "rad", how)


def same_steady_state(stated: Stated, compare: Mapping[str, Any]) -> Verdict:
    """M2: whether the credible intervals of both steady states lie within the stated error of each other."""
    pair = _rivals(compare)
    metrics = [] if pair is None else [_metric(model, _STEADY) for model in pair]
    if len(metrics) < 2 or None in metrics:
        return undecided("no steady state of both kinds of model is in it.")
    free, whole = (metric for metric in metrics if metric is not None)
    ends = [free["lower"], free["upper"], whole["lower"], whole["upper"]]
    if None in ends or free["lower"] <= 0 <= free["upper"]:
        return undecided("a steady state has an open interval, or may be 0.")
    limit = stated.records.steady_state_error
    quotients = [theirs / ours - 1 for theirs in ends[2:] for ours in ends[:2]]  # of either sign
    low, high = min(quotients), max(quotients)
    apart = whole["value"] / free["value"] - 1
    kind = (
        Kind.SUPPORTED
        if -limit < low and high < limit
        else Kind.CONTRADICTED
        if low > limit or high < -limit
        else Kind.UNDECIDED
    )
    how = (
        f"the integer model tends to {whole['value']:.4g}, the fractional model to {free['value']:.4g} "
        f"{free['unit']}: {100 * apart:+.2g} % apart ({100 * low:+.2g} to {100 * high:+.2g} % by their "
        f"{100 * free['level']:g} % intervals), stated within {100 * limit:g} %. Number: this distance."
    )
    return Verdict(kind, abs(apart), "-", how)


def three_needed(stated: Stated, compare: Mapping[str, Any]) -> Verdict:
    """M4: by the log evidence of three terms over the best of fewer."""
    fractional = [model for model in _ranked(compare) if not model["integer"]]
    many = [model for model in fractional if model["terms"] >= 3]
    few = [model for model in fractional if model["terms"] < 3]
    if not many or not few:
        return undecided("it lacks usable models of three terms or of fewer.", "nat")
    best, other = (max(models, key=lambda model: float(model["log_evidence"])) for models in (many, few))
    gain = best["log_evidence"] - other["log_evidence"]
    sd = hypot(best["log_evidence_sd"], other["log_evidence_sd"])
    kind = (
        Kind.SUPPORTED
        if gain - ERRORS * sd > STRONG
        else Kind.CONTRADICTED
        if gain + ERRORS * sd < STRONG
        else Kind.UNDECIDED
    )
    how = (
        f"{best['name']} gains {gain:+.2f} ± {sd:.2f} nats of log evidence over {other['name']} "
        f"({other['terms']} term{'s' if other['terms'] > 1 else ''}){_predicted(best, other)}. "
        "Three elements "
        f"are needed from {STRONG:.1f} nats on. Number: this gain."
    )
    return Verdict(kind, gain, "nat", how)


def dominant_order(stated: Stated, compare: Mapping[str, Any]) -> Verdict:
    """I5: the largest order of every model that the evidence does not exclude."""
    ranked = [model for model in _ranked(compare) if not model["integer"]]
    best = max((model["log_evidence"] for model in ranked), default=None)
    names = [model["name"] for model in ranked if best is not None and best - model["log_evidence"] < STRONG]
    rows = [
        row
        for row in compare["order_is_integer"]
        if row["model"] in names and row["parameter"] in _LARGEST and row["grade"] != "unusable"
    ]
    if not rows:
        return undecided("no usable largest order is in it.")
    wanted = stated.records.dominant_order
    inside = [row["estimate"]["lower"] <= wanted <= row["estimate"]["upper"] for row in rows]
    settled = [row["answer"] == "not an integer" for row in rows]
    width = max(row["estimate"]["upper"] for row in rows) - min(row["estimate"]["lower"] for row in rows)
    said = ", ".join(
        f"{row['estimate']['lower']:.3g} to {row['estimate']['upper']:.3g} in {row['model']} "
        f"({row['answer']})"
        for row in rows
    )
    how = (
        f"{100 * rows[0]['estimate']['level']:g} % intervals of the largest order in the models the evidence "
        f"does not exclude: {said}; stated {wanted:g}. The data set it when every interval holds the stated "
        "order and the nearest integer is excluded. Number: the width of all intervals together."
    )
    return Verdict(Kind.of(all(inside) and all(settled)), width, "-", how)


def jointly(first: Test, second: Test) -> Test:
    """A claim that both tests must support; where one is undecided the other decides."""

    def test(stated: Stated, evidence: Evidence) -> Verdict:
        verdicts = [first(stated, evidence), second(stated, evidence)]
        decided = [verdict for verdict in verdicts if verdict.kind is not Kind.UNDECIDED]
        if not decided:
            return verdicts[0]
        worst = next((verdict for verdict in decided if verdict.kind is Kind.CONTRADICTED), decided[0])
        others = [verdict.how for verdict in decided if verdict is not worst]
        return Verdict(worst.kind, worst.number, worst.unit, " ".join([worst.how, *others]))

    return test


def _ranked(compare: Mapping[str, Any]) -> list[Model]:
    return [model for model in compare["models"] if model["usable"] and model["log_evidence"] is not None]


def _rivals(compare: Mapping[str, Any]) -> tuple[Model, Model] | None:
    """The best fractional and the best integer model by evidence."""
    ranked = _ranked(compare)
    kinds = [[model for model in ranked if model["integer"] is kind] for kind in (False, True)]
    if not all(kinds):
        return None
    free, whole = (max(models, key=lambda model: float(model["log_evidence"])) for models in kinds)
    return free, whole


def _rmse(model: Model) -> float | None:
    """Root mean square error over all records, fitted and held out [rad]; None in another unit."""
    rows: Sequence[Mapping[str, Any]] = [*model["fit_scores"], *model["held_out"]]
    if not rows or any(row["unit"] != "rad" for row in rows):
        return None
    total = sum(row["rmse"] ** 2 * row["samples"] for row in rows)
    return float((total / sum(row["samples"] for row in rows)) ** 0.5)


def _metric(model: Model, names: Sequence[str]) -> Mapping[str, Any] | None:
    return next((metric for metric in model["step_metrics"] if metric["name"] in names), None)


def _predicted(best: Model, other: Model) -> str:
    if best["elpd"] is None or other["elpd"] is None:
        return ""
    gain, error = best["elpd"] - other["elpd"], ""
    against = next((model for model in (best, other) if model["elpd_difference_sd"]), None)
    if against is not None and 0.0 in (best["elpd_difference"], other["elpd_difference"]):
        error = f" ± {against['elpd_difference_sd']:.2f}"  # the other of the two predicts best of all
    return f", and predicts held-out data by {gain:+.2f}{error} nats"
