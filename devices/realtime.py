"""What a paced loop asks of Linux: sharp timers, priority, and whether the date is known.

Each is a wish: where the kernel refuses, the loop still runs, only less evenly (performance.md:
timer slack of 1 us halves the median lateness of a sleep).
"""

from __future__ import annotations

import ctypes
import gc
import os
import signal

_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29  # include/uapi/linux/prctl.h
_TIME_ERROR = 5  # include/uapi/linux/timex.h: the clock is not synchronised
_TIMEX_BYTES = 512  # struct timex is 208 bytes on 64-bit kernels
_FIFO_PRIORITY = 50  # above ordinary work, level with threaded interrupts


def sharpen_timers(slack_ns: int = 1_000) -> bool:
    """Let this thread's sleeps end within `slack_ns`, not 50 us; return if that was granted."""
    return bool(_libc().prctl(_PR_SET_TIMERSLACK, ctypes.c_ulong(slack_ns), 0, 0, 0) == 0)


def run_before_others() -> bool:
    """Run this thread with SCHED_FIFO; whether that was permitted (root, or an rtprio limit)."""
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(_FIFO_PRIORITY))
    except OSError:
        return False
    return True


def spare_what_is_loaded() -> None:
    """Have Python's collector leave alone what there is so far: modules, which last.

    A whole collection holds all threads up while it looks at every object: 55 ms for the hundred
    thousand of a server that has only begun, on a fast machine. Call it once a process, before the
    work begins that must not wait.
    """
    gc.collect()
    gc.freeze()


def end_with_parent() -> None:
    """Make the kernel terminate this process when its parent dies, however it dies."""
    _libc().prctl(_PR_SET_PDEATHSIG, signal.SIGTERM, 0, 0, 0)


def clock_is_set() -> bool:
    """Whether anything (NTP, a laptop) has set this machine's date, as the kernel knows it.

    A Raspberry Pi has no battery clock: until it is set, its UTC is a guess.
    """
    state = int(_libc().adjtimex(ctypes.create_string_buffer(_TIMEX_BYTES)))
    return 0 <= state != _TIME_ERROR


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)
