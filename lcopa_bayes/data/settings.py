"""Settings: what a study file may say, one frozen dataclass per table, each field with its default and rule.

Every class raises InputError on construction with all that is wrong.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from itertools import pairwise
from typing import Annotated, Literal, TypeAlias, final

import numpy as np
from scipy import stats
from scipy.stats.distributions import rv_frozen

from lcopa_bayes.core.errors import nearest
from lcopa_bayes.core.rules import FLAG, FOLDER, POSITIVE, Rule, Ruled, is_number, texts, whole, word_of
from lcopa_bayes.core.units import TIME_UNITS

Share: TypeAlias = Literal["paper", "all", "none"]
"""Which paths share an element."""
DelayKind: TypeAlias = Literal["shared", "element", "path"]
"""What has a delay of its own."""
OffsetKind: TypeAlias = Literal["record", "shared", "none"]
"""What has an offset of its own."""
NoiseKind: TypeAlias = Literal["white", "ar1", "white+ar1", "student"]
"""Noise models by the name a study gives them."""
Method: TypeAlias = Literal["auto", "ensembles"]
"""How a posterior is sampled."""
_IMPROPER = ("flat", "improper", "jeffreys")
"""Words for a prior that is no distribution."""
STAGES = ("fit", "rival")
"""Stages that `run` knows."""
_CANDIDATES = texts('a list of candidates, as in ["fractional-1", "second-order"]')
_EFFECTS = texts('a list of names, as in ["cubic_stiffness"]')
_FILES = texts('a list of file names, as in ["a.csv", "b.csv"]')
_DEFLECTIONS = Rule("a table such as { x = 0.03 }", lambda value: False, each=POSITIVE)


def _are_orders(value: object) -> bool:
    some = isinstance(value, tuple) and value and all(is_number(order) and 0 < order <= 2 for order in value)
    return value == "free" or bool(some)


_TERMS = Rule(
    'a whole number from 1 to 6, or "auto"',
    lambda value: value == "auto" or whole(1, 6).holds(value),
    ("auto",),
    each=whole(1, 6),
)
_ORDERS = Rule('"free" or numbers in (0, 2], such as [2, 1]', _are_orders)
_EXPOSURE = Rule("a time, zero or more", lambda value: is_number(value) and value >= 0)


@final
@dataclass(frozen=True)
class HeadingSettings(Ruled):
    """Table ``[study]``."""

    name: Annotated[str | None, FOLDER] = None
    """Also the name of the run folder; None: the name of the study's folder."""
    time_unit: Annotated[str | None, word_of(*TIME_UNITS)] = None
    """ns, us, ms, s, min or h: the unit of every time in the study, its priors and its results; None: the
    unit of the time column of the first fit record."""
    seed: Annotated[int, whole(0)] = 0
    """Seed of every random number of the study."""


@final
@dataclass(frozen=True)
class RecordsSettings(Ruled):
    """Table ``[records]``: file names, relative to the study file."""

    fit: Annotated[tuple[str, ...] | None, _FILES] = None
    """None: every CSV and Parquet file beside the study file that is not held out."""
    held_out: Annotated[tuple[str, ...], _FILES] = ()
    """Records the fit never sees."""

    def contradictions(self) -> list[str]:
        """A fit of no record."""
        return ["`fit` names no record; name one or more"] if self.fit == () else []


