"""The node's end of the link: dials the server, gives it what it lacks, and never stops trying.

Whatever breaks, the backlog keeps the frames and the next connection takes up where the server
says it left off.
"""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Callable
from contextlib import suppress
from urllib.parse import urlsplit, urlunsplit

from pydantic import ValidationError
from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from devices.errors import LinkError, UsageError
from service.backlog import Backlog
from service.link import (
    INGEST_PATH,
    MESSAGE_BYTES_MAX,
    PROBES,
    SILENCE_S,
    SUBPROTOCOL,
    Ack,
    ClockRow,
    FromServer,
    Hello,
    Probe,
    Status,
    Welcome,
)

PING_S = 2.0
PROBE_EVERY_S = 10.0
STATUS_EVERY_S = 1.0
_BACK_OFF_S = (0.2, 3.0)
_UNAUTHORISED = 401


class Publisher:
    """Sends a backlog to a server, over as many connections as it takes.

    Args:
        server: http(s) or ws(s) address of the server.
        hello: describes the stream; asked for at every connection.
        backlog: what is to be sent.
        status: what the node counts.
        token: for servers that want one.
        report: told what happened, once for every change.
    """

    def __init__(
        self,
        server: str,
        *,
        hello: Callable[[], Hello],
        backlog: Backlog,
        status: Callable[[], Status],
        token: str | None,
        report: Callable[[str], None],
    ) -> None:
        self._url = ingest_url(server)
        self._hello = hello
        self._backlog = backlog
        self._status = status
        self._headers = {"Authorization": f"Bearer {token}"} if token else {}
        self._report = report
        self._last_report = ""
        self._connected = False
        self._news = asyncio.Event()
        self._probe_answers: asyncio.Queue[Probe] = asyncio.Queue(PROBES)
        self._utc_offset_ns = 0

    def notify(self) -> None:
        """There is something new in the backlog."""
        self._news.set()

    async def run(self) -> None:
        """Publish until cancelled."""
        wait_s = _BACK_OFF_S[0]
        while True:
            try:
                async with connect(
                    self._url,
                    subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
                    compression=None,  # costs three times the CPU, saves little (performance.md)
                    max_size=MESSAGE_BYTES_MAX,
                    ping_interval=PING_S,
                    ping_timeout=SILENCE_S,
                    open_timeout=SILENCE_S,
                    close_timeout=1.0,
                    additional_headers=self._headers,
                    proxy=None,
                ) as socket:
                    welcome = await self._greet(socket)
                    self._say(f"connected to {self._url}")
                    wait_s = _BACK_OFF_S[0]
                    self._connected = True
                    await self._serve(socket, welcome)
            except* (OSError, ValueError, WebSocketException) as group:
                self._say(f"not connected to {self._url}: {_reason(group)}; trying again")
            self._connected = False
            await asyncio.sleep(wait_s * random.uniform(0.5, 1.0))  # noqa: S311  # no secret
            wait_s = min(2.0 * wait_s, _BACK_OFF_S[1])

    @property
    def is_connected(self) -> bool:
        """Has a server welcomed it?"""
        return self._connected

    async def _greet(self, socket: ClientConnection) -> Welcome:
        if socket.subprotocol != SUBPROTOCOL:
            raise LinkError(
                f"the server does not speak {SUBPROTOCOL}", where=self._url, expected=SUBPROTOCOL
            )
        hello = self._hello()
        self._utc_offset_ns = hello.array_info.utc_offset_ns
        await socket.send(hello.model_dump_json())
        async with asyncio.timeout(SILENCE_S):
            answer = _parse(await socket.recv())
        if not isinstance(answer, Welcome):
            raise LinkError(f"the server answered hello with {answer.type!r}", expected="welcome")
        return answer

    async def _serve(self, socket: ClientConnection, welcome: Welcome) -> None:
        """All that goes on over one connection; ends by an exception."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._receive(socket))
            tasks.create_task(self._send_frames(socket, welcome))
            tasks.create_task(self._measure_clock(socket))
            tasks.create_task(self._send_status(socket))

    async def _receive(self, socket: ClientConnection) -> None:
        while True:
            message = _parse(await socket.recv())
            if isinstance(message, Ack):
                self._backlog.acknowledge(message.seq_first, message.seq_last)
            elif isinstance(message, Probe):
                with suppress(asyncio.QueueFull):
                    self._probe_answers.put_nowait(message)

    async def _send_frames(self, socket: ClientConnection, welcome: Welcome) -> None:
        at = 0
        for first, last in welcome.lacks:
            at = max(at, first)
            while True:
                # News that come while sending are seen in the next round.
                self._news.clear()
                for batch in self._backlog.since(at):
                    if last is not None and batch.seq_first > last:
                        break
                    await socket.send(batch.payload)
                    at = batch.seq_last + 1
                if last is not None:
                    break
                await self._news.wait()

    async def _measure_clock(self, socket: ClientConnection) -> None:
        """The clocks' offset, by the probe with the shortest round trip; unmeasured is unsent."""
        number = 0
        while True:
            best: ClockRow | None = None
            for _ in range(PROBES):
                number += 1
                sent_ns = time.monotonic_ns()
                await socket.send(Probe(id=number).model_dump_json())
                answer = await self._probe_answer(number)
                came_ns = time.monotonic_ns()
                if answer is None or answer.server_t_ns is None:
                    continue
                middle_ns = (sent_ns + came_ns) // 2
                half_ns = (came_ns - sent_ns + 1) // 2
                if best is None or half_ns < best.uncertainty_ns:
                    best = ClockRow(
                        t_mono_ns=middle_ns,
                        server_minus_node_ns=answer.server_t_ns - middle_ns - self._utc_offset_ns,
                        uncertainty_ns=half_ns,
                    )
            if best is not None:
                await socket.send(best.model_dump_json())
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
        while True:
            await socket.send(self._status().model_dump_json())
            await asyncio.sleep(STATUS_EVERY_S)

    def _say(self, message: str) -> None:
        if message != self._last_report:
            self._report(message)
        self._last_report = message


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


def _parse(message: str | bytes) -> Welcome | Ack | Probe:
    try:
        return FromServer.validate_json(message)
    except ValidationError as error:
        raise LinkError(
            "the server said something that is no message",
            expected=f"{SUBPROTOCOL} messages",
            remedy="Is it a foottile server of this version?",
        ) from error


def _reason(group: BaseExceptionGroup[Exception]) -> str:
    error: BaseException = group
    while isinstance(error, BaseExceptionGroup):
        error = error.exceptions[0]
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        return error.rcvd.reason or f"closed with code {error.rcvd.code}"
    if isinstance(error, InvalidStatus) and error.response.status_code == _UNAUTHORISED:
        return "the server wants its token: set FOOTTILE_TOKEN to the one `foottile serve` prints"
    if isinstance(error, InvalidStatus):
        said = error.response.body.decode(errors="replace")[:300] if error.response.body else ""
        return f"HTTP {error.response.status_code} {said}".strip()
    return str(error) or type(error).__name__
