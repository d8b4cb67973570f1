"""Frame rate of a node, by its own clock."""

from __future__ import annotations

from collections import deque

_OVER_NS = 1_000_000_000
_JITTER = 1.02


class FrameRateMeter:
    """Frame rate over the last second."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, int]] = deque()

    def clear(self) -> None:
        """Drop all samples: the next frame does not follow the last one."""
        self._samples.clear()

    def add_frame(self, t_mono_ns: int, seq: int) -> None:
        """Add time and number of the newest frame."""
        noted = self._samples
        noted.append((t_mono_ns, seq))
        while noted[-1][0] - noted[0][0] > _OVER_NS and len(noted) > 2:
            noted.popleft()

    def rate_hz(self, nominal_hz: float, silent_ns: int | None) -> float | None:
        """Return frames per second; 0 if none came lately; None if unknown.

        Args:
            nominal_hz: rate limit of bus and node: a slightly higher rate over one second is
                jitter.
            silent_ns: time since the last frame; None: no frame yet.
        """
        if len(self._samples) < 2:  # a rate needs two instants
            return None
        if silent_ns is None or silent_ns > 2 * _OVER_NS:
            return 0.0
        (first_ns, first_seq), (last_ns, last_seq) = self._samples[0], self._samples[-1]
        if last_ns <= first_ns:
            return None
        rate_hz = (last_seq - first_seq) / ((last_ns - first_ns) * 1e-9)
        return nominal_hz if nominal_hz < rate_hz < _JITTER * nominal_hz else rate_hz
