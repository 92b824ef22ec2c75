"""Symmetries: directions in which parameters change no sample, from the rank of sensitivities.

The printed parametrisation of a path, and its sensitivities from those of the normalised
parametrisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, Literal, NamedTuple, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.estimate import plain
from lcopa_bayes.identifiability.curvature import Sensitivities
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import Normalisation, TransferPath
from lcopa_bayes.optics.array import linearised_angle, paper_array

Kind = Literal["no effect", "sum", "product", "scale", "exchange", "combination"]

TOLERANCES = (1e-9, 1e-10, 1e-11)
"""Singular values, relative to the largest, below which a direction counts as blind [-]; a symmetry is
called one only when all of them give the same rank: those of true ones are below 1e-12, while those of
directions that are merely stiff spread over all decades."""
DIFFERENCED = (3e-5, 1e-5, 3e-6)
"""The same for slopes that are differences, which are good to 1e-6 [-]."""
_CONSTANT = 1e-4
"""Entries of a null vector that differ less between points count as the same [-] ..."""
_PROPORTIONAL = 1e-7
"""... unit columns closer than this are the same [-] ..."""
_MOVES = 1e-6
"""... and from this share of the largest entry a parameter takes part in a null vector [-]: all with exact
slopes."""
_ROUGH = 100.0
"""Error of such entries over the tolerance of the singular values that leaves it: what differs less is not
told apart, however exact the limits above are [-]."""
_CLEAR = 6
"""Best conditioned points, from which symmetries are named."""
_NOTHING = 1e-10
"""Relative change of the responses below which a parameter has no effect [-]."""


@final
@dataclass(frozen=True)
class Symmetry:
    """Parameters that can make up for each other exactly."""

    kind: Kind
    parameters: tuple[str, ...]
    powers: tuple[float, ...]
    """Relative changes that leave the responses as they are (scale), or how each enters what acts
    (sum, product) [-]; empty where these depend on the values."""
    sentence: str

    def as_json(self) -> dict[str, Any]:
        """Plain values."""
        return plain(asdict(self))


@final
@dataclass(frozen=True, eq=False)
class Structure:
    """What the model and the drives leave open before any noise."""

    symmetries: tuple[Symmetry, ...]
    parameters: int
    """Number of parameters looked at."""
    rank: int
    """Largest rank of the sensitivities over all points."""
    certain: bool
    """Whether all tolerances give that rank."""
    singular: Vector
    """Singular values of the best conditioned point, relative to the largest, decreasing [-]."""

    @property
    def blind(self) -> frozenset[str]:
        """Names that take part in a continuous symmetry."""
        return frozenset(
            name
            for symmetries in self.symmetries
            if symmetries.kind != "exchange"
            for name in symmetries.parameters
        )

    def partners(self, name: str) -> tuple[str, ...]:
        """The other parameters of the continuous symmetries of `name`."""
        symmetries = [s.parameters for s in self.symmetries if s.kind != "exchange" and name in s.parameters]
        return tuple(dict.fromkeys(other for group in symmetries for other in group if other != name))


def structure(
    names: Sequence[str],
    slopes: Sequence[Matrix],
    values: Sequence[Vector],
    *,
    tolerances: tuple[float, float, float] = TOLERANCES,
) -> Structure:
    """Symmetries of a model from its sensitivities at several points.

    Parameters: `slopes`, per point, derivatives of all samples in the logarithm of each parameter's size
    (samples, parameters); `values`, per point, the parameters (parameters,), none zero. A direction is
    blind when it is so at every point: full rank at one point proves that there is none nearby. All of the
    `tolerances` [-] must agree on the rank.
    """
    names = tuple(names)
    largest = [max(float(np.linalg.norm(m, axis=0).max()), 1e-300) for m in slopes]
    reach = [np.linalg.norm(m, axis=0) / top for m, top in zip(slopes, largest, strict=True)]
    acting = [p for p in range(len(names)) if any(shares[p] > _NOTHING for shares in reach)]
    symmetries = [
        Symmetry("no effect", (names[p],), (1.0,), f"{names[p]} changes no sample: nothing excites it")
        for p in range(len(names))
        if p not in acting
    ]
    points = [
        m[:, acting] for m, shares in zip(slopes, reach, strict=True) if shares[acting].min(initial=1) > 0
    ]
    at = [v[acting] for v, shares in zip(values, reach, strict=True) if shares[acting].min(initial=1) > 0]
    kept = [names[p] for p in acting]
    if not points or not kept:
        return Structure(tuple(symmetries), len(names), 0, True, np.empty(0))
    spectra = [_spectrum(m) for m in points]
    ranks = {t: max(int(np.sum(s > t)) for s in spectra) for t in tolerances}
    rank = ranks[tolerances[1]]
    certain = len(set(ranks.values())) == 1
    if rank < len(kept) and certain:
        clear = np.argsort([-s[rank - 1] for s in spectra], kind="stable")[:_CLEAR]
        near = [points[p] for p in clear], [at[p] for p in clear]
        columns, labels, members, grouped = _merged(*near, kept, tolerances[1])
        symmetries += [*grouped, *_directions(columns, labels, members, tolerances[1])]
    best = max(spectra, key=lambda s: float(s[rank - 1]))
    return Structure(tuple(symmetries), len(names), rank, certain, best)


def _spectrum(matrix: Matrix) -> Vector:
    """Singular values of unit columns, relative to the largest."""
    singular = np.linalg.svd(matrix / np.linalg.norm(matrix, axis=0), compute_uv=False)
    return np.asarray(singular / singular[0])


def _merged(
    points: Sequence[Matrix], values: Sequence[Vector], names: Sequence[str], tolerance: float
) -> tuple[list[Matrix], list[str], list[tuple[str, ...]], list[Symmetry]]:
    """Columns with those that are proportional at every point merged; their labels and members; the
    symmetries."""
    unit = [m / np.linalg.norm(m, axis=0) for m in points]
    groups: list[list[int]] = []
    for p in range(len(names)):
        own = (g for g in groups if all(_same(m[:, g[0]], m[:, p], tolerance) for m in unit))
        group = next(own, None)
        groups.append([p]) if group is None else group.append(p)
    symmetries, labels, columns = [], [], [np.empty((m.shape[0], len(groups))) for m in points]
    for g, group in enumerate(groups):
        members = tuple(names[p] for p in group)
        labels.append(members[0])
        for column, m in zip(columns, points, strict=True):
            column[:, g] = m[:, group[0]]
        if len(group) == 1:
            continue
        shares = np.array([m[:, group[0]] @ m[:, group] / (m[:, group[0]] @ m[:, group[0]]) for m in points])
        sizes = np.array([v[group] / v[group[0]] for v in values])
        if _constant(shares, tolerance):
            powers = _round(shares.mean(axis=0))
            label = " ".join(f"{n}^{p:g}" if p != 1 else n for n, p in zip(members, powers, strict=True))
            symmetries.append(Symmetry("product", members, powers, f"only the product {label} acts"))
            labels[-1] = f"the product {label}"
        elif _constant(shares / sizes, tolerance):
            weights = _round((shares / sizes).mean(axis=0))
            parts = (n if w == 1 else f"{w:g} {n}" for n, w in zip(members, weights, strict=True))
            label = " + ".join(parts).replace("+ -", "- ")
            symmetries.append(Symmetry("sum", members, weights, f"only the sum {label} acts"))
            labels[-1] = f"the sum {label}"
            for column, m in zip(columns, points, strict=True):
                column[:, g] = m[:, group].sum(axis=1)
        else:
            label = ", ".join(members)
            symmetries.append(Symmetry("combination", members, (), f"only one combination of {label} acts"))
    return columns, labels, [tuple(names[p] for p in group) for group in groups], symmetries


def _directions(
    columns: Sequence[Matrix], labels: Sequence[str], members: Sequence[tuple[str, ...]], tolerance: float
) -> list[Symmetry]:
    """Remaining blind directions, each group counting as one parameter."""
    kernels = [_kernel(m, tolerance) for m in columns]
    width = min(kernel.shape[1] for kernel in kernels)
    kernels = [kernel for kernel in kernels if kernel.shape[1] == width]
    if not width:
        return []
    reach = np.max([np.abs(kernel).max(axis=1) for kernel in kernels], axis=0)
    taking = [p for p in range(len(labels)) if reach[p] > max(_MOVES, _ROUGH * tolerance) * reach.max()]
    names, parameters = [labels[p] for p in taking], tuple(n for p in taking for n in members[p])
    if width == 1:
        vectors = np.array([k[taking, 0] / k[taking[0], 0] for k in kernels])
        if _constant(vectors, tolerance):
            powers = _round(vectors.mean(axis=0))
            parts = (n if w == 1 else f"{n} (to the power {w:g})" for n, w in zip(names, powers, strict=True))
            sentence = f"a common factor on {', '.join(parts)} has no effect"
            return [Symmetry("scale", parameters, powers if len(parameters) == len(names) else (), sentence)]
    many = f"{width} directions" if width > 1 else "one direction"
    sentence = f"{many} in which {', '.join(names)} move together without any effect"
    return [Symmetry("combination", parameters, (), sentence)]


def _kernel(matrix: Matrix, tolerance: float) -> Matrix:
    """Null space in relative changes, (parameters, dimension)."""
    norms = np.linalg.norm(matrix, axis=0)
    _, singular, rows = np.linalg.svd(matrix / norms, full_matrices=True)
    rank = int(np.sum(singular > tolerance * singular[0]))
    return np.asarray(rows[rank:].T / norms[:, None])


def _same(a: Vector, b: Vector, tolerance: float) -> bool:
    """Whether two unit columns are the same but for their sign."""
    apart = min(np.linalg.norm(a - b), np.linalg.norm(a + b))
    return bool(apart < max(_PROPORTIONAL, tolerance))


def _constant(rows: Matrix, tolerance: float) -> bool:
    """Whether all points have the same entries."""
    limit = max(_CONSTANT, _ROUGH * tolerance)
    return bool(np.all(np.ptp(rows, axis=0) <= limit * np.abs(rows).max(axis=0)))


def _round(entries: Vector) -> tuple[float, ...]:
    """Entries to the digits that are sure."""
    return tuple(float(f"{shares:.4g}") + 0.0 for shares in entries)


def exchanges(table: ParameterTable) -> tuple[Symmetry, ...]:
    """Pairs of terms of an element that have equal priors: the denominator is their sum in any order."""
    out = []
    for terms, exchangeable in zip(table.terms, table.exchangeable, strict=True):
        for pair in combinations(zip(*terms, strict=True) if exchangeable else (), 2):
            first, second = (tuple(table.names[k] for k in term) for term in pair)
            sentence = (
                f"({', '.join(first)}) and ({', '.join(second)}) are interchangeable; with "
                "decreasing orders each plant is counted once"
            )
            out.append(Symmetry("exchange", (*first, *second), (), sentence))
    return tuple(out)


SPRINGS = 4
"""Springs of the element, of which Eq. 16 adds up the stiffnesses."""


@final
class PrintedForm(NamedTuple):
    """Values of a path as Eqs. 16, 21 and 28 write them."""

    names: tuple[str, ...]
    values: Vector
    slopes: Matrix
    """Derivatives of its normalised parameters in the logarithms of these, (normalised, printed)."""


def printed_form(
    gain: float, times: Vector, orders: Vector, delay: float, rng: np.random.Generator
) -> PrintedForm:
    """One of the many printed forms of ``gain exp(-delay s) / (1 + sum_i (T_i s)^order_i)``.

    ``gain = b / k``, ``T_i = (eta_i / k)^(1 / order_i)``, ``k = k1 + ... + k4`` and
    ``b = asin(lambda / (2 pi d)) j q / (0.4019 x)`` (Ta et al. 2026, Eqs. 16, 21, 28); the springs are
    drawn with `rng`, the rest follows. Rows of `slopes`: gain, log T_i, order_i, delay; units as given.
    """
    optics = PAPER.optics
    springs = rng.uniform(0.5, 2.0, SPRINGS)
    k = float(springs.sum())
    path = TransferPath.of_times(gain, delay, times.tolist(), orders.tolist())
    path = path.normalised(Normalisation.STIFFNESS, k)
    lever = float(linearised_angle(paper_array(optics), 1.0)) / optics.tilt_slope_low
    j = path.gain / lever * optics.element_width / optics.charge
    terms = times.size
    names = (
        *("j", "q", "x"),
        *(f"eta{i + 1}" for i in range(terms)),
        *(f"order_{i + 1}" for i in range(terms)),
        "delay",
        *(f"k{i + 1}" for i in range(SPRINGS)),
    )
    values = np.concatenate([[j, optics.charge, optics.element_width], path.etas, orders, [delay], springs])
    slopes = np.zeros((2 * terms + 2, len(names)))
    slopes[0, :3] = gain * np.array([1.0, 1.0, -1.0])
    slopes[0, -SPRINGS:] = -gain * springs / k
    for i in range(terms):
        slopes[1 + i, 3 + i] = 1 / orders[i]
        slopes[1 + i, 3 + terms + i] = -np.log(times[i])
        slopes[1 + i, -SPRINGS:] = -springs / k / orders[i]
        slopes[1 + terms + i, 3 + terms + i] = orders[i]
    slopes[1 + 2 * terms, 3 + 2 * terms] = delay
    return PrintedForm(names, values, slopes)


def printed_structure(points: list[Sensitivities], rng: np.random.Generator) -> Structure | None:
    """Symmetries of the printed form of the first path of a plant; None where it has parameters fixed.

    `points` are sensitivities of the normalised form at several values.
    """
    names: tuple[str, ...] = ()
    values, slopes = [], []
    for point in points:
        kinds = ("gain", "time", "order", "delay")
        where = {kind: [p for p, n in enumerate(point.names) if n.split("_")[0] == kind] for kind in kinds}
        terms = len(where["time"])
        single = len(where["gain"]) == len(where["delay"]) == 1 and len(where["order"]) == terms
        if not single or not terms:
            return None
        gain, delay = where["gain"][0], where["delay"][0]
        form = printed_form(
            float(point.values[gain]),
            point.values[where["time"]],
            point.values[where["order"]],
            float(point.values[delay]),
            rng,
        )
        columns = [gain, *where["time"], *where["order"], delay]
        natural = point.matrix[:, columns].copy()
        logs = np.array(point.logarithmic)[columns]
        for c, log in enumerate(logs):
            is_time = 1 <= c <= terms
            if is_time and not log:
                natural[:, c] *= point.values[columns[c]]
            elif not is_time and log:
                natural[:, c] /= point.values[columns[c]]
        names = form.names
        values.append(form.values)
        slopes.append(natural @ form.slopes)
    return structure(names, slopes, values)
