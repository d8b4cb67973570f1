"""What a process of ours has freed goes back to the system.

Left to themselves Arrow's allocator and glibc's keep for each of their threads what it has ever
used: a server that had answered 400 zooms into ten hours of 8 tiles held 80 MB of it.
"""

from __future__ import annotations

import ctypes
import os

_M_ARENA_MAX = -8  # malloc.h of glibc


def give_back_freed() -> None:
    """One heap for all threads, Arrow's too.

    Call it before pyarrow is imported, which chooses its allocator then, and before there are other
    threads. Processes that are started from here have Arrow's choice as well.
    """
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:  # other C libraries have none, and one heap
        mallopt(_M_ARENA_MAX, 1)
