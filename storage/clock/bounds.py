"""One stream's clock against the server's: measured bounds of the offset, and bounds in between.

Each row bounds the offset to +-`uncertainty_ns` at its instant: half the shortest round trip is a
bound however asymmetric the two ways were. So rows are intersected, never averaged; a mean over
asymmetric ways would have a small sigma around a wrong value. Two instants are connected by how
fast one clock can gain on the other:

- never more than `CRYSTAL_RATE_LIMIT`, two uncompensated crystals of 50 ppm each, and
- within `RATE_TOLERANCE` of its mean over the stretch, the frequency tolerance of RFC 5905 (PHI).

From every row the offset can thus only lie in a cone that opens with time; the intersection of all
cones of a stretch is the bound. No assumption is made about the network's delays. Rows that no such
clock connects are a step, and begin another stretch. A step, or a clock being slewed, that hides
within the rows' own uncertainties cannot be seen, and makes the bound wrong by as much between two
rows.

Rates are ns of offset per ns of the node's time: 1 ppm is 1e-6.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools, Floats, Times

CRYSTAL_RATE_LIMIT = 100e-6
"""Rate limit of two uncompensated crystals, each 50 ppm off at most over temperature and age."""
RATE_TOLERANCE = 15e-6
"""Frequency tolerance around the measured rate (RFC 5905, PHI)."""
DISCIPLINE_RATE_LIMIT = 500e-6
"""Linux's limit of clock discipline (`tolerance` of adjtimex); accepted only for a steady rate."""

_CLOCK_RESOLUTION_NS = 1.0
"""Resolution of both clocks' readings."""
_ROUNDING_NS = 4
"""Rounding of bounds and their middle to whole ns."""
_FIRST_WINDOW_ROWS = 64
"""First search window in rows, doubled each time: frequent steps cost no quadratic time."""
_MIN_STEADY_ROWS = 4
"""Fewest rows of a steady rate: a step between two or three rows looks like one."""


@dataclass(frozen=True)
class OffsetRows:
    """Measurements, int64[n] each; `ClockTable` sorts them. Ranges are checked at reading.

    Attributes:
        t_mono_ns: instant by the node's clock that never steps.
        offset_ns: the server's UTC minus the `t_ns` of a frame of that instant.
        uncertainty_ns: bound of the offset's error, plus or minus.
    """

    t_mono_ns: Times
    offset_ns: Times
    uncertainty_ns: Times

    def __len__(self) -> int:
        return len(self.t_mono_ns)

    def slice_rows(self, begin: int, end: int) -> OffsetRows:
        """Return rows `begin` to `end`, the latter not included."""
        s = slice(begin, end)
        return OffsetRows(self.t_mono_ns[s], self.offset_ns[s], self.uncertainty_ns[s])


class _Cones:
    """Intersection of the cones of all rows, for rates from `slowest` to `fastest`.

    Entry k of an "ahead" array covers the first k rows, whose cones open towards later; entry k of
    a "behind" one the others, whose cones open towards earlier.
    """

    def __init__(
        self, x: Floats, low: Floats, high: Floats, slowest: float, fastest: float
    ) -> None:
        self.slowest = slowest
        self.fastest = fastest
        none = np.array([np.inf])
        least, most = np.minimum.accumulate, np.maximum.accumulate
        self._ahead_high = np.concatenate((none, least(high - fastest * x)))
        self._ahead_low = np.concatenate((-none, most(low - slowest * x)))
        self._behind_high = np.concatenate((least((high - slowest * x)[::-1])[::-1], none))
        self._behind_low = np.concatenate((most((low - fastest * x)[::-1])[::-1], -none))

    def bounds_at(self, x: Floats, rows_before: npt.NDArray[np.intp]) -> tuple[Floats, Floats]:
        """Return least and greatest offset at `x`, given the number of rows up to it."""
        high = np.minimum(
            self.fastest * x + self._ahead_high[rows_before],
            self.slowest * x + self._behind_high[rows_before],
        )
        low = np.maximum(
            self.slowest * x + self._ahead_low[rows_before],
            self.fastest * x + self._behind_low[rows_before],
        )
        return low, high


