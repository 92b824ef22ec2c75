"""Settings: what a study file may say, one frozen dataclass per table, each field with its default.

Every class checks its own values on construction and raises InputError with all that is wrong.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import pairwise
from types import MappingProxyType
from typing import Any, Literal, TypeVar, final, get_args

import numpy as np
from scipy import stats
from scipy.stats.distributions import rv_frozen

from lcopa_bayes.core.checks import file_names, is_number, one_of, rebuilt, refuse_if, whole_number
from lcopa_bayes.core.errors import InputError, nearest
from lcopa_bayes.data.record import TIME_UNITS

STAGES: Mapping[str, frozenset[str]] = MappingProxyType({"fit": frozenset(), "rival": frozenset()})
"""Stages a study may name, each with the keys of its settings."""
NOISE_KINDS = ("white", "ar1", "white+ar1", "student")
"""Noise models by the name a study gives them."""
S = TypeVar("S")


@final
@dataclass(frozen=True)
class HeadingSettings:
    """Table ``[study]``."""

    name: str | None = None
    """Also the name of the run folder; None: the name of the study's folder."""
    time_unit: str | None = None
    """s, ms or us: the unit of every time in the study, its priors and its results; None: the unit of the
    time column of the first fit record."""
    seed: int = 0
    """Seed of every random number of the study."""

    def __post_init__(self) -> None:
        bad = self.name is not None and not (isinstance(self.name, str) and self.name.strip(" ."))
        bad = bad or any(mark in (self.name or "") for mark in "/\\\0\n")
        problems = [f"`name` must be text fit for a folder; got {self.name!r}"] if bad else []
        if self.time_unit is not None:
            problems += one_of("time_unit", self.time_unit, TIME_UNITS)
        refuse_if([*problems, *whole_number("seed", self.seed, 0)])


@final
@dataclass(frozen=True)
class RecordsSettings:
    """Table ``[records]``: file names, relative to the study file."""

    fit: tuple[str, ...] | None = None
    """None: every CSV and Parquet file beside the study file that is not held out."""
    held_out: tuple[str, ...] = ()
    """Records the fit never sees."""

    def __post_init__(self) -> None:
        fit = () if self.fit is None else self.fit
        problems = file_names("fit", fit) + file_names("held_out", self.held_out)
        refuse_if(problems + (["`fit` names no record; name one or more"] if self.fit == () else []))


@final
@dataclass(frozen=True)
class ModelSettings:
    """Table ``[model]``."""

    terms: int | Mapping[str, int] = 1
    """Viscous terms [-] of every element, 1 to 6, or of each element by name; in a study file that
    states `orders` the default is their number."""
    orders: Literal["free"] | tuple[float, ...] = "free"
    """Fractional orders [-] in (0, 2], not increasing, one per term; "free": estimated."""
    share: Literal["paper", "all", "none"] = "paper"
    """Which paths share an element."""
    delay: Literal["shared", "element", "path"] = "shared"
    """Whether the delay is one for all, one per element or one per path."""
    offset: Literal["record", "shared", "none"] = "record"
    """Whether the offset of a response axis is one per record, one for all or zero."""
    blocks: int | None = None
    """Block pulses per record [-]; None: chosen from the record."""
    exposure: float = field(default=0.0, metadata={"key": "exposure_ms"})
    """Time over which a response sample is a mean [time unit of the study]; in a study file [ms]."""

    def __post_init__(self) -> None:
        each = self.terms if isinstance(self.terms, Mapping) else {"": self.terms}
        problems = [] if each else ["`terms` names no element; give a number or one number per element"]
        for name, terms in each.items():
            problems += whole_number(f"terms.{name}" if name else "terms", terms, 1, 6)
        if isinstance(self.terms, Mapping):
            object.__setattr__(self, "terms", MappingProxyType(dict(self.terms)))
        orders: Any = self.orders
        if isinstance(orders, tuple):
            if not orders or not all(is_number(order) and 0 < order <= 2 for order in orders):
                problems.append(f"`orders` must be numbers in (0, 2]; got {list(orders)}")
            elif any(later > order for order, later in pairwise(orders)):
                problems.append(f"`orders` must not increase; got {list(orders)}")
            elif not problems and any(terms != len(orders) for terms in each.values()):
                problems.append(
                    f"`orders` needs one order per term; got {len(orders)} for `terms` {self.terms}"
                )
            else:
                object.__setattr__(self, "orders", tuple(float(order) for order in orders))
        elif orders != "free":
            problems.append(f'`orders` must be "free" or a list such as [2, 1]; got {orders!r}')
        problems += one_of("share", self.share, ("paper", "all", "none"))
        problems += one_of("delay", self.delay, ("shared", "element", "path"))
        problems += one_of("offset", self.offset, ("record", "shared", "none"))
        problems += whole_number("blocks", self.blocks, 2) if self.blocks is not None else []
        if not is_number(self.exposure) or self.exposure < 0:
            problems.append(f"`exposure` must be a time, zero or more; got {self.exposure!r}")
        refuse_if(problems)

    __reduce__ = rebuilt


