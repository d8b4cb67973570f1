"""Time: injected monotonic clocks, the anchor that maps one to UTC, and a server's UTC.

The node uses `SystemClock`. `VirtualClock` advances only when the emulated bus adds bit times or a
sleep jumps ahead, so that a session runs bit-exactly and faster than real time. `DriverClock` is
for an emulated bus in real time.
"""

from __future__ import annotations

import time
from collections.abc import Callable
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


LAG_MAX_NS = 20_000_000
"""Largest lag of the driver's clock: less than a batch. On a machine too slow for the emulation the
driver is really late."""


class DriverClock:
    """Clock of a driver on emulated wires, without the emulation's computing time.

    On hardware a transfer ends with its last bit. In an emulation the same thread first computes
    the chips and is then woken a little late. This clock excludes that time: it continues from the
    instant at which the transfer ended on the wire. The next wait of the driver or the wires is
    shorter by that lag, so that the clock returns to CLOCK_MONOTONIC, and is never ahead. Time of
    the driver itself (code, wake-ups, missing CPU) passes as on any other clock.

    Args:
        host: clock of the machine, which this clock never overtakes.
    """

    def __init__(self, host: Clock) -> None:
        self._host = host
        self._host_now_ns = host.now_ns  # called some fifty times a frame
        self._lag_ns = 0

    def now_ns(self) -> int:
        """Return the machine's clock minus the emulation's lag."""
        return self._host_now_ns() - self._lag_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep until `t_ns`; a late wake-up counts as the driver's time."""
        over_ns = self._host_now_ns() - t_ns
        if over_ns < 0:
            self._host.sleep_until_ns(t_ns)
            self._lag_ns = 0
        else:
            # The sleep would have absorbed at least a part of the lag.
            self._lag_ns = min(self._lag_ns, over_ns)

    def continue_from(self, t_ns: int) -> None:
        """Continue the driver's time from `t_ns`, the end of a transfer."""
        self._lag_ns = min(max(0, self._host_now_ns() - t_ns), LAG_MAX_NS)


class WireClock:
    """Clock of the emulated wires, in the driver's thread.

    Args:
        driver: clock of the driver.
        host: clock of the machine, for waiting while bits pass.
    """

    def __init__(self, driver: DriverClock, host: Clock) -> None:
        self._driver = driver
        self._host = host

    def now_ns(self) -> int:
        """Return the driver's time, the begin of a transfer."""
        return self._driver.now_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Wait for the end of a transfer and set the driver's clock to it.

        Args:
            t_ns: end of the transfer, not before its begin.
        """
        self._host.sleep_until_ns(t_ns)
        self._driver.continue_from(t_ns)


_UTC_READINGS = 5


def _read_utc_offset_ns(read_ns: Callable[[], int]) -> int:
    """Return UTC minus a clock, from the shortest of some readings.

    A process that is stopped between the two clocks of one would keep the time of its stop.
    """
    readings = [(read_ns(), time.time_ns(), read_ns()) for _ in range(_UTC_READINGS)]
    before_ns, t_ns, after_ns = min(readings, key=lambda reading: reading[2] - reading[0])
    return t_ns - (before_ns + after_ns) // 2


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
        return cls(_read_utc_offset_ns(time.monotonic_ns), clock_set)

    @classmethod
    def from_readings(cls, t_mono_ns: int, t_ns: int, *, clock_set: bool) -> UtcAnchor:
        """Build an anchor from one simultaneous reading of both clocks."""
        return cls(offset_ns=t_ns - t_mono_ns, clock_set=clock_set)


def _read_boottime_ns() -> int:
    # Unlike CLOCK_MONOTONIC it continues during suspend.
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


_UTC_OFFSET_NS = _read_utc_offset_ns(_read_boottime_ns)


def server_utc_ns() -> int:
    """Return a server's UTC in nanoseconds since 1970: read once, then continued without steps.

    It times the begin and end of sessions, and is the reference for nodes' clocks. If NTP sets the
    machine's date while the server runs, intervals stay correct; the new date applies from the next
    start.
    """
    return _UTC_OFFSET_NS + _read_boottime_ns()
