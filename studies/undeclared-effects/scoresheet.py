"""What the rows of many campaigns add up to, each number beside its target and its error."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import beta, norm

Row = Mapping[str, Any]
NAMING = ("explained", "partly explained", "disturbance")
"""Verdicts that name effects."""
EQUIVALENT = {"duffing_with_memory": {"cubic_stiffness"}, "fringing_gain": {"odd_curvature"}}
"""Outsiders whose leading term the catalogue has: naming it, and nothing else, counts as right. A gain that
changes with the deflection is an odd curvature of every axis while one axis moves."""

FIGURES = {
    "gain": "gains",
    "delay": "delays",
    "value_at_end": "values at record end",
    "rise_10_90": "rise times",
}
"""Numbers of the device that are scored, by how their names begin."""
SIZES = {"": "sizes and constants of effects"}
PATHS = {"steady_state": "steady states"} | {
    key: FIGURES[key] for key in ("delay", "value_at_end", "rise_10_90")
}
"""The same of the paths of foreign plants."""


def bounds(hits: float, trials: float, level: float = 0.95) -> tuple[float, float]:
    """Two-sided Clopper-Pearson interval of a share [-]."""
    tail = (1 - level) / 2
    low = float(beta.ppf(tail, hits, trials - hits + 1)) if hits else 0.0
    high = float(beta.ppf(1 - tail, hits + 1, trials - hits)) if hits < trials else 1.0
    return low, high


def first_of(row: Row) -> str:
    """The effect put first: the first named, else the best refit, else the leading named class; or
    nothing."""
    if row["named"]:
        return str(row["named"][0])
    for made in row["refits"]:
        if made:
            return str(made[0][0][0])
    return ""


def independent(held: Sequence[Sequence[bool]]) -> float:
    """Independent trials that know the share of hits of all campaigns as well as theirs do [-].

    What numbers of one campaign have in common makes the shares of campaigns scatter by more than chance
    (Kish 1965, Survey Sampling, 5.4). Between the number of campaigns and that of all trials.
    """
    hits, sizes = (np.array([float(f(one)) for one in held if one]) for f in (sum, len))
    trials, most = sizes.sum(), sizes.size
    value = hits.sum() / trials
    spread = ((hits - value * sizes) ** 2).sum() / trials**2 * most / max(most - 1, 1)
    return float(np.clip(value * (1 - value) / spread if spread else most, most, trials))


def share(
    name: str, rows: Sequence[Any], right: Callable[[Any], bool], target: Any, side: str
) -> dict[str, Any]:
    """One line of the sheet: a share with its interval; `side` says whether it must be "least", "most" or
    "within" two numbers."""
    hits, trials = sum(map(right, rows)), len(rows)
    if not trials:
        return {"measure": name, "target": target, "side": side, "value": None, "trials": 0}
    low, high = bounds(hits, trials)
    value = hits / trials
    line = {"measure": name, "target": target, "side": side, "value": value, "lower": low, "upper": high}
    return line | {"trials": trials}


def standing(line: Row) -> str:
    """Whether a line reaches its target: "yes", "no", or "open" where its value does not but its 95 %
    interval does, so that more campaigns decide."""
    target, value = line["target"], line["value"]
    ends = {"within": target, "least": (target, np.inf), "most": (-np.inf, target)}
    least, most = ends[line["side"]]
    if least <= value <= most:
        return "yes"
    return "open" if line.get("lower", value) <= most and line.get("upper", value) >= least else "no"


def number(
    name: str, values: Sequence[float], reduce: Callable[..., Any], target: Any, side: str
) -> dict[str, Any]:
    """One line of the sheet: a summary of many numbers."""
    finite = [value for value in values if value is not None and np.isfinite(value)]
    if not finite:
        return {"measure": name, "target": target, "side": side, "value": None, "trials": 0}
    value = float(reduce(finite))
    return {
        "measure": name,
        "target": target,
        "side": side,
        "value": value,
        "trials": len(finite),
        "quartiles": [float(q) for q in np.quantile(finite, [0.25, 0.75])],
    }


def sheet(rows: Sequence[Row], targets: Mapping[str, Any], seen: float) -> list[dict[str, Any]]:
    """Every measure of "What to hold ourselves to"."""
    usable = [row for row in rows if not row["crashed"] and row["kind"] != "foreign"]
    by = {
        kind: [row for row in usable if row["kind"] == kind]
        for kind in ("clean", "coloured", "heavy", "named")
    }
    by |= {kind: [row for row in usable if row["kind"] == kind] for kind in ("plain", "outside", "pair")}
    controls = [row for row in usable if row["kind"] == "control"]
    cells = sorted({(row["correlation"], row["quiet"]) for row in controls})
    visible = [row for row in by["named"] if (_survival(row) or 0.0) > seen or _survival(row) is None]
    alarmed = [row for row in visible if row["alarmed"]]
    hidden = [row for row in [*by["named"], *by["plain"]] if (_survival(row) or 1.0) <= seen and row["named"]]
    single = [*by["named"], *by["plain"]]
    saying = [row for row in single if row["named"]]
    firm = [
        row
        for row in [*single, *by["pair"], *by["outside"]]
        if row["verdict"] in NAMING and row["confidence"] == "firm"
    ]
    corrected = [row for row in by["named"] if row["verdict"] in NAMING]
    widened = [row for row in [*by["named"], *by["outside"]] if row["verdict"] == "unexplained"]
    plants = [row for row in corrected if not row["disturbance"]]
    ratio = [_ratio(row) for row in plants]
    over = [row["after"]["fit_over_noise"] for row in [*by["clean"], *plants]]
    clean, inside = [row for row in usable if row["verdict"] == "clean"], targets["coverage"]
    return [
        share(
            "false alarms, white noise",
            by["clean"],
            lambda r: r["verdict"] != "clean",
            targets["false_alarms"],
            "most",
        ),
        share(
            "false alarms, coloured noise",
            by["coloured"],
            lambda r: r["verdict"] != "clean",
            targets["false_alarms"],
            "most",
        ),
        *(
            share(
                f"false alarms, correlation {rho:g}, {quiet} samples at rest",
                [row for row in controls if (row["correlation"], row["quiet"]) == (rho, quiet)],
                lambda r: r["verdict"] != "clean",
                targets["false_alarms"],
                "most",
            )
            for rho, quiet in cells
        ),
        share(
            "false alarms, all correlations and samples at rest",
            controls,
            lambda r: r["verdict"] != "clean",
            targets["false_alarms"],
            "most",
        ),
        share(
            "the same, firm",
            controls,
            lambda r: r["verdict"] != "clean" and r["confidence"] == "firm",
            targets["false_alarms"],
            "most",
        ),
        share(
            "false alarms, heavy-tailed noise",
            by["heavy"],
            alarming,
            targets["false_alarms"],
            "most",
        ),
        share("noticed, where it survives", visible, lambda r: r["alarmed"], 0.0, "least"),
        share(
            "right effect first, where it survives",
            visible,
            lambda r: first_of(r) in r["truth"],
            targets["right_first"],
            "least",
        ),
        share(
            "the same among those noticed",
            alarmed,
            lambda r: first_of(r) in r["truth"],
            targets["right_first"],
            "least",
        ),
        share("elsewhere the group holds the truth", hidden, _grouped, targets["right_when_named"], "least"),
        share("right when it says anything", saying, _grouped, targets["right_when_named"], "least"),
        share("right when it is firm", firm, _right, targets["right_when_firm"], "least"),
        share(
            "outsiders left unexplained",
            [r for r in by["outside"] if r["alarmed"]],
            _outside,
            targets["outsiders_unexplained"],
            "least",
        ),
        number(
            "held-out error after / before, median",
            ratio,
            np.median,
            targets["held_out_ratio_median"],
            "most",
        ),
        number(
            "held-out error after / before, largest", ratio, np.max, targets["held_out_ratio_largest"], "most"
        ),
        number("fit RMSE after / noise, median", over, np.median, targets["fit_over_noise"], "most"),
        number("90 % bands, clean", [r["coverage_after"] for r in by["clean"]], np.mean, inside, "within"),
        number("90 % bands, corrected", [r["coverage_after"] for r in corrected], np.mean, inside, "within"),
        number(
            "90 % bands, widened",
            [r["coverage_after"] for r in widened],
            np.mean,
            targets["coverage_widened"],
            "least",
        ),
        number(
            "90 % bands before correction", [r["coverage_before"] for r in corrected], np.mean, 0.0, "least"
        ),
        *intervals("nothing hidden", [r for r in clean if not r["truth"]], "plant_after", targets),
        *intervals("clean, an effect hidden", [r for r in clean if r["truth"]], "plant_after", targets),
        *intervals("heavy-tailed", by["heavy"], "plant_after", targets),
        *intervals("corrected", plants, "plant_after", targets),
        *intervals("corrected, final model alone", plants, "plant_alone", None),
        *intervals("before correction", plants, "plant_before", None),
        *intervals("named effects", [r for r in usable if r["named"]], "sizes_after", targets, SIZES),
        share("two effects, both found", by["pair"], _both, targets["two_effects"], "least"),
        share(
            "the same where both survive",
            [row for row in by["pair"] if all((one or 1.0) > seen for one in _told(row))],
            _both,
            targets["two_effects"],
            "least",
        ),
        *_foreign([row for row in rows if row["kind"] == "foreign" and not row["crashed"]], targets, seen),
        share("crashed", list(rows), lambda r: bool(r["crashed"]), 0.0, "most"),
    ]


def _foreign(rows: Sequence[Row], targets: Mapping[str, Any], seen: float) -> list[dict[str, Any]]:
    """Lines of plants outside the family."""
    name = "foreign plants"
    bare = [row for row in rows if not row["effects"]]
    visible = [row for row in rows if row["effects"] and (_survival(row) is None or _survival(row) > seen)]
    ratio = [_ratio(row) for row in rows if row["verdict"] in NAMING and not row["disturbance"]]
    most = targets["held_out_ratio_largest"]
    return [
        share(f"an effect named, {name}", bare, lambda r: bool(r["named"]), targets["false_alarms"], "most"),
        share(f"clean, {name}", bare, lambda r: r["verdict"] == "clean", 0.0, "least"),
        share(
            f"right effect first, where it survives, {name}",
            visible,
            lambda r: first_of(r) in r["truth"],
            targets["right_first"],
            "least",
        ),
        number(f"held-out error after / before, {name}, largest", ratio, np.max, most, "most"),
        *intervals(name, _concluded(rows), "plant_after", targets, PATHS),
    ]


def plants(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Foreign plants by kind: campaigns, those with nothing hidden, of these the clean and the named, and the
    90 % intervals of each figure that hold the truth, of how many."""
    out = []
    for kind in dict.fromkeys(row["plant"] for row in rows if row["kind"] == "foreign"):
        own = [row for row in rows if row["plant"] == kind]
        done = [row for row in own if not row["crashed"]]
        bare = [row for row in done if not row["effects"]]
        line = {"plant": kind, "campaigns": len(own), "bare": len(bare)}
        line["clean"] = sum(row["verdict"] == "clean" for row in bare)
        line["named"] = sum(bool(row["named"]) for row in bare)
        lines = intervals(kind, _concluded(done), "plant_after", None, PATHS)[len(PATHS) :]
        line["held"] = {
            key: [round(one["trials"] * (one["value"] or 0.0)), one["trials"]]
            for key, one in zip(PATHS, lines, strict=True)
        }
        out.append(line)
    return out