@final
@dataclass(frozen=True)
class ModelSettings(Ruled):
    """Table ``[model]``."""

    terms: Annotated[int | Literal["auto"] | Mapping[str, int], _TERMS] = "auto"
    """Viscous terms [-] of every element, 1 to 6, or of each element by name; "auto": the records choose, and
    what paths share too; in a study file that states `orders` the default is their number."""
    orders: Annotated[Literal["free"] | tuple[float, ...], _ORDERS] = "free"
    """Fractional orders [-] in (0, 2], not increasing, one per term; "free": estimated."""
    share: Share | None = None
    """Which paths share an element; None: as `for_plant` says."""
    delay: DelayKind | None = None
    """Whether the delay is one for all, one per element or one per path; None: as `for_plant` says."""
    offset: OffsetKind = "record"
    """Whether the offset of a response axis is one per record, one for all or zero."""
    blocks: Annotated[int | None, whole(2)] = None
    """Block pulses per record [-]; None: chosen from the record."""
    exposure_ms: Annotated[float, _EXPOSURE] = 0.0
    """Time over which a response sample is a mean [ms], whatever the time unit of the study."""

    def for_plant(self, drives: int, responses: int) -> ModelSettings:
        """The same with what paths share decided.

        A plant of as many drives as responses is one of the paper's: direct paths share an element, cross
        paths another, all of them a delay. Of any other plant nothing says that paths have anything in
        common, so every path has an element and a delay of its own, unless `terms` names shared elements.
        """
        alike = drives == responses
        share = self.share or ("paper" if alike or isinstance(self.terms, Mapping) else "none")
        return replace(self, share=share, delay=self.delay or ("shared" if alike else "path"))

    @property
    def most_terms(self) -> int:
        """Terms of the richest element [-]; 1 before the records have chosen."""
        each = self.terms.values() if isinstance(self.terms, Mapping) else (self.terms,)
        return max(1 if terms == "auto" else terms for terms in each)

    def contradictions(self) -> list[str]:
        """Elements without a number of terms, and orders that are not one per term or that increase."""
        each = self.terms if isinstance(self.terms, Mapping) else {"": self.terms}
        if self.terms == "auto" and isinstance(self.orders, tuple):
            return ['`terms = "auto"` needs free orders; state the number of terms, or leave `orders` out']
        if not each:
            return ["`terms` names no element; give a number or one number per element"]
        if not isinstance(self.orders, tuple):
            return []
        if any(later > order for order, later in pairwise(self.orders)):
            return [f"`orders` must not increase; got {list(self.orders)}"]
        if any(terms != len(self.orders) for terms in each.values()):
            return [f"`orders` needs one order per term; got {len(self.orders)} for `terms` {self.terms}"]
        object.__setattr__(self, "orders", tuple(map(float, self.orders)))
        return []


@final
@dataclass(frozen=True)
class NoiseSettings(Ruled):
    """Table ``[noise]``."""

    kind: NoiseKind = "white+ar1"
    """Independent Gaussian, first-order autoregressive, the sum of both, or independent Student noise."""


@final
@dataclass(frozen=True)
class SamplerSettings(Ruled):
    """Table ``[sampler]``."""

    ensembles: Annotated[int, whole(2)] = 4
    """Independent ensembles [-], two or more: agreement between them is what grades a fit."""
    walkers: Annotated[int | None, whole(4)] = None
    """Walkers per ensemble [-]; None: chosen from the number of parameters."""
    steps: Annotated[int | None, whole(1)] = None
    """Largest number of steps per ensemble [-]; None: chosen from the number of parameters."""
    target_ess: Annotated[int, whole(1)] = 400
    """Effective sample size [-] at which sampling stops."""
    thin: Annotated[int | None, whole(1)] = None
    """Steps per kept draw [-]; None: 5."""
    seconds: Annotated[float | None, POSITIVE] = None
    """Budget: time after which sampling ends with the draws it has, or takes the fewest steps to some [s].
    What they lack, and how much more time would give it, is part of the grade. Importance draws of a plant
    with effects take their own time. None: no limit."""
    method: Method | None = None
    """"auto": importance draws where a proposal gives enough of them, else ensembles;
    "ensembles": these in any case. None: ensembles where `steps` or `thin` is stated, which concern them
    alone, else "auto". Where the plant has effects "auto" is importance sampling around the optima, and
    ensembles only where its weights fail."""


@final
@dataclass(frozen=True)
class EffectsSettings(Ruled):
    """Table ``[effects]``."""

    add: Annotated[tuple[str, ...], texts('a list of "file.py:Class"', ".py:")] = ()
    """Effects of the user's own, ``file.py:Class``, relative to the study file."""
    use: Annotated[tuple[str, ...], _EFFECTS] = ()
    """Effects that the plant has, by name; that they exist is checked where the axes are known."""
    deflection: Annotated[Mapping[str, float], _DEFLECTIONS] = field(default_factory=dict)
    """Largest deflection of a response axis by its name, ymax of the effects' formulas [response unit]; of
    the axes left out it is derived from the fit records."""
    speed: Annotated[float | None, POSITIVE] = None
    """Time to half of a step response, delay excluded [time unit]; None: derived from the fit records."""


