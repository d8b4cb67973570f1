"""Time: injected monotonic clocks, the anchor that maps one to UTC, and a server's UTC.

The node uses `SystemClock`. `VirtualClock` advances only when the emulated bus adds bit times or a
sleep jumps ahead, so that a session runs bit-exactly and faster than real time.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """Monotonic clock with an absolute sleep."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in nanoseconds."""

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; return at once if it has passed."""


class SystemClock:
    """CLOCK_MONOTONIC of this machine."""

    def now_ns(self) -> int:
        """Return CLOCK_MONOTONIC in nanoseconds."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; CPython's `time.sleep` uses clock_nanosleep."""
        while (left_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns * 1e-9)


class SpinningClock(SystemClock):
    """System clock that spins for the last part of a sleep, so as not to oversleep.

    A sleep ends some 60 us late, more beside busy processes (`benchmarks/acquisition_jitter.py`).
    Spinning costs CPU time in each wait, so use it only for the paced loop in its own process.
    """

    SPIN_NS = 150_000

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns` and return as soon after it as possible."""
        super().sleep_until_ns(t_ns - self.SPIN_NS)
        while time.monotonic_ns() < t_ns:
            pass


class VirtualClock:
    """Clock that advances only by `sleep_until_ns`. It never goes back."""

    def __init__(self, t_ns: int = 0) -> None:
        self._t_ns = t_ns

    def now_ns(self) -> int:
        """Return virtual nanoseconds since power-up of the emulated machine."""
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Advance to `t_ns` if it lies ahead."""
        if t_ns > self._t_ns:
            self._t_ns = t_ns


@dataclass(frozen=True)
class UtcAnchor:
    """Offset from CLOCK_MONOTONIC to UTC, fixed for a whole stream.

    UTC of any frame is `t_mono_ns` plus `offset_ns`. Later knowledge of UTC goes into the session's
    clock table, not into the stream.

    Attributes:
        offset_ns: UTC minus CLOCK_MONOTONIC.
        clock_set: the wall clock had been set (by NTP or a laptop) at the anchor's instant.
    """

    offset_ns: int
    clock_set: bool

    @classmethod
    def measure(cls, *, clock_set: bool) -> UtcAnchor:
        """Read both clocks of this machine as nearly at one instant as possible."""
        before_ns = time.monotonic_ns()
        t_ns = time.time_ns()
        return cls.from_readings((before_ns + time.monotonic_ns()) // 2, t_ns, clock_set=clock_set)

    @classmethod
    def from_readings(cls, t_mono_ns: int, t_ns: int, *, clock_set: bool) -> UtcAnchor:
        """Build an anchor from one simultaneous reading of both clocks."""
        return cls(offset_ns=t_ns - t_mono_ns, clock_set=clock_set)


def _read_boottime_ns() -> int:
    # Unlike CLOCK_MONOTONIC it continues during suspend.
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


_UTC_OFFSET_NS = time.time_ns() - _read_boottime_ns()


def server_utc_ns() -> int:
    """Return a server's UTC in nanoseconds since 1970: read once, then continued without steps.

    It times the begin and end of sessions, and is the reference for nodes' clocks. If NTP sets the
    machine's date while the server runs, intervals stay correct; the new date applies from the next
    start.
    """
    return _UTC_OFFSET_NS + _read_boottime_ns()
