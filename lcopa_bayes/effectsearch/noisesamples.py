"""Samples that hold no signal: before the drive moves, inside the delay, and differences of repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import final

import numpy as np
from scipy.signal import correlate
from scipy.stats import chi2

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.effectsearch.autoregression import Autoregression, unbroken
from lcopa_bayes.effectsearch.noisepieces import NoisePieces
from lcopa_bayes.effectsearch.noiseposterior import NoisePosterior
from lcopa_bayes.inference.observations import Samples

FEWEST = 50
"""Fewer quiet samples than this know the noise scale to worse than a tenth [-]."""
_SAFE = 0.8
"""Share of the fitted delay inside which a response is surely at rest [-]."""
_LAGS = 2000
"""Autocorrelations of an autoregression that are summed at most [-]."""
_WINDOW = 5.0
"""Lags over which autocorrelations are summed, over that sum (Sokal 1997, NATO ASI B 361) [-]."""
_ALIKE = 1e-3
"""p-value below which repeats differ by more than the quiet noise [-]."""
_REPEATED = 200
"""Plausible noise processes over which a number is averaged [-]."""
_SEED = 5


@final
@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one response axis and where it is known from."""

    process: Autoregression
    posterior: NoisePosterior
    """What the samples leave plausible."""
    samples: int
    """Samples it was estimated from [-]."""
    source: str
    """One of "quiet", "repeats", "joint"."""
    sentence: str
    dependence: float = 1.0
    """Samples that count as one independent sample [-]; above 1 only when fitted jointly."""

    @classmethod
    def of(cls, posterior: NoisePosterior, samples: int, source: str, sentence: str) -> AxisNoise:
        """Noise measured apart from the fit, at the estimate from its pieces."""
        return cls(posterior.pieces.estimate, posterior, samples, source, sentence)

    @cached_property
    def independent(self) -> float:
        """Independent samples that the samples are worth for the noise scale, median of the posterior [-]."""
        drawn = self.posterior.draw(_REPEATED, np.random.default_rng(_SEED))
        return self.samples / float(np.median([one.correlated(self.samples) for one in drawn]))

    @property
    def caution(self) -> str:
        """Why no verdict is better than tentative beside this noise; empty when it is known well."""
        if not self.known:
            return self.sentence
        if self.independent >= FEWEST:
            return ""
        return (
            f"{self.sentence.rstrip('.')}; successive ones are so alike that they count as "
            f"{self.independent:.0f} independent ones ({FEWEST} are needed): what is slow in the noise is "
            "known too roughly for a firm verdict. Record a longer stretch before the first command."
        )

    @property
    def known(self) -> bool:
        """Whether it was measured apart from the fit."""
        return self.source != "joint"


def quiet_samples(record: Samples, axis: int, delay: float) -> int:
    """Number of samples of an axis before anything can have arrived [-]; `delay` as in `quiet_pieces`."""
    until = record.first_change + _SAFE * delay
    return int(np.searchsorted(record.times[record.axes[axis].index], until))


def quiet_pieces(samples: Sequence[Samples], axis: int, delay: float) -> list[Vector]:
    """Unbroken stretches of an axis before anything can have arrived [response unit].

    `delay` is the shortest fitted delay [time unit]; 0.8 of it counts as dead time.
    """
    out = []
    for record in samples:
        observed = record.axes[axis]
        count = quiet_samples(record, axis, delay)
        gaps = observed.gaps[:count]
        out += [observed.values[:count][piece] for piece in unbroken(gaps)] if count > 1 else []
    return [piece for piece in out if piece.size > 1]


def repeat_pieces(samples: Sequence[Samples], axis: int) -> list[Vector]:
    """Differences over sqrt(2) of records with the same drive and sample times [response unit]."""
    out, taken = [], set()
    for k, one in enumerate(samples):
        for j in range(k + 1, len(samples)):
            other = samples[j]
            if k in taken or j in taken or not _repeats(one, other, axis):
                continue
            taken |= {k, j}
            difference = (one.axes[axis].values - other.axes[axis].values) / np.sqrt(2)
            out += [difference[piece] for piece in unbroken(one.axes[axis].gaps)]
    return [piece for piece in out if piece.size > 1]


def _repeats(one: Samples, other: Samples, axis: int) -> bool:
    first, second = one.record, other.record
    return (
        first.time.shape == second.time.shape
        and np.array_equal(first.drive, second.drive)
        and np.allclose(first.time, second.time)
        and np.array_equal(one.axes[axis].index, other.axes[axis].index)
    )


