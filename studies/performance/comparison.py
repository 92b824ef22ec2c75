"""Arithmetic of the study: ratios with their spread, and effective draws shown by the errors of estimates."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector

RESAMPLES = 400
"""Bootstrap samples of the runs of a method."""


@dataclass(frozen=True)
class Spread:
    """Median and quartiles of repeated measurements."""

    median: float
    low: float
    """First quartile."""
    high: float
    """Third quartile."""
    count: int
    """Measurements."""

    @classmethod
    def of(cls, values: Sequence[float]) -> Spread | None:
        """Of the finite ones among some values; None without any."""
        finite = [value for value in values if np.isfinite(value)]
        if not finite:
            return None
        low, median, high = np.quantile(finite, [0.25, 0.5, 0.75]).tolist()
        return cls(median, low, high, len(finite))

    def __str__(self) -> str:
        if self.count == 1:
            return f"{self.median:.3g}"
        return f"{self.median:.3g} ({self.low:.3g} to {self.high:.3g})"


def ratio(numerators: Sequence[float], denominators: Sequence[float]) -> Spread | None:
    """Ratio of two measurements, round by round: what slows a machine in a round slows both."""
    return Spread.of([a / b for a, b in zip(numerators, denominators, strict=True)])


@dataclass(frozen=True)
class Estimate:
    """What one run of a sampler says of a posterior, and what it cost."""

    means: Vector
    """Of the quantities, (quantities,); NaN where the run gave none."""
    squares: Vector
    """Means of their squares, (quantities,)."""
    stated: float
    """Effective sample size by the method's own account [draws]; NaN without one."""
    cpu: float
    """[s]"""
    wall: float
    """[s]"""
    evaluations: int
    """Parameter sets whose likelihood was evaluated, as the sampler asked for."""
    finished: bool = True
    """Whether it ended by its own rule, not by the time allowed."""
    log_evidence: float = np.nan

    @property
    def usable(self) -> bool:
        """Whether it gave estimates."""
        return bool(np.isfinite(self.means).all())


@dataclass(frozen=True)
class Reference:
    """Estimates of the quantities with their error."""

    means: Vector
    variances: Vector
    """Squared standard errors of the means, (quantities,)."""

    @classmethod
    def of(cls, methods: Sequence[Matrix]) -> Reference | None:
        """Mean over methods of the means of their runs, (runs, quantities); None without two runs of one."""
        several = [runs for runs in methods if len(runs) > 1]
        if not several:
            return None
        means = np.mean([runs.mean(axis=0) for runs in several], axis=0)
        variances = [runs.var(axis=0, ddof=1) / len(runs) for runs in several]
        return cls(means, np.sum(variances, axis=0) / len(several) ** 2)


def shown_by_errors(estimates: Matrix, variance: Vector, reference: Reference | None) -> Vector:
    """Independent draws that would err as much: posterior variance over mean squared error, (quantities,).

    `estimates`, (runs, quantities), two or more. The squared error is their variance, plus the squared
    distance of their mean from the reference beyond what chance explains in both. Without a reference scatter
    alone counts, and what errs alike in every run does not show.
    """
    scatter = estimates.var(axis=0, ddof=1)
    if reference is None:
        return np.asarray(variance / scatter)
    distance = (estimates.mean(axis=0) - reference.means) ** 2
    bias = np.maximum(distance - scatter / len(estimates) - reference.variances, 0.0)
    return np.asarray(variance / (scatter + bias))


def posterior_variance(estimates: Sequence[Estimate]) -> Vector:
    """Variance of every quantity over draws of all runs, (quantities,)."""
    means = np.mean([one.means for one in estimates], axis=0)
    return np.asarray(np.mean([one.squares for one in estimates], axis=0) - means**2)


