"""How much may be under way on a link, so that what is newest never waits long behind the rest.

Every message counts as under way until an answer shows that the other side has read past it. From
the pace at which that happens follows how much the link carries in `QUEUE_S`, and no more than that
is sent ahead: a slow link has half a second of frames in its buffers, not a minute. Pure
arithmetic; the sender tells it what happened, and when.
"""

from __future__ import annotations

from collections import deque

QUEUE_S = 0.4
"""How long the bytes under way may take: the newest frame waits no longer than this."""
LEAST_BYTES = 32 << 10
"""Half a second or so of four tiles: with less, a link with a long delay would stand idle."""
MOST_BYTES = 8 << 20
"""More than any link needs in `QUEUE_S`; bounds memory."""
_PACE_OVER_S = 1.0
"""The pace is that of the last second: links change."""
_PIECES = 8
"""Number of questions that are under way in a full window."""


class Flow:
    """What is under way on one connection."""

    def __init__(self) -> None:
        self._sent = 0
        self._marks: deque[tuple[int, int]] = deque()
        self._passed = 0
        self._history: deque[tuple[float, int]] = deque()
        self.window_bytes = LEAST_BYTES
        """How much may be under way."""

    @property
    def under_way_bytes(self) -> int:
        """Sent, and not yet known to be read."""
        return self._sent - self._passed

    @property
    def is_open(self) -> bool:
        """May more be sent?"""
        return self.under_way_bytes < self.window_bytes

    @property
    def wants_mark(self) -> bool:
        """Is it time to ask? Often enough that room comes back piece by piece, not all at once."""
        marked = self._marks[-1][1] if self._marks else self._passed
        return self._sent - marked >= self.window_bytes / _PIECES

    def sent(self, length: int) -> None:
        """A message of so many bytes went out."""
        self._sent += length

    def mark(self, number: int) -> None:
        """A question went out behind what was sent so far; its answer is `answered`."""
        self._marks.append((number, self._sent))

    def answered(self, number: int, now_s: float) -> None:
        """The other side has answered a question: it has read all that went out before.

        Args:
            number: of the question; an unknown one tells nothing.
            now_s: an instant of a clock that never steps.
        """
        while self._marks and self._marks[0][0] <= number:
            self._passed = self._marks.popleft()[1]
        self._history.append((now_s, self._passed))
        while len(self._history) > 2 and now_s - self._history[1][0] > _PACE_OVER_S:
            self._history.popleft()
        (begin_s, before), (end_s, after) = self._history[0], self._history[-1]
        if end_s - begin_s > 0:
            # Twice what it needs would be a window that grows until the link is full, and then
            # holds `QUEUE_S` of what the link carries.
            pace = (after - before) / (end_s - begin_s)
            self.window_bytes = round(min(max(pace * QUEUE_S, LEAST_BYTES), MOST_BYTES))
