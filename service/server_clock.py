"""The server's UTC: read once, then carried on by a clock that never steps.

Sessions begin and end, and nodes' clocks are compared, by this one. If NTP sets the machine's date
while the server runs, these instants keep their distances; the new date counts from the next start.
"""

from __future__ import annotations

import time


def _boot_ns() -> int:
    # Unlike CLOCK_MONOTONIC it goes on while a laptop sleeps.
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME)


_OFFSET_NS = time.time_ns() - _boot_ns()


def utc_ns() -> int:
    """Nanoseconds since 1970 in UTC, as this server counts them."""
    return _OFFSET_NS + _boot_ns()
