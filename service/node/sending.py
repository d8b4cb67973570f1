"""Sender of frames to a server: the newest first, then the backlog of missing older ones.

Flow control (`service.node.flow`) bounds the bytes in flight to a part of a second. Answers to
interleaved pings show how much the server has read.
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
from service.link import FramesOf, Hello, Status, Wanted, Welcome, say, with_check
from service.node.flow import Flow
from storage.intervals import NO_END, Intervals, closed, union
from storage.journal.node.stream import NodeStream
from storage.wire import EncodedBatch

_ASK_EVERY_S = 0.5
"""Interval of pings on an idle link, to detect its loss."""
_NO_ANSWER_S = 4.0
"""Timeout of a ping, after which the link counts as half open."""
_LIVE_BEHIND_S = 0.5
"""Age from which unsent new frames are moved to the backlog."""
_CHUNK_FRAMES = 512
"""Frames of the backlog read at once, about a second; then newer frames have priority."""
_READ_AGAIN_S = 0.2
"""Delay before frames that were not found are read again."""


@dataclass(frozen=True)
class Source:
    """Callbacks of the node for its link.

    Attributes:
        present: returns the present stream.
        streams: returns all streams of the node, by boot_id.
        hello: describes them for a new connection.
        secret: returns the secret shared with a server, by the server's id; created and stored at
            first contact. None if it cannot be stored.
        status: returns the node's status, given the number of frames in the backlog.
        wanted: receives a server's retention request, and the streams announced to the server.
        damaged: receives frames found damaged on disk.
    """

    present: Callable[[], NodeStream]
    streams: Callable[[], Mapping[str, NodeStream]]
    hello: Callable[[], Hello]
    secret: Callable[[str], str | None]
    status: Callable[[int], Status]
    wanted: Callable[[str, Wanted, tuple[str, ...]], None]
    damaged: Callable[[NodeStream, Intervals], None]


@dataclass(frozen=True)
class Greeted:
    """Connection after its handshake.

    Attributes:
        socket: the connection.
        source: callbacks of the node.
        server_id: id of the server's data folder.
        hello: the node's hello.
        welcome: the server's answer.
        wake: set whenever there may be frames to send.
    """

    socket: ClientConnection
    source: Source
    server_id: str
    hello: Hello
    welcome: Welcome
    wake: asyncio.Event


class Sending:
    """Sender of a node's frames over one connection."""

    def __init__(self, link: Greeted) -> None:
        self._link = link
        self._flow = Flow()
        self._asked: dict[int, float] = {}
        """Unanswered pings, with the times at which they were sent."""
        self._numbers = count()
        self.backlog = Backlog(
            # In the server's order: frames of sessions first.
            (lacks.boot_id, _before(pair, link.hello, lacks.boot_id))
            for lacks in link.welcome.lacks
            for pair in lacks.numbers
        )
        """Older frames still to be sent."""
        self._not_found: tuple[str, int, int] | None = None
        """Range of the last read that found no frames."""

    async def run(self) -> None:
        """Send new frames as they come, and in between the backlog, until cancelled."""
        present, hello = self._link.source.present(), self._link.hello
        at = hello.next_seq
        behind_frames = max(1, round(_LIVE_BEHIND_S * hello.array_info.nominal_rate_hz))
        chunk: deque[tuple[str, EncodedBatch]] = deque()
        named = hello.array_info.boot_id
        reading: asyncio.Task[list[tuple[str, EncodedBatch]]] | None = None
        while True:
            self._link.wake.clear()  # frames that come while sending are sent in the next round
            if not self._flow.is_open:
                await self._link.wake.wait()
                continue
            newest = present.recent(at)
            if newest:
                # Skip frames that waited too long, but not because of one long batch.
                late = newest[-1].seq_last - behind_frames
                batch = next((b for b in newest if b.seq_first > late), newest[-1])
                if batch.seq_first > at:
                    self.backlog.add(present.boot_id, at, batch.seq_first - 1)
                boot_id, at = present.boot_id, batch.seq_last + 1
            elif chunk:
                boot_id, batch = chunk.popleft()
            else:
                # A read may take long while the card is being written.
                if reading is None and self.backlog.count:
                    chunk_of = asyncio.to_thread(self._next_chunk)
                    reading = asyncio.create_task(chunk_of)
                    reading.add_done_callback(lambda _: self._link.wake.set())
                elif reading is not None and reading.done():
                    chunk += reading.result()
                    reading = None
                else:
                    await self._link.wake.wait()
                continue
            if boot_id != named:
                named = boot_id
                await self._link.socket.send(say(FramesOf(boot_id=boot_id)))
            await self._link.socket.send(with_check(batch.payload))
            self._flow.sent(len(batch.payload))
            if self._flow.wants_mark:
                await self.ask()

    async def watch(self) -> None:
        """Send pings at intervals; raise `LinkError` if the server does not answer in time."""
        while True:
            oldest_s = next(iter(self._asked.values()), None)
            if oldest_s is not None and time.monotonic() - oldest_s > _NO_ANSWER_S:
                raise LinkError(f"the server has not answered for {_NO_ANSWER_S:g} s")
            await self.ask()
            await asyncio.sleep(_ASK_EVERY_S)

    async def ask(self) -> None:
        """Send a ping; its answer shows that all frames sent before were read."""
        number, flow = next(self._numbers), self._flow
        asked = self._asked
        asked[number] = time.monotonic()
        flow.mark(number)

        def answered(answer: asyncio.Future[float]) -> None:
            asked.pop(number, None)
            if not answer.cancelled() and answer.exception() is None:
                flow.answered(number, time.monotonic())
                self._link.wake.set()

        asyncio.ensure_future(await self._link.socket.ping()).add_done_callback(answered)

    def _next_chunk(self) -> list[tuple[str, EncodedBatch]]:
        """Read the next batches of the backlog, from memory or disk."""
        backlog = self.backlog
        wanted = backlog.next(_CHUNK_FRAMES)
        if wanted is None:
            return []
        boot_id, first, last = wanted
        stream = self._link.source.streams().get(boot_id)
        found: list[EncodedBatch] = []
        done = asked = Intervals([(first, last)])
        if stream is not None:
            has_failed, damaged = False, Intervals()
            try:
                found.extend(stream.batches(first, last))
            except DamagedFramesError as error:
                damaged = Intervals([(error.seq_first, error.seq_last)])
                self._link.source.damaged(stream, damaged)
            except StorageError:
                has_failed = True
            # Frames not held were evicted meanwhile, and counted; held ones may be on the way from
            # memory to disk, and are read again. Whole batches are sent, which may exceed the
            # requested range.
            done = union(batch.numbers for batch in found) | damaged | (asked - stream.held)
            if not asked & done:
                time.sleep(_READ_AGAIN_S)
                if not has_failed and wanted == self._not_found:  # its index may be damaged
                    done = asked
                self._not_found = wanted
        for numbers in done:
            backlog.done(boot_id, *numbers)
        return [(boot_id, batch) for batch in found]


