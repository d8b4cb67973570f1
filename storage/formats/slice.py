"""Slice of a session: rows by time, and columns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from devices.errors import UsageError
from storage.schema import Array

SECONDS_MAX = 1e9
"""Longest time of a slice's bounds: thirty years."""


@dataclass(frozen=True)
class Slice:
    """Selection of rows and columns of a session.

    Attributes:
        start_s: first instant, in seconds after the first frame; None: the beginning.
        end_s: end, exclusive, in seconds after the first frame; None: the end of the session.
        columns: names of columns, of one tile (`force_n_0`) or of all tiles (`force_n`); empty: all
            columns.

    Raises:
        UsageError: an instant is out of range, or the end is not after the start.
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
    def is_unrestricted(self) -> bool:
        """True for the whole session with all columns."""
        return self == Slice()

    @property
    def has_time_bounds(self) -> bool:
        """True if the slice bounds time."""
        return self.start_s is not None or self.end_s is not None

    def compute_bounds_ns(self, begin_t_ns: int) -> tuple[int | None, int | None]:
        """Return the slice's first instant, and its end, exclusive; None: no bound.

        Args:
            begin_t_ns: instant of the session's first frame.
        """
        start, end = (
            None if seconds is None else begin_t_ns + round(seconds * 1e9)
            for seconds in (self.start_s, self.end_s)
        )
        return start, end

    def compute_row_mask(self, t_ns: Array, begin_t_ns: int) -> Array:
        """Return the mask of the frames in the slice, bool[n].

        Args:
            t_ns: int64[n], instants of frames on the session's time axis.
            begin_t_ns: instant of the session's first frame.
        """
        start_ns, end_ns = self.compute_bounds_ns(begin_t_ns)
        rows = np.ones(len(t_ns), dtype=np.bool_)
        if start_ns is not None:
            rows &= t_ns >= start_ns
        if end_ns is not None:
            rows &= t_ns < end_ns
        return rows

    def starts_after(self, end_s: float) -> bool:
        """Return whether the slice begins after `end_s`, in seconds after the first frame."""
        return self.start_s is not None and self.start_s > end_s
