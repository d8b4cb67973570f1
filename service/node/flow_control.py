"""Flow control of a link: a limit of the bytes in flight, so that the newest frames wait briefly.

A message is in flight until the answer to a later ping shows that it was read. The throughput gives
the bytes that the link transfers in `WINDOW_S`, and no more are sent ahead: a slow link has half a
second of frames in its buffers, not a minute. Pure arithmetic; the sender reports events and times.
"""

from __future__ import annotations

from collections import deque

WINDOW_S = 0.4
"""Transfer time of a full window: the longest wait of the newest frame."""
WINDOW_MIN_BYTES = 32 << 10
"""Smallest window, about half a second of four tiles; with less, a link with a long delay would
idle."""
WINDOW_MAX_BYTES = 8 << 20
"""Largest window, more than any link needs in `WINDOW_S`; bounds memory."""
_THROUGHPUT_OVER_S = 1.0
"""Time over which throughput is measured."""
_PINGS_PER_WINDOW = 8
"""Number of pings in flight in a full window."""


class SendWindow:
    """Send window of one connection."""

    def __init__(self) -> None:
        self._sent = 0
        self._pings: deque[tuple[int, int]] = deque()
        self._read_bytes = 0
        self._history: deque[tuple[float, int]] = deque()
        self.window_bytes = WINDOW_MIN_BYTES
        """Limit of the bytes in flight."""

    @property
    def in_flight_bytes(self) -> int:
        """Bytes sent and not yet known to be read."""
        return self._sent - self._read_bytes

    @property
    def is_open(self) -> bool:
        """True if more may be sent."""
        return self.in_flight_bytes < self.window_bytes

    @property
    def is_ping_due(self) -> bool:
        """True if a ping is due; several per window, so that it opens gradually."""
        marked = self._pings[-1][1] if self._pings else self._read_bytes
        return self._sent - marked >= self.window_bytes / _PINGS_PER_WINDOW

    def add_sent_bytes(self, length: int) -> None:
        """Add a sent message of `length` bytes."""
        self._sent += length

    def record_ping(self, number: int) -> None:
        """Record a ping behind all bytes sent before; `answered` takes its answer."""
        self._pings.append((number, self._sent))

    def record_ping_answer(self, number: int, now_s: float) -> None:
        """Update the window with a ping's answer: the other side has read all bytes before it.

        Args:
            number: number of the ping; unknown numbers have no effect.
            now_s: instant of a monotonic clock.
        """
        while self._pings and self._pings[0][0] <= number:
            self._read_bytes = self._pings.popleft()[1]
        self._history.append((now_s, self._read_bytes))
        while len(self._history) > 2 and now_s - self._history[1][0] > _THROUGHPUT_OVER_S:
            self._history.popleft()
        (begin_s, before), (end_s, after) = self._history[0], self._history[-1]
        if end_s - begin_s > 0:
            # The window grows until the link is saturated, and then stays at `WINDOW_S` of it.

            pace = (after - before) / (end_s - begin_s)
            self.window_bytes = round(min(max(pace * WINDOW_S, WINDOW_MIN_BYTES), WINDOW_MAX_BYTES))
