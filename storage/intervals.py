"""Sets of sequence numbers as closed intervals: stored, missing or lost ones.

`Losses` are intervals by reason: why frames of a stream are not stored.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Iterator, Mapping
from itertools import chain
from operator import itemgetter
from typing import Any

import numpy as np
import numpy.typing as npt

from devices.arrays import Bools

NO_END = 2**62
"""Stand-in for the last number of an interval without an end."""

OpenPairs = tuple[tuple[int, int | None], ...]
"""Intervals in JSON and messages; last None: an interval without an end."""


class Intervals:
    """Set of integers, kept as sorted intervals `(first, last)` that neither touch nor overlap.

    A stream without losses is one interval, however long it runs.
    """

    def __init__(self, intervals: Iterable[tuple[int, int]] = ()) -> None:
        self._intervals: list[tuple[int, int]] = []
        if isinstance(intervals, Intervals):  # one copy: another thread may be adding to it
            self._intervals = list(intervals)
            return
        for first, last in intervals:
            self.add(first, last)

    def __iter__(self) -> Iterator[tuple[int, int]]:
        return iter(self._intervals)

    def __bool__(self) -> bool:
        return bool(self._intervals)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Intervals) and self._intervals == other._intervals

    def __repr__(self) -> str:
        return f"Intervals({self._intervals})"

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def number_count(self) -> int:
        """Number of integers in the set."""
        return sum(last - first + 1 for first, last in self._intervals)

    @property
    def first(self) -> int | None:
        """Least number; None for an empty set."""
        return self._intervals[0][0] if self._intervals else None

    @property
    def last(self) -> int | None:
        """Greatest number; None for an empty set."""
        return self._intervals[-1][1] if self._intervals else None

    def add(self, first: int, last: int) -> None:
        """Add `first` to `last`, both included.

        Raises:
            ValueError: `last` lies before `first`.
        """
        if last < first:
            raise ValueError(f"interval {first} to {last} is empty")
        if not self._intervals or first > self._intervals[-1][1] + 1:  # the usual case: at the end
            self._intervals.append((first, last))
            return
        begins, ends = self._intervals[-1]
        if first >= begins:
            self._intervals[-1] = (begins, max(last, ends))
            return
        begin = bisect_left(self._intervals, first - 1, key=itemgetter(1))
        end = begin
        while end < len(self._intervals) and self._intervals[end][0] <= last + 1:
            first = min(first, self._intervals[end][0])
            last = max(last, self._intervals[end][1])
            end += 1
        self._intervals[begin:end] = [(first, last)]

    def add_ranges(self, first: npt.NDArray[Any], count: npt.NDArray[Any]) -> None:
        """Add non-empty ranges of numbers, in any order.

        Args:
            first: first number of each range, [n].
            count: length of each range, [n].
        """
        first = first.astype(np.int64)
        last = first + count.astype(np.int64) - 1
        begins = np.concatenate([[True], first[1:] != last[:-1] + 1])[: len(first)]
        ends = np.concatenate([begins[1:], [True]])[: len(first)]
        for a, b in zip(first[begins].tolist(), last[ends].tolist(), strict=True):
            self.add(a, b)

    def restricted_to(self, first: int, last: int) -> Intervals:
        """Return the numbers of this set from `first` to `last`."""
        found = Intervals()
        begin = bisect_left(self._intervals, first, key=itemgetter(1))
        end = bisect_right(self._intervals, last, key=itemgetter(0))
        if first <= last:
            inside = self._intervals[begin:end]
            found._intervals = [
                (max(a, first), min(b, last)) for a, b in inside if a <= last and b >= first
            ]
        return found

    def nearest_outside(self, first: int, last: int) -> tuple[int | None, int | None]:
        """Return the nearest numbers of this set below `first` and above `last`, or None."""
        at = bisect_left(self._intervals, first, key=itemgetter(0))
        before = min(self._intervals[at - 1][1], first - 1) if at else None
        at = bisect_right(self._intervals, last, key=itemgetter(1))
        after = max(self._intervals[at][0], last + 1) if at < len(self._intervals) else None
        return before, after

    def missing_in(self, first: int, last: int) -> Intervals:
        """Return the numbers from `first` to `last` that are not in this set."""
        gaps = Intervals()
        at = first
        for a, b in self.restricted_to(first, last):
            if at < a:
                gaps._intervals.append((at, a - 1))
            at = b + 1
        if at <= last:
            gaps._intervals.append((at, last))
        return gaps

    def contains_ranges(self, first: npt.NDArray[Any], count: npt.NDArray[Any]) -> Bools:
        """Return a mask of the ranges that are in this set completely.

        Args:
            first: first number of each range, [n].
            count: length of each range, [n].
        """
        begins, ends = np.array([(0, 0), *self._intervals], np.int64).T  # one before the first
        first = first.astype(np.int64)
        at = np.searchsorted(begins[1:], first, side="right")
        found: Bools = (at > 0) & (ends[at] >= first + count.astype(np.int64) - 1)
        return found

    def __or__(self, other: Intervals) -> Intervals:
        """Return the union."""
        return union((self, other))

    def __and__(self, other: Intervals) -> Intervals:
        """Return the intersection."""
        both = Intervals()
        ours, theirs = list(self._intervals), list(other._intervals)
        i = j = 0
        while i < len(ours) and j < len(theirs):
            (a, b), (c, d) = ours[i], theirs[j]
            if max(a, c) <= min(b, d):
                both._intervals.append((max(a, c), min(b, d)))
            if b < d:
                i += 1
            else:
                j += 1
        return both

    def __sub__(self, other: Intervals) -> Intervals:
        """Return the numbers of this set that are not in `other`."""
        left = Intervals()
        theirs = list(other._intervals)
        j = 0
        for first, last in list(self._intervals):
            at = first
            while j < len(theirs) and theirs[j][1] < first:
                j += 1
            k = j
            while k < len(theirs) and theirs[k][0] <= last:
                if at < theirs[k][0]:
                    left._intervals.append((at, theirs[k][0] - 1))
                at = max(at, theirs[k][1] + 1)
                k += 1
            j = max(j, k - 1)  # the last of these may reach into the next of ours
            if at <= last:
                left._intervals.append((at, last))
        return left


def union(sets: Iterable[Intervals]) -> Intervals:
    """Return the union of several sets."""
    return Intervals(sorted(chain.from_iterable(sets)))  # sorted, each is added at the end


def intervals_from_inclusive_pairs(pairs: Iterable[tuple[int, int | None]]) -> Intervals:
    """Return pairs as a set, with `NO_END` for a missing last number."""
    return Intervals((first, NO_END if last is None else last) for first, last in pairs)


def to_open_pairs(pairs: Iterable[tuple[int, int]]) -> OpenPairs:
    """Return intervals as pairs, with None for a last number of `NO_END` or more."""
    return tuple((first, None if last >= NO_END else last) for first, last in pairs)


DISK_FULL = "disk_full"
READ_ONLY = "read_only"
DISK_SLOW = "disk_slow"
NODE_BUSY = "node_busy"
EVICTED = "evicted"
CORRUPT = "corrupt"
NODE_RESTARTED = "node_restarted"
ABANDONED = "abandoned"
REFUSED = "refused"

LossPairs = dict[str, tuple[tuple[int, int], ...]]
"""Losses in JSON and messages: `{"evicted": [[0, 99], [200, 299]]}`."""


class Losses:
    """Lost numbers by reason; a number keeps its first reason."""

    def __init__(self, pairs: Mapping[str, Iterable[tuple[int, int]]] | None = None) -> None:
        self.by_reason: dict[str, Intervals] = {}
        for reason, intervals in (pairs or {}).items():
            self.add_if_new(Intervals(intervals), reason)

    def __bool__(self) -> bool:
        return any(self.by_reason.values())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Losses) and self.to_pairs() == other.to_pairs()

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def numbers(self) -> Intervals:
        """Union of all lost numbers."""
        return union(self.by_reason.values())

    def add_if_new(self, numbers: Intervals, reason: str) -> None:
        """Add lost numbers; numbers that already have a reason keep it."""
        if new := numbers - self.numbers:
            self.by_reason[reason] = new | self.by_reason.get(reason, Intervals())

    def remove(self, numbers: Intervals) -> None:
        """Remove numbers: they are stored after all."""
        self.by_reason = {
            reason: left for reason, lost in self.by_reason.items() if (left := lost - numbers)
        }

    def restricted_to(self, numbers: Intervals) -> dict[str, Intervals]:
        """Return the lost ones among `numbers`, by reason."""
        found = {reason: numbers & lost for reason, lost in self.by_reason.items()}
        return {reason: lost for reason, lost in found.items() if lost}

    def to_pairs(self) -> LossPairs:
        """Return the losses as pairs by reason, for JSON and messages."""
        return {reason: tuple(numbers) for reason, numbers in self.by_reason.items() if numbers}
