"""What a fleet says together: its table, populations of parameters, who does not belong, a verdict."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta

from lcopa_bayes.core.arrays import Array, Matrix
from lcopa_bayes.core.estimate import LEVEL, plain
from lcopa_bayes.core.wording import listed
from lcopa_bayes.fleets.population import LEVELS, Population, has_likelihood, population_of
from lcopa_bayes.sampling.importanceweights import LARGEST_K

_ODD = 0.5
"""Probability from which a device is said not to belong [-]."""
_FEW = 8
"""Devices below which a spread is uncertain to more than half of it [-]."""
_MOST_FAILED = 0.05
"""Share of devices whose weights may fail [-]."""
_MOST_OF_THEM = 0.9
"""Share of reliable devices above which a fleet is reliable [-]."""
_CURVES = 24
"""Devices whose curves are kept for the page."""
_RANKS = {"failed": 0, "unusable": 1, "tentative": 2, "reliable": 3}
_NAMED = 6
"""Most devices that a sentence names."""
_TWO = "a spread cannot be estimated from two devices"


def results(
    name: str, verb: str, outcomes: Sequence[Mapping[str, Any]], draws: Mapping[str, Matrix]
) -> dict[str, Any]:
    """Every number of a fleet as plain values; `draws` are those of each device (`devices.plant_of`)."""
    rows = {one["row"]["device"]: dict(one["row"]) for one in outcomes}
    for row in rows.values():
        row["differs_in"], row["p_odd"] = "", None
    groups = []
    for number, members in enumerate(_groups(outcomes), start=1):
        groups.append(_group(number, members, draws))
        for one in groups[-1]["parameters"]:
            for each in one["devices"]:
                row = rows[each["device"]]
                row["p_odd"] = max(row["p_odd"] or 0.0, each["p_odd"])
                if each["p_odd"] > _ODD:
                    row["differs_in"] += ", " * bool(row["differs_in"]) + one["name"]
    ordered = sorted(rows.values(), key=_badness)
    curves = {one["row"]["device"]: one.get("curve") for one in outcomes}
    shown = [{"device": row["device"]} | (curves[row["device"]] or {}) for row in ordered]
    seconds = [one["seconds"] for one in outcomes if "seconds" in one]
    grade, reason = _graded(ordered, groups)
    values = {
        "study": name,
        "of": verb,
        "grade": grade,
        "grade_reason": reason,
        "counts": {one: sum(row["grade"] == one for row in ordered) for one in reversed(_RANKS)},
        "devices": ordered,
        "groups": groups,
        "shares": _shares(verb, ordered),
        "curves": [one for one in shown if len(one) > 1][:_CURVES],
        "seconds": {"total": sum(seconds), "median": np.median(seconds) if seconds else None},
    }
    return plain({**values, "verdict": _verdict(values)})


def _groups(outcomes: Iterable[Mapping[str, Any]]) -> list[list[Mapping[str, Any]]]:
    """Devices of the same axes and parameters, the most first."""
    groups: dict[str, list[Mapping[str, Any]]] = {}
    for one in outcomes:
        if one.get("plant"):
            groups.setdefault(json.dumps(one["plant"], sort_keys=True), []).append(one)
    return sorted(groups.values(), key=len, reverse=True)


def _group(number: int, members: Sequence[Mapping[str, Any]], draws: Mapping[str, Matrix]) -> dict[str, Any]:
    plant = members[0]["plant"]
    count, parameters = len(plant["parameters"]), []
    names = [one["row"]["device"] for one in members]
    unusable = {one["row"]["device"] for one in members if one["row"]["grade"] == "unusable"}
    unusable |= {one for one in names if not has_likelihood(draws[one][:, :count])}
    used = [one for one in names if one not in unusable]
    sure = sum(one["row"]["grade"] == "reliable" for one in members) / len(members)
    for k, row in enumerate(plant["parameters"] if len(used) > 1 else ()):
        columns = [draws[device][:, k] for device in used]
        priors = [draws[device][:, count + k] for device in used]
        population = population_of(columns, priors, np.random.default_rng([number, k]))
        parameters.append(_parameter(row, used, columns, population, sure))
    about = f"{', '.join(plant['drives'])} to {', '.join(plant['responses'])}, times in {plant['time_unit']}"
    sentence = ""
    if len(used) < 2:
        sentence = f"{used[0] if used else 'No device'} stands alone: a population needs two devices or more."
    return {
        "number": number,
        "about": f"{about}; {', '.join(row['name'] for row in plant['parameters'])}",
        "time_unit": plant["time_unit"],
        "devices": used,
        "left_out": [one for one in names if one in unusable],
        "sentence": sentence,
        "parameters": parameters,
    }


def _parameter(
    row: Mapping[str, Any], names: Sequence[str], columns: Sequence[Array], of: Population, sure: float
) -> dict[str, Any]:
    """Numbers of the population of a parameter, in its unit."""

    def unit(x: Array) -> Array:
        return np.exp(x) if row["log"] else x

    spread = of.spread
    if row["log"]:  # half of the range that holds 68 % of the devices
        spread = np.exp(of.mean) * np.sinh(np.minimum(of.spread, 300.0))
    middle, sd = of.prior
    devices = [
        {
            "device": name,
            "own": _interval(unit(own)),
            "shrunk": _interval(unit(shrunk)),
            "p_odd": odd,
            "pareto_k": k,
            "weights": "failed" if failed else "used",
        }
        for name, own, shrunk, odd, k, failed in zip(
            names, columns, of.shrunk, of.odd, of.pareto_k, of.failed, strict=True
        )
    ]
    grade, reason = _trusted(len(names), float(np.mean(of.failed & (of.odd <= _ODD))), sure)
    return {
        **row,
        "mean": _interval(unit(of.mean)),
        "spread": _interval(spread),
        "log_spread": _interval(of.spread) if row["log"] else None,
        "next": _interval(unit(of.following)),
        "prior": {"dist": "lognorm", "s": sd, "scale": float(np.exp(middle))}
        if row["log"]
        else {"dist": "norm", "loc": middle, "scale": sd},
        "largest_k": float(np.nanmax(of.pareto_k)) if np.isfinite(of.pareto_k).any() else None,
        "weights_failed": int(of.failed.sum()),
        "grade": grade,
        "grade_reason": reason,
        "devices": devices,
    }


def _interval(draws: Array) -> dict[str, float]:
    ends = np.quantile(draws, LEVELS).tolist()
    return dict(zip(("lower", "lower_50", "value", "upper_50", "upper"), ends, strict=True))


def _trusted(count: int, failed: float, sure: float) -> tuple[str, str]:
    """Grade of a population, and why."""
    if count < 3:
        return "unusable", _TWO
    if failed > _MOST_FAILED:
        why = f"the weights of {100 * failed:.0f} % of its devices fail (Pareto k above {LARGEST_K:g})"
        return "tentative", f"{why}: normal likelihoods stand for their draws"
    if count < _FEW:
        return "tentative", f"{count} devices leave the spread uncertain; {_FEW} or more determine it"
    if sure < _MOST_OF_THEM:
        return "tentative", f"only {100 * sure:.0f} % of its devices are graded reliable"
    return "reliable", f"{count} devices, {100 * sure:.0f} % of them graded reliable"


def _badness(row: Mapping[str, Any]) -> tuple[Any, ...]:
    """Sorts the worst device first."""
    white = row.get("p_white")
    return _RANKS[row["grade"]], not row["differs_in"], -(row["p_odd"] or 0.0), white or 0.0, row["device"]


def _graded(rows: Sequence[Mapping[str, Any]], groups: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    counts = Counter(row["grade"] for row in rows)
    share = counts["reliable"] / len(rows)
    said = f"{counts['reliable']} of {len(rows)} devices are graded reliable"
    worst = min((p for one in groups[:1] for p in one["parameters"]), key=_by_grade, default=None)
    if counts["failed"] + counts["unusable"] > len(rows) / 2:
        return "unusable", said
    if worst is not None and worst["grade"] == "unusable":
        return "unusable", worst["grade_reason"]
    if counts["failed"]:
        return "tentative", f"{said}, {counts['failed']} failed"
    if share < _MOST_OF_THEM:
        return "tentative", said
    if worst is not None and worst["grade"] != "reliable":
        return "tentative", f"{worst['name']}: {worst['grade_reason']}"
    return "reliable", said


def _by_grade(one: Mapping[str, Any]) -> int:
    return _RANKS[one["grade"]]


def _shares(verb: str, rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """How many devices have an effect, or prefer a candidate, with a binomial interval (Jeffreys: Brown, Cai
    and DasGupta 2001, Statistical Science 16)."""
    key = {"loop": "effects", "compare": "preferred"}.get(verb)
    done = [row for row in rows if row["grade"] != "failed"]
    found = (
        Counter(name for row in done for name in (row.get(key) or "none").split("; ")) if key else Counter()
    )
    out = []
    for name, count in found.most_common():
        shape, tail = (count + 0.5, len(done) - count + 0.5), (1 - LEVEL) / 2
        lower = 0.0 if count == 0 else beta.ppf(tail, *shape)
        upper = 1.0 if count == len(done) else beta.ppf(1 - tail, *shape)
        share = count / len(done)
        out.append({"name": name, "devices": count, "share": share, "lower": lower, "upper": upper})
    return out


def _verdict(values: Mapping[str, Any]) -> str:
    rows, groups, counts = values["devices"], values["groups"], values["counts"]
    graded = ", ".join(f"{count} {one}" for one, count in counts.items() if count)
    parts = [f"{len(rows)} device{'s' * (len(rows) > 1)} by `{values['of']}`: {graded}."]
    odd = [f"{row['device']} ({row['differs_in']})" for row in rows if row["differs_in"]]
    if odd:
        verb = "do not belong" if len(odd) > 1 else "does not belong"
        parts.append(f"{len(odd)} {verb} to the population: {listed(odd, _NAMED)}.")
    elif any(one["parameters"] for one in groups):
        parts.append("No device stands out from the population.")
    if len(groups) > 1:
        sizes = " and ".join(str(len(one["devices"])) for one in groups)
        parts.append(f"Devices of other axes or structures are {len(groups)} groups, of {sizes}.")
    two = any(p["grade_reason"] == _TWO for one in groups for p in one["parameters"])
    parts += [f"{_TWO[0].upper()}{_TWO[1:]}."] if two else []
    parts += [one["sentence"] for one in groups if one["sentence"]]
    for one in values["shares"][:_NAMED]:
        ends = f"90 % interval {100 * one['lower']:.0f} to {100 * one['upper']:.0f} %"
        parts.append(f"{one['name']}: {one['devices']} devices, {100 * one['share']:.0f} % ({ends}).")
    failed = {row["device"]: row["reason"] for row in rows if row["grade"] == "failed"}
    for name in list(failed)[:1]:
        parts.append(f"Failed: {listed(list(failed), _NAMED)}; {name}: {failed[name].rstrip('.')}.")
    return " ".join(parts)
