"""Curvature of the likelihood at its maximum: sensitivities, Fisher information, spectrum, correlations,
collinearity.

Whether the delays of several paths can be distinguished, given which drives moved and when.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import HALF_WIDTH, LEVEL, plain
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import problem_of
from lcopa_bayes.inference.likelihood import Landscape
from lcopa_bayes.inference.noise import Student
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.posterior import Posterior


@final
@dataclass(frozen=True, eq=False)
class Sensitivities:
    """Derivatives of the samples, whitened by the noise model, at one set of values.

    Their products are the Fisher information, under Student noise too.
    """

    names: tuple[str, ...]
    matrix: Matrix
    """In the sampled coordinates of the plant parameters, (samples, parameters) [noise sd]."""
    values: Vector
    """Where they were taken, in each parameter's unit, (parameters,)."""
    logarithmic: tuple[bool, ...]
    """Whether a coordinate is a logarithm."""

    def relative(self) -> Matrix:
        """Derivatives in the logarithm of the size of every parameter, (samples, parameters)."""
        logs = np.array(self.logarithmic)
        return np.asarray(self.matrix * np.where(logs, 1.0, self.values))


def sensitivities(landscape: Landscape, values: Vector) -> Sensitivities:
    """At table values, whose noise parameters make the samples white (AR(1) included).

    Accuracy: that of the forward model's exact slopes, about 1e-10 of the largest.
    """
    least, rows = landscape.least, landscape.posterior.table.rows
    _, jacobian = least.residual(least.coordinates(values), values)
    white = jacobian[: landscape.posterior.size]
    if isinstance(landscape.posterior.noise, Student):
        white = white * np.sqrt(_information(landscape.posterior, values))[:, None]
    return Sensitivities(
        tuple(rows[k].name for k in least.columns),
        white,
        values[least.columns],
        tuple(rows[k].log_scale for k in least.columns),
    )


def _information(posterior: Posterior, values: Vector) -> Vector:
    """Information of every sample over that of a Gaussian of its scale, (samples,) [-]."""
    nu = [values[posterior.table.at("nu", axis)] for axis in range(len(posterior.table.layout.responses))]
    sizes = [axis.values.size for samples in posterior.samples for axis in samples.axes]
    return np.repeat(Student.information(np.tile(nu, len(posterior.samples))), sizes)


_SINGULAR = 1e-11
"""Eigenvalues below this share of the largest are rounding [-]."""
_TOUCHED = 1e-6
"""Squared weight in a singular direction from which a parameter's variance is infinite [-]."""
_PARTNERS = 0.8
"""Correlation from which two parameters are named together [-]."""
_SHOWN = 0.1
"""Weights of a direction that are named [-]."""


@final
@dataclass(frozen=True, eq=False)
class Curvature:
    """Local precision of the free plant parameters on their sampled scale."""

    names: tuple[str, ...]
    sd: Vector
    """Cramer-Rao standard deviation on the sampled scale (a relative one for logarithms), (parameters,);
    infinite where the Fisher matrix is singular."""
    relative_sd: Vector
    """Standard deviation over the size of the value, (parameters,) [-]; infinite likewise."""
    eigenvalues: Vector
    """Of the Fisher information in units of prior standard deviations, decreasing [-]: how many times as
    precise as the prior the data are along a direction; below 1 the prior is more informative."""
    directions: Matrix
    """Unit vectors in units of prior standard deviations, one per row, (parameters, parameters) [-]."""
    correlations: Matrix
    """Of the linearised estimates, (parameters, parameters) [-]; NaN where a variance is infinite."""
    overlap: Matrix
    """Cosines between sensitivities, (parameters, parameters) [-]; 0 for a sensitivity of zero."""
    collinearity: float
    """``1 / sqrt(smallest eigenvalue)`` of the cosines [-] (Brun et al. 2001, Water Resources Research 37):
    above 10 to 15 some sensitivity is nearly a combination of the others; infinite when it is one."""

    def at(self, name: str) -> tuple[float, float] | None:
        """Standard deviation on the sampled scale and relative to the size; None for noise parameters."""
        if name not in self.names:
            return None
        place = self.names.index(name)
        return float(self.sd[place]), float(self.relative_sd[place])

    def partners(self, name: str) -> tuple[str, ...]:
        """Parameters whose linearised estimates are correlated with this one's, strongest first."""
        if name not in self.names:
            return ()
        row = np.abs(self.correlations[self.names.index(name)])
        order = np.argsort(-np.nan_to_num(row))
        return tuple(self.names[p] for p in order if self.names[p] != name and row[p] >= _PARTNERS)

    def as_json(self) -> dict[str, Any]:
        """Plain values without the spectrum; infinite values are None."""
        pairs = sorted(combinations(range(len(self.names)), 2), key=lambda ab: -abs(self.overlap[ab]))
        return plain(
            {
                "relative_sd": dict(zip(self.names, self.relative_sd, strict=True)),
                "collinearity": self.collinearity,
                "most_alike": [
                    {
                        "pair": [self.names[a], self.names[b]],
                        "cosine": self.overlap[a, b],
                        "correlation": self.correlations[a, b],
                    }
                    for a, b in pairs[:5]
                ],
                "names": self.names,
                "correlations": self.correlations,
            }
        )

    def spectrum(self) -> list[dict[str, Any]]:
        """Directions by falling precision with the parameters that make them up."""
        out = []
        for value, row in zip(self.eigenvalues, self.directions, strict=True):
            order = [p for p in np.argsort(-np.abs(row)) if abs(row[p]) >= _SHOWN]
            sign = np.sign(row[order[0]])
            out.append(
                {
                    "eigenvalue": float(value),
                    "direction": {self.names[p]: float(sign * row[p]) for p in order},
                    "prior_knows_more": bool(value < 1),
                }
            )
        return out


