"""A normalised density that covers a posterior: mixtures in several charts.

One chart straightens the ridges along which orders and times trade off, but squeezes the region where a term
is negligible; a chart that holds one term is wide there. Every point of a population is explained by the
chart that gives it the largest density, and each chart has a mixture fitted to the points it explains.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import final

import numpy as np
from scipy.special import logsumexp

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.inference.posterior import Posterior
from lcopa_bayes.sampling.coordinates import Chart
from lcopa_bayes.sampling.mixture import Mixture, spread_evenly

_POINTS = 12_000
"""Points a cover is fitted to."""
_FIRST = 8
"""Components of every chart before points are divided among charts."""
_DIVISIONS = 2
"""Divisions of the points among charts."""
_NEGLIGIBLE = 0.02
"""Charts that explain a smaller share of the points are left out [-]."""
_MOST_CHARTS = 16
"""Most charts that are tried; elements beyond hold no term."""
_WIDER, _DEFENSIVE = 1.6, 0.25
"""Factor by which a share of every mixture is wider than its fit, and that share [-]."""

Held = tuple[int | None, ...]
"""Term of each element that a chart holds; None: no term."""


@final
@dataclass(frozen=True, eq=False)
class Cover:
    """Mixtures in charts; the weights of all their components sum to one."""

    charts: tuple[tuple[Held, Chart], ...]
    mixtures: tuple[Mixture, ...]

    @classmethod
    def fitted(cls, posterior: Posterior, points: Matrix, seed: int, components: int) -> Cover:
        """Fit to points (n, dimension) of the sampled coordinates, with about so many components in all.

        Deterministic given `seed`. ValueError where no point lies inside all charts.
        """
        plain = Chart.of(posterior)
        z = plain.terrain.sorted(spread_evenly(points, _POINTS))
        charts = [(held, plain.holding(held)) for held in _choices(plain)]
        charted = [chart.charted(z) for _, chart in charts]
        usable = np.all([np.isfinite(y).all(axis=1) & np.isfinite(v) for y, v in charted], axis=0)
        count = int(usable.sum())
        if count == 0:
            raise ValueError("no point to cover lies inside the charts of the posterior")
        charted = [(y[usable], v[usable]) for y, v in charted]
        kept, rows = list(range(len(charts))), [np.arange(count)] * len(charts)
        shares = np.full(len(charts), 1 / len(charts))
        for _ in range(_DIVISIONS if len(charts) > 1 else 0):
            wanted = [max(2, min(_FIRST, round(components * share))) for share in shares]
            parts = (
                np.array(
                    [
                        Mixture.fitted(charted[k][0][own], seed, number).log_density(charted[k][0])
                        + charted[k][1]
                        for k, own, number in zip(kept, rows, wanted, strict=True)
                    ]
                )
                + np.log(shares)[:, None]
            )
            share = np.bincount(parts.argmax(axis=0), minlength=len(kept)) / count
            large = np.flatnonzero(share >= min(_NEGLIGIBLE, share.max()))
            best = parts[large].argmax(axis=0)
            kept = [kept[position] for position in large]
            rows = [np.flatnonzero(best == position) for position in range(len(kept))]
            shares = np.array([own.size for own in rows]) / count
        mixtures = []
        for k, own, share in zip(kept, rows, shares, strict=True):
            core = Mixture.fitted(charted[k][0][own], seed, max(2, round(components * share)))
            wide = core.blended(Mixture(core.weights, core.means, _WIDER * core.factors), _DEFENSIVE)
            mixtures.append(wide.scaled(share))
        return cls(tuple(charts[k] for k in kept), tuple(mixtures))

    def draw(self, count: int, rng: np.random.Generator) -> Matrix:
        """Independent draws of the sampled coordinates, chart by chart; fewer than `count` where a chart
        has no point."""
        shares = np.array([mixture.weights.sum() for mixture in self.mixtures])
        found = []
        for (_, chart), mixture, number in zip(
            self.charts, self.mixtures, rng.multinomial(count, shares / shares.sum()), strict=True
        ):
            z, exists = chart.uncharted(mixture.draw(int(number), rng))
            found.append(z[exists])
        return np.concatenate(found)

    def log_density(self, z: Matrix) -> Vector:
        """Log density of the sampled coordinates, exchangeable terms by decreasing order, (n,)."""
        return np.asarray(logsumexp(self._log_parts(z), axis=0))

    def _log_parts(self, z: Matrix) -> Matrix:
        """Log density of each component times its weight, (components, n); -inf where a chart has none."""
        out = []
        for (_, chart), mixture in zip(self.charts, self.mixtures, strict=True):
            y, log_volume = chart.charted(z)
            inside = np.isfinite(y).all(axis=1) & np.isfinite(log_volume)
            parts = np.full((mixture.weights.size, len(z)), -np.inf)
            parts[:, inside] = mixture.log_parts(y[inside]) + log_volume[inside]
            out.append(parts)
        return np.concatenate(out)


def _choices(chart: Chart) -> list[Held]:
    """Which terms charts hold: none or one of every element, while the charts are few."""
    choices: list[Held] = [()]
    for element in chart.terrain.elements:
        own = (None, *range(element.terms)) if element.terms > 1 else (None,)
        if len(choices) * len(own) > _MOST_CHARTS:
            own = (None,)
        choices = [(*before, held) for before, held in product(choices, own)]
    return choices