@cache
def _distributions() -> Mapping[str, stats.rv_continuous]:
    return {name: value for name, value in vars(stats).items() if isinstance(value, stats.rv_continuous)}


@final
@dataclass(frozen=True)
class PriorSettings(Ruled):
    """One line of ``[priors]``: a fixed value, or any continuous distribution of `scipy.stats`."""

    name: str
    """Parameter; that the model has it is checked where the model is known."""
    fixed: float | None = None
    """Value [unit of the parameter] the parameter is held at."""
    dist: str | None = None
    """Name in `scipy.stats`; flat, improper or jeffreys for a prior that is no distribution."""
    parameters: Mapping[str, float] = field(default_factory=dict)
    """Shape parameters, ``loc`` and ``scale`` by scipy's names, in the parameter's unit or [-]."""

    def contradictions(self) -> list[str]:
        """What makes it neither a value nor a distribution."""
        return [f"prior of {self.name!r}: {problem}" for problem in self._problems()]

    def _problems(self) -> list[str]:
        if (self.fixed is None) == (self.dist is None):
            return ['expected a number, or a distribution such as {dist = "norm", loc = 0, scale = 1}']
        if self.dist is None:
            bad = not is_number(self.fixed) or self.parameters
            return [f"a fixed value must be one finite number; got {self.fixed!r}"] if bad else []
        if self.improper:
            return [f"{self.dist} has no parameters; got {dict(self.parameters)}"] if self.parameters else []
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

    @property
    def improper(self) -> bool:
        """Whether this is no distribution."""
        return self.dist in _IMPROPER

    def frozen(self) -> rv_frozen:
        """The distribution; ValueError for a fixed value or an improper prior, which have none."""
        if self.dist is None or self.improper:
            raise ValueError(f"{self.name!r} is {self.dist or f'fixed at {self.fixed}'}")
        # scipy fails on integers that no machine word holds
        return _distributions()[self.dist](**{key: float(value) for key, value in self.parameters.items()})


@final
@dataclass(frozen=True)
class CompareSettings(Ruled):
    """Table ``[compare]``."""

    pick: Annotated[tuple[str, ...] | None, _CANDIDATES] = None
    """Candidates by name; None: chosen from the study, and all of ``[[candidates]]``."""


@final
@dataclass(frozen=True)
class CandidateSettings(Ruled):
    """One table of ``[[candidates]]``; what is not given is as in the study."""

    name: Annotated[str, FOLDER]
    """Also the name of the candidate's folder."""
    terms: Annotated[int | Literal["auto"] | Mapping[str, int] | None, _TERMS] = None
    """Viscous terms [-]; "auto": of each element as many as the records choose; None: as many as `orders`,
    else those of the study."""
    orders: Annotated[Literal["free"] | tuple[float, ...] | None, _ORDERS] = None
    """Orders [-]; None: free where `terms` is given, else those of the study."""
    share: Share | None = None
    """Which paths share an element."""
    delay: DelayKind | None = None
    """Which paths share a delay."""
    offset: OffsetKind | None = None
    """Which records share an offset."""
    noise: NoiseKind | None = None
    """Noise model."""
    cross: Annotated[bool, FLAG] = True
    """Whether a drive moves other axes than its own."""
    effects: Annotated[tuple[str, ...] | None, _EFFECTS] = None
    """Effects of the plant by name; None: those of the study."""
    priors: Mapping[str, PriorSettings] = field(default_factory=dict)
    """In place of the study's, by parameter name; some may be improper."""

    def contradictions(self) -> list[str]:
        """What `ModelSettings` refuses."""
        self.model(ModelSettings())
        return []

    def model(self, own: ModelSettings) -> ModelSettings:
        """Settings of the model, what is left out from `own`; InputError when they contradict each other."""
        stated, orders = self.terms, self.orders
        if stated is None and isinstance(orders, tuple):
            stated = max(1, len(orders))
        if orders is None:
            orders = own.orders if stated is None else "free"
        share = self.share or own.share
        terms = own.terms if stated is None else stated
        if stated is None and isinstance(terms, Mapping) and share != own.share:  # other elements than the
            terms = own.most_terms  # study names
        return replace(
            own,
            terms=terms,
            orders=orders,
            share=share,
            delay=self.delay or own.delay,
            offset=self.offset or own.offset,
        )
