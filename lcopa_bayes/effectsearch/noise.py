"""Noise of the loop: its law, and samples that hold no signal to measure it by.

Such samples are those before the drive moves and inside the delay, and differences of repeats. The law is
that of a fit, white noise plus a correlated part (`inference.noise`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, product
from typing import final

import numpy as np
from scipy.signal import correlate
from scipy.special import logsumexp
from scipy.stats import chi2

from lcopa_bayes.core.arrays import Vector
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.record import Axis
from lcopa_bayes.effectsearch.noiselaw import Law, laws, plausible
from lcopa_bayes.inference.defaultpriors import Scales
from lcopa_bayes.inference.observations import Observed, PlausibleNoise, Samples

FEWEST = 50
"""Fewer quiet samples than this know the noise scale to worse than a tenth [-]."""
_KNOWN = 10
"""Samples before the drive moves that say what is like them [-]."""
_SAFE = 0.8
"""Share of the fitted delay inside which a response is surely at rest [-]."""
_LAGS = 2000
"""Autocorrelations of a noise that are summed at most [-]."""
_WINDOW = 5.0
"""Lags over which autocorrelations are summed, over that sum (Sokal 1997, NATO ASI B 361) [-]."""
_ALIKE = 1e-3
"""p-value below which repeats differ by more than the quiet noise [-]."""
_REPEATED = 200
"""Plausible noise laws over which a number is averaged [-]."""
_SEED = 5
_SEEN = 0.02
"""Part of the power at which a correlation is mentioned [-]."""
_SHARES = (1e-3, 5e-3, 3e-2)
"""Shares of outliers tried [-]."""
_WIDTHS = (6.0, 30.0)
"""Standard deviations of an outlier over that of the noise tried [-]."""


@final
@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one response axis and where it is known from."""

    law: Law
    posterior: PlausibleNoise
    """What the samples leave plausible."""
    samples: int
    """Samples it was estimated from [-]."""
    source: str
    """One of "quiet", "repeats", "joint", "least"."""
    sentence: str
    dependence: float = 1.0
    """Samples that count as one independent sample [-]; above 1 only when fitted jointly."""

    @classmethod
    def of(cls, posterior: PlausibleNoise, samples: int, source: str, sentence: str) -> AxisNoise:
        """Noise measured apart from the fit, at the estimate from its pieces."""
        return cls(Law.of(posterior), posterior, samples, source, sentence)

    @cached_property
    def independent(self) -> float:
        """Independent samples that the samples are worth for the noise scale, median of the posterior [-]."""
        drawn = laws(self.posterior.draw(_REPEATED, np.random.default_rng(_SEED)))
        return self.samples / float(np.median([one.correlated(self.samples) for one in drawn]))

    @property
    def firm(self) -> bool:
        """Whether so many independent samples know it apart from the fit that a verdict may be firm."""
        return self.known and self.independent >= FEWEST

    @property
    def caution(self) -> str:
        """Why no verdict is better than tentative beside this noise; empty when it is known well."""
        if not self.known:
            return self.sentence
        if self.firm:
            return ""
        return (
            f"{self.sentence.rstrip('.')}; successive ones are so alike that they count as "
            f"{self.independent:.0f} independent ones ({FEWEST} are needed): what is slow in the noise is "
            "known too roughly for a firm verdict. Record a longer stretch before the first command."
        )

    @property
    def least(self) -> bool:
        """Whether it is the least noise that is considered."""
        return self.source == "least"

    @property
    def known(self) -> bool:
        """Whether it is known apart from the fit."""
        return self.source != "joint"


def quiet_samples(record: Samples, axis: int, delay: float) -> int:
    """Number of samples of an axis before anything can have arrived [-]; `delay` as in `quiet_pieces`."""
    until = record.first_change + _SAFE * delay
    return int(np.searchsorted(record.times[record.axes[axis].index], until))


def quiet_pieces(samples: Sequence[Samples], axis: int, delay: float) -> list[Observed]:
    """Samples of an axis before anything can have arrived [response unit].

    `delay` is the shortest fitted delay [time unit]; 0.8 of it counts as dead time.
    """
    counts = [quiet_samples(record, axis, delay) for record in samples]
    return [one.resting(axis, count) for one, count in zip(samples, counts, strict=True) if count > 1]


def repeat_pieces(samples: Sequence[Samples], axis: int) -> list[Observed]:
    """Differences over sqrt(2) of records with the same drive and sample times [response unit]."""
    out, taken = [], set[int]()
    for (k, one), (j, other) in combinations(enumerate(samples), 2):
        if not taken & {k, j} and _repeats(one, other, axis):
            taken |= {k, j}
            difference = (one.axes[axis].values - other.axes[axis].values) / np.sqrt(2)
            out.append(replace(one.axes[axis], values=difference))
    return [piece for piece in out if piece.values.size > 1]