@final
@dataclass(frozen=True)
class NoiseSettings:
    """Table ``[noise]``."""

    kind: Literal["white", "ar1", "white+ar1", "student"] = "white+ar1"
    """Independent Gaussian, first-order autoregressive, the sum of both, or independent Student noise."""

    def __post_init__(self) -> None:
        refuse_if(one_of("kind", self.kind, NOISE_KINDS))


Method = Literal["auto", "ensembles"]
"""How a posterior is sampled."""


@final
@dataclass(frozen=True)
class SamplerSettings:
    """Table ``[sampler]``."""

    ensembles: int = 4
    """Independent ensembles [-], two or more: agreement between them is what grades a fit."""
    walkers: int | None = None
    """Walkers per ensemble [-]; None: chosen from the number of parameters."""
    steps: int | None = None
    """Largest number of steps per ensemble [-]; None: chosen from the number of parameters."""
    target_ess: int = 400
    """Effective sample size [-] at which sampling stops."""
    thin: int | None = None
    """Steps per kept draw [-]; None: 5."""
    method: Method | None = None
    """"auto": importance draws where a proposal gives enough of them, else ensembles;
    "ensembles": these in any case. None: ensembles where `steps` or `thin` is stated, which concern them
    alone, else "auto". Where the plant has effects "auto" is importance sampling around the optima, and
    ensembles only where its weights fail."""

    def __post_init__(self) -> None:
        least = {"ensembles": 2, "walkers": 4, "steps": 1, "target_ess": 1, "thin": 1}
        chosen = {key: getattr(self, key) for key in least}
        optional = ("walkers", "steps", "thin")
        stated = [key for key in least if not (key in optional and chosen[key] is None)]
        problems = [problem for key in stated for problem in whole_number(key, chosen[key], least[key])]
        if self.method not in (None, *get_args(Method)):
            allowed = " or ".join(f'"{name}"' for name in get_args(Method))
            problems.append(f"method must be {allowed}; got {self.method!r}")
        refuse_if(problems)


@final
@dataclass(frozen=True)
class EffectsSettings:
    """Table ``[effects]``."""

    add: tuple[str, ...] = ()
    """Effects of the user's own, ``file.py:Class``, relative to the study file."""
    use: tuple[str, ...] = ()
    """Effects that the plant has, by name; that they exist is checked where the axes are known."""
    deflection: Mapping[str, float] = field(default_factory=dict)
    """Largest deflection of a response axis by its name, ymax of the effects' formulas [response unit]; of
    the axes left out it is derived from the fit records."""
    speed: float | None = None
    """Time to half of a step response, delay excluded [time unit]; None: derived from the fit records."""

    def __post_init__(self) -> None:
        problems: list[str] = []
        for key, value in (("add", self.add), ("use", self.use)):
            if not isinstance(value, tuple):
                problems.append(f"`{key}` must be a list of texts; got {value!r}")
        if problems:
            raise InputError(problems)
        wrong = [one for one in self.add if not (isinstance(one, str) and ".py:" in one)]
        problems += [f'`add` must list "file.py:Class"; got {one!r}' for one in wrong]
        problems += [f"`use` must list names; got {one!r}" for one in self.use if not isinstance(one, str)]
        if not isinstance(self.deflection, Mapping):
            problems.append(f"`deflection` must be a table such as {{ x = 0.03 }}; got {self.deflection!r}")
        else:
            problems += [
                f"`deflection.{axis}` must be a number above 0; got {value!r}"
                for axis, value in self.deflection.items()
                if not (is_number(value) and value > 0)
            ]
            object.__setattr__(self, "deflection", MappingProxyType(dict(self.deflection)))
        if self.speed is not None and not (is_number(self.speed) and self.speed > 0):
            problems.append(f"`speed` must be a time above 0; got {self.speed!r}")
        refuse_if(problems)

    __reduce__ = rebuilt