def rates(estimates: Sequence[Estimate], variance: Vector, reference: Reference | None) -> dict[str, Vector]:
    """Effective draws per CPU second of a method: stated, one per run, and shown by the errors of its runs,
    resampled; the second counts the quantity that errs most."""
    cpu = np.array([one.cpu for one in estimates])
    usable = [one for one in estimates if one.usable]
    shown = np.empty(0)
    if len(usable) > 1:
        means, rng = np.array([one.means for one in usable]), np.random.default_rng(0)
        chosen = rng.integers(len(usable), size=(RESAMPLES, len(usable)))
        kept = [each for each in chosen if len(np.unique(each)) > 1]
        worst = [shown_by_errors(means[each], variance, reference).min() for each in kept]
        shown = np.array(worst) / cpu.mean()
    return {"stated": np.array([one.stated for one in estimates]) / cpu, "shown": shown}


def compared(
    names: Sequence[str],
    runs: Mapping[str, Sequence[Estimate]],
    references: Sequence[str],
    absent: Mapping[str, str],
) -> dict[str, Any]:
    """The comparison of methods on one posterior: a row per method, ratios of the first method to each.

    `runs` holds the estimates of each method, in rounds; `references` names methods that say what is right,
    each judged by the others of them alone; `absent` says why a method has no runs.
    """
    judges = [m for m in references if sum(one.usable for one in runs.get(m, ())) > 0]
    trusted = [one for m in judges for one in runs[m] if one.usable]
    if not trusted:
        raise ValueError("no reference method gave estimates")
    variance = posterior_variance(trusted)
    usable = {m: np.array([one.means for one in own if one.usable]) for m, own in runs.items()}
    first, rows = next(iter(runs)), []
    own_rates = {}
    for method, own in runs.items():
        reference = Reference.of([usable[m] for m in judges if m != method])
        own_rates[method] = rates(own, variance, reference)
        row: dict[str, Any] = {
            "method": method,
            "runs": len(own),
            "finished": sum(one.finished for one in own),
            "judged_by_scatter_alone": reference is None,
            "cpu_s": Spread.of([one.cpu for one in own]),
            "wall_s": Spread.of([one.wall for one in own]),
            "evaluations": Spread.of([one.evaluations for one in own]),
            "ess_stated": Spread.of([one.stated for one in own]),
            "evaluations_per_stated_draw": ratio([x.evaluations for x in own], [x.stated for x in own]),
            "log_evidence": Spread.of([one.log_evidence for one in own]),
            "stated_per_cpu_s": Spread.of(own_rates[method]["stated"]),
        }
        if len(usable[method]) > 1:
            shown = shown_by_errors(usable[method], variance, reference)
            cpu = float(np.mean([one.cpu for one in own]))
            row |= {
                "ess_shown": float(shown.min()),
                "ess_shown_by": names[int(shown.argmin())],
                "ess_shown_of": dict(zip(names, shown.tolist(), strict=True)),
                "shown_per_cpu_s": float(shown.min()) / cpu,
            }
        rows.append(row)
    for row in rows:
        own, best = own_rates[row["method"]], own_rates[first]
        row["ratio_stated"] = ratio(best["stated"][: len(own["stated"])], own["stated"])
        pairs = min(len(best["shown"]), len(own["shown"]))
        row["ratio_shown"] = None
        if pairs and row["method"] != first:
            row["ratio_shown"] = ratio(best["shown"][:pairs], own["shown"][:pairs])
    both = Reference.of([usable[m] for m in judges])
    return {
        "references": judges,
        "quantities": [
            {
                "name": name,
                "posterior_sd": float(variance[k] ** 0.5),
                "mean": None if both is None else float(both.means[k]),
                "standard_error": None if both is None else float(both.variances[k] ** 0.5),
            }
            for k, name in enumerate(names)
        ],
        "methods": rows,
        "absent": dict(absent),
    }


def plain(value: Any) -> Any:
    """The same with spreads as dictionaries and without numbers that JSON lacks."""
    if isinstance(value, Spread):
        return {"median": value.median, "quartiles": [value.low, value.high], "count": value.count}
    if isinstance(value, Mapping):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not np.isfinite(value) else value


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """A table in Markdown, the first column words and the others numbers; nothing for None."""
    lines = [f"| {' | '.join(head)} |", f"|---|{'---:|' * (len(head) - 1)}"]
    for row in rows:
        lines.append(f"| {' | '.join(cell(each) for each in row)} |")
    return "\n".join(lines)


def cell(value: object) -> str:
    """A cell of a table: three significant digits."""
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)