def _before(pair: tuple[int, int | None], hello: Hello, boot_id: str) -> Intervals:
    """Return the missing frames from before hello; newer ones are sent anyway."""
    newest = hello.next_seq - 1 if boot_id == hello.array_info.boot_id else NO_END
    return closed([pair]).within(0, newest)


class Backlog:
    """Backlog of frames to be sent after the newest ones. Thread-safe.

    The event loop adds frames while a thread reads the next ones and removes them.

    Args:
        lacks: streams and their missing frames, most urgent first; streams may repeat.
    """

    def __init__(self, lacks: Iterable[tuple[str, Intervals]] = ()) -> None:
        self._lacks = [(boot_id, numbers) for boot_id, numbers in lacks if numbers]
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """Number of frames in the backlog."""
        streams: dict[str, Intervals] = {}
        with self._lock:
            for boot_id, numbers in self._lacks:
                streams[boot_id] = numbers | streams.get(boot_id, Intervals())
        return sum(numbers.count for numbers in streams.values())

    def add(self, boot_id: str, first: int, last: int) -> None:
        """Add frames that could not be sent when they were new."""
        with self._lock:
            for stream, numbers in self._lacks:
                if stream == boot_id:
                    numbers.add(first, last)
                    return
            self._lacks.append((boot_id, Intervals([(first, last)])))

    def next(self, frames_max: int) -> tuple[str, int, int] | None:
        """Return stream, first and last number of the next frames to send; None if empty."""
        with self._lock:
            for boot_id, numbers in self._lacks:
                for first, last in numbers:
                    return boot_id, first, min(last, first + frames_max - 1)
        return None

    def done(self, boot_id: str, first: int, last: int) -> None:
        """Remove frames that are sent or cannot be read."""
        gone = Intervals([(first, last)])
        with self._lock:
            left = [(s, n - gone if s == boot_id else n) for s, n in self._lacks]
            self._lacks = [(stream, numbers) for stream, numbers in left if numbers]
