"""Lag by the clock tables of two sessions that share one server's clock."""

from __future__ import annotations

from dataclasses import dataclass

from service.offline.compare.align import Alignment


@dataclass(frozen=True)
class ClockLag:
    """Lag by the clock tables alone.

    Attributes:
        lag_s: as in `Alignment`, at the same time.
        within_s: bound of its error; not a standard uncertainty.
    """

    lag_s: float
    within_s: float

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        return {
            "value": self.lag_s,
            "within": (self.lag_s - self.within_s, self.lag_s + self.within_s),
        }


def clock_notes(alignment: Alignment, by_clocks: ClockLag | None) -> list[str]:
    """Return a note if the lag by forces contradicts the lag by clocks; else an empty list."""
    if by_clocks is None:
        return []
    low_s, high_s = alignment.lag_s.interval_95
    least_s, most_s = by_clocks.lag_s - by_clocks.within_s, by_clocks.lag_s + by_clocks.within_s
    if low_s <= most_s and least_s <= high_s:
        return []
    return [
        f"the clocks say a lag of {1e3 * by_clocks.lag_s:.3f} ms, within "
        f"{1e3 * by_clocks.within_s:.3f} ms, and the forces another one: two feet, or two "
        "servers' sessions"
    ]
