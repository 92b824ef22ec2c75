"""Time, memory and error of a unit step response, by this package's algebra and by what else computes it.

The element is the paper's with three viscous terms, without gain or delay, so that no method is judged by how
it samples a delayed drive. Whatever depends on orders or time constants is counted, because every evaluation
of a likelihood changes them: matrices, weights and the pole expansions of Oustaloup et al. (2000, IEEE
Trans. Circuits Syst. I 47). What depends on the number of blocks alone is prepared beforehand: the wavelet
basis with its inverse, compiled code. The error is that of the numbers a method gives, against the
inverse Laplace transform: at the ends of the steps, or, for block means, at the middle of the blocks.
"""

from __future__ import annotations

import time
import tracemalloc
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from comparison import Spread, ratio
from scipy.linalg import solve_triangular

from lcopa_bayes.bench.inversion import unit_step
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.parallel import keep_freed_memory
from lcopa_bayes.data.drive import AxisDrive
from lcopa_bayes.data.record import Axis
from lcopa_bayes.data.settings import ModelSettings
from lcopa_bayes.model.blockpulses import integration_matrix
from lcopa_bayes.model.forward import Dynamics, Experiment, ForwardModel
from lcopa_bayes.model.grid import Mesh
from lcopa_bayes.model.layout import Layout
from lcopa_bayes.model.literature import PAPER
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.paper.numericsclaims import WaveletBasis, wavelet_response

SPAN = 25.0
"""Length of the record [ms]."""
BATCH = 64
"""Plants that the package evaluates at once."""
SIZES = (128, 512, 1024, 4096, 16_384, 100_000)
QUICK_SIZES = (128, 1024, 16_384, 100_000)
POLES, DECADES = 5, 1.0
"""Oustaloup's order N, of 2 N + 1 poles, the usual choice; and decades by which the band that he
approximates reaches beyond the frequencies of the record, 1 / span to the Nyquist frequency."""
READ = 400
"""Positions at which errors are taken."""


def element() -> TransferPath:
    """The paper's direct path with unit gain and stiffness, without delay."""
    path = PAPER.plant.xx
    times = [(eta / path.stiffness) ** (1 / order) for eta, order in zip(path.etas, path.orders, strict=True)]
    return TransferPath.of_times(1.0, 0.0, times, path.orders)


@dataclass(frozen=True)
class Method:
    """A way to compute a step response on n blocks."""

    name: str
    prepared: Callable[[int], Callable[[], Vector]]
    """What computes the response on n blocks, (n,); everything that depends on n alone is done."""
    middle: bool = False
    """Whether its numbers belong to the middles of blocks, not their ends."""
    plants: int = 1
    """Computed by one call."""
    power: float = 1.0
    """Time grows at most as this power of n, by which sizes out of reach are known."""
    bytes: Callable[[int], float] = lambda n: 1e3 * n
    """Memory needed at least [byte]."""
    needs: str | None = None
    """Package it comes from, where that is optional."""
    powers_of_two: bool = False
    """Whether n must be one."""


def ours(n: int, batch: int) -> Callable[[], Vector]:
    path = element()
    layout = Layout.of([Axis("x", "rad")], [Axis("x", "rad")], ModelSettings(terms=3))
    mesh = Mesh.of_samples(SPAN / n * np.arange(1, n + 1), 0.0, blocks=n)
    if mesh.grid.n > n + 3:
        raise RuntimeError(f"the mesh has {mesh.grid.n} blocks where {n} were asked for")
    model = ForwardModel(
        layout, (Experiment("step", mesh, (AxisDrive(np.zeros(1), np.ones(1)),), np.zeros(1)),)
    )
    dynamics = Dynamics(
        (np.tile(path.times, (batch, 1)),), (np.tile(path.orders, (batch, 1)),), np.zeros((batch, 1))
    )
    return lambda: model.unit_responses(dynamics)[0][0, 0]


