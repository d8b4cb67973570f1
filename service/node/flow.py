"""Flow control of a link: a limit of the bytes in flight, so that the newest frames wait briefly.

A message is in flight until the answer to a later ping shows that it was read. The throughput gives
the bytes that the link transfers in `QUEUE_S`, and no more are sent ahead: a slow link has half a
second of frames in its buffers, not a minute. Pure arithmetic; the sender reports events and times.
"""

from __future__ import annotations

from collections import deque

QUEUE_S = 0.4
"""Transfer time of a full window: the longest wait of the newest frame."""
LEAST_BYTES = 32 << 10
"""Smallest window, about half a second of four tiles; with less, a link with a long delay would
idle."""
MOST_BYTES = 8 << 20
"""Largest window, more than any link needs in `QUEUE_S`; bounds memory."""
_PACE_OVER_S = 1.0
"""Time over which throughput is measured."""
_PIECES = 8
"""Number of pings in flight in a full window."""


class Flow:
    """Send window of one connection."""

    def __init__(self) -> None:
        self._sent = 0
        self._marks: deque[tuple[int, int]] = deque()
        self._passed = 0
        self._history: deque[tuple[float, int]] = deque()
        self.window_bytes = LEAST_BYTES
        """Limit of the bytes in flight."""

    @property
    def under_way_bytes(self) -> int:
        """Bytes sent and not yet known to be read."""
        return self._sent - self._passed

    @property
    def is_open(self) -> bool:
        """True if more may be sent."""
        return self.under_way_bytes < self.window_bytes

    @property
    def wants_mark(self) -> bool:
        """True if a ping is due; several per window, so that it opens gradually."""
        marked = self._marks[-1][1] if self._marks else self._passed
        return self._sent - marked >= self.window_bytes / _PIECES

    def sent(self, length: int) -> None:
        """Add a sent message of `length` bytes."""
        self._sent += length

    def mark(self, number: int) -> None:
        """Record a ping behind all bytes sent before; `answered` takes its answer."""
        self._marks.append((number, self._sent))

    def answered(self, number: int, now_s: float) -> None:
        """Update the window with a ping's answer: the other side has read all bytes before it.

        Args:
            number: number of the ping; unknown numbers have no effect.
            now_s: instant of a monotonic clock.
        """
        while self._marks and self._marks[0][0] <= number:
            self._passed = self._marks.popleft()[1]
        self._history.append((now_s, self._passed))
        while len(self._history) > 2 and now_s - self._history[1][0] > _PACE_OVER_S:
            self._history.popleft()
        (begin_s, before), (end_s, after) = self._history[0], self._history[-1]
        if end_s - begin_s > 0:
            # The window grows until the link is saturated, and then stays at `QUEUE_S` of it.

            pace = (after - before) / (end_s - begin_s)
            self.window_bytes = round(min(max(pace * QUEUE_S, LEAST_BYTES), MOST_BYTES))
