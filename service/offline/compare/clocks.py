"""The lag that two clock tables say, where both sessions were compared with one server's clock."""

from __future__ import annotations

from dataclasses import dataclass

from service.offline.compare.align import Alignment


@dataclass(frozen=True)
class ClockLag:
    """What a lag has to be by the clocks alone.

    Attributes:
        lag_s: as of `Alignment`, at the same instant.
        within_s: it is off by no more: a bound, and no standard uncertainty.
    """

    lag_s: float
    within_s: float

    def as_dict(self) -> dict[str, object]:
        """For JSON."""
        return {
            "value": self.lag_s,
            "within": (self.lag_s - self.within_s, self.lag_s + self.within_s),
        }


def clock_notes(alignment: Alignment, by_clocks: ClockLag | None) -> list[str]:
    """What is to be said if forces and clocks contradict each other."""
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