LINEAR = "Unmodelled linear dynamics are missing: "
"""How a loop says that sums of lags are all that the records ask for."""


def _concluded(rows: Sequence[Row]) -> list[Row]:
    """Those whose numbers the loop stands by: of linear dynamics that are missing, those of sums of lags."""
    return [row for row in rows if row["verdict"] != "unexplained" or LINEAR in row["sentence"]]


def _ratio(row: Row) -> float:
    """Held-out error after over before, against the response without noise [-]."""
    return row["after"]["held_out_truth_over_noise"] / row["before"]["held_out_truth_over_noise"]


def intervals(
    name: str,
    rows: Sequence[Row],
    when: str,
    targets: Mapping[str, Any] | None,
    kinds: Mapping[str, str] = FIGURES,
) -> list[dict[str, Any]]:
    """Lines of the sheet: how often intervals of numbers of these kinds hold those of the device. Without
    `targets` the shares are reported only."""
    out = []
    for level, key in ((0.5, "intervals_50"), (0.9, "intervals_90")):
        width = float(norm.ppf(0.5 + level / 2))
        for kind, plural in kinds.items():
            held = [
                [abs(z) <= width for what, z in row[when].items() if what.startswith(kind)] for row in rows
            ]
            line = share(
                f"{100 * level:.0f} % intervals of the {plural}, {name}",
                [one for own in held for one in own],
                bool,
                targets[key] if targets else 0.0,
                "within" if targets else "least",
            )
            if line["trials"]:
                count = independent(held)
                line["lower"], line["upper"] = bounds(line["value"] * count, count)
            out.append(line)
    return out


