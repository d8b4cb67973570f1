"""Memory allocation that returns freed memory to the system.

By default the allocators of Arrow and glibc retain each thread's peak: a server that had answered
400 zooms into ten hours of 8 tiles held 80 MB.
"""

from __future__ import annotations

import ctypes
import os

_M_ARENA_MAX = -8  # malloc.h of glibc


def use_system_allocator() -> None:
    """Use one heap of the system's allocator for all threads, and for Arrow.

    Call it before pyarrow is imported, which then chooses its allocator, and before other threads
    start. Child processes inherit the choice for Arrow.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # other C libraries lack it, and have one heap
        mallopt(_M_ARENA_MAX, 1)
