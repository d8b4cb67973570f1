"""Server's UTC: read once, then continued by a clock that never steps.

It times the begin and end of sessions, and is the reference for nodes' clocks. If NTP sets the
machine's date while the server runs, intervals stay correct; the new date applies from the next
start.
"""

from __future__ import annotations

import time


def _read_boottime_ns() -> int:
    # Unlike CLOCK_MONOTONIC it continues during suspend.
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


_OFFSET_NS = time.time_ns() - _read_boottime_ns()


def server_utc_ns() -> int:
    """Return the server's UTC in nanoseconds since 1970."""
    return _OFFSET_NS + _read_boottime_ns()