@cache
def _distributions() -> Mapping[str, stats.rv_continuous]:
    return {name: value for name, value in vars(stats).items() if isinstance(value, stats.rv_continuous)}


@final
@dataclass(frozen=True)
class PriorSettings:
    """One line of ``[priors]``: a fixed value, or any continuous distribution of `scipy.stats`."""

    name: str
    """Parameter; that the model has it is checked where the model is known."""
    fixed: float | None = None
    """Value [unit of the parameter] the parameter is held at."""
    dist: str | None = None
    """Name in `scipy.stats`."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Shape parameters, ``loc`` and ``scale`` by scipy's names, in the parameter's unit or [-]."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "parameters", MappingProxyType(dict(self.parameters)))
        refuse_if([f"prior of {self.name!r}: {problem}" for problem in self._problems()])

    def _problems(self) -> list[str]:
        if (self.fixed is None) == (self.dist is None):
            return ['expected a number, or a distribution such as {dist = "norm", loc = 0, scale = 1}']
        if self.dist is None:
            bad = not is_number(self.fixed) or self.parameters
            return [f"a fixed value must be one finite number; got {self.fixed!r}"] if bad else []
        if not isinstance(self.dist, str) or self.dist not in _distributions():
            return [f"unknown distribution {self.dist!r}{nearest(str(self.dist), _distributions())}"]
        shapes = (_distributions()[self.dist].shapes or "").replace(",", " ").split()
        given, known = self.parameters, (*shapes, "loc", "scale")
        problems = [
            f"{self.dist} has no parameter {key!r}{nearest(key, known)}" for key in given if key not in known
        ]
        problems += [f"{self.dist} needs its parameter {key!r}" for key in shapes if key not in given]
        problems += [
            f"{key!r} must be a finite number; got {v!r}" for key, v in given.items() if not is_number(v)
        ]
        if problems:
            return problems
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")  # scipy warns before it answers NaN; the answer is checked
            low, high = self.frozen().support()
            mass = self.frozen().cdf(high) - self.frozen().cdf(low)
        wrong = not abs(float(mass) - 1) < 1e-6  # also when NaN, scipy's answer to parameters out of range
        return [
            f"{self.dist} with {dict(given)} is not a distribution; its parameters are out of range"
        ] * wrong

    def frozen(self) -> rv_frozen:
        """The distribution; ValueError for a fixed value, which has none."""
        if self.dist is None:
            raise ValueError(f"{self.name!r} is fixed at {self.fixed}")
        return _distributions()[self.dist](**self.parameters)

    __reduce__ = rebuilt


def keys_of(kind: type[Any]) -> dict[str, str]:
    """Field of each key that a table of a study file may have; a field whose key is None has none there."""
    keys = {field.name: field.metadata.get("key", field.name) for field in dataclasses.fields(kind)}
    return {key: name for name, key in keys.items() if key is not None}


def settings_from(kind: type[S], table: Mapping[str, object], where: str, problems: list[str]) -> S | None:
    """`kind` from a table of a study file; what is wrong joins `problems`, each told after `where`.

    None when a value is wrong; an unknown key alone is a problem but leaves the others usable.
    """
    known = keys_of(kind)
    problems += [f"{where}: unknown key {key!r}{nearest(key, known)}" for key in table if key not in known]
    values = {known[key]: tuple(v) if isinstance(v, list) else v for key, v in table.items() if key in known}
    try:
        return kind(**values)
    except InputError as error:
        for problem in error.problems:
            for key, name in known.items():
                problem = problem.replace(f"`{name}`", f"`{key}`")
            problems.append(f"{where}: {problem}")
        return None


def prior_settings(table: Mapping[str, Any], where: str, problems: list[str]) -> dict[str, PriorSettings]:
    """Priors by parameter name from values to fix, tables with `dist`, or settings; what is wrong joins
    `problems`."""
    priors = {}
    for name, value in table.items():
        try:
            if isinstance(value, PriorSettings):
                priors[name] = value
            elif isinstance(value, Mapping):
                parameters = {key: number for key, number in value.items() if key != "dist"}
                priors[name] = PriorSettings(name, dist=value.get("dist"), parameters=parameters)
            else:
                priors[name] = PriorSettings(name, fixed=value)
        except InputError as error:
            problems += [f"{where}: {problem}" for problem in error.problems]
    return priors
