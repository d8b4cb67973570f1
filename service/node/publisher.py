"""The node's end of the link: dials the server, gives it what it lacks, and never stops trying.

Newest frames go first, and what the server lacks of the past follows behind them, never more of it
under way than passes in part of a second (`service.node.flow`). Whatever breaks, the journal keeps
the frames, and the next connection takes up where the server says it left off.
"""

from __future__ import annotations

import asyncio
import random
import socket as sockets
import time
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from itertools import count
from typing import Any
from urllib.parse import urlsplit, urlunsplit

from pydantic import ValidationError
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.frames import CloseCode

from devices.errors import DamagedFramesError, LinkError, StorageError, UsageError
from service.link import (
    INGEST_PATH,
    MESSAGE_BYTES_MAX,
    PROBES,
    SILENCE_S,
    SUBPROTOCOL,
    Ack,
    ClockRow,
    Close,
    FramesOf,
    FromServer,
    Hello,
    Lost,
    Probe,
    Status,
    Wanted,
    Welcome,
    heard,
    say,
    with_check,
)
from service.node.backlog import Backlog
from service.node.dial import dial
from service.node.flow import Flow
from storage.intervals import NO_END, Intervals
from storage.journal.node_stream import NodeStream
from storage.wire import EncodedBatch

PROBE_EVERY_S = 10.0
STATUS_EVERY_S = 1.0
_ASK_EVERY_S = 0.5
_NO_ANSWER_S = 4.0
"""A link on which nothing comes back for so long is half open."""
_BACK_OFF_S = (0.1, 0.5)
"""Between attempts at a server that cannot be reached: the picture is back within a second."""
_REFUSED_BACK_OFF_S = (0.2, 5.0)
"""Between attempts at one that answered, and did not want us."""
_LIVE_BEHIND_S = 0.5
"""Frames that wait longer to be sent are no news: newer ones overtake them."""
_CHUNK_FRAMES = 512
_READ_AGAIN_S = 0.2
_UNAUTHORISED = 401