def block_pulses(n: int, solve: Callable[[Matrix, Vector], Vector]) -> Callable[[], Vector]:
    path, step = element(), SPAN / n

    def response() -> Vector:
        top = path.orders[0]
        system = path.stiffness * integration_matrix(top, n, step)
        for eta, order in zip(path.etas, path.orders, strict=True):
            system += eta * integration_matrix(top - order, n, step)
        return solve(system, integration_matrix(top, n, step) @ np.ones(n))

    return response


def legendre(n: int) -> Callable[[], Vector]:
    basis, path = WaveletBasis(n), element()
    assert basis.inverse.size  # computed once and kept
    return lambda: wavelet_response(path, np.ones(n), basis, SPAN, 0)


def oustaloup(n: int) -> Callable[[], Vector]:
    """States of ``v = u / (eta_1 + sum_i eta_i s^(order_i - order_1) + k s^-order_1)``, ``y = s^-order_1 v``.

    Every power is an integrator: whole ones exactly, times a power between 0 and 1 by Oustaloup.
    """
    control = import_module("control")
    path, times = element(), SPAN / n * np.arange(n + 1)
    low, high = 10**-DECADES / SPAN, 10**DECADES * np.pi * n / SPAN

    def integrator(order: float) -> Any:
        whole = int(np.ceil(order))
        return chain(whole, whole - order)

    def chain(whole: int, rest: float) -> Any:
        out = control.ss([], [], [], [[1.0]])
        for _ in range(whole):
            out = control.ss([[0.0]], [[1.0]], [[1.0]], [[0.0]]) * out
        if rest:
            position = np.arange(-POLES, POLES + 1) + POLES
            zeros = low * (high / low) ** ((position + 0.5 * (1 - rest)) / (2 * POLES + 1))
            poles = low * (high / low) ** ((position + 0.5 * (1 + rest)) / (2 * POLES + 1))
            for zero, pole in zip(zeros, poles, strict=True):
                # (s + zero) / (s + pole), scaled to gain high^rest above the band
                out = control.ss([[-pole]], [[1.0]], [[zero - pole]], [[1.0]]) * out
            out = high**rest * out
        return out

    def response() -> Vector:
        top, rest = path.orders[0], zip(path.etas[1:], path.orders[1:], strict=True)
        inner = integrator(top)
        loop = path.stiffness * inner
        for eta, order in rest:
            loop = loop + eta * integrator(top - order)
        closed = inner * control.feedback(control.ss([], [], [], [[1 / path.etas[0]]]), loop)
        return np.asarray(control.forced_response(closed, times, np.ones(n + 1)).outputs[1:])

    return response


@cache
def convolved() -> Callable[[Vector, float], Vector]:
    """The compiled recursion ``y_k = (1 - sum_j c_j y_(k-j)) / (k + c_0)``."""
    numba = import_module("numba")

    @numba.njit(fastmath=True)
    def recursion(weights: Vector, stiffness: float) -> Vector:  # pragma: no cover - compiled
        n = weights.size - 1
        y = np.zeros(n + 1)
        for k in range(1, n + 1):
            total = 0.0
            for j in range(1, k):
                total += weights[j] * y[k - j]
            y[k] = (1.0 - total) / (stiffness + weights[0])
        return y[1:]

    return recursion


def gruenwald(n: int) -> Callable[[], Vector]:
    path, step = element(), SPAN / n
    recursion = convolved()
    recursion(np.ones(4), 1.0)  # compiles

    def response() -> Vector:
        weights, index = np.zeros(n + 1), np.arange(1, n + 1)
        for eta, order in zip(path.etas, path.orders, strict=True):
            weights += eta * step**-order * np.cumprod(np.append(1.0, 1 - (order + 1) / index))
        return recursion(weights, path.stiffness)

    return response