def curvature(landscape: Landscape, values: Vector, prior_sd: Vector) -> Curvature:
    """Fisher information of the plant parameters at table values, including those of the noise parameters.

    `prior_sd`, (rows,): standard deviations of the prior on the sampled scale. The mean of the samples does
    not depend on noise parameters, so that theirs is a separate block and is omitted.
    """
    derivatives = sensitivities(landscape, values)
    slopes, columns = derivatives.matrix, landscape.least.columns
    norms = np.linalg.norm(slopes, axis=0)
    unit = slopes / np.where(norms > 0, norms, 1.0)
    overlap = unit.T @ unit
    singular, rows = _spectral(unit)
    blind = singular <= _SINGULAR * max(singular[0], 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        shape = (rows[~blind].T / singular[~blind]) @ rows[~blind]
        sd = np.sqrt(np.diag(shape)) / norms
    touched = (rows[blind] ** 2).sum(axis=0) > _TOUCHED
    sd = np.where(touched | (norms == 0), np.inf, sd)
    scale = np.sqrt(np.diag(shape))
    correlations = shape / np.outer(np.where(scale > 0, scale, 1.0), np.where(scale > 0, scale, 1.0))
    correlations[~np.isfinite(sd)] = correlations[:, ~np.isfinite(sd)] = np.nan
    sizes = np.where(derivatives.logarithmic, 1.0, np.abs(derivatives.values))
    with np.errstate(divide="ignore"):
        relative = np.where(sizes > 0, sd / np.where(sizes > 0, sizes, 1.0), np.inf)
    eigenvalues, directions = _spectral(slopes * prior_sd[columns])
    least = float(singular[-1])
    return Curvature(
        names=derivatives.names,
        sd=sd,
        relative_sd=relative,
        eigenvalues=eigenvalues,
        directions=directions,
        correlations=correlations,
        overlap=overlap,
        collinearity=float(1 / np.sqrt(least)) if not blind[-1] else np.inf,
    )


def _spectral(matrix: Matrix) -> tuple[Vector, Matrix]:
    """Eigenvalues, decreasing, and eigenvectors as rows of ``matrix.T @ matrix``, without squaring first."""
    _, singular, rows = np.linalg.svd(matrix, full_matrices=matrix.shape[0] < matrix.shape[1])
    whole = np.zeros(matrix.shape[1])
    whole[: singular.size] = singular**2
    return whole, rows


def delays(study: Study, table: ParameterTable, values: Vector) -> dict[str, Any]:
    """Delay separation at the maximum of the likelihood, every path given a delay of its own, which it has
    from its slot and may leave; linearised at table values.

    Returns: Cramer-Rao standard deviation of each path's delay, and the smallest difference of two delays
    that a two-sided interval at `LEVEL` keeps apart from 0 [time unit]; infinite without information.
    """
    paths = [
        table.layout.path_name(i, j) or "the path"
        for i in range(len(table.layout.responses))
        for j in range(len(table.layout.drives))
    ]
    if len(paths) == 1:
        said = "one path: there are no delays to compare"
        return {"paths": (), "separations": (), "sentence": said}
    priors = {name: prior for name, prior in study.priors.items() if name.split("_")[0] != "delay"}
    apart = replace(study, model=replace(study.model, delay="path"), priors=priors)
    landscape = Landscape(problem_of(apart).posterior)
    own = landscape.posterior.table
    at = np.empty(len(own.rows))
    for k, row in enumerate(own.rows):
        if row.kind == "delay":
            i, j = divmod(row.place.first, len(own.layout.drives))
            at[k] = values[table.at("delay", table.layout.delay_of[i][j])]
        else:
            at[k] = values[table.names.index(row.name)]
    curved = curvature(landscape, at, np.ones(at.size))
    where = [curved.names.index(f"delay_{path}") for path in paths]
    separations = []
    for a, b in combinations(range(len(paths)), 2):
        p, q = where[a], where[b]
        both = np.isfinite(curved.sd[[p, q]]).all()
        mixed = 2 * curved.correlations[p, q] * curved.sd[p] * curved.sd[q] if both else 0.0
        spread = np.sqrt(max(curved.sd[p] ** 2 + curved.sd[q] ** 2 - mixed, 0.0)) if both else np.inf
        pair = (paths[a], paths[b])
        separations.append({"pair": pair, "smallest_difference": float(HALF_WIDTH * spread), "level": LEVEL})
    rows = [
        {"path": path, "sd": float(curved.sd[p]), "unit": study.time_unit}
        for path, p in zip(paths, where, strict=True)
    ]
    return {
        "paths": rows,
        "separations": separations,
        "sentence": _sentence(separations, study.time_unit),
    }


def _sentence(separations: list[dict[str, Any]], unit: str) -> str:
    resolved = [one for one in separations if np.isfinite(one["smallest_difference"])]
    if not resolved:
        return "no two path delays can be distinguished: the records bound at most one of them"
    worst = max(resolved, key=lambda one: float(one["smallest_difference"]))
    smallest = f"{' and '.join(worst['pair'])} from a difference of {worst['smallest_difference']:.2g} {unit}"
    if len(resolved) < len(separations):
        return (
            f"{len(separations) - len(resolved)} of {len(separations)} pairs of path delays cannot be "
            f"distinguished; the least resolved of the others: {smallest}"
        )
    return f"all path delays can be distinguished, the least resolved pair {smallest}"
