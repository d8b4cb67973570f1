"""Sources of a servo's newest position, to be stored with each frame.

On a real clock a separate thread reads the servo, so that its silence does not delay the tiles. On
virtual time no thread may run beside the tile loop, so the servo is read in lock-step: at every
instant at which a reading was due, on a separate clock of the servo's line. A frame gets a value
only if its answer was complete by then.

A servo counts turns in volatile memory. After power-up or reboot, and when its torque is switched
on in position control, the count restarts within one turn (e-manual, Present Position). In 1.0's
wheel mode the count always stays within one turn. So a count may jump by whole turns while the
joint stands still, and each turn is 2 pi of angle.

The joint's maximum speed bounds its travel between two readings. If the bound is less than half a
turn, the number of turns follows; otherwise it is unknown.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from dataclasses import replace
from typing import Self

from devices.chips.dynamixel.driver import DynamixelServo, PositionReading
from devices.chips.dynamixel.protocol import COUNTS_PER_TURN, CountRange
from devices.clock import Clock
from devices.errors import ServoError, ServoSetupError
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


_RECENT = 16
"""Recent readings, for long frames: 64 tiles take 16 ms, a fast servo 1 ms."""


class _ServoSourceBase(ABC):
    """Base class of servos that are read at fixed intervals."""

    def __init__(self, servo: DynamixelServo, clock: Clock, *, rate_hz: float) -> None:
        self.failed_readings = 0
        """Number of failed readings: silence, garbage, or an error status."""
        self.is_turn_known = True
        """True if the number of whole turns in the last returned position is known."""
        self._servo = servo
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self._turns = TurnUnwrapper()
        self._last_error = ""
        self._newest_is_turn_known = True

    @property
    def warning(self) -> str:
        """Present warning about the servo; empty if it works."""
        if self._last_error:
            return self._last_error
        if self._newest_is_turn_known:
            return ""
        return (
            "the servo restarted, or its count leapt, and which turn it counts from is not known: "
            "there is no angle. Bring the joint into the turn of zero_counts, and start the node "
            "again"
        )

    def _read_position(self) -> PositionReading | None:
        """Read the servo once; None if it failed: the error is kept."""
        try:
            reading = self._turns.unwrap(self._servo.read_position())
        except ServoError as error:
            self.failed_readings += 1
            self._last_error = str(error)
            if isinstance(error, ServoSetupError):
                self._discard_readings()
            return None
        self._last_error, self._newest_is_turn_known = "", reading.is_turn_known
        return reading

    @abstractmethod
    def _discard_readings(self) -> None:
        """Discard readings from before the servo went away."""

    @property
    def stale_after_ns(self) -> int:
        """Age in ns above which a position is stale: three intervals, to tolerate a late answer."""
        return 3 * self._period_ns


class VirtualTimeServoSource(_ServoSourceBase):
    """Servo source for virtual time: readings at fixed intervals on the servo line's clock.

    A silent servo blocks it, so do not use it in a real loop.
    """

    def __init__(self, servo: DynamixelServo, line_clock: Clock, *, rate_hz: float) -> None:
        super().__init__(servo, line_clock, rate_hz=rate_hz)
        self._due_ns = line_clock.now_ns()
        self._newest: PositionReading | None = None
        self._pending: deque[PositionReading] = deque()

    def find_latest_position(self, t_mono_ns: int) -> tuple[int, int] | None:
        """Return the newest position known at `t_mono_ns`, and its instant; None before the first.

        Performs all readings that were due by then.
        """
        while self._due_ns <= t_mono_ns:
            self._clock.sleep_until_ns(self._due_ns)
            reading = self._read_position()
            if reading is not None:
                self._pending.append(reading)
            self._due_ns = max(self._due_ns + self._period_ns, self._clock.now_ns())
        while self._pending and self._pending[0].answered_ns <= t_mono_ns:
            self._newest = self._pending.popleft()
        if self._newest is None:
            return None
        self.is_turn_known = self._newest.is_turn_known
        return self._newest.counts, self._newest.t_mono_ns

    def _discard_readings(self) -> None:
        self._newest = None
        self._pending.clear()


class ThreadedServoSource(_ServoSourceBase):
    """Servo source for a real clock: a thread reads the servo at a fixed rate.

    Context manager: the thread runs within the block.
    """

    def __init__(self, servo: DynamixelServo, clock: Clock, *, rate_hz: float) -> None:
        super().__init__(servo, clock, rate_hz=rate_hz)
        self._recent: tuple[PositionReading, ...] = ()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="servo", daemon=True)

    def find_latest_position(self, t_mono_ns: int) -> tuple[int, int] | None:
        """Return the newest position sampled by `t_mono_ns`, and its instant; None if none exists.

        The thread continues during a frame, so newer readings may exist: they belong to the next
        frame. If all are newer, return the oldest, with age 0; None if it is as far away as a stale
        one, since then the bus was held up.
        """
        recent = self._recent
        if not recent or recent[-1].t_mono_ns - t_mono_ns > self.stale_after_ns:
            return None
        reading = next((r for r in recent if r.t_mono_ns <= t_mono_ns), recent[-1])
        self.is_turn_known = reading.is_turn_known
        return reading.counts, min(reading.t_mono_ns, t_mono_ns)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _discard_readings(self) -> None:
        self._recent = ()

    def _run(self) -> None:
        due_ns = self._clock.now_ns()
        while not self._stop.is_set():
            reading = self._read_position()
            if reading is not None:
                # Replaced atomically, newest first.
                self._recent = (reading, *self._recent[: _RECENT - 1])
            else:
                # A missing port fails at once: do not spin.
                self._stop.wait(self._period_ns * 1e-9)
            due_ns = max(due_ns + self._period_ns, self._clock.now_ns())
            self._clock.sleep_until_ns(due_ns)
