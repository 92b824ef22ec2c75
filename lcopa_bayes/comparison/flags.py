"""What a reader of a comparison must not overlook."""

from __future__ import annotations

from collections.abc import Sequence

from lcopa_bayes.comparison.gains import Row

RESONANT = 1.5
"""Order from which a single term overshoots visibly [-]."""
NOT_WHITE = 0.01
"""p-value below which a whitened residual is not white [-]."""


def flags(rows: Sequence[Row]) -> list[dict[str, str]]:
    """What a reader must not overlook, per candidate."""
    out: list[dict[str, str]] = []
    for row in rows:
        out += missed_modes(row)
        if not row["usable"]:
            continue
        left = [one for one in row["residual_tests"] if not one["held_out"]]
        worst = min(left, key=lambda one: one["p_white"], default=None)
        if worst is None or worst["p_white"] >= NOT_WHITE:
            continue
        high = [one["estimate"] for one in row["order_is_integer"] if one["estimate"]["lower"] > RESONANT]
        said = (
            f"on {worst['record']}, axis {worst['axis']}, what it leaves is not white "
            f"(p = {worst['p_white']:.1g})"
        )
        if high:
            names = ", ".join(f"{one['name']} = {one['value']:.3g}" for one in high)
            said = (
                f"{names} makes it overshoot, and {said}: the high order may imitate an overshoot of another "
                "origin, such as a pulse of the drive that is not in the record"
            )
        out.append({"model": row["name"], "kind": "imitation" if high else "residual", "sentence": said})
    ranked = [row for row in rows if row["usable"] and row["held_out"]]
    for axis in dict.fromkeys(one["axis"] for row in ranked for one in row["fit_scores"]):
        fitted = min(ranked, key=lambda row: row["residual_rms"][axis])
        error = {row["name"]: row["held_out_rmse"].get(axis) for row in ranked}
        if None in error.values() or len(ranked) < 2:
            continue
        if max(error, key=lambda name: error[name]) == fitted["name"]:
            least = min(error, key=lambda name: error[name])
            out.append(
                {
                    "model": fitted["name"],
                    "kind": "overfit",
                    "sentence": (
                        f"it fits axis {axis} best (RMSE {fitted['residual_rms'][axis]:.3g}) and predicts it "
                        f"worst (RMSE {error[fitted['name']]:.3g}; {least}: {error[least]:.3g})"
                    ),
                }
            )
    return out


def missed_modes(row: Row) -> list[dict[str, str]]:
    """That a candidate was sampled again because a model it contains had found a mode it had missed."""
    held = row["containment"]
    missed = [one for one in held["contains"] if one["missed"]]
    if not missed:
        return []
    best = max(missed, key=lambda one: one["reached"])
    said = (
        f"its first sampling missed a mode that {best['model']}, which it contains, had found (best log "
        f"likelihood {best['own']:.1f} against {best['reached']:.1f} there); it was sampled again with that "
        "mode among the proposals"
    )
    if not held["met"]:
        said += ", and still has not met it: it is ranked nowhere"
    return [{"model": row["name"], "kind": "missed mode", "sentence": said}]
