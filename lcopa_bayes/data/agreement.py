"""Whether the records of a campaign agree with each other, before any plant is assumed.

What one record determines of a sum of lagged drives (`description`) predicts another one. By how much that
prediction must be scaled, under noise correlated from sample to sample, shows records of one plant (1), of
one plant in another unit (a thousand), with a connection reversed (negative), with axes exchanged (the
prediction for another axis fits), or of two plants (none of these). A record whose response runs ahead of its
drive is described better by the drive of later times.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import TypeAlias, final

import numpy as np

from lcopa_bayes.core.arrays import Matrix, Vector
from lcopa_bayes.core.crew import ALONE, Crew
from lcopa_bayes.core.units import measured
from lcopa_bayes.data.description import FOLLOWED, Described, Followed, LaggedSum
from lcopa_bayes.data.drive import moved_with_drive
from lcopa_bayes.data.record import Record

_LAGS = 6
"""Time constants of a description that finds delays [-]: with ten, the drive of later times describes noise
of long memory."""
_FINE = 10
"""Time constants of a description that predicts other records [-]: with six, what it misses makes standard
errors three times as wide; with sixteen, a record of two responses may take half a minute."""
_PAIRED = 12
"""Records up to which each is compared with each, and not with all others together only [-]."""
_CLOSELY = 0.98
"""Share of a response's variance that is followed where a difference in size is judged [-]."""
_AHEAD = 2.0
"""Residual variance with delays over that with advances from which a response runs ahead [-]."""
_ROW = 1.5
"""Lead of a response that moves in the row of its drive's first change up to which it leads by that row alone
[sampling periods]."""
_OTHER_UNIT = 30.0
"""Ratio of two records from which they are in different units [-]."""
_REVERSED = 3.0
"""Size up to which a negative ratio, or its reciprocal, is a reversed sign [-]: a twelfth of what is
predicted with the other sign is a prediction from drives that do not show the plant."""
_CONTRADICTION, _SLIGHT = 20.0, 0.05
"""Difference of two records that is a contradiction [standard errors], and least such difference [-]."""
_EXCHANGED = 5.0
"""What a prediction misses of a record as it is, over what it misses with exchanged axes, from which they
are exchanged [-]."""
_BEYOND = 5.0
"""What a prediction misses over the variance that is left open of it, from which it misses more than that
[-]: the square of one normal error is above it in 3 % of cases."""
_SURE = 5.0
"""Standard errors from zero from which a ratio has a sign and a size [-]."""
_DISAGREE = "records disagree: "
_UNIT = "one of them is in another unit than it states; correct the unit, or convert the values"
_SIGN = "check the signs of drive and response in both"
_PLANT = (
    "no linear plant follows both; leave one out, or let `loop` trace what changed between them or depends "
    "on the size of the drive"
)

_Order: TypeAlias = tuple[tuple[int, ...], tuple[int, ...]]
"""Positions of drives and of responses."""


@final
@dataclass(frozen=True)
class Disagreement:
    """A record that runs ahead of its drive, or does not follow the plant of another record."""

    records: tuple[str, ...]
    reason: str
    """What was seen, a clause without a full stop."""
    remedy: str
    """What to do, a clause without a full stop."""
    gross: bool
    """Whether no plant follows these records as they are."""
    ratio: float = np.nan
    """Of the first to what the others predict for it; NaN where they differ in another way [-]."""
    misfit: float = 0.0
    """Share of its variance that remains with that ratio, or the axes exchanged [-]."""

    def __str__(self) -> str:
        return f"{self.reason}: {self.remedy}"

    @property
    def sentence(self) -> str:
        """Both, with a capital and a full stop."""
        return f"{self.reason[0].upper()}{self.reason[1:]}: {self.remedy}."