class Publisher:
    """Gives a node's streams to a server, over as many connections as it takes.

    Args:
        server: http(s) or ws(s) address of the server.
        present: the stream that is being taken.
        streams: all streams that the node has, by boot_id.
        hello: describes them; asked for at every connection.
        status: what the node counts; is given how many frames are behind.
        wanted: told what the server's sessions need, and of which streams it had heard.
        damaged: told of frames that turned out to be damaged on disk.
        token: for servers that want one.
        report: told what happened, once for every change.
    """

    def __init__(
        self,
        server: str,
        *,
        present: Callable[[], NodeStream],
        streams: Callable[[], Mapping[str, NodeStream]],
        hello: Callable[[], Hello],
        status: Callable[[int], Status],
        wanted: Callable[[str, Wanted, tuple[str, ...]], None],
        damaged: Callable[[NodeStream, Intervals], None],
        token: str | None,
        report: Callable[[str], None],
    ) -> None:
        self._url = ingest_url(server)
        self._present = present
        self._streams = streams
        self._hello = hello
        self._status = status
        self._wanted = wanted
        self._damaged = damaged
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._report = report
        self._last_report = ""
        self._connected = False
        self._news = asyncio.Event()
        self._renewed = asyncio.Event()
        self._probe_answers: asyncio.Queue[Probe] = asyncio.Queue(PROBES)
        self._said_hello: Hello | None = None
        self._server_id = ""
        self._flow = Flow()
        self._asked: dict[int, float] = {}
        """Questions that were not answered yet, and when they were asked."""
        self._numbers = count()
        self._backlog = Backlog()

    def notify(self) -> None:
        """There are new frames."""
        self._news.set()

    def renew(self) -> None:
        """Another stream has begun: say hello again."""
        self._renewed.set()

    async def run(self) -> None:
        """Publish until cancelled."""
        waits = _Waits()
        while True:
            self._renewed.clear()
            try:
                await self._connection(waits)
            except (OSError, ValueError, WebSocketException) as error:
                self._say(f"not connected to {self._url}: {_reason(error)}; trying again")
                waits.failed(error)
            self._connected = False
            await asyncio.sleep(waits.next_s())

    @property
    def is_connected(self) -> bool:
        """Has a server welcomed it?"""
        return self._connected

    async def _connection(self, waits: _Waits) -> None:
        parts = urlsplit(self._url)
        secure = parts.scheme == "wss"
        tcp = await dial(parts.hostname or "", parts.port or (443 if secure else 80))
        try:
            await self._speak(tcp, waits)
        finally:
            tcp.close()  # if it was not handed over, or not yet let go

    async def _speak(self, tcp: sockets.socket, waits: _Waits) -> None:
        async with connect(
            self._url,
            sock=tcp,
            subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
            compression=None,  # costs three times the CPU, saves little (performance.md)
            max_size=MESSAGE_BYTES_MAX,
            ping_interval=None,  # we ask ourselves, and measure by the answers
            open_timeout=SILENCE_S,
            close_timeout=1.0,
            additional_headers=self._headers,
            proxy=None,
        ) as socket:
            welcome = await self._greet(socket)
            self._flow, self._asked = Flow(), {}
            self._say(f"connected to {self._url}")
            waits.succeeded()
            self._connected = True
            await _until_one_ends(
                self._receive(socket),
                self._send_frames(socket, welcome),
                self._watch(socket),
                self._measure_clock(socket),
                self._send_status(socket),
                self._renewed.wait(),
            )
            await socket.close(CloseCode.GOING_AWAY, "another stream has begun")

    async def _greet(self, socket: ClientConnection) -> Welcome:
        if socket.subprotocol != SUBPROTOCOL:
            raise LinkError(
                f"the server does not speak {SUBPROTOCOL}", where=self._url, expected=SUBPROTOCOL
            )
        # In a thread: it looks into the journals of earlier streams.
        hello = self._said_hello = await asyncio.to_thread(self._hello)
        await socket.send(say(hello))
        async with asyncio.timeout(SILENCE_S):
            answer = _parse(await socket.recv())
        if not isinstance(answer, Welcome):
            raise LinkError(f"the server answered hello with {answer.type!r}", expected="welcome")
        self._server_id = answer.server_id
        self._take_wanted(answer.wanted)
        return answer

    async def _receive(self, socket: ClientConnection) -> None:
        while True:
            message = _parse(await socket.recv())
            match message:
                case Ack(boot_id=boot_id, seq_first=first, seq_last=last):
                    stream = self._streams().get(boot_id)
                    if stream is not None:
                        stream.acknowledge(self._server_id, first, last)
                case Wanted():
                    self._take_wanted(message)
                case Probe():
                    with suppress(asyncio.QueueFull):
                        self._probe_answers.put_nowait(message)
                case Welcome():
                    raise LinkError("welcome was said before")

    def _take_wanted(self, wanted: Wanted) -> None:
        hello = self._said_hello
        if hello is not None:
            earlier = tuple(stream.array_info.boot_id for stream in hello.earlier)
            self._wanted(self._server_id, wanted, (*earlier, hello.array_info.boot_id))

    async def _send_frames(self, socket: ClientConnection, welcome: Welcome) -> None:
        """The newest frames as they come, and behind them what the server lacks."""
        hello = self._said_hello
        if hello is None:
            return
        present, at = self._present(), hello.next_seq
        self._backlog = Backlog(
            # In the server's order: what sessions need comes first.
            (lacks.boot_id, _before(pair, hello, lacks.boot_id))
            for lacks in welcome.lacks
            for pair in lacks.numbers
        )
        behind_frames = max(1, round(_LIVE_BEHIND_S * hello.array_info.nominal_rate_hz))
        chunk: deque[tuple[str, EncodedBatch]] = deque()
        named = hello.array_info.boot_id
        reading: asyncio.Task[list[tuple[str, EncodedBatch]]] | None = None
        while True:
            self._news.clear()  # news that come while sending are seen in the next round
            if not self._flow.is_open:
                await self._news.wait()
                continue
            newest = present.recent(at)
            if newest:
                # What has waited too long is overtaken; a long batch is no reason to skip it.
                late = newest[-1].seq_last - behind_frames
                batch = next((b for b in newest if b.seq_first > late), newest[-1])
                if batch.seq_first > at:
                    self._backlog.add(present.boot_id, at, batch.seq_first - 1)
                boot_id, at = present.boot_id, batch.seq_last + 1
            elif chunk:
                boot_id, batch = chunk.popleft()
            else:
                # Reading may take long, beside a card that is being written.
                if reading is None and self._backlog.count:
                    chunk_of = asyncio.to_thread(self._next_chunk, self._backlog)
                    reading = asyncio.create_task(chunk_of)
                    reading.add_done_callback(lambda _: self._news.set())
                elif reading is not None and reading.done():
                    chunk += reading.result()
                    reading = None
                else:
                    await self._news.wait()
                continue
            if boot_id != named:
                named = boot_id
                await socket.send(say(FramesOf(boot_id=boot_id)))
            await socket.send(with_check(batch.payload))
            self._flow.sent(len(batch.payload))
            if self._flow.wants_mark:
                await self._ask(socket)

    def _next_chunk(self, backlog: Backlog) -> list[tuple[str, EncodedBatch]]:
        """Batches of the backlog, read from where they are."""
        wanted = backlog.next(_CHUNK_FRAMES)
        if wanted is None:
            return []
        boot_id, first, last = wanted
        stream = self._streams().get(boot_id)
        found: list[EncodedBatch] = []
        if stream is not None:
            try:
                found.extend(stream.batches(first, last))
            except DamagedFramesError as error:
                self._damaged(stream, Intervals([(error.seq_first, error.seq_last)]))
                backlog.done(boot_id, error.seq_first, error.seq_last)
                last = max(first, error.seq_first) - 1
            except StorageError:
                # Evicted meanwhile, and counted; what is still there is tried again.
                found = []
                for gone in Intervals([(first, last)]) - stream.held:
                    backlog.done(boot_id, *gone)
                time.sleep(_READ_AGAIN_S)
                return []
        if last >= first:
            # Batches are sent whole, and may reach further than what was asked for.
            backlog.done(boot_id, first, max([last, *(b.seq_last for b in found[-1:])]))
        return [(boot_id, batch) for batch in found]

    async def _watch(self, socket: ClientConnection) -> None:
        """Ask now and then whether anybody is there: a link that is half open is noticed."""
        while True:
            oldest_s = next(iter(self._asked.values()), None)
            if oldest_s is not None and time.monotonic() - oldest_s > _NO_ANSWER_S:
                raise LinkError(f"the server has not answered for {_NO_ANSWER_S:g} s")
            await self._ask(socket)
            await asyncio.sleep(_ASK_EVERY_S)

    async def _ask(self, socket: ClientConnection) -> None:
        """Mark what was sent so far; the answer says that it was read."""
        number, flow = next(self._numbers), self._flow
        asked = self._asked
        asked[number] = time.monotonic()
        flow.mark(number)

        def answered(answer: asyncio.Future[float]) -> None:
            asked.pop(number, None)
            if not answer.cancelled() and answer.exception() is None:
                flow.answered(number, time.monotonic())
                self._news.set()

        asyncio.ensure_future(await socket.ping()).add_done_callback(answered)

    async def _measure_clock(self, socket: ClientConnection) -> None:
        """The clocks' offset, by the probe with the shortest round trip; unmeasured is unsent."""
        number = 0
        hello = self._said_hello
        utc_offset_ns = hello.array_info.utc_offset_ns if hello is not None else 0
        while True:
            best: ClockRow | None = None
            for _ in range(PROBES):
                number += 1
                sent_ns = time.monotonic_ns()
                await socket.send(say(Probe(id=number)))
                answer = await self._probe_answer(number)
                came_ns = time.monotonic_ns()
                if answer is None or answer.server_t_ns is None:
                    continue
                middle_ns = (sent_ns + came_ns) // 2
                half_ns = (came_ns - sent_ns + 1) // 2
                if best is None or half_ns < best.uncertainty_ns:
                    best = ClockRow(
                        t_mono_ns=middle_ns,
                        server_minus_node_ns=answer.server_t_ns - middle_ns - utc_offset_ns,
                        uncertainty_ns=half_ns,
                    )
            if best is not None:
                await socket.send(say(best))
            await asyncio.sleep(PROBE_EVERY_S)

    async def _probe_answer(self, number: int) -> Probe | None:
        with suppress(TimeoutError):
            async with asyncio.timeout(SILENCE_S):
                while True:
                    answer = await self._probe_answers.get()
                    if answer.id == number:  # not a late one
                        return answer
        return None

    async def _send_status(self, socket: ClientConnection) -> None:
        hello = self._said_hello
        said = {} if hello is None else {hello.array_info.boot_id: hello.lost}
        said |= {} if hello is None else {s.array_info.boot_id: s.lost for s in hello.earlier}
        while True:
            for boot_id, stream in self._streams().items():
                lost = stream.lost.as_pairs()
                if boot_id in said and lost != said[boot_id]:
                    said[boot_id] = lost
                    await socket.send(say(Lost(boot_id=boot_id, lost=lost)))
            await socket.send(say(self._status(self._backlog.count)))
            await asyncio.sleep(STATUS_EVERY_S)

    def _say(self, message: str) -> None:
        if message != self._last_report:
            self._report(message)
        self._last_report = message


