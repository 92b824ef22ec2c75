"""Effective sample sizes from the errors of repeated estimates, and methods compared by them per second."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector

WANTED = 20.0
"""Ratio of effective draws per CPU second that the project asks for [-]."""


@dataclass(frozen=True)
class Piece:
    """Estimates of one independent part of a run."""

    means: Vector
    """Of the quantities, (quantities,)."""
    squares: Vector
    """Means of their squares, (quantities,)."""
    told: float
    """Effective sample size by the method's own account [draws]."""
    cpu: float
    """[s]"""
    wall: float
    """[s]"""
    log_evidence: float = np.nan
    finished: bool = True


@dataclass(frozen=True)
class Known:
    """Estimates with their error."""

    means: Vector
    variances: Vector
    """Squared standard errors of the means, (quantities,)."""

    @classmethod
    def of(cls, estimates: Matrix) -> "Known":
        """Mean of independent estimates, at least two, (parts, quantities)."""
        return cls(estimates.mean(axis=0), estimates.var(axis=0, ddof=1) / len(estimates))

    def averaged(self, other: "Known") -> "Known":
        """Mean of two."""
        return Known((self.means + other.means) / 2, (self.variances + other.variances) / 4)


def shown_by_errors(estimates: Matrix, variance: Vector, reference: Known, parts: int = 1) -> Vector:
    """Independent draws that would err as much: posterior variance over mean squared error, (quantities,).

    `estimates`, (n, quantities), of independent parts, of which a run has `parts`. The squared error of a run
    is the parts' variance over `parts`, plus the squared distance of their mean from the reference beyond
    what chance explains in both. One estimate alone: its squared distance from the reference.
    """
    distance = (estimates.mean(axis=0) - reference.means) ** 2
    if len(estimates) == 1:
        return np.asarray(variance / distance)
    scatter = estimates.var(axis=0, ddof=1)
    bias = np.maximum(distance - scatter / len(estimates) - reference.variances, 0.0)
    return np.asarray(variance / (scatter / parts + bias))


def compared(names: list[str], found: dict[str, list[Piece]], parts: dict[str, int]) -> dict[str, Any]:
    """The report: reference, a row per method, ratios of the first method to each.

    `found` has the parts of each method, `parts` how many of them make a run. The first two methods are the
    methods of the reference: each of them is judged by the other, all others by both.
    """
    first_method, second_method, *_ = found
    estimates = {method: np.array([one.means for one in pieces]) for method, pieces in found.items()}
    first, second = Known.of(estimates[first_method]), Known.of(estimates[second_method])
    both = first.averaged(second)
    squares = [
        np.mean([one.squares for one in found[method]], axis=0) for method in (first_method, second_method)
    ]
    variance = np.mean(squares, axis=0) - both.means**2
    against = {first_method: second, second_method: first}
    rows = []
    for method, pieces in found.items():
        ess = shown_by_errors(estimates[method], variance, against.get(method, both), parts[method])
        cpu = parts[method] * float(np.mean([one.cpu for one in pieces]))
        told = parts[method] * float(np.mean([one.told for one in pieces]))
        evidences = [one.log_evidence for one in pieces]
        rows.append(
            {
                "method": method,
                "estimates": len(pieces),
                "estimates_per_run": parts[method],
                "finished": all(one.finished for one in pieces),
                "cpu_s_per_run": cpu,
                "wall_s_per_run": parts[method] * float(np.mean([one.wall for one in pieces])),
                "log_evidence": float(np.mean(evidences)) if np.isfinite(evidences).all() else None,
                "ess_told": told,
                "ess_told_per_s": told / cpu,
                "ess_shown": float(ess.min()),
                "ess_shown_limited_by": names[int(ess.argmin())],
                "ess_shown_per_s": float(ess.min()) / cpu,
                "ess_shown_median_per_s": float(np.median(ess)) / cpu,
                "ess_shown_by_quantity": dict(zip(names, ess.tolist(), strict=True)),
                "estimates_by_quantity": dict(zip(names, estimates[method].T.tolist(), strict=True)),
            }
        )
    best = rows[0]
    for row in rows:
        for kind in ("told", "shown", "shown_median"):
            row[f"ratio_{kind}"] = best[f"ess_{kind}_per_s"] / row[f"ess_{kind}_per_s"]
        row["reached"] = None if row is best else min(row["ratio_told"], row["ratio_shown"]) >= WANTED
    apart = np.abs(first.means - second.means) / np.sqrt(first.variances + second.variances)
    return {
        "wanted_ratio": WANTED,
        "reference": {
            name: {"value": m, "standard_error": s, "posterior_sd": d, "methods_apart_in_errors": z}
            for name, m, s, d, z in zip(
                names,
                *(one.tolist() for one in (both.means, both.variances**0.5, variance**0.5, apart)),
                strict=True,
            )
        },
        "methods": rows,
    }


COLUMNS = {
    "CPU s per run": "cpu_s_per_run",
    "ESS told": "ess_told",
    "told per s": "ess_told_per_s",
    "ratio told": "ratio_told",
    "ESS shown": "ess_shown",
    "shown per s": "ess_shown_per_s",
    "ratio shown": "ratio_shown",
}
"""Columns of the table by their key in the report."""


def table(report: dict[str, Any]) -> str:
    """The report's methods in Markdown, with a sentence on each rival."""
    lines = [f"| method | {' | '.join(COLUMNS)} | limited by |", f"|---|{'---:|' * len(COLUMNS)}---|"]
    for row in report["methods"]:
        name = row["method"] + ("" if row["finished"] else " (stopped before its end)")
        numbers = [f"{row[key]:.3g}" for key in COLUMNS.values()]
        lines.append(f"| {' | '.join([name, *numbers, row['ess_shown_limited_by']])} |")
    verdicts = [
        f"{row['method']}: told {row['ratio_told']:.3g}, shown {row['ratio_shown']:.3g} "
        f"({'reached' if row['reached'] else 'not reached'})"
        for row in report["methods"][1:]
    ]
    wanted = f"Ratio wanted of both kinds: {report['wanted_ratio']:g}. Ratios against {'; '.join(verdicts)}."
    reference = report["reference"]
    name = max(reference, key=lambda key: reference[key]["methods_apart_in_errors"])
    apart = (
        f"The two methods of the reference are furthest apart in {name}, "
        f"{reference[name]['methods_apart_in_errors']:.1f} standard errors."
    )
    return "\n".join([*lines, "", wanted, "", apart])
