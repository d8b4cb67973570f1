"""Frames on their way to a server: the newest first, and what it lacks of the past behind them.

Never more is under way than passes in part of a second (`service.node.flow`); how much has passed
is known by the answers to pings that are sent in between.
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
"""Asked even if nothing is sent, so that silence means something."""
_NO_ANSWER_S = 4.0
"""A link on which nothing comes back for this long is half open."""
_LIVE_BEHIND_S = 0.5
"""Frames that wait longer to be sent are overtaken by newer ones."""
_CHUNK_FRAMES = 512
"""A second or so of the past is read at once; then newer frames have their turn."""
_READ_AGAIN_S = 0.2
"""After what was to be read was deleted meanwhile."""


@dataclass(frozen=True)
class Source:
    """The node, as far as its link uses it.

    Attributes:
        present: the stream that is being taken.
        streams: all streams that the node has, by boot_id.
        hello: describes them; asked for at every connection.
        secret: the one that it shares with a server, by the server's id; made and kept on the disk
            at first contact. None if the disk does not keep it.
        status: what the node counts; is given how many frames are behind.
        wanted: called with what the server's sessions need, and the streams that it knows.
        damaged: called with frames that turned out to be damaged on disk.
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
    """A connection on which both sides have greeted each other.

    Attributes:
        socket: the connection.
        source: the node.
        server_id: name of the server's data folder.
        hello: what it has said.
        welcome: what the server has answered.
        wake: set whenever there may be something to send.
    """

    socket: ClientConnection
    source: Source
    server_id: str
    hello: Hello
    welcome: Welcome
    wake: asyncio.Event


class Sending:
    """Sends the frames of a node over one connection."""

    def __init__(self, link: Greeted) -> None:
        self._link = link
        self._flow = Flow()
        self._asked: dict[int, float] = {}
        """Questions that were not answered yet, and when they were asked."""
        self._numbers = count()
        self.backlog = Backlog(
            # In the server's order: what sessions need comes first.
            (lacks.boot_id, _before(pair, link.hello, lacks.boot_id))
            for lacks in link.welcome.lacks
            for pair in lacks.numbers
        )
        """What is still to be sent of the past."""
        self._not_found: tuple[str, int, int] | None = None
        """What was looked for last in vain."""

    async def run(self) -> None:
        """The newest frames as they come, and behind them what the server lacks."""
        present, hello = self._link.source.present(), self._link.hello
        at = hello.next_seq
        behind_frames = max(1, round(_LIVE_BEHIND_S * hello.array_info.nominal_rate_hz))
        chunk: deque[tuple[str, EncodedBatch]] = deque()
        named = hello.array_info.boot_id
        reading: asyncio.Task[list[tuple[str, EncodedBatch]]] | None = None
        while True:
            self._link.wake.clear()  # what comes while sending is seen in the next round
            if not self._flow.is_open:
                await self._link.wake.wait()
                continue
            newest = present.recent(at)
            if newest:
                # Overtake frames that waited too long; a long batch alone is no reason.
                late = newest[-1].seq_last - behind_frames
                batch = next((b for b in newest if b.seq_first > late), newest[-1])
                if batch.seq_first > at:
                    self.backlog.add(present.boot_id, at, batch.seq_first - 1)
                boot_id, at = present.boot_id, batch.seq_last + 1
            elif chunk:
                boot_id, batch = chunk.popleft()
            else:
                # Reading may take long, beside a card that is being written.
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
        """Ask now and then whether the server is there: a link that is half open is noticed."""
        while True:
            oldest_s = next(iter(self._asked.values()), None)
            if oldest_s is not None and time.monotonic() - oldest_s > _NO_ANSWER_S:
                raise LinkError(f"the server has not answered for {_NO_ANSWER_S:g} s")
            await self.ask()
            await asyncio.sleep(_ASK_EVERY_S)

    async def ask(self) -> None:
        """Mark what was sent so far; the answer says that it was read."""
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
        """Batches of the backlog, read from where they are."""
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
            # What is not held was evicted meanwhile, and counted; what still is may be on its way
            # between disk and memory, and is looked for again. Batches are sent whole, and may
            # reach further than what was asked for.
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
    """Missing frames taken before hello; newer frames of the present stream follow anyway."""
    newest = hello.next_seq - 1 if boot_id == hello.array_info.boot_id else NO_END
    return closed([pair]).within(0, newest)


class Backlog:
    """Numbers still to be sent behind the newest ones.

    The loop adds to it while a thread reads what is next and takes off what is done.

    Args:
        lacks: streams and their numbers, most urgent first; a stream may come more than once.
    """

    def __init__(self, lacks: Iterable[tuple[str, Intervals]] = ()) -> None:
        self._lacks = [(boot_id, numbers) for boot_id, numbers in lacks if numbers]
        self._lock = threading.Lock()

    @property
    def count(self) -> int:
        """How many frames."""
        streams: dict[str, Intervals] = {}
        with self._lock:
            for boot_id, numbers in self._lacks:
                streams[boot_id] = numbers | streams.get(boot_id, Intervals())
        return sum(numbers.count for numbers in streams.values())

    def add(self, boot_id: str, first: int, last: int) -> None:
        """These frames could not be sent when they were new."""
        with self._lock:
            for stream, numbers in self._lacks:
                if stream == boot_id:
                    numbers.add(first, last)
                    return
            self._lacks.append((boot_id, Intervals([(first, last)])))

    def next(self, frames_max: int) -> tuple[str, int, int] | None:
        """Stream, first and last number of what is to be sent next; None: there is nothing."""
        with self._lock:
            for boot_id, numbers in self._lacks:
                for first, last in numbers:
                    return boot_id, first, min(last, first + frames_max - 1)
        return None

    def done(self, boot_id: str, first: int, last: int) -> None:
        """These are sent, or cannot be."""
        gone = Intervals([(first, last)])
        with self._lock:
            left = [(s, n - gone if s == boot_id else n) for s, n in self._lacks]
            self._lacks = [(stream, numbers) for stream, numbers in left if numbers]
