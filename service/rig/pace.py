"""Frame rate of an array without disturbance by other load of the machine.

The rate of a trial is estimated from its fastest runs of frames; a stream that is faster than its
nominal rate disproves that rate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from devices.frames import FrameBatch

_STRETCH = 10
"""Frames in a run, which averages out an early frame after a pause."""
_BEST_PART = 10  # percentile of the runs' durations: most runs may be disturbed
_WRONG = 1.02
"""Ratio to the nominal rate, over `_OVER_NS`, that exceeds jitter."""
_OVER_NS = 2_000_000_000


def undisturbed_hz(t_ns: Sequence[int]) -> float:
    """Estimate the frame rate from the fastest runs of frames.

    Args:
        t_ns: end of each frame of a trial, rising, more than ten frames.
    """
    instants_ns = np.asarray(t_ns, dtype=np.int64)
    took_ns = instants_ns[_STRETCH:] - instants_ns[:-_STRETCH]
    return float(1e9 * _STRETCH / np.percentile(took_ns, _BEST_PART))


class Pace:
    """Monitor of a stream that detects frames faster than the nominal rate.

    Args:
        nominal_hz: nominal rate, the assumed maximum.
    """

    def __init__(self, nominal_hz: float) -> None:
        self._nominal_hz = nominal_hz
        self._passed: deque[tuple[int, int]] = deque()
        self.found_hz: float | None = None
        """Measured rate that exceeds the nominal one; None until then."""

    def see(self, batch: FrameBatch) -> None:
        """Update with the next batch."""
        passed = self._passed
        passed.append((int(batch.t_mono_ns[-1]), int(batch.seq[-1])))
        (begin_ns, first), (end_ns, last) = passed[0], passed[-1]
        if end_ns - begin_ns < _OVER_NS:
            return
        rate_hz = 1e9 * (last - first) / (end_ns - begin_ns)
        if rate_hz > _WRONG * self._nominal_hz:
            self.found_hz = rate_hz
        passed.popleft()
