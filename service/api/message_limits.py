"""Limits on messages of websockets: how many, and how many at a time.

A subscriber sends a ping a second. Each frame that it sends, control frames and fragments too,
takes a token; a new connection takes several. There are three buckets of tokens: of the connection,
of its address, and of all subscribers together. A connection without tokens is closed. If address
or all have none, those are closed that have used a good part of their own, and newcomers are
refused: reconnecting gives nothing, and a page that sends little stays. A node is limited until
welcome, then for control frames only.

One read may have 43,000 frames. They are parsed in slices, so that others have their turn.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from uvicorn._types import ASGIReceiveEvent
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from service.api.settings import LimitSettings
from service.protocol.codec import LinkCloseCode

CONNECTION_TOKENS = 10
"""Tokens of a new connection: its handshake and hello cost more than a frame."""
CONNECTION_BURST_S = 60.0
"""Burst of a connection, in seconds of its rate; a page that wakes sends several pings."""
NODE_PINGS_PER_S, NODE_BURST_S = 40.0, 3.0
"""Rate and burst of a node: it measures its clock by pings, some ten a second."""
SHARED_BURST_S = 4.0
"""Burst of an address and of all; many pages come back at once after a restart."""
SLICE_FRAMES = 8
"""Frames that are parsed before others have their turn; a frame takes 40 us."""
FRAGMENTS_MAX = 128
"""Limit of fragments of a message; neither nodes nor browsers send any."""
_REFUSED_BURST_S = 4.0
_SPARED_PART = 0.75
_ADDRESSES_MAX = 1024
_LINGER_S = 1.0
"""Time to read the reason before the connection is reset."""
_HEAD_BYTES = 2
_MASK_BYTES = 4
_LENGTH_BYTES = {126: 2, 127: 8}
_CONTROL_BIT, _FINAL_BIT = 0x08, 0x80


class TokenBucket:
    """Tokens that come at a rate, up to a burst; full at first.

    Args:
        rate_hz: tokens a second.
        burst_s: time in which it fills.
        now_s: present time, as of `refill`.
    """

    def __init__(self, rate_hz: float, burst_s: float, now_s: float) -> None:
        self._rate_hz = rate_hz
        self.burst = self.tokens = rate_hz * burst_s
        self._refilled_s = now_s

    def refill(self, now_s: float) -> None:
        """Add the tokens of the time since the last call."""
        came = (now_s - self._refilled_s) * self._rate_hz
        self.tokens = min(self.burst, self.tokens + came)
        self._refilled_s = now_s

    def take(self, count: int) -> None:
        """Take tokens, down to none."""
        self.tokens = max(0.0, self.tokens - count)

    @property
    def is_little_used(self) -> bool:
        """True if most of the burst is there."""
        return self.tokens >= _SPARED_PART * self.burst


class Allowance:
    """Allowance of one connection, a subscriber or a node.

    Args:
        own: its bucket.
        shared: buckets of its address and of all; None: a node, or a refused subscriber.
        clock: present time in seconds.
    """

    def __init__(
        self,
        own: TokenBucket,
        shared: tuple[TokenBucket, TokenBucket] | None,
        clock: Callable[[], float],
    ) -> None:
        self._own = own
        self._shared = shared
        self._clock = clock

    def take_frame(self) -> bool:
        """Take the tokens of a frame; False: the connection has to be closed."""
        now_s = self._clock()
        self._own.refill(now_s)
        if self._own.tokens < 1:
            return False
        self._own.take(1)
        if self._shared is None:
            return True
        has_shared = take_shared(self._shared, 1, now_s)
        return has_shared or self._own.is_little_used


def take_shared(shared: tuple[TokenBucket, TokenBucket], count: int, now_s: float) -> bool:
    """Take tokens of an address and of all; False: too few, and the address has used many."""
    address, everyone = shared
    address.refill(now_s)
    everyone.refill(now_s)
    has_tokens = address.tokens >= count and (everyone.tokens >= count or address.is_little_used)
    address.take(count)
    everyone.take(count)
    return has_tokens


class MessageLimiter:
    """Buckets of one server; used from one event loop.

    Args:
        limits: rates, as settings.
        clock: present time in seconds.
    """

    def __init__(self, limits: LimitSettings, clock: Callable[[], float] = time.monotonic) -> None:
        self._limits = limits
        self._clock = clock
        self._everyone = TokenBucket(limits.max_messages_per_s_in_all, SHARED_BURST_S, clock())
        self._addresses: dict[str, TokenBucket] = {}

    def make_node_allowance(self) -> Allowance:
        """Return the allowance of a node."""
        own = TokenBucket(NODE_PINGS_PER_S, NODE_BURST_S, self._clock())
        return Allowance(own, None, self._clock)

    def make_refused_allowance(self) -> Allowance:
        """Return the allowance of a connection that is refused: it has to answer a close frame."""
        return Allowance(self._make_own(_REFUSED_BURST_S), None, self._clock)

    def admit_subscriber(self, address: str) -> Allowance | None:
        """Return the allowance of a new subscriber; None: refuse it."""
        now_s = self._clock()
        shared = (self._find_address(address, now_s), self._everyone)
        if not take_shared(shared, CONNECTION_TOKENS, now_s):
            return None
        return Allowance(self._make_own(CONNECTION_BURST_S), shared, self._clock)

    def _make_own(self, burst_s: float) -> TokenBucket:
        return TokenBucket(self._limits.max_messages_per_s, burst_s, self._clock())

    def _find_address(self, address: str, now_s: float) -> TokenBucket:
        if address not in self._addresses:
            if len(self._addresses) >= _ADDRESSES_MAX:
                # A full bucket is as good as a new one. Were there none, the fullest goes.
                for bucket in self._addresses.values():
                    bucket.refill(now_s)
                fullest = sorted(self._addresses, key=lambda each: self._addresses[each].tokens)
                for each in fullest[_ADDRESSES_MAX // 2 :]:
                    del self._addresses[each]
            self._addresses[address] = TokenBucket(
                self._limits.max_messages_per_s_per_address, SHARED_BURST_S, now_s
            )
        return self._addresses[address]


def find_frame_size(content: bytearray) -> int | None:
    """Return the size of the frame that begins here; None: its head is incomplete."""
    if len(content) < _HEAD_BYTES:
        return None
    is_masked, payload_bytes = divmod(content[1], 0x80)
    head_bytes = _HEAD_BYTES + _LENGTH_BYTES.get(payload_bytes, 0)
    if len(content) < head_bytes:
        return None
    if head_bytes > _HEAD_BYTES:
        payload_bytes = int.from_bytes(content[_HEAD_BYTES:head_bytes])
    return head_bytes + is_masked * _MASK_BYTES + payload_bytes


class SlicedWebSocket(WebSocketsSansIOProtocol):
    """Websocket of uvicorn that parses a few frames at a time, as many as are allowed."""

    allowance: Allowance
    """Set with the handshake."""
    has_free_messages = False
    """True for a node after welcome: only its control frames take tokens."""
    _is_flooding = False
    _fragments = 0
    _frame_bytes_left = 0
    _turn: asyncio.Handle | None = None

    def data_received(self, data: bytes) -> None:
        """Parse bytes, or keep them for the next turn."""
        if not self.handshake_initiated:
            self._unparsed = bytearray()
            super().data_received(data)  # the request, and nothing else
        elif not self._is_flooding:
            self._unparsed += data
            if self._turn is None:
                self._parse_slice()

    def _parse_slice(self) -> None:
        self._turn = None
        for _ in range(SLICE_FRAMES):
            if self.transport.is_closing() or self._is_flooding:
                self._unparsed.clear()
                return
            if self._frame_bytes_left == 0:
                size = find_frame_size(self._unparsed)
                if size is not None and not self._take_frame(self._unparsed[0]):
                    self._close_flood()
                    return
                self._frame_bytes_left = size or 0
            piece = bytes(self._unparsed[: self._frame_bytes_left])
            if not piece:  # the rest has not come
                self._resume_reading()
                return
            del self._unparsed[: len(piece)]
            self._frame_bytes_left -= len(piece)
            super().data_received(piece)
        self._turn = self.loop.call_soon(self._parse_slice)
        self._pause_reading()

    def _take_frame(self, first_byte: int) -> bool:
        """Count a frame; False: there are too many."""
        if first_byte & _CONTROL_BIT:
            return self.allowance.take_frame()
        self._fragments = 0 if first_byte & _FINAL_BIT else self._fragments + 1
        if self._fragments > FRAGMENTS_MAX:
            return False
        return self.has_free_messages or self.allowance.take_frame()

    def _pause_reading(self) -> None:
        if not self.read_paused:
            self.read_paused = True
            self.transport.pause_reading()

    def _resume_reading(self) -> None:
        if self.read_paused and self.queue.empty():
            self.read_paused = False
            self.transport.resume_reading()

    def _close_flood(self) -> None:
        """Close with a reason, and read nothing more."""
        self._is_flooding = True
        self._unparsed.clear()
        if self.close_sent or not self.handshake_complete:
            self.transport.abort()
            return
        self.close_now(LinkCloseCode.POLICY, "this client sends too many messages")
        self.transport.pause_reading()
        if self.close_timer is not None:
            self.close_timer.cancel()
        self.close_timer = self.loop.call_later(_LINGER_S, self.transport.abort)
        self.queue.put_nowait({"type": "websocket.disconnect", "code": LinkCloseCode.POLICY})

    def close_now(self, code: int, reason: str) -> None:
        """Close with a reason without waiting for room, behind all earlier writes.

        Until the peer has answered, or for `close_timeout`, the connection stays open and received
        data is ignored: closing earlier would be a reset, which discards the reason.
        """
        if not (self.close_sent or self.disconnected or self.transport.is_closing()):
            self.conn.send_close(code, reason)
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.close_sent = True
            if self.read_paused:
                self.read_paused = False
                self.transport.resume_reading()
            self.close_timer = self.loop.call_later(self.close_timeout, self.transport.close)

    async def receive(self) -> ASGIReceiveEvent:
        """Return a message; uvicorn then reads on, even if received bytes still wait."""
        event = await super().receive()
        if self._turn is not None and not self.transport.is_closing():
            self._pause_reading()
        return event