async def _until_one_ends(*work: Coroutine[Any, Any, object]) -> None:
    """Do all of it at once until one ends, and fail as that one failed.

    Not by a TaskGroup: before Python 3.13 one that ends while its owner is about to go on may leave
    the owner cancelled (CPython 117407), and a node without its link.
    """
    tasks = [asyncio.create_task(each) for each in work]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    for task in done:
        task.result()


class _Waits:
    """How long to wait before the next attempt."""

    def __init__(self) -> None:
        self._bounds = _BACK_OFF_S
        self._wait_s = 0.0

    def succeeded(self) -> None:
        self._bounds, self._wait_s = _BACK_OFF_S, 0.0

    def failed(self, error: Exception) -> None:
        bounds = _REFUSED_BACK_OFF_S if _is_refusal(error) else _BACK_OFF_S
        if bounds != self._bounds:
            self._bounds, self._wait_s = bounds, bounds[0]

    def next_s(self) -> float:
        least, most = self._bounds
        self._wait_s = min(max(2.0 * self._wait_s, least), most)
        return self._wait_s * random.uniform(0.5, 1.0)  # noqa: S311  # no secret


def _is_refusal(error: BaseException) -> bool:
    if isinstance(error, ConnectionClosed):
        # One that is going down will be back, and what was damaged on its way is sent once more.
        soon = (Close.RESTART, Close.MALFORMED)
        return error.rcvd is not None and error.rcvd.code not in soon
    return isinstance(error, InvalidStatus)