def _resting(samples: Sequence[Samples], axis: int, delay: float, scales: Scales) -> list[Observed]:
    """Samples at rest, those inside the delay only where these are like the ones before the drive moves.

    A fit that something else bends may find a delay in which the response has begun.
    """
    with_delay, before = (quiet_pieces(samples, axis, each) for each in (delay, 0.0))
    usable = [piece for piece in before if np.ptp(piece.values) > 0]
    if sum(piece.values.size - 1 for piece in usable) < _KNOWN:
        return with_delay
    return with_delay if _repeated(plausible(usable, scales), with_delay)[1] > _ALIKE else before


def _repeats(one: Samples, other: Samples, axis: int) -> bool:
    first, second = one.record, other.record
    return (
        first.time.shape == second.time.shape
        and np.array_equal(first.drive, second.drive)
        and np.allclose(first.time, second.time)
        and np.array_equal(one.axes[axis].index, other.axes[axis].index)
    )


def axis_noise(
    samples: Sequence[Samples], axis: int, delay: float, response: Axis, scales: Scales
) -> AxisNoise | str:
    """Noise of an axis from quiet samples, and from repeats where these agree; else why these do not tell it,
    and what to record.

    Repeats that differ by more than the quiet noise hold a disturbance from record to record (a trigger that
    jitters, a mount that shakes): then they are no measure of the noise, and the sentence says so.
    """
    quiet, repeats = _resting(samples, axis, delay, scales), repeat_pieces(samples, axis)
    count = sum(piece.values.size - 1 for piece in quiet)
    again = sum(piece.values.size - 1 for piece in repeats)
    usable = [piece for piece in quiet if np.ptp(piece.values) > 0]
    if count >= FEWEST and usable:
        alone = plausible(usable, scales)
        said = f"{response.name}: {_named(alone, response.unit)} from {count} quiet samples"
        if not again:
            return AxisNoise.of(alone, count, "quiet", f"{said}.")
        ratio, p = _repeated(alone, repeats)
        if p > _ALIKE:
            both = plausible([*usable, *repeats], scales)
            measured = f"{count} quiet samples and {again} differences of repeats"
            said = f"{response.name}: {_named(both, response.unit)} from {measured}"
            return AxisNoise.of(both, count + again, "quiet", f"{said}, which agree.")
        differ = f"repeats differ by {ratio:.2f} times the quiet noise (p = {p:.1g})"
        return AxisNoise.of(alone, count, "quiet", f"{said}; {differ}: something varies between records.")
    few = f"too few to measure the noise ({FEWEST} are needed)"
    at_rest = few if count < FEWEST else "all alike, as the steps of the sensor hide the noise"
    at_rest = f"{count} quiet samples are {at_rest}"
    if again >= FEWEST and (differing := [piece for piece in repeats if np.ptp(piece.values) > 0]):
        alone = plausible(differing, scales)
        said = f"{response.name}: {_named(alone, response.unit)} from {again} differences of repeats"
        return AxisNoise.of(alone, again, "repeats", f"{said}; {at_rest}.")
    apart = f"{again} differences of repeats are {'too few' if again < FEWEST else 'all alike'}"
    advice = (
        "a stretch before the first command, or a repeat" if count < FEWEST else "repeats, or finer steps"
    )
    return f"{at_rest}, and {apart if again else 'nothing was repeated'}; record {advice}"


def _named(posterior: PlausibleNoise, unit: str) -> str:
    law = Law.of(posterior)
    if law.share * law.rho < _SEEN:
        return f"white noise of sd {measured(law.sd, unit)}"
    part = "" if law.share > 1 - _SEEN else f" in {100 * law.share:.0f} % of its power"
    return f"noise of sd {measured(law.sd, unit)} and correlation {law.rho:.2f}{part}"


def joint_noise(residual: Sequence[Observed], response: Axis, why: str, scales: Scales) -> AxisNoise:
    """Noise of an axis fitted together with the plant, from its residual on each record [response unit];
    `why`, what keeps it from being measured.

    Coloured noise as free as the residual would take every slow effect for noise, and a fit whitened by it
    predicts the next sample and not the response. So the fit weighs all samples alike, and what its residual
    is worth as evidence is divided by ``sum_k rho_k^2``, the samples per independent one of a power (Bayley
    and Hammersley 1946, J. R. Stat. Soc. Suppl. 8), rho_k its autocorrelations.
    """
    pieces = [piece.values for piece in residual]
    count = sum(piece.size for piece in pieces)
    power = sum(float(((piece - piece.mean()) ** 2).sum()) for piece in pieces)
    law = Law(max(float(np.sqrt(power / count)), 1e-300))
    coloured = plausible(residual, scales)
    dependence = _dependence(pieces, Law.of(coloured))
    sentence = (
        f"{response.name}: {why}. Its sd of {measured(law.sd, response.unit)} is that of the residual, where "
        f"{count} samples count as {count / dependence:.0f} independent ones. An effect may pass for noise "
        "there, so no verdict is better than tentative."
    )
    return AxisNoise(law, coloured, count, "joint", sentence, dependence)


