"""Unwrapping of whole turns in a servo's count.

A servo counts turns in volatile memory. After power-up or reboot, and when its torque is switched
on in position control, the count restarts within one turn (e-manual, Present Position). In 1.0's
wheel mode the count always stays within one turn. So a count may jump by whole turns while the
joint stands still, and each turn is 2 pi of angle.

The joint's maximum speed bounds its travel between two readings. If the bound is less than half a
turn, the number of turns follows; otherwise it is unknown.
"""

from __future__ import annotations

from dataclasses import replace

from devices.chips.dynamixel.firmwares import COUNTS_PER_TURN, CountRange
from devices.chips.dynamixel.position_reading import PositionReading
from devices.frames import NO_SERVO_COUNTS

SPEED_MAX_COUNTS_PER_S = 3 * COUNTS_PER_TURN
"""Maximum speed: twice the no-load speed of an MX-64 at its highest voltage, 78 rev/min, because a
load may drive the joint."""
SLACK_COUNTS = 64
"""Allowance for noise of the encoder and of the instants."""
_COUNTS_END = 2**31  # the limit of a frame's column, int32


class TurnUnwrapper:
    """Unwrapper of the readings of one servo."""

    def __init__(self) -> None:
        self._last: PositionReading | None = None
        self._turns: int | None = 0
        self._has_left_turn = False

    def unwrap(self, reading: PositionReading) -> PositionReading:
        """Return the next reading with its count unwrapped, or with `is_turn_known` false."""
        last, self._last = self._last, reading
        if last is not None:
            self._turns = self._count_turns(last, reading)
        counts = reading.counts + COUNTS_PER_TURN * (self._turns or 0)
        if self._turns is None or not NO_SERVO_COUNTS < counts < _COUNTS_END:
            return replace(reading, is_turn_known=False)
        self._has_left_turn |= self._turns != 0
        return replace(reading, counts=counts)

    def _count_turns(self, last: PositionReading, reading: PositionReading) -> int | None:
        turns = self._turns
        if turns is None:
            if self._has_left_turn or not (_is_within_turn(last) and _is_within_turn(reading)):
                return None
            turns = 0
        moved = reading.counts - last.counts
        elapsed_s = (reading.t_mono_ns - last.t_mono_ns) * 1e-9
        reach = SLACK_COUNTS + SPEED_MAX_COUNTS_PER_S * elapsed_s
        is_ambiguous = 2 * reach >= COUNTS_PER_TURN
        # Without a restart: in wheel mode, or by torque that was switched on in position control.
        may_have_leapt = is_ambiguous and (
            reading.count_range is CountRange.WRAPPED
            or (reading.count_range is CountRange.ONE_TURN and not _is_within_turn(last))
        )
        if not reading.has_restarted and not may_have_leapt and abs(moved) <= reach:
            return turns
        added = round(-moved / COUNTS_PER_TURN)
        if is_ambiguous or abs(moved + added * COUNTS_PER_TURN) > reach:
            return None
        return turns + added


def _is_within_turn(reading: PositionReading) -> bool:
    """Return whether the joint's mode limits it to the turn that its encoder measures."""
    is_in_turn = 0 <= reading.counts < COUNTS_PER_TURN
    return reading.count_range is CountRange.ONE_TURN and is_in_turn
