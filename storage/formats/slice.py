"""Which rows and columns of a session are wanted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.errors import UsageError
from storage.schema import Array

SECONDS_MAX = 1e9
"""Thirty years."""


@dataclass(frozen=True)
class Slice:
    """Which rows and columns.

    Attributes:
        start_s: from so many seconds after the first frame on; None: from the beginning.
        end_s: before so many seconds; None: to the end.
        columns: names of columns, either of one tile (`force_n_0`) or of all (`force_n`); empty:
            all there are.

    Raises:
        UsageError: an instant is none, or the end is not after the start.
    """

    start_s: float | None = None
    end_s: float | None = None
    columns: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name, value in (("start", self.start_s), ("end", self.end_s)):
            if value is not None and not 0.0 <= value <= SECONDS_MAX:
                raise UsageError(
                    f"the slice's {name} is at {value:g} s",
                    expected=f"0 to {SECONDS_MAX:g} seconds after the first frame",
                )
        if self.end_s is not None and self.end_s <= (self.start_s or 0.0):
            raise UsageError(
                f"the slice ends at {self.end_s:g} s and starts at {self.start_s or 0.0:g} s",
                expected="an end after the start",
            )

    @property
    def is_all(self) -> bool:
        """Is it the whole session?"""
        return self == Slice()

    @property
    def is_some(self) -> bool:
        """Is it some time, and not all?"""
        return self.start_s is not None or self.end_s is not None

    def bounds_ns(self, begin_t_ns: int) -> tuple[int | None, int | None]:
        """The first instant that is in it, and the first that is not any more; None: no bound.

        Args:
            begin_t_ns: instant of the session's first frame.
        """
        start, end = (
            None if seconds is None else begin_t_ns + round(seconds * 1e9)
            for seconds in (self.start_s, self.end_s)
        )
        return start, end

    def rows(self, t_ns: Array, begin_t_ns: int) -> Array:
        """Which frames are in it, bool[n].

        Args:
            t_ns: int64[n], instants of frames on the session's time axis.
            begin_t_ns: instant of the session's first frame.
        """
        start_ns, end_ns = self.bounds_ns(begin_t_ns)
        rows = np.ones(len(t_ns), dtype=np.bool_)
        if start_ns is not None:
            rows &= t_ns >= start_ns
        if end_ns is not None:
            rows &= t_ns < end_ns
        return rows

    def begins_after(self, end_s: float) -> bool:
        """Does it begin after a session that ends so many seconds after its first frame?"""
        return self.start_s is not None and self.start_s > end_s