def disagreements(records: Sequence[Record], crew: Crew = ALONE) -> tuple[Disagreement, ...]:
    """What the records, all of equal axes, contradict: each record by itself, then in pairs.

    A record that several others contradict is named once. Ratios are accurate to a tenth where a description
    follows at least 70 % of the variance; records that it follows less are not judged.
    """
    if not records:
        return ()
    period = min(float(np.median(np.diff(record.time))) for record in records)
    span = max(float(np.ptp(record.time)) for record in records)
    lags = np.geomspace(period, span, _LAGS)
    described = [one for one in crew.sharing(lags).each(_described, records) if one is not None]
    leads = [
        max((-seen.delay for seen in _judged(one) if _runs_ahead(seen, period)), default=0.0)
        for one in described
    ]
    at_once = {one.name for one in records if any(_moves_at_once(one))}
    by_rows = [
        _ahead(one.record, lead)
        for one, lead in zip(described, leads, strict=True)
        if lead > (_ROW * period if one.record.name in at_once else 0.0)
    ]
    at_once -= {one.records[0] for one in by_rows}
    ahead = [*by_rows, *(_at_once(one) for one in records if one.name in at_once)]
    rest = [one for one, lead in zip(described, leads, strict=True) if lead <= 0.0]
    if len(rest) < 2:
        return tuple(ahead)
    delay = float(np.median([max(seen.delay, 0.0) for one in rest for seen in one.best]))
    fine = np.geomspace(period, span, _FINE)
    rest = [Described(one.record, fine) for one in rest]
    pairs: list[Disagreement] = []
    joint: list[Disagreement] = []
    for one in rest:
        others = tuple(other for other in rest if other is not one)
        single = others if len(rest) <= _PAIRED else ()
        together = _Comparison(one, others, delay)
        comparisons = [_Comparison(one, (other,), delay, together) for other in single]
        if any(comparison.judged for comparison in comparisons):
            pairs += [seen for each in comparisons if (seen := each.disagreement()) is not None]
        elif (seen := together.disagreement()) is not None:
            joint.append(seen)
    # what one record contradicts in all others together, these contradict in it
    return (*ahead, *_once(sorted(pairs, key=_severity)), *sorted(joint, key=_severity)[:1])


def _described(lags: Vector, record: Record) -> Described | None:
    """A record's description; None where nothing moves or is described."""
    one = Described(record, lags)
    return one if one.moving and one.best else None


def _severity(one: Disagreement) -> tuple[bool, bool, float]:
    """Sorts the gross ones first, those of all axes before those of one, then by what explains most."""
    return not one.gross, np.isfinite(one.ratio), one.misfit


def _judged(one: Described) -> list[Followed]:
    """What is best of the axes that say when a record's clock ran: those that are followed closely, where
    there are any; noise of long memory is ahead of anything on an axis that hardly moves."""
    return [seen for seen in one.best if seen.misfit <= 1 - _CLOSELY] or list(one.best)


def _runs_ahead(seen: Followed, period: float) -> bool:
    """Whether a response is described so well by the drive of later times alone, and moves before it."""
    alone = seen.other > max(1 - _CLOSELY, _AHEAD * seen.misfit)
    return -seen.delay > period and alone and not seen.rests


def _ahead(record: Record, lead: float) -> Disagreement:
    return Disagreement(
        (record.name,),
        f"the response of record {record.name!r} runs about {lead:.3g} {record.time_unit} ahead of its drive",
        "no plant responds to a drive of later times; align the clocks of its drive and response columns",
        gross=True,
    )


def _moves_at_once(record: Record) -> list[float]:
    return [moved_with_drive(record, axis) for axis in range(len(record.response_axes))]


def _at_once(record: Record) -> Disagreement:
    moved = _moves_at_once(record)
    axis = record.response_axes[int(np.argmax(np.abs(moved)))]
    return Disagreement(
        (record.name,),
        f"response {axis.name!r} of record {record.name!r} moves by "
        f"{measured(max(moved, key=abs), axis.unit)} in the very row in which a drive first changes, "
        "while a drive holds from its row on",
        "if the drive of a row acted until its response was read, convert the table with `new --drive-until`",
        gross=False,
    )


