"""How fast frames come where nothing disturbs them: a busy machine is no slower bus.

The pace of a trial is that of its best stretches; a stream that is faster than its nominal rate
proves that wrong.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from devices.frames import FrameBatch

_STRETCH = 10
"""Frames in a row: after a pause one comes early, which the pause before it makes up for."""
_BEST_PART = 10  # per cent of all stretches: most may be disturbed, and still it is found
_WRONG = 1.02
"""So much faster than nominal, over `_OVER_NS`, is no jitter."""
_OVER_NS = 2_000_000_000


def undisturbed_hz(t_ns: Sequence[int]) -> float:
    """Frames a second of the best stretches.

    Args:
        t_ns: when each frame of a trial was over, rising, more than ten of them.
    """
    instants_ns = np.asarray(t_ns, dtype=np.int64)
    took_ns = instants_ns[_STRETCH:] - instants_ns[:-_STRETCH]
    return float(1e9 * _STRETCH / np.percentile(took_ns, _BEST_PART))


class Pace:
    """Watches whether a stream is faster than it should be able to be.

    Args:
        nominal_hz: what it was taken to be capable of.
    """

    def __init__(self, nominal_hz: float) -> None:
        self._nominal_hz = nominal_hz
        self._passed: deque[tuple[int, int]] = deque()
        self.found_hz: float | None = None
        """The rate that proves the nominal one wrong; None so far."""

    def see(self, batch: FrameBatch) -> None:
        """Frames that were taken, in order."""
        passed = self._passed
        passed.append((int(batch.t_mono_ns[-1]), int(batch.seq[-1])))
        (begin_ns, first), (end_ns, last) = passed[0], passed[-1]
        if end_ns - begin_ns < _OVER_NS:
            return
        rate_hz = 1e9 * (last - first) / (end_ns - begin_ns)
        if rate_hz > _WRONG * self._nominal_hz:
            self.found_hz = rate_hz
        passed.popleft()
