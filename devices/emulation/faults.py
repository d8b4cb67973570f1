"""Faults of single parts, by scene key at a time of the scene, or as context managers at will.

`no_answer`: the part does not acknowledge, as when its plug is pulled (its registers survive, which
a real unplugged part's would not). `stale`: it acknowledges, but a conversion never ends.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from devices.scene import FaultScene


class Fault:
    """One kind of fault of one part: is it there at a given time?"""

    def __init__(self, windows_ns: Sequence[tuple[int, int]] = ()) -> None:
        self._windows_ns = tuple(windows_ns)
        self._depth = 0

    def __call__(self, t_ns: int) -> bool:
        """Is the fault there at `t_ns`?"""
        if self._depth:
            return True
        if not self._windows_ns:  # asked at every START
            return False
        return any(begin <= t_ns < end for begin, end in self._windows_ns)

    @contextmanager
    def injected(self) -> Iterator[None]:
        """The fault is there while the block runs, whatever the time."""
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1


def scene_fault(faults: Sequence[FaultScene], kind: str, serial: str, epoch_ns: int) -> Fault:
    """The fault of one kind and part with the windows that the scene gives it."""
    return Fault(
        [
            (epoch_ns + round(f.t_s * 1e9), epoch_ns + round((f.t_s + f.duration_s) * 1e9))
            for f in faults
            if f.kind == kind and f.tile == serial
        ]
    )
