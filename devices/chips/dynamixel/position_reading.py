"""Reading of a servo's position."""

from __future__ import annotations

from dataclasses import dataclass

from devices.chips.dynamixel.firmwares import CountRange


@dataclass(frozen=True, slots=True)
class PositionReading:
    """Position with its sample instant, `t_mono_ns` within `half_width_ns`."""

    counts: int
    """Signed; 4096 to the turn, beyond one turn in multi-turn mode."""
    t_mono_ns: int
    """Sample instant: midway between end of request and first byte of the answer."""
    half_width_ns: int
    answered_ns: int
    """Instant at which the answer was complete."""
    has_alert: bool = False
    """True if the servo reports a hardware error; the position is still valid."""
    has_restarted: bool = False
    """True if the servo restarted, or may have, since the previous reading."""
    count_range: CountRange = CountRange.MANY_TURNS
    is_turn_known: bool = True
    """True if the number of whole turns is known; set by `TurnUnwrapper`."""
