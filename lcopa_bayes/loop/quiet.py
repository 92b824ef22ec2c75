"""Samples that hold no signal: before the drive moves, inside the delay, and differences of repeats."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import final

import numpy as np
from scipy import stats
from scipy.signal import correlate

from lcopa_bayes.arrays import Vector
from lcopa_bayes.inference.data import Samples
from lcopa_bayes.loop.autoregression import Autoregression, estimated, unbroken

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


@final
@dataclass(frozen=True, eq=False)
class AxisNoise:
    """Noise of one response axis and where it is known from."""

    process: Autoregression
    samples: int
    """Samples it was estimated from [-]."""
    source: str
    """One of "quiet", "repeats", "joint"."""
    sentence: str
    dependence: float = 1.0
    """Samples that count as one independent sample [-]; above 1 only when fitted jointly."""
    coloured: Autoregression | None = None
    """Coloured noise that the residual may be, from which chance is drawn when fitted jointly."""

    @property
    def known(self) -> bool:
        """Whether it was measured apart from the fit."""
        return self.source != "joint"


def first_change(samples: Samples) -> float:
    """Time of the first drive change of a record, infinite when there is none [time unit]."""
    drive = samples.record.drive
    moved = np.flatnonzero((drive != drive[0]).any(axis=1))
    return float(samples.record.time[moved[0]]) if moved.size else np.inf


def quiet_samples(record: Samples, axis: int, delay: float) -> int:
    """Number of samples of an axis before anything can have arrived [-]; `delay` as in `quiet_pieces`."""
    until = first_change(record) + _SAFE * delay
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
        process = estimated(usable)
        said = f"{name}: AR({process.order}) noise of sd {process.sd:.3g} from {count} quiet samples"
        if not again:
            return AxisNoise(process, count, "quiet", f"{said}.")
        ratio = _power(process, repeats)
        p = float(2 * min(stats.f.sf(ratio, again, count), stats.f.cdf(ratio, again, count)))
        if p > _ALIKE:
            both = estimated([*usable, *repeats])
            told = (
                f"{name}: AR({both.order}) noise of sd {both.sd:.3g} from {count} quiet samples and {again}"
            )
            return AxisNoise(both, count + again, "quiet", f"{told} differences of repeats, which agree.")
        differ = f"repeats differ by {np.sqrt(ratio):.2f} times the quiet noise (p = {p:.1g})"
        return AxisNoise(process, count, "quiet", f"{said}; {differ}: something varies between records.")
    if again >= FEWEST:
        process = estimated([piece for piece in repeats if np.ptp(piece) > 0])
        told = f"{name}: AR({process.order}) noise of sd {process.sd:.3g} from {again} differences of repeats"
        return AxisNoise(process, again, "repeats", f"{told}; {count} quiet samples are too few.")
    return None


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
    coloured = estimated(residual)
    dependence = _dependence(residual, coloured)
    sentence = (
        f"{name}: {quiet} quiet samples and no repeats are too few to know the noise ({FEWEST} are needed), "
        f"so noise of sd {process.sd:.3g} is fitted to the residual together with the plant, and {count} "
        f"samples count as {count / dependence:.0f} independent ones: what it takes for noise may be an "
        "effect, so no verdict is better than tentative. Record a stretch before the first command, or a "
        "repeat."
    )
    return AxisNoise(process, count, "joint", sentence, dependence, coloured)


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


def _power(process: Autoregression, pieces: Sequence[Vector]) -> float:
    """Mean square of whitened pieces about their own levels [-]."""
    squares, count = 0.0, 0
    for piece in pieces:
        white, ones = process.whiten(np.stack([piece, np.ones_like(piece)]))
        squares += float(white @ white) - float(ones @ white) ** 2 / float(ones @ ones)
        count += piece.size - 1
    return squares / count
