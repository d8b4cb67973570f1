"""The newest position of a servo, for frames to carry along.

On a real clock a thread of its own reads the servo, so that its silence costs the tiles nothing. In
a session on virtual time nothing runs beside the tile loop, so the servo is read in lock-step:
at every instant a reading was due, on a clock of the servo's own line, and its value is known to
the frames only from the instant at which its answer was complete.
"""

from __future__ import annotations

import threading
from collections import deque
from types import TracebackType
from typing import Self

from devices.chips.dynamixel.reader import Dynamixel
from devices.chips.dynamixel.reading import PositionReading
from devices.chips.dynamixel.turns import TurnCounter
from devices.clock import Clock
from devices.errors import ServoError, ServoSetupError

_RECENT = 16
"""Readings kept for a frame that takes long: 64 tiles take 16 ms, a quick servo 1 ms."""


class _PacedServo:
    """A servo that is read at fixed intervals."""

    def __init__(self, servo: Dynamixel, clock: Clock, *, rate_hz: float) -> None:
        self.failures = 0
        """Readings that failed: silence, garbage, or an error status."""
        self.is_turn_known = True
        """Are the whole turns known of the position that `latest` gave last?"""
        self._servo = servo
        self._clock = clock
        self._period_ns = round(1e9 / rate_hz)
        self._turns = TurnCounter()
        self._failure = ""
        self._newest_is_turn_known = True

    @property
    def trouble(self) -> str:
        """What is wrong with the servo now, in words; empty if nothing is."""
        if self._failure:
            return self._failure
        if self._newest_is_turn_known:
            return ""
        return (
            "the servo restarted, or its count leapt, and which turn it counts from is not known: "
            "there is no angle. Bring the joint into the turn of zero_counts, and start the node "
            "again"
        )

    def _read_position(self) -> PositionReading | None:
        """Read the servo once; None if it failed, which `trouble` explains."""
        try:
            reading = self._turns.follow(self._servo.read_position())
        except ServoError as error:
            self.failures += 1
            self._failure = str(error)
            if isinstance(error, ServoSetupError):
                self._forget()
            return None
        self._failure, self._newest_is_turn_known = "", reading.is_turn_known
        return reading

    def _forget(self) -> None:
        """Drop what was read before the servo went away: its age tells nothing of it."""
        raise NotImplementedError

    @property
    def stale_after_ns(self) -> int:
        """Three intervals: one late answer is no fault."""
        return 3 * self._period_ns


class PolledServo(_PacedServo):
    """A `ServoSource` for virtual time: readings at fixed intervals on the servo line's clock.

    It blocks while a servo is silent, so it is not for a real loop.
    """

    def __init__(self, servo: Dynamixel, line_clock: Clock, *, rate_hz: float) -> None:
        super().__init__(servo, line_clock, rate_hz=rate_hz)
        self._due_ns = line_clock.now_ns()
        self._newest: PositionReading | None = None
        self._on_the_way: deque[PositionReading] = deque()

    def latest(self, t_mono_ns: int) -> tuple[int, int] | None:
        """Newest position known at `t_mono_ns` with its sample instant; None before the first."""
        while self._due_ns <= t_mono_ns:
            self._clock.sleep_until_ns(self._due_ns)
            reading = self._read_position()
            if reading is not None:
                self._on_the_way.append(reading)
            self._due_ns = max(self._due_ns + self._period_ns, self._clock.now_ns())
        while self._on_the_way and self._on_the_way[0].done_ns <= t_mono_ns:
            self._newest = self._on_the_way.popleft()
        if self._newest is None:
            return None
        self.is_turn_known = self._newest.is_turn_known
        return self._newest.counts, self._newest.t_mono_ns

    def _forget(self) -> None:
        self._newest = None
        self._on_the_way.clear()


class ServoReader(_PacedServo):
    """A `ServoSource` for a real clock: a thread reads the servo at a fixed rate.

    Use as a context manager: the thread runs while the block does.
    """

    def __init__(self, servo: Dynamixel, clock: Clock, *, rate_hz: float) -> None:
        super().__init__(servo, clock, rate_hz=rate_hz)
        self._recent: tuple[PositionReading, ...] = ()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._read, name="servo", daemon=True)

    def latest(self, t_mono_ns: int) -> tuple[int, int] | None:
        """Newest position sampled by `t_mono_ns`, with its sample instant; None before the first.

        The thread goes on while a frame is taken, so there are newer ones: they are for the next
        frame. Only if there is no older one is the oldest given, with age 0.
        """
        recent = self._recent
        if not recent:
            return None
        reading = next((r for r in recent if r.t_mono_ns <= t_mono_ns), recent[-1])
        self.is_turn_known = reading.is_turn_known
        return reading.counts, min(reading.t_mono_ns, t_mono_ns)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._stop.set()
        self._thread.join()

    def _forget(self) -> None:
        self._recent = ()

    def _read(self) -> None:
        due_ns = self._clock.now_ns()
        while not self._stop.is_set():
            reading = self._read_position()
            if reading is not None:
                # Replaced as a whole, newest first: a reader sees the old or the new ones.
                self._recent = (reading, *self._recent[: _RECENT - 1])
            else:
                # A port that has gone fails at once: do not spin on it.
                self._stop.wait(self._period_ns * 1e-9)
            due_ns = max(due_ns + self._period_ns, self._clock.now_ns())
            self._clock.sleep_until_ns(due_ns)
