"""A wall clock that the harness can step, for one process: the machine's own is left alone.

FAULTS_CLOCK names a file with an offset in nanoseconds. It is added to `time.time`, `time.time_ns`,
`time.clock_gettime(CLOCK_REALTIME)` and its `_ns`, and to `datetime.now`, `utcnow` and `today`.
Not stepped: `time.localtime()` and the like without an argument, time stamps of files, and what
C++ libraries read for themselves. Monotonic clocks stay what they are, as they do on a real step.
"""

from __future__ import annotations

import ctypes
import datetime
import gc
import os
import time
from typing import Any

CLOCK_ENV = "FAULTS_CLOCK"
_LOOK_NS = 20_000_000
_NS = 1_000_000_000


def install_from_environment() -> None:
    """Step this process's clock if the environment says so."""
    if path := os.environ.get(CLOCK_ENV):
        _install(path)


def _install(path: str) -> None:
    monotonic_ns = time.monotonic_ns
    real_time_ns, real_gettime, real_gettime_ns = (
        time.time_ns,
        time.clock_gettime,
        time.clock_gettime_ns,
    )
    offset_ns, look_at_ns = 0, 0

    def offset() -> int:
        nonlocal offset_ns, look_at_ns
        now_ns = monotonic_ns()
        if now_ns >= look_at_ns:
            look_at_ns = now_ns + _LOOK_NS
            try:
                descriptor = os.open(path, os.O_RDONLY)
                try:
                    offset_ns = int(os.read(descriptor, 64) or 0)
                finally:
                    os.close(descriptor)
            except (OSError, ValueError):  # it is being written: the last one holds
                pass
        return offset_ns

    def time_ns() -> int:
        return real_time_ns() + offset()

    def clock_gettime_ns(clock: int) -> int:
        return real_gettime_ns(clock) + (offset() if clock == time.CLOCK_REALTIME else 0)

    def clock_gettime(clock: int) -> float:
        if clock == time.CLOCK_REALTIME:
            return clock_gettime_ns(clock) / _NS
        return real_gettime(clock)

    time.time_ns = time_ns
    time.time = lambda: time_ns() / _NS
    time.clock_gettime_ns = clock_gettime_ns
    time.clock_gettime = clock_gettime

    real_now = datetime.datetime.now

    def now(cls: type[datetime.datetime], tz: datetime.tzinfo | None = None) -> Any:
        shift = datetime.timedelta(microseconds=offset() // 1000)
        # Shifted in UTC: local time would be ambiguous in the hour that comes twice.
        moved = (real_now(datetime.UTC) + shift).astimezone(tz)
        moved = moved if tz is not None else moved.replace(tzinfo=None)
        return cls.combine(moved.date(), moved.timetz())

    def utcnow(cls: type[datetime.datetime]) -> Any:
        return now(cls, datetime.UTC).replace(tzinfo=None)

    # datetime is a static C type, whose attributes cannot be set; a subclass in its place would
    # not be the type of what C code makes, and isinstance would fail. So its dictionary is changed.
    attributes = gc.get_referents(datetime.datetime.__dict__)[0]
    attributes["now"] = classmethod(now)
    attributes["utcnow"] = classmethod(utcnow)
    attributes["today"] = classmethod(now)
    ctypes.pythonapi.PyType_Modified(ctypes.py_object(datetime.datetime))
