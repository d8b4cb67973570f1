"""Linux settings for a paced loop: timer slack, real-time priority, clock synchronisation.

All are optional: where the kernel refuses, the loop still runs, with more jitter (performance.md:
timer slack of 1 us halves the median lateness of a sleep).
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal
from typing import NamedTuple

_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29  # include/uapi/linux/prctl.h
_TIME_ERROR = 5  # include/uapi/linux/timex.h: the clock is not synchronised
_TIMEX_BYTES = 512  # struct timex is 208 bytes on 64-bit kernels
_FIFO_PRIORITY = 50  # above ordinary work, level with threaded interrupts


def set_timer_slack(slack_ns: int = 1_000) -> bool:
    """Set the timer slack of this thread (default 50 us); return whether the kernel accepts it."""
    return bool(_libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0) == 0)


def use_realtime_priority() -> bool:
    """Run this thread with SCHED_FIFO; return whether it is permitted (root, or rtprio limit)."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    except OSError:
        return False
    return True


def freeze_garbage_collector() -> None:
    """Exclude all present objects (mostly modules) from garbage collection.

    A full collection stops all threads while it visits every object: 55 ms for the hundred thousand
    of a server at its start, on a fast machine. Call it once a process, before time-critical work.
    """
    gc.collect()
    gc.freeze()


def terminate_with_parent() -> None:
    """Make the kernel terminate this process when its parent dies."""
    _libc().prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


class _Timex(ctypes.Structure):
    _fields_ = (
        ("modes", ctypes.c_uint),
        ("offset", ctypes.c_long),
        ("freq", ctypes.c_long),
        ("maxerror", ctypes.c_long),
        ("rest", ctypes.c_char * _TIMEX_BYTES),
    )


class ClockState(NamedTuple):
    """State of the wall clock, as the kernel reports it."""

    is_set: bool
    error_max_s: float


def read_clock_state() -> ClockState | None:
    """Read whether the wall clock is set, and the bound of its error; None if that is refused."""
    timex = _Timex()
    state = int(_libc().adjtimex(ctypes.byref(timex)))
    return None if state < 0 else ClockState(state != _TIME_ERROR, timex.maxerror * 1e-6)


def is_clock_set() -> bool:
    """Return whether the kernel reports the wall clock as set (by NTP or a laptop).

    A Raspberry Pi has no battery clock: until it is set, its UTC is a guess.
    """
    state = read_clock_state()
    return state is not None and state.is_set


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
