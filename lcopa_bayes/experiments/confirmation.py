"""Does a drive keep its promise: records of the virtual bench under it and under the plain step, refitted."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import isfinite
from operator import call
from typing import Any, final

import numpy as np
from scipy.stats import chi2

from lcopa_bayes.bench.device import Bench as VirtualBench
from lcopa_bayes.bench.device import truth
from lcopa_bayes.calibration.replica import device_of
from lcopa_bayes.core.arrays import Array, Flags, Matrix, Vector
from lcopa_bayes.core.estimate import LEVEL, attributes, plain
from lcopa_bayes.core.parallel import workers
from lcopa_bayes.experiments.design import LINEAR, Design, promises
from lcopa_bayes.experiments.information import Bench, Trial

REPLICAS = 12
"""Records simulated and fitted per drive."""
_RESAMPLED = 2000
"""Bootstrap samples behind the interval of a factor."""


@final
@dataclass(frozen=True, eq=False)
class Achieved:
    """Estimates from independent records of one drive."""

    drive: str
    errors: Matrix
    """Estimate minus truth relative to the size of the truth, in logarithms for time constants,
    (records, parameters) [-]."""
    expected: Vector
    """Cramer-Rao standard deviations at the truth, likewise relative, (parameters,) [-]."""
    at_bound: Array
    """Whether an estimate leans on the end of its search, (records, parameters) [-]."""

    @property
    def spread(self) -> Vector:
        """Standard deviations of the estimates, (parameters,) [-]."""
        return np.asarray(self.errors.std(axis=0, ddof=1))


@final
@dataclass(frozen=True, eq=False)
class Confirmation:
    """Expected against achieved precision of the winner and the plain step at one draw of the posterior."""

    where: str
    """Which draw, in words."""
    names: tuple[str, ...]
    among: Flags
    """Parameters that the worst is sought among, (parameters,)."""
    truth: Vector
    """Values the records were simulated with, each in its unit, (parameters,)."""
    winner: Achieved
    step: Achieved
    factor: float
    """Worst achieved standard deviation after the step over that after the winner [-]."""
    lower: float
    """Lower end of its bootstrap interval at `LEVEL` [-]."""
    upper: float
    """Upper end [-]."""

    @property
    def expected(self) -> float:
        """The factor that the Cramer-Rao bounds promise at this truth [-]; perhaps infinite."""
        return float(self.step.expected[self.among].max() / self.winner.expected[self.among].max())

    @property
    def confirmed(self) -> bool:
        """Whether the winner is better by more than the scatter of the simulation."""
        return self.lower > 1.0

    @property
    def sentence(self) -> str:
        """Result of the simulation."""
        count = self.winner.errors.shape[0]
        achieved = (
            f"over {count} simulated records of each drive, the worst standard deviation of a fit is "
            f"{self.factor:.3g} times ({100 * LEVEL:g} %: {self.lower:.3g} to {self.upper:.3g}) smaller than "
            "after the plain step"
        )
        promised = (
            f"the bounds promise {self.expected:.3g}"
            if isfinite(self.expected)
            else "the bounds promise none after the step"
        )
        held = int(self.step.at_bound[:, self.among].any(axis=1).sum())
        bound = (
            f" {held} of {count} fits after the step lie at the end of a prior, which makes their scatter "
            "smaller than that of the data alone."
        ) * (held > 0)
        word = "Confirmed" if self.confirmed else "Not confirmed"
        return f"{word} {self.where}: {achieved}; {promised}.{bound}"

    def as_json(self) -> dict[str, Any]:
        """Plain values; infinite ones are None."""
        return plain(
            {
                **attributes(self, "confirmed", "sentence", "where"),
                "replicas": self.winner.errors.shape[0],
                "factor": {
                    "value": self.factor,
                    "unit": "-",
                    "lower": self.lower,
                    "upper": self.upper,
                    "level": LEVEL,
                    "interval": "bootstrap over records",
                    "expected": self.expected,
                },
                "parameters": [
                    {
                        "name": name,
                        "truth": self.truth[k],
                        "winner": _row(self.winner, k),
                        "step": _row(self.step, k),
                    }
                    for k, name in enumerate(self.names)
                ],
            }
        )


def _row(achieved: Achieved, k: int) -> dict[str, Any]:
    """Expected and achieved of one parameter, with the interval of a standard deviation of few estimates."""
    freedom, spread = achieved.errors.shape[0] - 1, float(achieved.spread[k])
    ends = [spread * np.sqrt(freedom / chi2.ppf(q, freedom)) for q in (0.5 + LEVEL / 2, 0.5 - LEVEL / 2)]
    return {
        "expected_relative_sd": float(achieved.expected[k]),
        "achieved_relative_sd": spread,
        "lower": ends[0],
        "upper": ends[1],
        "level": LEVEL,
        "interval": "chi-squared",
        "bias": float(achieved.errors[:, k].mean()),
        "at_bound": int(achieved.at_bound[:, k].sum()),
    }


def confirm(design: Design, *, replicas: int = REPLICAS, jobs: int = 1) -> tuple[Confirmation, ...]:
    """Simulate and fit records of the winner and of the plain step; nothing when these are the same drive.

    Truths are two draws of the posterior: the one with the middle factor among those where the winner's
    bounds are small enough to be believed, and the one whose worst bound is the median of all. Fits are
    output-error least squares within the support of the study's priors, started at the truth. One record
    per fit and no prior, whatever the design counts.
    """
    if not design.determined.any() or design.winner is design.step:
        return ()
    worst, factors = design.winner.worst(design.determined), design.factors(design.winner)
    finite = np.flatnonzero(np.isfinite(worst))
    small = finite[worst[finite] <= LINEAR]
    places: dict[int, str] = {}
    if small.size:
        ranked = small[np.argsort(factors[small])]
        places[int(ranked[(small.size - 1) // 2])] = "where linear bounds can be believed"
    ranked = finite[np.argsort(worst[finite])]
    places.setdefault(int(ranked[(finite.size - 1) // 2]), "at the draw of median precision")
    return tuple(_confirmed(design, k, where, replicas, jobs) for k, where in places.items())


def confirmed(design: Design, *, jobs: int = 1, replicas: int = REPLICAS) -> dict[str, Any]:
    """`confirm` as plain values under the key `confirmed`: the verdict and factor of the first trial, where
    bounds can be believed if they can anywhere, and whether every trial agrees."""
    trials = confirm(design, jobs=jobs, replicas=replicas)
    sentence = (
        " ".join(one.sentence for one in trials) or "Nothing to confirm: no drive beats the plain step."
    )
    return {
        "confirmed": {
            "confirmed": bool(trials) and trials[0].confirmed,
            "where": trials[0].where if trials else None,
            "everywhere": bool(trials) and all(one.confirmed for one in trials),
            "factor": trials[0].as_json()["factor"] if trials else None,
            "sentence": sentence,
            "trials": [one.as_json() for one in trials],
        }
    }


def _confirmed(design: Design, chosen: int, where: str, replicas: int, jobs: int) -> Confirmation:
    """Both drives at one truth; a replica has the same noise whatever the number of processes."""
    problem, period = design.fit.problem, design.limits.period
    values, table = design.draws[chosen], problem.posterior.table
    device = device_of(table, values, 0, time_unit=problem.study.time_unit)
    camera = VirtualBench(camera=period, exposure=problem.study.exposure)
    tasks, expected = [], []
    for which, each in enumerate((design.winner, design.step)):
        drive, name = each.candidate.command, "simulated"
        bench = Bench(problem, each.time, period)
        # of one record without a prior, as it is fitted, whatever the design counts beside it
        (alone,) = promises(bench, [each.candidate], values[None])
        expected.append(np.sqrt(np.diagonal(alone.covariance[0])))
        responding = table.effects and partial(bench.responses, values)
        clean = truth(device, camera, drive, duration=each.time, name=name, responding=responding)
        tasks += [
            Trial(bench, clean, values, design.names, (problem.study.seed, 9, chosen, which, k))
            for k in range(replicas)
        ]
    with workers(None, jobs=min(jobs, replicas)) as crew:
        result = list(crew.map(call, tasks))
    winner, step = (
        Achieved(
            promise.candidate.name,
            np.array([errors for errors, _ in part]),
            bounds,
            np.array([bound for _, bound in part]),
        )
        for promise, part, bounds in zip(
            (design.winner, design.step), (result[:replicas], result[replicas:]), expected, strict=True
        )
    )
    rng = np.random.default_rng([design.fit.study.seed, 10])
    factor, low, high = _factor(winner.errors, step.errors, design.determined, rng)
    columns = [design.fit.draws.table.names.index(name) for name in design.names]
    at = design.draws[chosen, columns]
    return Confirmation(
        where=where,
        names=design.names,
        among=design.determined,
        truth=at,
        winner=winner,
        step=step,
        factor=factor,
        lower=low,
        upper=high,
    )


def _factor(
    winner: Matrix, step: Matrix, among: Flags, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Ratio of the worst standard deviations with its bootstrap interval."""

    def worst(errors: Array) -> Array:
        return np.asarray(errors[..., among].std(axis=-2, ddof=1).max(axis=-1))

    drawn = [
        worst(errors[rng.integers(0, errors.shape[0], (_RESAMPLED, errors.shape[0]))])
        for errors in (step, winner)
    ]
    spread = (drawn[0] > 0) & (drawn[1] > 0)  # a resample of one record, over and over, has no spread
    low, high = np.quantile(drawn[0][spread] / drawn[1][spread], (0.5 - LEVEL / 2, 0.5 + LEVEL / 2))
    return float(worst(step) / worst(winner)), float(low), float(high)
