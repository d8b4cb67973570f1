"""Lag by the clock tables of two sessions that share one server's clock."""

from __future__ import annotations

from dataclasses import dataclass

from service.offline.compare.alignment import Alignment


@dataclass(frozen=True)
class ClockLag:
    """Lag by the clock tables alone.

    Attributes:
        lag_s: as in `Alignment`, at the same time.
        error_bound_s: bound of its error; not a standard uncertainty.
    """

    lag_s: float
    error_bound_s: float

    def as_dict(self) -> dict[str, object]:
        """Return the JSON representation."""
        return {
            "value": self.lag_s,
            "within": (self.lag_s - self.error_bound_s, self.lag_s + self.error_bound_s),
        }


def describe_clock_contradiction(alignment: Alignment, clock_lag: ClockLag | None) -> list[str]:
    """Return a note if the lag by forces contradicts the lag by clocks; else an empty list."""
    if clock_lag is None:
        return []
    low_s, high_s = alignment.lag_s.interval_95
    least_s, most_s = (
        clock_lag.lag_s - clock_lag.error_bound_s,
        clock_lag.lag_s + clock_lag.error_bound_s,
    )
    if low_s <= most_s and least_s <= high_s:
        return []
    return [
        f"the clocks say a lag of {1e3 * clock_lag.lag_s:.3f} ms, within "
        f"{1e3 * clock_lag.error_bound_s:.3f} ms, and the forces another one: two feet, or two "
        "servers' sessions"
    ]