class OffsetStretch:
    """Measurements that one clock without a step can explain.

    Args:
        rows: at least one, in order of time.
        rate_limit: bound of its rate.
    """

    def __init__(self, rows: OffsetRows, rate_limit: float = CRYSTAL_RATE_LIMIT) -> None:
        self.rows = rows
        self.is_steady = True
        """True: a rate within `RATE_TOLERANCE` of its mean explains all rows."""
        self.mean_rate_bounds: tuple[float, float] = (-rate_limit, rate_limit)
        """Bounds of the mean rate from the first row to the last."""
        self._limit = rate_limit
        self._begin_ns = rows.t_mono_ns[0]
        self._reference_ns = rows.offset_ns[0]
        x = self._ns_since_begin(rows.t_mono_ns)
        low, high = _offset_intervals(rows)
        wander = RATE_TOLERANCE
        while not self._fit(x, low, high, rate_limit, wander) and wander < 2 * rate_limit:
            # The rate wanders more than assumed: double the limit until it fits the rows.
            self.is_steady = False
            wander *= 2

    @property
    def begin_t_mono_ns(self) -> int:
        """Instant of its first row, `t_mono_ns`."""
        return int(self._begin_ns)

    @property
    def end_t_mono_ns(self) -> int:
        """Instant of its last row, `t_mono_ns`."""
        return int(self.rows.t_mono_ns[-1])

    @property
    def narrowed_mean_rate_bounds(self) -> tuple[float, float] | None:
        """Bounds of the mean rate, ns per ns; None if the rows do not narrow the limit."""
        return (
            None if self.mean_rate_bounds == (-self._limit, self._limit) else self.mean_rate_bounds
        )

    def offset_bounds_at(self, t_mono_ns: Times) -> tuple[Times, Times]:
        """Compute least and greatest offset in ns at any instants, also outside the rows."""
        low, high = self._cones.bounds_at(
            self._ns_since_begin(t_mono_ns),
            np.searchsorted(self.rows.t_mono_ns, t_mono_ns, side="right"),
        )
        return (
            self._reference_ns + np.floor(low).astype(np.int64),
            self._reference_ns + np.ceil(high).astype(np.int64),
        )

    def _ns_since_begin(self, t_mono_ns: Times) -> Floats:
        # Exact up to 104 days; beyond, a rate's 1e-4 of the rounding is still below 1 ns.
        x: Floats = (t_mono_ns - self._begin_ns).astype(np.float64)
        return x

    def _fit(self, x: Floats, low: Floats, high: Floats, limit: float, wander: float) -> bool:
        """Fit bounds of rate and offset; False if no rate within `wander` of its mean fits."""
        before = np.searchsorted(x, x, side="right")
        self.mean_rate_bounds = (-limit, limit)
        self._cones = _Cones(x, low, high, -limit, limit)
        if not x[-1]:
            return True
        for _ in range(3):  # a narrower rate narrows the ends, and these the rate
            lowest, highest = self._cones.bounds_at(x, before)
            if np.any(lowest > highest):
                return False
            self.mean_rate_bounds = (
                max(-limit, float((lowest[-1] - highest[0]) / x[-1])),
                min(limit, float((highest[-1] - lowest[0]) / x[-1])),
            )
            slowest = max(-limit, self.mean_rate_bounds[0] - wander)
            fastest = min(limit, self.mean_rate_bounds[1] + wander)
            self._cones = _Cones(x, low, high, slowest, fastest)
        lowest, highest = self._cones.bounds_at(x, before)
        return not np.any(lowest > highest)


class BoundedOffset(NamedTuple):
    """Offset of a clock, within plus or minus a bound; (n,) each."""

    offset_ns: Times
    bound_ns: Times