def matrix(rows: Sequence[Row]) -> dict[str, dict[str, int]]:
    """How often each hidden effect was put down to which name, over single effects and outsiders."""
    out: dict[str, Counter[str]] = {}
    for row in rows:
        if row["crashed"] or len(row["effects"]) > 1:
            continue
        hidden = f"{row['effects'][0]} ({row['drives']})" if row["effects"] else f"nothing ({row['kind']})"
        said = row["named"][0] if row["named"] else row["verdict"]
        out.setdefault(hidden, Counter())[said] += 1
    return {hidden: dict(said.most_common()) for hidden, said in sorted(out.items())}


def _survival(row: Row) -> float | None:
    values = list(row["survival"].values())
    return values[0] if values else None


def _told(row: Row) -> list[float | None]:
    """Survival of every hidden effect; None for one that changes only the noise."""
    return [one if one is None or one > 0 else 1e-9 for one in row["survival"].values()]


def alarming(row: Row) -> bool:
    """Whether something else is said than that the noise is what it is."""
    return row["verdict"] not in ("clean", "disturbance") or not set(row["named"]) <= set(row["truth"])


def _grouped(row: Row) -> bool:
    return any(row["truth"][0] in group for group in row["groups"])


def _outside(row: Row) -> bool:
    allowed = EQUIVALENT.get(row["truth"][0], set())
    return row["verdict"] == "unexplained" or (bool(row["named"]) and set(row["named"]) <= allowed)


def _right(row: Row) -> bool:
    """Whether no name is wrong: each is hidden, or the leading term of what is."""
    truth = set(row["truth"]).union(*(EQUIVALENT.get(name, set()) for name in row["truth"]))
    return set(row["named"]) <= truth


def _both(row: Row) -> bool:
    return set(row["truth"]) <= {name for group in row["groups"] for name in group}
