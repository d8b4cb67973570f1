"""How many frames a second a node takes, by its own clock."""

from __future__ import annotations

from collections import deque

_OVER_NS = 1_000_000_000
_JITTER = 1.02


class Pace:
    """Of the last second."""

    def __init__(self) -> None:
        self._noted: deque[tuple[int, int]] = deque()

    def clear(self) -> None:
        """What comes next does not follow on this."""
        self._noted.clear()

    def note(self, t_mono_ns: int, seq: int) -> None:
        """Instant and number of the newest frame."""
        noted = self._noted
        noted.append((t_mono_ns, seq))
        while noted[-1][0] - noted[0][0] > _OVER_NS and len(noted) > 2:
            noted.popleft()

    def rate_hz(self, nominal_hz: float, silent_ns: int | None) -> float | None:
        """Frames a second; 0 if none came lately; None where that cannot be told.

        Args:
            nominal_hz: what bus and node can do: a little more in one second is its jitter.
            silent_ns: for how long nothing has come; None: nothing ever has.
        """
        if len(self._noted) < 2:  # a rate needs two instants
            return None
        if silent_ns is None or silent_ns > 2 * _OVER_NS:
            return 0.0
        (first_ns, first_seq), (last_ns, last_seq) = self._noted[0], self._noted[-1]
        if last_ns <= first_ns:
            return None
        rate_hz = (last_seq - first_seq) / ((last_ns - first_ns) * 1e-9)
        return nominal_hz if nominal_hz < rate_hz < _JITTER * nominal_hz else rate_hz