class OffsetRange(NamedTuple):
    """Bounds of the offset over n time ranges, (n,) each."""

    least_ns: Times
    greatest_ns: Times
    is_certain: Bools
    """(n,); False where a step may lie in the range, which has no bound."""


class ClockOffsets:
    """Offset of one stream's clock to the server's, with its bound, at every instant.

    Args:
        rows: at least one, in any order.
    """

    def __init__(self, rows: OffsetRows) -> None:
        order = np.argsort(rows.t_mono_ns, kind="stable")
        self.rows = OffsetRows(
            rows.t_mono_ns[order], rows.offset_ns[order], rows.uncertainty_ns[order]
        )
        self.stretches = _split_into_stretches(self.rows)
        self._begins_ns = np.array([s.begin_t_mono_ns for s in self.stretches], dtype=np.int64)
        self._ends_ns = np.array([s.end_t_mono_ns for s in self.stretches], dtype=np.int64)

    def offset_and_bound_at(self, t_mono_ns: Times) -> BoundedOffset:
        """Compute the offset and its bound at each instant; every instant independently.

        Between two stretches the instant of the step is unknown, and the bound covers both
        stretches. The truth is within plus or minus the bound, which is no standard deviation.

        Args:
            t_mono_ns: int64[n], in any order, absolute value below `T_MONO_NS_END`.
        """
        begun = np.searchsorted(self._begins_ns, t_mono_ns, side="right")
        ended = np.searchsorted(self._ends_ns, t_mono_ns, side="left")
        number = np.maximum(begun - 1, 0)
        between = (begun == ended) & (begun > 0) & (begun < len(self.stretches))
        low = np.empty(len(t_mono_ns), dtype=np.int64)
        high = np.empty(len(t_mono_ns), dtype=np.int64)
        for i in np.unique(number):
            here = number == i
            low[here], high[here] = self.stretches[i].offset_bounds_at(t_mono_ns[here])
            torn = here & between
            if torn.any():
                later_low, later_high = self.stretches[i + 1].offset_bounds_at(t_mono_ns[torn])
                low[torn] = np.minimum(low[torn], later_low)
                high[torn] = np.maximum(high[torn], later_high)
        offset = (low >> 1) + (high >> 1) + (low & high & 1)  # the sum might not fit
        return BoundedOffset(offset, np.maximum(high - offset, offset - low))

    def bound_offset_in_ranges(self, begins_t_mono_ns: Times, ends_t_mono_ns: Times) -> OffsetRange:
        """Compute bounds of the offset over n time ranges.

        Args:
            begins_t_mono_ns: int64[n], `t_mono_ns`, absolute values below `T_MONO_NS_END`.
            ends_t_mono_ns: int64[n], the same, not before them.
        """
        sure = np.ones(len(begins_t_mono_ns), dtype=np.bool_)
        if len(self.stretches) > 1:
            for begun_ns, ended_ns in zip(self._begins_ns, self._ends_ns, strict=True):
                sure &= (ends_t_mono_ns < begun_ns) | (begins_t_mono_ns >= begun_ns)
                sure &= (ends_t_mono_ns <= ended_ns) | (begins_t_mono_ns > ended_ns)
        one = self.offset_and_bound_at(begins_t_mono_ns).offset_ns
        other = self.offset_and_bound_at(ends_t_mono_ns).offset_ns
        # Within a stretch the offset has no jumps, and no clock gains faster than this limit.
        slack_ns = (
            np.ceil(DISCIPLINE_RATE_LIMIT * (ends_t_mono_ns - begins_t_mono_ns)).astype(np.int64)
            + _ROUNDING_NS
        )
        return OffsetRange(
            np.minimum(one, other) - slack_ns, np.maximum(one, other) + slack_ns, sure
        )