def no_less(
    noise: AxisNoise | str, residual: Sequence[Observed], response: Axis, least: float
) -> AxisNoise | str:
    """Noise of an axis, or why samples at rest do not tell it, but noise of an sd of `least` [response unit]
    where theirs is less, or the residual.

    What records of a simulation leave is the error to which a response is calculated: it is no noise, and
    has the shape of many effects.
    """
    pieces = [piece.values for piece in residual]
    count = sum(piece.size for piece in pieces)
    error = float(np.sqrt(sum(float((piece**2).sum()) for piece in pieces) / count))
    if min(error, np.inf if isinstance(noise, str) else noise.law.sd) >= least:
        return noise
    sentence = (
        f"{response.name}: samples have no noise above {measured(least, response.unit)}, a millionth of "
        "their range; nothing smaller is looked for."
    )
    return AxisNoise(Law(least), PlausibleNoise.white(least, count), count, "least", sentence)


def _dependence(pieces: Sequence[Vector], coloured: Law) -> float:
    """Samples per independent one of a power, from pieces and the noise that describes them best [-].

    The lesser of two estimates, as each errs upwards where its assumption fails: the law where a smooth
    misfit makes it nearly a random walk, the pieces' own autocorrelations where a ripple goes on for ever.
    """
    longest = max(piece.size for piece in pieces)
    products = np.zeros(longest)
    for piece in pieces:
        apart = piece - piece.mean()
        products[: piece.size] += correlate(apart, apart, mode="full", method="fft")[piece.size - 1 :]
    if products[0] == 0.0:
        return 1.0
    summed = 1.0 + 2.0 * np.cumsum((products[1:] / products[0]) ** 2)
    wide = np.flatnonzero(np.arange(1, longest) >= _WINDOW * summed)
    own = float(summed[wide[0]] if wide.size else summed[-1]) if longest > 1 else 1.0
    return min(own, coloured.correlated(min(longest - 1, _LAGS)))


def _repeated(posterior: PlausibleNoise, repeats: Sequence[Observed]) -> tuple[float, float]:
    """Root mean square of whitened repeats, and the p-value of noise alone over all that is plausible [-]."""
    count = sum(piece.values.size - 1 for piece in repeats)
    drawn = laws(posterior.draw(_REPEATED, np.random.default_rng(_SEED)))
    powers = np.array([_power(law, repeats) for law in drawn])
    above, below = chi2.sf(powers, count).mean(), chi2.cdf(powers, count).mean()
    ratio = np.sqrt(_power(Law.of(posterior), repeats) / count)
    return float(ratio), float(2 * min(above, below))


def _power(law: Law, pieces: Sequence[Observed]) -> float:
    """Squares of whitened pieces about their own levels [-]."""
    squares = 0.0
    for piece in pieces:
        white, ones = law.whiten(np.stack([piece.values, np.ones_like(piece.values)]), piece.gaps)
        squares += float(white @ white) - float(ones @ white) ** 2 / float(ones @ ones)
    return squares


def scatter_evidence(white: Vector) -> float:
    """Log Bayes factor of a mixture of N(0, s^2) and rare wide outliers against N(0, s^2) [nat].

    Averaged over shares and widths, each s at its best. Samples are taken against the mean of their two
    neighbours, so that a smooth residual is no outlier; every other sample makes these differences nearly
    independent, and the evidence is the mean of both halves.
    """
    apart = white[1:-1] - 0.5 * (white[:-2] + white[2:])
    return 0.5 * (_mixture(apart[::2]) + _mixture(apart[1::2]))


def _mixture(apart: Vector) -> float:
    scale = float(np.sqrt(np.mean(apart**2))) if apart.size else 0.0
    core = min(scale, float(np.median(np.abs(apart))) / 0.6744897501960817) if apart.size else 0.0
    if core == 0.0:
        return 0.0
    plain = -0.5 * (apart / scale) ** 2 - np.log(scale)
    z2 = (apart / core) ** 2
    evidence = []
    for share, width in product(_SHARES, _WIDTHS):
        inner = np.log1p(-share) - 0.5 * z2
        outer = np.log(share / width) - 0.5 * z2 / width**2
        evidence.append(float((np.logaddexp(inner, outer) - np.log(core) - plain).sum()))
    return float(logsumexp(evidence) - np.log(len(evidence)))
