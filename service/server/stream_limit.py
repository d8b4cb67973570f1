"""Upper bounds for frames of a running stream: latest plausible time and number.

The bounds follow from hello, in which a node states its clock and its next number, and from the
server's clock, which counts suspend and never steps (`service.server_clock`). A node's clock gains
no more on it than `FAST`; it may fall behind, where the node was suspended. So neither a date that
was set nor an offset that the node measured changes them, and frames of the past are never beyond
them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from devices.frames import FrameBatch
from service.protocol import Hello
from storage.clock.bounds import DISCIPLINE_RATE_LIMIT
from storage.message_layout import MAX_MESSAGE_FRAMES

AHEAD_MAX_NS = 60_000_000_000
"""Tolerance: hello is some seconds old when it comes over a poor link, and a server may be busy."""
_RATE_TOLERANCE = 2.0
"""The nominal rate is the fastest that the schedule allows; no node is twice as fast."""


@dataclass(frozen=True)
class StreamLimit:
    """Upper bounds of one stream, from its last hello.

    Attributes:
        hello_t_ns: arrival time of hello, server's UTC.
        t_mono_ns: node's clock, as hello states it.
        next_seq: number of the next frame, as hello states it.
        rate_hz: nominal rate of the array.
    """

    hello_t_ns: int
    t_mono_ns: int
    next_seq: int
    rate_hz: float

    @classmethod
    def from_hello(cls, hello: Hello, now_t_ns: int) -> StreamLimit:
        """Return the limit for the present stream of a node, from its hello."""
        rate_hz = hello.array_info.nominal_rate_hz
        return cls(now_t_ns, hello.t_mono_ns, hello.next_seq, rate_hz)

    def describe_frames_ahead(self, frames: FrameBatch, now_t_ns: int) -> str:
        """Return why frames are ahead of time, as text; empty if they are plausible.

        Args:
            frames: of one message.
            now_t_ns: the server's UTC.
        """
        ahead_ns = int(frames.t_mono_ns.max()) - self._clock_ns(now_t_ns)
        if ahead_ns > self._tolerance_ns(now_t_ns):
            return f"they are dated {ahead_ns * 1e-9:.0f} s ahead of the node's clock"
        since_s = (now_t_ns - self.hello_t_ns + AHEAD_MAX_NS) * 1e-9
        possible = (
            self.next_seq + MAX_MESSAGE_FRAMES + math.ceil(_RATE_TOLERANCE * self.rate_hz * since_s)
        )
        if int(frames.seq[-1]) > possible:
            return f"by now no frame can have a number above {possible}"
        return ""

    def is_near_stated_clock(self, t_mono_ns: int, uncertainty_ns: int, now_t_ns: int) -> bool:
        """Return whether a time just measured is near the clock that hello stated, to either side.

        Args:
            t_mono_ns: the time, by the node's clock.
            uncertainty_ns: half the duration of the measurement.
            now_t_ns: the server's UTC.
        """
        off_ns = abs(t_mono_ns - self._clock_ns(now_t_ns))
        return off_ns <= self._tolerance_ns(now_t_ns) + uncertainty_ns

    def _clock_ns(self, now_t_ns: int) -> int:
        return self.t_mono_ns + now_t_ns - self.hello_t_ns

    def _tolerance_ns(self, now_t_ns: int) -> int:
        return AHEAD_MAX_NS + math.ceil(DISCIPLINE_RATE_LIMIT * abs(now_t_ns - self.hello_t_ns))