def _once(pairs: Sequence[Disagreement]) -> Iterator[Disagreement]:
    """One pair, of those in their order of severity, for each record that disagrees with others: records in
    most pairs first."""
    remaining = list(pairs)
    while remaining:
        counts = Counter(name for one in remaining for name in one.records)
        odd = counts.most_common(1)[0][0]
        about = [one for one in remaining if odd in one.records]
        alike = (one for one in about if one.records[0] == odd and one.gross == about[0].gross)
        yield next(alike, about[0])
        remaining = [one for one in remaining if odd not in one.records]


@final
@dataclass(frozen=True)
class _Ratio:
    """One axis of a record over what another record predicts for it."""

    axis: int
    value: float
    """[-]."""
    sd: float
    """[-]."""
    misfit: float
    """Residual variance of the scaled prediction over that of the response [-]."""
    size: float
    """Variance of the response over the square of the other record's range [-]."""
    missed: float
    """The same of response less unscaled prediction [-]."""
    unknown: float
    """The same of what the other record leaves open of that prediction [-]."""

    @property
    def remedy(self) -> str:
        """What to do about a record of that size; empty where it is one of the same plant, or not known."""
        if self.misfit > 1 - FOLLOWED or abs(self.value) < _SURE * self.sd:
            return ""
        if not 1 / _OTHER_UNIT < abs(self.value) < _OTHER_UNIT:
            return _UNIT
        if 1 / _REVERSED < -self.value < _REVERSED:
            return _SIGN
        apart = abs(self.value - 1) > max(_CONTRADICTION * self.sd, _SLIGHT)
        return _PLANT if apart and self.misfit <= 1 - _CLOSELY else ""


