"""Small studies with a known truth, made on the bench, for the tests of inference."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from lcopa_bayes.bench.command import Command, on_off, step
from lcopa_bayes.bench.device import Bench, Device, simulate
from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.data.record import Axis, Record
from lcopa_bayes.data.settings import (
    EffectsSettings,
)
from lcopa_bayes.data.study import Study
from lcopa_bayes.inference.assembly import Problem, problem_of
from lcopa_bayes.inference.leastsquares import LeastSquares
from lcopa_bayes.inference.parameter import Parameter, Place
from lcopa_bayes.inference.parameters import ParameterTable
from lcopa_bayes.inference.priors import Prior
from lcopa_bayes.model.path import TransferPath
from lcopa_bayes.sampling.convergence import Quality
from lcopa_bayes.sampling.draws import Draws

U, Y = Axis("u", "V"), Axis("y", "rad")
TRUTH = {"gain": 2.0, "time_1": 1.5, "order_1": 0.8, "delay": 0.73, "offset": 0.3, "sigma": 0.02}


def path(gain: float, delay: float, times: Sequence[float], orders: Sequence[float]) -> TransferPath:
    return TransferPath.of_times(gain, delay, times, orders)


ONE = Device(
    ((path(TRUTH["gain"], TRUTH["delay"], (TRUTH["time_1"],), (TRUTH["order_1"],)),),),
    (U,),
    (Y,),
    (TRUTH["offset"],),
)
DIRECT, CROSS = ((1.2, 2.5), (1.6, 0.7)), ((2.0,), (0.9,))
TWO = Device(
    (
        (path(1.0, 0.4, *DIRECT), path(0.2, 0.4, *CROSS)),
        (path(0.3, 0.4, *CROSS), path(1.5, 0.4, *DIRECT)),
    ),
    (Axis("x", "V"), Axis("y", "V")),
    (Axis("x", "rad"), Axis("y", "rad")),
    (0.1, -0.2),
)


def record(
    seed: int = 1,
    *,
    device: Device = ONE,
    command: Command | None = None,
    camera: float = 0.2,
    duration: float = 12.0,
    noise_sd: float = TRUTH["sigma"],
    correlation: float = 0.0,
    name: str = "step",
) -> Record:
    command = command or (
        step(1.0, at=0.35)
        if len(device.drive_axes) == 1
        else on_off((1.0, 0.6), hold=5.0, at=0.35, rest=(0.0, 0.2))
    )
    bench = Bench(camera=camera, noise_sd=noise_sd, noise_correlation=correlation)
    rng = np.random.default_rng(seed)
    return simulate(device, bench, command, duration=duration, name=name, rng=rng)


def ringing(time: float, order: float, delay: float, *, seed: int) -> tuple[Record, Vector]:
    """300 samples, one per ms, of a plant of gain 1 whose drive is 1 or -1 from sample to sample, with noise
    of 0.05, and the table values it was made with, by blocks 32 times narrower than those of its study."""
    rng = np.random.default_rng(seed)
    drive = rng.choice([-1.0, 1.0], 300)
    drive[:4] = 0.0
    silent = Record("ringing", np.arange(300.0), drive[:, None], np.zeros((300, 1)), (U,), (Y,), "ms")
    fine = problem_of(study(silent, noise="white")).refined(32).posterior
    known = {"gain": 1.0, "time": time, "order": order, "delay": delay, "offset": 0.0, "sigma": 0.05}
    values = np.array([known[row.kind] for row in fine.table.rows])
    least = LeastSquares(fine)
    exact = known["sigma"] * least.misfit(least.coordinates(values), values)[:300]
    seen = exact + known["sigma"] * rng.standard_normal(300)
    return replace(silent, response=seen[:, None]), values


def study(
    *fit: Record,
    held_out: Sequence[Record] = (),
    noise: str = "white",
    priors: Mapping[str, float | tuple[str, Mapping[str, float]]] | None = None,
    sampler: Mapping[str, int] | None = None,
    seed: int = 5,
    **model: object,
) -> Study:
    stated = {
        name: {"dist": value[0], **value[1]} if isinstance(value, tuple) else value
        for name, value in (priors or {}).items()
    }
    return Study(
        "small",
        None,
        fit[0].time_unit,
        seed,
        tuple(fit),
        tuple(held_out),
        model={"terms": 1, **model},
        priors=stated,
        noise={"kind": noise},
        sampler=sampler,
    )


def problem(*fit: Record, **options: object) -> Problem:
    return problem_of(study(*(fit or (record(),)), **options))


def row_values(table: ParameterTable, reported: Mapping[str, float]) -> Vector:
    """Values in table order; an unnamed parameter is an error."""
    return np.array([reported[name] for name in table.names])


def draws_of(table: ParameterTable, values: Matrix) -> Draws:
    """Draws that count as perfectly converged, and as all wanted, in two ensembles."""
    half = values.shape[0] // 2
    found = tuple(Quality(row.name, 1e6, 1e6, 1.0) for row in table.rows if row.free)
    stacked = values[: 2 * half].reshape(2, half, -1)
    return Draws(table, stacked, np.zeros((2, half)), found, max(400.0, 2.0 * half))


ON_OFF_TABLE = "Messung 3;;;\n\nZeit [min];Heater [%];T1 (°C);Notiz\n" + "".join(
    f"{k / 5:.1f};{40 * (k > 9)};{21 + 14 * max(0.0, 1 - 0.9 ** (k - 12)) + 0.01 * (k * k % 5):.2f};\n"
    for k in range(80)
).replace(".", ",")
"""What a spreadsheet saves: semicolons, decimal commas, remarks above the header, an empty column."""


class Toy:
    """A known density in place of a posterior without elements: what sampling asks of a posterior.

    `log_likelihood` takes coordinates (batch, dimension); `priors` are uniform, normal or another density
    of the whole line, by name.
    """

    linear = ()
    simulation = None

    def __init__(
        self,
        log_likelihood: Callable[[Matrix], Vector],
        priors: Mapping[str, tuple[str, Mapping[str, float]]],
    ) -> None:
        self.log_likelihood = log_likelihood
        self.rows = tuple(
            Parameter(name, "-", "gain", Place(0, k), Prior(*prior))
            for k, (name, prior) in enumerate(priors.items())
        )
        self.sampled = tuple(range(len(self.rows)))
        self.dimension = len(self.rows)
        grid = SimpleNamespace(n=10, step=1.0)
        self.model = SimpleNamespace(experiments=[SimpleNamespace(mesh=SimpleNamespace(grid=grid))])
        self.table = SimpleNamespace(
            layout=SimpleNamespace(elements=()),
            exchangeable=(),
            rows=self.rows,
            names=tuple(priors),
            log_permutations=0.0,
            draw=lambda size, rng: np.stack([row.draw(size, rng) for row in self.rows], axis=1),
        )

    def values(self, coordinates: Matrix) -> Matrix:
        return coordinates.copy()

    def coordinates(self, values: Matrix) -> Matrix:
        return values.copy()

    def complete(self, coordinates: Matrix, rng: np.random.Generator | None) -> Matrix:
        return coordinates.copy()

    def log_prior(self, coordinates: Matrix) -> Vector:
        return np.sum([row.log_prior(coordinates[:, k]) for k, row in enumerate(self.rows)], axis=0)

    def log_density(self, coordinates: Matrix, *, heat: float = 1.0) -> Vector:
        total = self.log_prior(coordinates)
        inside = total > -np.inf
        total[inside] += heat * self.log_likelihood(coordinates[inside])
        return total


def same_quantiles(a: Draws, b: Draws) -> bool:
    """Whether the shares of `a` below quantiles of `b` are as they should be, within Monte Carlo error."""
    p = np.array([0.02, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98])
    error = np.sqrt(p * (1 - p) * (1 / min(a.ess, len(a.flat)) + 1 / min(b.ess, len(b.flat))))
    free = [k for k, row in enumerate(a.table.rows) if row.free]
    shares = [np.mean(a.flat[:, k, None] < np.quantile(b.flat[:, k], p), axis=0) for k in free]
    return bool((np.abs(np.array(shares) - p) < 4.5 * error).all())


def check_page(path: Path) -> str:
    """The page stands alone: nothing fetched, files of its run folder alone named, no duplicate ids."""
    page = path.read_text(encoding="utf-8")
    assert not re.search(r'src="(?!data:)|https?:', page)
    linked = re.findall(r'href="(?!#|data:)([^"]*)"', page)
    assert [name for name in linked if not (path.parent / name).is_file()] == []
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    return page


def with_effect(
    base: Study, use: Sequence[str], truth: Mapping[str, float], *, seed: int = 3
) -> tuple[Study, Vector]:
    """The study with its responses made anew by a plant with effects, and its table values.

    `truth` is by name of a parameter or by its kind; white noise of its ``sigma``. What the effects count
    deflections in is stated, so that it does not follow the noise.
    """
    made = problem_of(replace(base, effects=EffectsSettings(use=tuple(use))))
    posterior, ranges = made.posterior, made.ranges
    assert posterior.simulation is not None
    assert ranges is not None
    values = np.array(
        [truth.get(row.name, truth.get(row.kind, row.value)) for row in posterior.table.rows], dtype=float
    )
    assert np.isfinite(values).all()
    rng, records = np.random.default_rng(seed), []
    for r, (each, clean) in enumerate(
        zip(base.fit, posterior.simulation.responses(values[None]), strict=True)
    ):
        response, rows = each.response.copy(), np.isfinite(each.response).any(axis=1)
        for axis in range(response.shape[1]):
            level = posterior.table.offset(values[None], axis, r)[0]
            noise = truth["sigma"] * rng.standard_normal(int(rows.sum()))
            response[rows, axis] = clean[axis, 0] + level + noise
        records.append(replace(each, response=response))
    stated = EffectsSettings(
        use=tuple(use),
        deflection=dict(zip(ranges.names, ranges.response.tolist(), strict=True)),
        speed=ranges.speed,
    )
    return replace(base, fit=tuple(records), effects=stated), values
