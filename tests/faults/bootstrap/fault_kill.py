"""Ends this process at a chosen call."""

from __future__ import annotations

import os
import signal
import threading


class KillPoint:
    """SIGKILL to this process at the Nth call that fits.

    Args:
        spec: KIND[+KIND...][@PART_OF_PATH]:N[:before|after].
    """

    def __init__(self, spec: str) -> None:
        what, number, *when = spec.strip().split(":")
        kinds, _, self._part = what.partition("@")
        self._kinds = kinds.split("+")
        self._left = int(number)
        self._when = when[0] if when else "before"
        self._lock = threading.Lock()

    def reached(self, kind: str, path: str, when: str) -> None:
        """A call begins ("before") or has returned ("after"); this may not return."""
        fits = kind in self._kinds or "any" in self._kinds
        if when != self._when or not fits or self._part not in path:
            return
        with self._lock:
            self._left -= 1
            if not self._left:
                os.kill(os.getpid(), signal.SIGKILL)
                signal.pause()  # it may be another thread that takes it