OURS = "this package, 64 at once"
METHODS = (
    Method(OURS, lambda n: ours(n, BATCH), plants=BATCH, power=1.1, bytes=lambda n: 4e3 * n),
    Method("this package, one", lambda n: ours(n, 1), power=1.1),
    Method(
        "dense block pulses, numpy.linalg.solve",
        lambda n: block_pulses(n, np.linalg.solve),
        middle=True,
        power=3.0,
        bytes=lambda n: 32.0 * n**2,
    ),
    Method(
        "dense block pulses, scipy solve_triangular",
        lambda n: block_pulses(n, lambda a, b: solve_triangular(a, b, lower=True)),
        middle=True,
        power=2.2,
        bytes=lambda n: 32.0 * n**2,
    ),
    Method(
        "dense Legendre wavelets",
        legendre,
        middle=True,
        power=3.0,
        bytes=lambda n: 64.0 * n**2,
        powers_of_two=True,
    ),
    Method("python-control, Oustaloup", oustaloup, needs="control"),
    Method("Gruenwald-Letnikov, compiled", gruenwald, power=2.0, needs="numba"),
)


def errors(method: Method, n: int, values: Vector) -> tuple[float, float]:
    """Largest and root mean square error [share of the steady response], at positions spread over the
    record and its logarithm."""
    spread = np.concatenate([np.linspace(0, n - 1, READ // 2), np.geomspace(1, n, READ // 2) - 1])
    index = np.unique(spread.round().astype(int))
    at = SPAN / n * (index + (0.5 if method.middle else 1.0))
    off = values[index] - element().stiffness * unit_step(element(), at)
    return float(np.abs(off).max()), float(np.sqrt(np.mean(off**2)))


def peak_memory(work: Callable[[], object]) -> float:
    """Most memory that one call holds beyond what it began with [MB]; of numpy arrays and Python objects."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def out_of_reach(
    method: Method, n: int, last: tuple[int, float] | None, seconds: float, megabytes: float
) -> str | None:
    """Why a method is not tried on n blocks: it is not there, or would take too much; None where it is."""
    if method.needs and find_spec(method.needs) is None:
        return f"{method.needs} is not installed"
    if method.bytes(n) > 1e6 * megabytes:
        return f"needs {method.bytes(n) / 1e9:.3g} GB"
    if method.powers_of_two and n & (n - 1):
        return "takes powers of two only"
    if last is not None:
        expected = last[1] * (n / last[0]) ** method.power
        if expected > seconds:
            return f"would take about {expected:.2g} s"
    return None


def cpu_of(work: Callable[[], object]) -> float:
    """CPU time of one call [s]; repeated within until it can be read off the clock."""
    count, spent = 0, 0.0
    while spent < 2e-3:
        begin = time.process_time()
        work()
        spent += time.process_time() - begin
        count += 1
    return spent / count


def measured(*, quick: bool) -> list[dict[str, Any]]:
    """A row per method and number of blocks; times of all methods are taken in turn, round by round."""
    keep_freed_memory()  # as wherever the package evaluates responses; every method gains by it
    seconds, megabytes, rounds = (1.0, 2_000.0, 5) if quick else (60.0, 8_000.0, 9)
    rows: list[dict[str, Any]] = []
    last: dict[str, tuple[int, float]] = {}
    for n in QUICK_SIZES if quick else SIZES:
        works: dict[str, Callable[[], Vector]] = {}
        for method in METHODS:
            reason = out_of_reach(method, n, last.get(method.name), seconds, megabytes)
            row: dict[str, Any] = {"method": method.name, "blocks": n, "reason": reason}
            rows.append(row)
            if reason is None:
                work = works[method.name] = method.prepared(n)
                row["error"], row["error_rms"] = errors(method, n, work())
                row["memory_MB"] = peak_memory(work)
        times: dict[str, list[float]] = {name: [] for name in works}
        for _ in range(rounds):
            for name, work in works.items():
                times[name].append(cpu_of(work))
        for method, row in zip(METHODS, rows[-len(METHODS) :], strict=True):
            if row["reason"] is None:
                own = [one / method.plants for one in times[method.name]]
                last[method.name] = n, float(np.median(times[method.name]))
                row["cpu_s"] = Spread.of(own)
                row["ratio"] = ratio(own, [one / BATCH for one in times[OURS]])
    return rows
