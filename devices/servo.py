"""The newest position of a servo, for frames to carry along.

In a session on virtual time nothing runs beside the tile loop, so the servo is read in lock-step:
at every instant a reading was due, on a clock of the servo's own line, and its value is known to
the frames only from the instant at which its answer was complete.
"""

from __future__ import annotations

from collections import deque

from devices.clock import Clock
from devices.dynamixel import Dynamixel, PositionReading
from devices.errors import ServoError


class PolledServo:
    """A `ServoSource` for virtual time: readings at fixed intervals on the servo line's clock.

    It blocks while a servo is silent, so it is not for a real loop.
    """

    def __init__(self, servo: Dynamixel, line_clock: Clock, *, rate_hz: float) -> None:
        self.failures = 0
        """Readings that failed: silence, garbage, or an error status."""
        self._servo = servo
        self._clock = line_clock
        self._period_ns = round(1e9 / rate_hz)
        self._due_ns = line_clock.now_ns()
        self._newest: PositionReading | None = None
        self._on_the_way: deque[PositionReading] = deque()

    @property
    def stale_after_ns(self) -> int:
        """Three intervals: one late answer is no fault."""
        return 3 * self._period_ns

    def latest(self, t_mono_ns: int) -> tuple[int, int] | None:
        """Newest position known at `t_mono_ns` with its sample instant; None before the first."""
        while self._due_ns <= t_mono_ns:
            self._clock.sleep_until_ns(self._due_ns)
            try:
                self._on_the_way.append(self._servo.read_position())
            except ServoError:
                self.failures += 1
            self._due_ns = max(self._due_ns + self._period_ns, self._clock.now_ns())
        while self._on_the_way and self._on_the_way[0].done_ns <= t_mono_ns:
            self._newest = self._on_the_way.popleft()
        return None if self._newest is None else (self._newest.counts, self._newest.t_mono_ns)
