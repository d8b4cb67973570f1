"""Why frames of a stream are not held: numbers by reason, each number under one reason only."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from storage.intervals import Intervals, union

DISK_FULL = "disk_full"
READ_ONLY = "read_only"
DISK_SLOW = "disk_slow"
NODE_BUSY = "node_busy"
EVICTED = "evicted"
CORRUPT = "corrupt"
NODE_RESTARTED = "node_restarted"
GIVEN_UP = "given_up"

AsPairs = dict[str, tuple[tuple[int, int], ...]]
"""How losses travel and are kept: `{"evicted": [[0, 99], [200, 299]]}`."""


class Losses:
    """Numbers that are lost, by reason; a number keeps the reason that came first."""

    def __init__(self, pairs: Mapping[str, Iterable[tuple[int, int]]] | None = None) -> None:
        self.by_reason: dict[str, Intervals] = {}
        for reason, intervals in (pairs or {}).items():
            self.add(Intervals(intervals), reason)

    def __bool__(self) -> bool:
        return any(self.by_reason.values())

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Losses) and self.as_pairs() == other.as_pairs()

    __hash__ = None  # type: ignore[assignment]  # it changes

    @property
    def all(self) -> Intervals:
        """Every number that is lost."""
        return union(self.by_reason.values())

    def add(self, numbers: Intervals, reason: str) -> None:
        """Note a loss."""
        if new := numbers - self.all:
            self.by_reason[reason] = new | self.by_reason.get(reason, Intervals())

    def found(self, numbers: Intervals) -> None:
        """These numbers are held after all."""
        self.by_reason = {
            reason: left for reason, lost in self.by_reason.items() if (left := lost - numbers)
        }

    def within(self, numbers: Intervals) -> dict[str, Intervals]:
        """Of these numbers the lost ones, by reason."""
        found = {reason: numbers & lost for reason, lost in self.by_reason.items()}
        return {reason: lost for reason, lost in found.items() if lost}

    def as_pairs(self) -> AsPairs:
        """As it travels and is kept."""
        return {reason: tuple(numbers) for reason, numbers in self.by_reason.items() if numbers}
