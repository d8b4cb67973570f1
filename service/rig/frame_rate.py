"""Frame rate of an array without disturbance by other load of the machine.

The rate of a trial is estimated from its fastest runs of frames; a stream that is faster than its
nominal rate disproves that rate.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from devices.frames import FrameBatch

_RUN_FRAMES = 10
"""Frames in a run, which averages out an early frame after a pause."""
_FASTEST_PERCENTILE = 10  # percentile of the runs' durations: most runs may be disturbed
_EXCESS_RATIO = 1.02
"""Ratio to the nominal rate, over `_EXCESS_WINDOW_NS`, that exceeds jitter."""
_EXCESS_WINDOW_NS = 2_000_000_000


def estimate_undisturbed_rate_hz(t_ns: Sequence[int]) -> float:
    """Estimate the frame rate from the fastest runs of frames.

    Args:
        t_ns: end of each frame of a trial, rising, more than ten frames.
    """
    instants_ns = np.asarray(t_ns, dtype=np.int64)
    took_ns = instants_ns[_RUN_FRAMES:] - instants_ns[:-_RUN_FRAMES]
    return float(1e9 * _RUN_FRAMES / np.percentile(took_ns, _FASTEST_PERCENTILE))


class FrameRateMonitor:
    """Monitor of a stream that detects frames faster than the nominal rate.

    Args:
        nominal_hz: nominal rate, the assumed maximum.
    """

    def __init__(self, nominal_hz: float) -> None:
        self._nominal_hz = nominal_hz
        self._passed: deque[tuple[int, int]] = deque()
        self.exceeding_rate_hz: float | None = None
        """Measured rate that exceeds the nominal one; None until then."""

    def add_batch(self, batch: FrameBatch) -> None:
        """Update with the next batch."""
        passed = self._passed
        passed.append((int(batch.t_mono_ns[-1]), int(batch.seq[-1])))
        (begin_ns, first), (end_ns, last) = passed[0], passed[-1]
        if end_ns - begin_ns < _EXCESS_WINDOW_NS:
            return
        rate_hz = 1e9 * (last - first) / (end_ns - begin_ns)
        if rate_hz > _EXCESS_RATIO * self._nominal_hz:
            self.exceeding_rate_hz = rate_hz
        passed.popleft()
