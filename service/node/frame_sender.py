"""Sender of frames to a server: the newest first, then the backlog of missing older ones.

Flow control bounds the bytes in flight to a part of a second. Answers to interleaved pings show how
much the server has read.

A message is in flight until the answer to a later ping shows that it was read. The throughput gives
the bytes that the link transfers in `WINDOW_S`, and no more are sent ahead: a slow link has half a
second of frames in its buffers, not a minute. Pure arithmetic; the sender reports events and times.
"""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from itertools import count

from websockets.asyncio.client import ClientConnection

from devices.errors import DamagedFramesError, LinkError, StorageError
from service.protocol.codec import append_crc, encode_link_message
from service.protocol.link import Hello, NodeStatus, RetentionMessage, StreamSelect, Welcome
from storage.intervals import NO_END, Intervals, intervals_from_inclusive_pairs, union
from storage.journal.node.stream import NodeStream
from storage.wire import EncodedBatch

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
        """Record a ping behind all bytes sent before, until `record_ping_answer`."""
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


_PING_INTERVAL_S = 0.5
"""Interval of pings on an idle link, to detect its loss."""
_PING_TIMEOUT_S = 4.0
"""Timeout of a ping, after which the link counts as half open."""
_LIVE_BEHIND_S = 0.5
"""Age from which unsent new frames are moved to the backlog."""
_CHUNK_FRAMES = 512
"""Frames of the backlog read at once, about a second; then newer frames have priority."""
_REREAD_DELAY_S = 0.2
"""Delay before frames that were not found are read again."""


@dataclass(frozen=True)
class NodeCallbacks:
    """Callbacks of the node for its link.

    Attributes:
        get_present_stream: returns the present stream.
        get_streams: returns all streams of the node, by stream_id.
        make_hello: describes them for a new connection.
        get_secret: returns the secret shared with a server, by the server's id; created and stored
            at first contact. None if it cannot be stored.
        make_status: returns the node's status, given the number of frames in the backlog.
        on_retention_request: receives a server's retention request, and the streams announced to
            the server.
        on_damaged_frames: receives frames found damaged on disk.
    """

    get_present_stream: Callable[[], NodeStream]
    get_streams: Callable[[], Mapping[str, NodeStream]]
    make_hello: Callable[[], Hello]
    get_secret: Callable[[str], str | None]
    make_status: Callable[[int], NodeStatus]
    on_retention_request: Callable[[str, RetentionMessage, tuple[str, ...]], None]
    on_damaged_frames: Callable[[NodeStream, Intervals], None]


@dataclass(frozen=True)
class EstablishedLink:
    """Connection after its handshake.

    Attributes:
        socket: the connection.
        callbacks: callbacks of the node.
        server_id: id of the server's data folder.
        hello: the node's hello.
        welcome: the server's answer.
        wake_sender: set whenever there may be frames to send.
    """

    socket: ClientConnection
    callbacks: NodeCallbacks
    server_id: str
    hello: Hello
    welcome: Welcome
    wake_sender: asyncio.Event


