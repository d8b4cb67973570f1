"""Time is injected: one monotonic clock that never steps, and the one anchor that gives it a date.

`SystemClock` is the node's. `VirtualClock` only moves when it is moved (by the emulated bus with
its bit times, a sleeper by its wake-up), so that a whole session runs bit-exactly and faster than
it would last.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol


class Clock(Protocol):
    """What acquisition needs of time."""

    def now_ns(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""

    def sleep_until_ns(self, t_ns: int) -> None:
        """Return at or after `t_ns`; at once if it has passed."""


class SystemClock:
    """CLOCK_MONOTONIC of this machine."""

    def now_ns(self) -> int:
        """Nanoseconds of CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def sleep_until_ns(self, t_ns: int) -> None:
        """Sleep to an absolute instant; CPython's `time.sleep` is clock_nanosleep beneath."""
        while (left_ns := t_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns * 1e-9)


class SpinningClock(SystemClock):
    """The same clock, for a loop that must not oversleep: it spins for the last part of a wait.

    A sleep ends some 60 us late, more beside busy processes; measured by
    `benchmarks/acquisition_jitter.py`. The price is that much of a core in each wait, so it is for
    the paced loop in its own process and for nothing else.
    """

    SPIN_NS = 150_000

    def sleep_until_ns(self, t_ns: int) -> None:
        """Return at `t_ns`, or as soon after it as possible."""
        super().sleep_until_ns(t_ns - self.SPIN_NS)
        while time.monotonic_ns() < t_ns:
            pass


class VirtualClock:
    """A clock that stands still until it is moved. It never goes back."""

    def __init__(self, t_ns: int = 0) -> None:
        self._t_ns = t_ns

    def now_ns(self) -> int:
        """Virtual nanoseconds since the emulated machine was switched on."""
        return self._t_ns

    def sleep_until_ns(self, t_ns: int) -> None:
        """Jump to `t_ns` if it lies ahead."""
        if t_ns > self._t_ns:
            self._t_ns = t_ns


@dataclass(frozen=True)
class UtcAnchor:
    """One pair of instants, `t_mono_ns` and the same moment in UTC, fixed for a whole stream.

    UTC of any frame is `t_mono_ns` plus `offset_ns`. It is never changed while a stream runs: what
    is learnt later about UTC goes into the session's clock table, not into the stream.
    `clock_set` tells whether anything (NTP, a laptop) had set the wall clock when it was taken.
    """

    offset_ns: int
    clock_set: bool

    @classmethod
    def now(cls, *, clock_set: bool) -> UtcAnchor:
        """Anchor of this machine's clocks, read at one instant as near as can be."""
        before_ns = time.monotonic_ns()
        t_ns = time.time_ns()
        return cls.of((before_ns + time.monotonic_ns()) // 2, t_ns, clock_set=clock_set)

    @classmethod
    def of(cls, t_mono_ns: int, t_ns: int, *, clock_set: bool) -> UtcAnchor:
        """Anchor from one simultaneous reading of both clocks."""
        return cls(offset_ns=t_ns - t_mono_ns, clock_set=clock_set)
