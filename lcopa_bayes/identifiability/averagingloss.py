"""What means of samples lose of a record: the likelihood of all samples expanded about the optimum of the
means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil
from typing import final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.averaging import averaged
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.results.discretisation import optima_of, resolved_optima
from lcopa_bayes.results.structure import with_least_terms


@final
@dataclass(frozen=True, eq=False)
class AveragingLoss:
    """Posterior of means of samples beside that of all samples, both normal."""

    count: int
    """Samples in a mean [-]."""
    names: tuple[str, ...]
    """Free plant parameters."""
    widening: Vector
    """Standard deviation with means over that with all samples, (parameters,) [-]."""
    shift: Vector
    """Mode with means less that with all samples over the standard deviation with these, (parameters,) [-].
    A widening w alone makes one of about ``sqrt(w^2 - 1)``."""

    def __str__(self) -> str:
        wide, far = int(np.argmax(self.widening)), int(np.argmax(np.abs(self.shift)))
        return (
            f"Means of {self.count} samples make no standard deviation larger than "
            f"{self.widening[wide]:.3f} times that with all samples ({self.names[wide]}), and move no mode "
            f"by more than {abs(self.shift[far]):.2f} of them ({self.names[far]})."
        )


def averaging_losses(study: Study, counts: Sequence[int]) -> tuple[AveragingLoss, ...]:
    """Losses of means of so many samples each; the loss of a second number says how it grows.

    All are measured at the optimum of the means of the fewest samples, with the fewest terms where the study
    leaves their number to its records. Costs one response of all samples with its derivatives, and their
    noise. Accuracy: a shift is one step of least squares, right to a third of itself where a delay moves by
    less than its standard deviation. InputError as `averaged`.
    """
    study = with_least_terms(study)
    first, *others = [averaged(study, count) for count in sorted(counts)]
    problem = problem_of(first)
    problem, optima = resolved_optima(problem, optima_of(problem))
    values = optima[0].values
    names, information, step = _expansion(problem_of(study).posterior, values)
    sd = np.sqrt(np.diag(np.linalg.inv(information)))
    out = []
    for count, means in zip(sorted(counts), (first, *others), strict=True):
        narrow = ceil(problem.refinement * count / min(counts))  # blocks of one width for all
        own = problem if means is first else problem_of(means).refined(narrow)
        _, known, own_step = _expansion(own.posterior, values)
        widening = np.sqrt(np.diag(np.linalg.inv(known))) / sd
        out.append(AveragingLoss(count, names, widening, (own_step - step) / sd))
    return tuple(out)


def _expansion(posterior: Posterior, values: Vector) -> tuple[tuple[str, ...], Matrix, Vector]:
    """Free plant parameters, and in their sampled coordinates the information about them at `values` under
    the noise of the residual there and the step to the mode."""
    least = LeastSquares(posterior)
    values = least.with_noise(values)
    residual, jacobian = least.residual(least.coordinates(values), values)
    information = jacobian.T @ jacobian
    names = tuple(posterior.table.rows[k].name for k in least.columns)
    return names, information, np.asarray(-np.linalg.solve(information, jacobian.T @ residual), dtype=float)