class FrameSender:
    """Sender of a node's frames over one connection."""

    def __init__(self, link: EstablishedLink) -> None:
        self._link = link
        self._window = SendWindow()
        self._pending_pings: dict[int, float] = {}
        """Unanswered pings, with the times at which they were sent."""
        self._ping_numbers = count()
        self.backlog = Backlog(
            # In the server's order: frames of sessions first.
            (lacks.stream_id, _missing_before_hello(pair, link.hello, lacks.stream_id))
            for lacks in link.welcome.missing
            for pair in lacks.numbers
        )
        """Older frames still to be sent."""
        self._last_missing_range: tuple[str, int, int] | None = None
        """Range of the last read that found no frames."""

    async def send_frames(self) -> None:
        """Send new frames as they come, and in between the backlog, until cancelled."""
        present, hello = self._link.callbacks.get_present_stream(), self._link.hello
        at = hello.next_seq
        behind_frames = max(1, round(_LIVE_BEHIND_S * hello.array_info.nominal_rate_hz))
        chunk: deque[tuple[str, EncodedBatch]] = deque()
        named = hello.array_info.stream_id
        reading: asyncio.Task[list[tuple[str, EncodedBatch]]] | None = None
        while True:
            self._link.wake_sender.clear()  # later frames are sent in the next round
            if not self._window.is_open:
                await self._link.wake_sender.wait()
                continue
            newest = present.recent_batches(at)
            if newest:
                # Skip frames that waited too long, but not because of one long batch.
                late = newest[-1].seq_last - behind_frames
                batch = next((b for b in newest if b.seq_first > late), newest[-1])
                if batch.seq_first > at:
                    self.backlog.add_frames(present.stream_id, at, batch.seq_first - 1)
                stream_id, at = present.stream_id, batch.seq_last + 1
            elif chunk:
                stream_id, batch = chunk.popleft()
            else:
                # A read may take long while the card is being written.
                if reading is None and self.backlog.frame_count:
                    chunk_of = asyncio.to_thread(self._read_next_chunk)
                    reading = asyncio.create_task(chunk_of)
                    reading.add_done_callback(lambda _: self._link.wake_sender.set())
                elif reading is not None and reading.done():
                    chunk += reading.result()
                    reading = None
                else:
                    await self._link.wake_sender.wait()
                continue
            if stream_id != named:
                named = stream_id
                await self._link.socket.send(encode_link_message(StreamSelect(stream_id=stream_id)))
            await self._link.socket.send(append_crc(batch.payload))
            self._window.add_sent_bytes(len(batch.payload))
            if self._window.is_ping_due:
                await self.send_ping()

    async def ping_until_timeout(self) -> None:
        """Send pings at intervals; raise `LinkError` if the server does not answer in time."""
        while True:
            oldest_s = next(iter(self._pending_pings.values()), None)
            if oldest_s is not None and time.monotonic() - oldest_s > _PING_TIMEOUT_S:
                raise LinkError(f"the server has not answered for {_PING_TIMEOUT_S:g} s")
            await self.send_ping()
            await asyncio.sleep(_PING_INTERVAL_S)

    async def send_ping(self) -> None:
        """Send a ping; its answer shows that all frames sent before were read."""
        number, flow = next(self._ping_numbers), self._window
        requested = self._pending_pings
        requested[number] = time.monotonic()
        flow.record_ping(number)

        def on_pong(answer: asyncio.Future[float]) -> None:
            requested.pop(number, None)
            if not answer.cancelled() and answer.exception() is None:
                flow.record_ping_answer(number, time.monotonic())
                self._link.wake_sender.set()

        asyncio.ensure_future(await self._link.socket.ping()).add_done_callback(on_pong)

    def _read_next_chunk(self) -> list[tuple[str, EncodedBatch]]:
        """Read the next batches of the backlog, from memory or disk."""
        backlog = self.backlog
        wanted = backlog.get_next_range(_CHUNK_FRAMES)
        if wanted is None:
            return []
        stream_id, first, last = wanted
        stream = self._link.callbacks.get_streams().get(stream_id)
        found: list[EncodedBatch] = []
        done = requested = Intervals([(first, last)])
        if stream is not None:
            has_failed, damaged = False, Intervals()
            try:
                found.extend(stream.read_overlapping_batches(first, last))
            except DamagedFramesError as error:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                self._link.callbacks.on_damaged_frames(stream, damaged)
            except StorageError:
                has_failed = True
            # Frames not held were evicted meanwhile, and counted; held ones may be on the way from
            # memory to disk, and are read again. Whole batches are sent, which may exceed the
            # requested range.
            done = (
                union(batch.numbers for batch in found) | damaged | (requested - stream.available)
            )
            if not requested & done:
                time.sleep(_REREAD_DELAY_S)
                if (
                    not has_failed and wanted == self._last_missing_range
                ):  # its index may be damaged
                    done = requested
                self._last_missing_range = wanted
        for numbers in done:
            backlog.remove_frames(stream_id, *numbers)
        return [(stream_id, batch) for batch in found]


def _missing_before_hello(pair: tuple[int, int | None], hello: Hello, stream_id: str) -> Intervals:
    """Return the missing frames from before hello; newer ones are sent anyway."""
    newest = hello.next_seq - 1 if stream_id == hello.array_info.stream_id else NO_END
    return intervals_from_inclusive_pairs([pair]).restricted_to(0, newest)


class Backlog:
    """Backlog of frames to be sent after the newest ones. Thread-safe.

    The event loop adds frames while a thread reads the next ones and removes them.

    Args:
        missing_by_stream: streams and their missing frames, most urgent first; streams may repeat.
    """

    def __init__(self, missing_by_stream: Iterable[tuple[str, Intervals]] = ()) -> None:
        self._missing = [
            (stream_id, numbers) for stream_id, numbers in missing_by_stream if numbers
        ]
        self._lock = threading.Lock()

    @property
    def frame_count(self) -> int:
        """Number of frames in the backlog."""
        streams: dict[str, Intervals] = {}
        with self._lock:
            for stream_id, numbers in self._missing:
                streams[stream_id] = numbers | streams.get(stream_id, Intervals())
        return sum(numbers.number_count for numbers in streams.values())

    def add_frames(self, stream_id: str, first: int, last: int) -> None:
        """Add frames that could not be sent when they were new."""
        with self._lock:
            for stream, numbers in self._missing:
                if stream == stream_id:
                    numbers.add(first, last)
                    return
            self._missing.append((stream_id, Intervals([(first, last)])))

    def get_next_range(self, frames_max: int) -> tuple[str, int, int] | None:
        """Return stream, first and last number of the next frames to send; None if empty."""
        with self._lock:
            for stream_id, numbers in self._missing:
                for first, last in numbers:
                    return stream_id, first, min(last, first + frames_max - 1)
        return None

    def remove_frames(self, stream_id: str, first: int, last: int) -> None:
        """Remove frames that are sent or cannot be read."""
        gone = Intervals([(first, last)])
        with self._lock:
            left = [(s, n - gone if s == stream_id else n) for s, n in self._missing]
            self._missing = [(stream, numbers) for stream, numbers in left if numbers]