@final
@dataclass(frozen=True, eq=False)
class _Comparison:
    """A record beside what others, together, predict for it."""

    one: Described
    others: tuple[Described, ...]
    delay: float
    """Of the whole campaign [time unit]."""
    together: _Comparison | None = None
    """The record beside all others, where `others` is one of them."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the record, and of the other where it is one."""
        own = (self.one.record.name,)
        return (*own, self.others[0].record.name) if len(self.others) == 1 else own

    @property
    def _them(self) -> str:
        return f"record {self.names[1]!r}" if len(self.names) > 1 else "the other records"

    @cached_property
    def _known(self) -> tuple[LaggedSum | None, ...]:
        """Description of every response axis of the others; None where it follows too little of it."""
        columns = [one.columns(self.delay) for one in self.others]
        flat = [each.reshape(len(each), -1) for each in columns]
        known: list[LaggedSum | None] = []
        for axis in range(len(self.one.record.response_axes)):
            parts = [
                _centred(x, one.response[:, axis])
                for x, one in zip(flat, self.others, strict=True)
                if one.sampled(axis)
            ]
            if not parts:
                known.append(None)
                continue
            joined = LaggedSum.of(
                np.concatenate([x for x, _ in parts]), np.concatenate([y for _, y in parts])
            )
            known.append(joined if joined.misfit <= 1 - FOLLOWED else None)
        return tuple(known)

    @cached_property
    def ratios(self) -> list[_Ratio]:
        """Of all response axes that are followed, as they are."""
        drives, responses = range(len(self.one.drives)), range(len(self.one.record.response_axes))
        return self._ratios((tuple(drives), tuple(responses)))

    @property
    def judged(self) -> bool:
        """Whether a ratio is known well enough to show a contradiction."""
        return any(one.sd <= _SLIGHT * abs(one.value) for one in self.ratios)

    def _ratios(self, order: _Order) -> list[_Ratio]:
        """With its drives and responses taken in an order; empty where a drive moves in this record alone."""
        drives, responses = order
        if not {drives.index(j) for j in self.one.moving} <= {j for one in self.others for j in one.moving}:
            return []
        columns = self.one.columns(self.delay)[:, drives]
        target, out = columns.reshape(len(columns), -1), []
        for axis, k in enumerate(responses):
            known = self._known[axis]
            if known is None or not self.one.sampled(k):
                continue
            predicted, seen = target @ known.coefficients, self.one.response[:, k]
            if not np.ptp(predicted) > 0.0:
                continue
            scaled = LaggedSum.of(predicted[:, None], seen)
            lever = (predicted - predicted.mean()) @ target / float(np.var(predicted) * predicted.size)
            ratio = float(scaled.coefficients[0])
            variance = float(scaled.covariance[0, 0] + ratio**2 * lever @ known.covariance @ lever)
            size, missed = (float(np.nanvar(each) / known.span**2) for each in (seen, seen - predicted))
            moves = np.cov(target[np.isfinite(seen)].T, bias=True)
            unknown = float(np.sum(moves * known.covariance)) / known.span**2
            out.append(_Ratio(k, ratio, float(np.sqrt(variance)), scaled.misfit, size, missed, unknown))
        return out

    def _exchanges(self) -> Iterator[_Order]:
        """Orders in which two responses or two drives have changed places."""
        drives, responses = len(self.one.drives), len(self.one.record.response_axes)
        for i, j in combinations(range(responses), 2):
            yield tuple(range(drives)), _with_exchanged(responses, i, j)
        for i, j in combinations(range(drives), 2):
            yield _with_exchanged(drives, i, j), tuple(range(responses))

    @property
    def _as_is(self) -> float:
        """Least share that is missed of the record as it is, 0 where what the others leave open explains it
        [-]; NaN where a drive moves in it alone.

        A record that moves one drive says nothing of one that moves another, which may respond much alike,
        and one that moves both at once tells them apart badly: all others together know it better.
        """
        known = (one.ratios for one in (self, self.together) if one is not None and one.ratios)
        return min((_missed(one) if _surely_missed(one) else 0.0 for one in known), default=np.nan)

    def disagreement(self) -> Disagreement | None:
        """The most severe one; None where the record agrees or cannot be judged."""
        orders = {order: _missed(self._ratios(order)) for order in self._exchanges()}
        order = min(orders, key=lambda order: orders[order], default=None)
        as_is = self._as_is if order else np.nan
        if order and as_is > 1 - FOLLOWED > orders[order] and as_is > _EXCHANGED * orders[order]:
            which, name = _exchanged(self.one.record, order), self.one.record.name
            seen = f"record {name!r} follows {self._them} with its {which} exchanged, not as it is"
            remedy = "exchange the columns, or their names, in one of the two"
            return Disagreement(self.names, f"{_DISAGREE}{seen}", remedy, gross=True, misfit=orders[order])
        return next((self._in_size(ratio) for ratio in self.ratios if ratio.remedy), None)

    def _in_size(self, ratio: _Ratio) -> Disagreement:
        record = self.one.record
        seen = (
            f"response {record.response_axes[ratio.axis].name!r} of record {record.name!r} is "
            f"{ratio.value:.3g} times what is predicted for it from {self._them} (standard error "
            f"{ratio.sd:.1g})"
        )
        gross = ratio.remedy in (_UNIT, _SIGN)
        return Disagreement(self.names, f"{_DISAGREE}{seen}", ratio.remedy, gross, ratio.value, ratio.misfit)


def _centred(columns: Matrix, response: Vector) -> tuple[Matrix, Vector]:
    """Columns and response where this was sampled, each less its mean."""
    seen = np.isfinite(response)
    return columns[seen] - columns[seen].mean(axis=0), response[seen] - response[seen].mean()


def _missed(ratios: Sequence[_Ratio]) -> float:
    """Share of the variance of all responses that unscaled predictions miss [-]; 1 of no responses."""
    return sum(one.missed for one in ratios) / sum(one.size for one in ratios) if ratios else 1.0


def _surely_missed(ratios: Sequence[_Ratio]) -> bool:
    """Whether predictions miss more than what is left open of them explains."""
    return sum(one.missed for one in ratios) > _BEYOND * sum(one.unknown for one in ratios)


def _with_exchanged(count: int, i: int, j: int) -> tuple[int, ...]:
    return tuple({i: j, j: i}.get(k, k) for k in range(count))


def _exchanged(record: Record, order: _Order) -> str:
    """The two axes that have changed places, in words."""
    for role, axes, places in zip(
        ("drives", "responses"), (record.drive_axes, record.response_axes), order, strict=True
    ):
        moved = [axes[k].name for k, place in enumerate(places) if k != place]
        if moved:
            return f"{role} {moved[0]!r} and {moved[1]!r}"
    return "axes"