def _before(pair: tuple[int, int | None], hello: Hello, boot_id: str) -> Intervals:
    """What is lacking and was taken before hello; of the present stream all newer frames follow."""
    newest = hello.next_seq - 1 if boot_id == hello.array_info.boot_id else NO_END
    first, last = pair
    last = newest if last is None else min(last, newest)
    return Intervals([(first, last)] if last >= first else ())


def ingest_url(server: str) -> str:
    """The websocket address of a server's ingest.

    Raises:
        UsageError: `server` is no address.
    """
    expected = "one such as http://192.168.4.1:8000"
    try:
        parts = urlsplit(server)
        known = parts.hostname is not None and parts.port != 0
    except ValueError as error:
        raise UsageError(f"{server!r} is no server address", expected=expected) from error
    scheme = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}.get(parts.scheme)
    if scheme is None or not known:
        raise UsageError(f"{server!r} is no server address", expected=expected)
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/") + INGEST_PATH, "", ""))


def _parse(message: str | bytes) -> Welcome | Ack | Wanted | Probe:
    try:
        return FromServer.validate_json(heard(message))
    except ValidationError as error:
        raise LinkError(
            "the server said something that is no message",
            expected=f"{SUBPROTOCOL} messages",
            remedy="Is it a foottile server of this version?",
        ) from error


def _reason(error: Exception) -> str:
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        return error.rcvd.reason or f"closed with code {error.rcvd.code}"
    if isinstance(error, InvalidStatus) and error.response.status_code == _UNAUTHORISED:
        return "the server wants its token: set FOOTTILE_TOKEN to the one `foottile serve` prints"
    if isinstance(error, InvalidStatus):
        said = error.response.body.decode(errors="replace")[:300] if error.response.body else ""
        return f"HTTP {error.response.status_code} {said}".strip()
    return str(error) or type(error).__name__