def axis_noise(samples: Sequence[Samples], axis: int, delay: float, name: str) -> AxisNoise | None:
    """Noise of an axis from quiet samples, and from repeats where these agree; None when too few.

    Repeats that differ by more than the quiet noise hold a disturbance from record to record (a trigger that
    jitters, a mount that shakes): then they are no measure of the noise, and the sentence says so.
    """
    quiet, repeats = quiet_pieces(samples, axis, delay), repeat_pieces(samples, axis)
    count = sum(piece.size - 1 for piece in quiet)
    again = sum(piece.size - 1 for piece in repeats)
    usable = [piece for piece in quiet if np.ptp(piece) > 0]
    if count >= FEWEST and usable:
        alone = NoisePosterior(NoisePieces.of(usable))
        said = f"{name}: {_named(alone)} from {count} quiet samples"
        if not again:
            return AxisNoise.of(alone, count, "quiet", f"{said}.")
        ratio, p = _repeated(alone, repeats)
        if p > _ALIKE:
            both = NoisePosterior(NoisePieces.of([*usable, *repeats]))
            told = f"{name}: {_named(both)} from {count} quiet samples and {again} differences of repeats"
            return AxisNoise.of(both, count + again, "quiet", f"{told}, which agree.")
        differ = f"repeats differ by {ratio:.2f} times the quiet noise (p = {p:.1g})"
        return AxisNoise.of(alone, count, "quiet", f"{said}; {differ}: something varies between records.")
    if again >= FEWEST:
        alone = NoisePosterior(NoisePieces.of([piece for piece in repeats if np.ptp(piece) > 0]))
        told = f"{name}: {_named(alone)} from {again} differences of repeats"
        return AxisNoise.of(alone, again, "repeats", f"{told}; {count} quiet samples are too few.")
    return None


def _named(posterior: NoisePosterior) -> str:
    process = posterior.pieces.estimate
    return f"AR({process.order}) noise of sd {process.sd:.3g}"


def joint_noise(residual: Sequence[Vector], name: str, quiet: int) -> AxisNoise:
    """Noise of an axis fitted together with the plant, from its residual pieces [response unit].

    Coloured noise as free as the residual would take every slow effect for noise, and a fit whitened by it
    predicts the next sample and not the response. So the fit weighs all samples alike, and what its residual
    is worth as evidence is divided by ``sum_k rho_k^2``, the samples per independent one of a power (Bayley
    and Hammersley 1946, J. R. Stat. Soc. Suppl. 8), rho_k its autocorrelations.
    """
    count = sum(piece.size for piece in residual)
    power = sum(float(((piece - piece.mean()) ** 2).sum()) for piece in residual)
    process = Autoregression(np.empty(0), max(float(np.sqrt(power / count)), 1e-300))
    coloured = NoisePieces.of(residual)
    dependence = _dependence(residual, coloured.estimate)
    sentence = (
        f"{name}: {quiet} quiet samples and no repeats are too few to know the noise ({FEWEST} are needed), "
        f"so noise of sd {process.sd:.3g} is fitted to the residual together with the plant, and {count} "
        f"samples count as {count / dependence:.0f} independent ones: what it takes for noise may be an "
        "effect, so no verdict is better than tentative. Record a stretch before the first command, or a "
        "repeat."
    )
    return AxisNoise(process, NoisePosterior(coloured), count, "joint", sentence, dependence)


def _dependence(pieces: Sequence[Vector], coloured: Autoregression) -> float:
    """Samples per independent one of a power, from unbroken pieces and their autoregression [-].

    The lesser of two estimates, as each errs upwards where its assumption fails: the autoregression where a
    smooth misfit under a little white noise makes it nearly a random walk, the pieces' own autocorrelations
    where a ripple goes on for ever.
    """
    longest = max(piece.size for piece in pieces)
    covariance = coloured.autocovariance(min(longest - 1, _LAGS))
    rho2 = (covariance[1:] / covariance[0]) ** 2
    regressed = 1.0 + 2.0 * float(((1 - np.arange(1, rho2.size + 1) / longest) * rho2).sum())
    products = np.zeros(longest)
    for piece in pieces:
        apart = piece - piece.mean()
        products[: piece.size] += correlate(apart, apart, mode="full", method="fft")[piece.size - 1 :]
    if products[0] == 0.0:
        return 1.0
    summed = 1.0 + 2.0 * np.cumsum((products[1:] / products[0]) ** 2)
    wide = np.flatnonzero(np.arange(1, longest) >= _WINDOW * summed)
    own = float(summed[wide[0]] if wide.size else summed[-1]) if longest > 1 else 1.0
    return min(own, regressed)


def _repeated(posterior: NoisePosterior, repeats: Sequence[Vector]) -> tuple[float, float]:
    """Root mean square of whitened repeats, and the p-value of noise alone over all that is plausible [-]."""
    count = sum(piece.size - 1 for piece in repeats)
    drawn = posterior.draw(_REPEATED, np.random.default_rng(_SEED))
    powers = np.array([_power(process, repeats) for process in drawn])
    above, below = chi2.sf(powers, count).mean(), chi2.cdf(powers, count).mean()
    ratio = np.sqrt(_power(posterior.pieces.estimate, repeats) / count)
    return float(ratio), float(2 * min(above, below))


def _power(process: Autoregression, pieces: Sequence[Vector]) -> float:
    """Squares of whitened pieces about their own levels [-]."""
    squares = 0.0
    for piece in pieces:
        white, ones = process.whiten(np.stack([piece, np.ones_like(piece)]))
        squares += float(white @ white) - float(ones @ white) ** 2 / float(ones @ ones)
    return squares
