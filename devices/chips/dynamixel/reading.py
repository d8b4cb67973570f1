"""One reading of a servo's position."""

from __future__ import annotations

from dataclasses import dataclass

from devices.chips.dynamixel.models import CountRange


@dataclass(frozen=True, slots=True)
class PositionReading:
    """A position and when it was true: at `t_mono_ns`, give or take `half_width_ns`."""

    counts: int
    """Signed; 4096 to the turn, beyond one turn in multi-turn mode."""
    t_mono_ns: int
    """Nanoseconds of the clock, midway between end of request and first byte of the answer."""
    half_width_ns: int
    done_ns: int
    """When the answer was complete, nanoseconds of the clock."""
    alert: bool = False
    """The servo reports a hardware error; the position is valid all the same."""
    restarted: bool = False
    """The servo restarted since the reading before, or may have."""
    count_range: CountRange = CountRange.MANY_TURNS
    is_turn_known: bool = True
    """Are its whole turns known? `TurnCounter` tells."""
