"""What a loop found, as tables: errors before and after, evidence of every effect, what moved."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from lcopa_bayes.report.formatting import NONE, figures, interval, percent
from lcopa_bayes.report.section import Column, Section, Table


def sections(told: Mapping[str, Any]) -> list[Section]:
    """Everything of a loop that is words and numbers."""
    return [_found(told), _errors(told), _noise(told), _evidence(told), _rounds(told), _moved(told)]


def _found(told: Mapping[str, Any]) -> Section:
    text = [str(told["sentence"]), *(f"Caution: {one}" for one in told["cautions"])]
    if told.get("base_enlarged"):
        text.append(str(told["base_enlarged"]))
    for effect in told["effects"]:
        rest = effect["group"][1:]
        also = f" These records cannot tell it from {', '.join(rest)}." if rest else ""
        near = ", ".join(f"{one['name']} {one['cosine']:.2f}" for one in effect["nearest"])
        also += (
            f" Nearest to it, by the cosine of the angle between what each leaves: {near}." if near else ""
        )
        text.append(f"{effect['name']}: {effect['formula']} ({effect['source']}).{also}")
    if told["next_measurement"]:
        text.append(f"Next measurement: {told['next_measurement']}")
    columns = (
        *(Column("parameter", "code"), Column("value", "number"), Column("90 % interval", "interval")),
        *(Column("unit"), Column("prior sd", "number"), Column("grade", "grade")),
    )
    rows = tuple(
        (
            str(one["name"]),
            figures(one["value"]),
            interval(one["lower"], one["upper"], one["sd"]),
            str(one["unit"]),
            figures(one["prior_sd"], 2),
            str(one["grade"]),
        )
        for effect in told["effects"]
        for one in effect["parameters"]
    )
    constants = "; ".join(
        f"{effect['name']}: " + ", ".join(f"{key} {value}" for key, value in effect["constants"].items())
        for effect in told["effects"]
        if effect["constants"]
    )
    caption = "Coefficients of the effects; all vanish at zero." + (
        f" Constants: {constants}." if constants else ""
    )
    return Section("What was missing", tuple(text), (), (Table(columns, rows, caption),) if rows else ())


def _errors(told: Mapping[str, Any]) -> Section:
    before, after = told["before"], told["after"]
    columns = (
        *(Column("record"), Column("axis"), Column("unseen"), Column("RMSE before", "number")),
        *(
            Column("RMSE after", "number"),
            Column("after / noise", "number"),
            Column("90 % band before", "number"),
        ),
        *(Column("90 % band after", "number"), Column("unit"), Column("level from", "prose")),
    )
    rows = tuple(
        (
            *(str(a["record"]), str(a["axis"]), "yes" if a["held_out"] else ""),
            *(figures(a["rmse"]), figures(b["rmse"]), figures(b["rmse_over_noise"])),
            *(percent(a["coverage_90"]), percent(b["coverage_90"]), str(a["unit"])),
            str(b["level_from"]),
        )
        for a, b in zip(before["scores"], after["scores"], strict=True)
    )
    text = (
        f"Unseen records were predicted by {told['unseen_by']}. Pointwise 90 % bands hold "
        f"{percent(before['held_out_coverage_90'])} of their samples before and "
        f"{percent(after['held_out_coverage_90'])} after; log evidence "
        f"{figures(before['log_evidence'], 6)} before and {figures(after['log_evidence'], 6)} after "
        "(Laplace approximation, noise held at its estimate)."
    )
    caption = (
        "Root mean square of observed minus predicted, and the share of samples inside the pointwise band "
        "with noise. Where the level comes from the record itself, a constant error of it cannot show."
    )
    return Section("Errors before and after", (text,), (), (Table(columns, rows, caption),))


def _noise(told: Mapping[str, Any]) -> Section:
    return Section("Noise, measured first", tuple(str(one["sentence"]) for one in told["noise"]))


def _evidence(told: Mapping[str, Any]) -> Section:
    found = told["evidence"]
    if not found["classes"]:
        return Section("Evidence of every effect", ("Nothing was traced: the base fit cannot be used.",))
    columns = (
        *(Column("effect", "code"), Column("place"), Column("log Bayes factor [nat]", "number")),
        *(Column("probability", "number"), Column("survival", "number"), Column("shown by", "prose")),
        Column("else mistaken for", "prose"),
    )
    rows = tuple(
        (
            *(str(one["name"]), str(one["place"]), figures(one["log_bayes_factor"])),
            *(figures(one["probability"], 2), figures(one["survival"], 2)),
            *(str(one["reveals"]), str(one["mistaken_for"]) or NONE),
        )
        for one in found["classes"]
    )
    text = (
        f"Chance alone reaches {figures(found['threshold'])} nat once in a hundred times "
        f"({found['draws']} draws, "
        f"no less than 3); p-value of the largest {figures(found['p_value'], 2)}, whose floor is "
        f"{figures(1 / (found['draws'] + 1), 2)}. Probability that nothing is missing: "
        f"{figures(found['none'], 2)}."
    )
    caption = (
        "Survival is the share of an effect's signature that the base model cannot imitate, known "
        "before looking "
        "at the residual: below 0.1 these records cannot see the effect."
    )
    return Section("Evidence of every effect", (text,), (), (Table(columns, rows, caption),))


def _rounds(told: Mapping[str, Any]) -> Section:
    columns = (
        *(Column("round", "number"), Column("refitted", "code"), Column("log Bayes factor [nat]", "number")),
        *(Column("left-out gain [nat]", "number"), Column("beyond 3 sd"), Column("kept")),
    )
    rows = tuple(
        (
            *(str(number), ", ".join(one["added"]), figures(one["log_bayes_factor"])),
            *(figures(one["left_out_gain"]), "yes" if one["significant"] else "no"),
            "yes" if one["added"] == made["chosen"] else "",
        )
        for number, made in enumerate(told["rounds"], start=1)
        for one in made["refits"]
    )
    if not rows:
        return Section("Refits", ("No candidate had to be refitted.",))
    failures = tuple(f"Could not be refitted: {one}." for made in told["rounds"] for one in made["failures"])
    return Section(
        "Refits", failures, (), (Table(columns, rows, "Candidates refitted with everything free."),)
    )


def _moved(told: Mapping[str, Any]) -> Section:
    if not told["moved"]:
        return Section("What it had done to the parameters", ("No parameter moved by more than 2 sd.",))
    columns = (
        *(Column("parameter", "code"), Column("before", "number"), Column("after", "number")),
        *(Column("shift [sd]", "number"), Column("unit")),
    )
    rows = tuple(
        (
            *(str(one["name"]), figures(one["before"], 4), figures(one["after"], 4)),
            *(figures(one["shift_in_sd"], 2), str(one["unit"])),
        )
        for one in told["moved"]
    )
    text = "Without the effect these parameters were biased by more than 2 sd of the fit with it."
    return Section("What it had done to the parameters", (text,), (), (Table(columns, rows),))