def _offset_intervals(rows: OffsetRows) -> tuple[Floats, Floats]:
    """Return lowest and highest offset at each row, relative to the first row's."""
    offset = _subtract_first(rows.offset_ns, rows.offset_ns[0])
    # The server read its clock at some instant of the round trip; the row is about the middle.
    half = (
        rows.uncertainty_ns.astype(np.float64) * (1 + DISCIPLINE_RATE_LIMIT) + _CLOCK_RESOLUTION_NS
    )
    return offset - half, offset + half


def _subtract_first(values: Times, first: np.int64) -> Floats:
    """Return differences to `first`: exact, or, where they wrap in 64 bits, to a microsecond."""
    steps = values - first
    does_wrap = ((values ^ first) & (values ^ steps)) < 0
    return np.where(does_wrap, values.astype(np.float64) - float(first), steps.astype(np.float64))


def _count_explained_rows(rows: OffsetRows, limit: float) -> int:
    """Count the first rows that one clock with a rate within the limit can explain."""
    look = _FIRST_WINDOW_ROWS
    while True:
        part = rows.slice_rows(0, look)
        low, high = _offset_intervals(part)
        x = (part.t_mono_ns - part.t_mono_ns[0]).astype(np.float64)
        highest = limit * x + np.minimum.accumulate(high - limit * x)
        lowest = np.maximum.accumulate(low + limit * x) - limit * x
        apart = np.flatnonzero(lowest > highest)
        if len(apart):
            return int(apart[0])
        if look >= len(rows):
            return len(rows)
        look *= 2


def _count_steady_rows(rows: OffsetRows, min_rows: int) -> int:
    """Count the first rows that a clock with a steady rate beyond a crystal's explains; or 0."""
    shortest, longest = min_rows, _count_explained_rows(rows, DISCIPLINE_RATE_LIMIT)
    if (
        longest <= min_rows
        or not OffsetStretch(rows.slice_rows(0, min_rows + 1), DISCIPLINE_RATE_LIMIT).is_steady
    ):
        return 0
    while longest - shortest > 1:
        middle = (shortest + longest) // 2
        if OffsetStretch(rows.slice_rows(0, middle), DISCIPLINE_RATE_LIMIT).is_steady:
            shortest = middle
        else:
            longest = middle
    return (
        longest
        if OffsetStretch(rows.slice_rows(0, longest), DISCIPLINE_RATE_LIMIT).is_steady
        else shortest
    )


def _split_into_stretches(rows: OffsetRows) -> tuple[OffsetStretch, ...]:
    pieces: list[tuple[int, int, float]] = []
    begin = 0
    while begin < len(rows):
        rest = rows.slice_rows(begin, len(rows))
        reach, limit = _count_explained_rows(rest, CRYSTAL_RATE_LIMIT), CRYSTAL_RATE_LIMIT
        if reach < len(rest):
            further = _count_steady_rows(rest, reach)
            if further >= max(reach + 1, _MIN_STEADY_ROWS):
                reach, limit = further, DISCIPLINE_RATE_LIMIT
        pieces.append((begin, begin + reach, limit))
        begin += reach
    stretches: list[OffsetStretch] = []
    for begin, end, limit in reversed(pieces):
        certain = _find_certain_end(rows, begin, end, stretches[-1]) if stretches else end
        stretches.append(OffsetStretch(rows.slice_rows(begin, certain), limit))
    return tuple(reversed(stretches))


def _find_certain_end(rows: OffsetRows, begin: int, end: int, later: OffsetStretch) -> int:
    """Return the end of the rows that cannot belong to the later stretch."""
    part = rows.slice_rows(begin, end)
    low, high = later.offset_bounds_at(part.t_mono_ns)
    half = part.uncertainty_ns + part.uncertainty_ns // 2000 + 2  # as _offset_intervals, rounded up
    foreign = (part.offset_ns - half > high) | (part.offset_ns + half < low)
    last = np.flatnonzero(foreign)
    return begin + (int(last[-1]) + 1 if len(last) else 1)
