"""uvicorn's protocols with the bounds that it lacks, and how connections are taken in.

uvicorn bounds neither the size of headers nor the time they take, and counts connections only when
their headers are there. Its protocol classes are made to be replaced (`http=`, `ws=`), so what is
missing is added to them here; parsing and answering stay uvicorn's.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import struct
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from http import HTTPStatus
from typing import Any

import uvicorn
from starlette.types import Message, Receive, Scope, Send
from starlette.websockets import WebSocket as StarletteWebSocket
from starlette.websockets import WebSocketDisconnect
from uvicorn._types import ASGIReceiveEvent
from uvicorn.middleware.proxy_headers import ProxyHeadersMiddleware
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.protocols.utils import ClientDisconnected
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from websockets.frames import CloseCode
from websockets.http11 import Request

from service.api.doors import Doors
from service.api.problems import problem
from service.link import INGEST_PATH, SUBPROTOCOL, Close

log = logging.getLogger("foottile.doors")

OUTLET = "foottile.outlet"
"""Of a websocket's scope, among the extensions: the connection, as an `Outlet` to write to."""
SAID_ON_LIVE_BYTES_MAX = 4096
"""Of a message to a server by others than nodes."""
_UNREAD_BYTES_MAX = 1 << 20
"""What may wait for one who goes on asking and does not read."""
_STARVED = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
_STARVED_PAUSE_S = 0.1
_PAUSE_S = 0.01
_RETRY_AFTER_S = 5
_TOO_MANY = "There are too many connections; try again in some seconds"


class DoorsConfig(uvicorn.Config):
    """uvicorn's configuration, and the doors that its protocols ask."""

    doors: Doors

    proxies: ProxyHeadersMiddleware

    def forwarded_client(self, peer: str, forwarded_for: Sequence[str]) -> str | None:
        """Return the address that a trusted proxy names as its client's; None: it is the peer's.

        uvicorn puts it into the scope of a request when that has been admitted already.
        """
        trusted = self.proxies.trusted_hosts
        if not forwarded_for or peer not in trusted:
            return None
        return trusted.get_trusted_client_address(", ".join(forwarded_for))[0] or None


class Http(HttpToolsProtocol):
    """HTTP whose headers and bodies come in time and in bounds, or not at all."""

    config: DoorsConfig
    _timer: asyncio.TimerHandle | None = None
    _in_head = False
    _unseen_bytes = 0
    """Since something came of which a request consists: one endless header, be it behind the body,
    and an endless name of a chunk reach no callback before they end."""
    _head_bytes = 0
    """With the headers behind the body."""
    _is_too_long = False
    _is_upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """It waits now."""
        super().connection_made(transport)
        self._asked: deque[RequestResponseCycle] = deque()
        """Requests that are not answered yet, in their order; uvicorn knows but the newest."""
        self.config.doors.come(transport, _address(self.client))
        self._expect(self.config.doors.bounds.header_timeout_s)

    def connection_lost(self, exc: Exception | None) -> None:
        """It has gone."""
        self._expect(None)
        self.config.doors.go(self.transport)
        self._forget_asked()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse, unless it is more than headers may be."""
        self._unseen_bytes += len(data)
        super().data_received(data)
        if self.transport.is_closing() or self._is_upgraded:
            return
        if self._unseen_bytes > 2 * self.config.doors.bounds.max_header_bytes:
            self._is_too_long = True
            self.send_400_response("")
        elif self._timer is None and not self._asked:  # of a request, or empty lines
            self._expect(self.config.doors.bounds.header_timeout_s)

    def on_message_begin(self) -> None:
        """A request begins."""
        super().on_message_begin()
        self._in_head, self._unseen_bytes, self._head_bytes = True, 0, 0

    def on_url(self, url: bytes) -> None:
        """A piece of the request line."""
        self._count(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """A header; those behind the body are nobody's."""
        self._count(len(name) + len(value) + 4)
        if self._in_head:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """It asks for something: is there room?"""
        self._in_head = False
        self._expect(None)
        is_websocket = self.parser.should_upgrade() and self._should_upgrade()
        named = [v.decode("latin-1") for name, v in self.headers if name == b"x-forwarded-for"]
        client = self.config.forwarded_client(_address(self.client), named)
        if not is_websocket and not self.config.doors.admit(self.transport, client):
            self.app = refuse
        app = self.app
        without_chunks = WithoutChunks(app, self.transport)
        if self.parser.get_http_version() == "1.0":
            self.app = without_chunks
        before: RequestResponseCycle | None = self.cycle  # None before the first one
        super().on_headers_complete()
        without_chunks.cycle, self.app = self.cycle, app
        if self.cycle is not before:
            self._asked.append(self.cycle)
            self._expect_more()

    def on_chunk_header(self) -> None:
        """A piece of the body begins."""
        self._unseen_bytes = 0

    def on_body(self, body: bytes) -> None:
        """A piece of the body."""
        self._unseen_bytes = 0
        super().on_body(body)

    def on_message_complete(self) -> None:
        """The body is there."""
        self._expect(None)
        self._unseen_bytes = 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """It waits again, unless it has asked for more already."""
        is_last = not self.pipeline
        self._asked.popleft()
        self._expect_more()
        super().on_response_complete()
        if is_last:
            self.config.doors.rest(self.transport)

    def handle_websocket_upgrade(self) -> None:
        """It is the websocket's from here on."""
        self._is_upgraded = True
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        """Say what was wrong with it as a problem, and close."""
        if self._is_too_long:
            what = f"Headers of more than {self.config.doors.bounds.max_header_bytes} bytes"
            self._end(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, what)
        else:
            self._end(HTTPStatus.BAD_REQUEST, "This is not HTTP/1.1")

    def _count(self, more: int) -> None:
        self._head_bytes += more
        if self._head_bytes > self.config.doors.bounds.max_header_bytes:
            self._is_too_long = True
            raise ValueError("headers are too long")  # the parser gives up, and 400 is ours above

    def _expect(self, within_s: float | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        late = self._too_late
        self._timer = self.loop.call_later(within_s, late) if within_s is not None else None

    def _expect_more(self) -> None:
        """Time runs for the request whose turn it is: those behind it are perhaps not even read."""
        if not self._asked:
            if self._in_head:
                self._expect(self.config.doors.bounds.header_timeout_s)
        elif self._asked[0].more_body:
            self._expect(self.config.doors.bounds.body_timeout_s)

    def _too_late(self) -> None:
        self._timer = None
        self._end(HTTPStatus.REQUEST_TIMEOUT, "The request did not come in time")

    def _end(self, status: HTTPStatus, detail: str) -> None:
        if self.transport.is_closing():
            return
        waits = not self._asked[0].response_started if self._asked else self._in_head
        if waits:
            answer = problem("", status, detail, {"connection": "close"})
            head = [f"HTTP/1.1 {status.value} {status.phrase}".encode()]
            head += [name + b": " + value for name, value in answer.raw_headers]
            self.transport.write(b"\r\n".join([*head, b"", bytes(answer.body)]))
        self._forget_asked()
        self.transport.close()

    def _forget_asked(self) -> None:
        """Nobody waits for the answers any more: to write one would be a mistake."""
        for cycle in self._asked:
            cycle.disconnected = True
            cycle.message_event.set()


class WithoutChunks:
    """The application for one request of HTTP/1.0, which has no chunks.

    uvicorn sends them all the same. Here a body whose length is not known is sent as it is, and
    ends where the connection ends. One that breaks off resets the connection, else nobody could
    tell it from a whole one.

    Args:
        app: what answers.
        transport: the connection.
    """

    cycle: RequestResponseCycle
    """Of this request; set before it is answered."""

    def __init__(self, app: Any, transport: asyncio.Transport) -> None:
        self._app = app
        self._transport = transport

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer it."""
        is_unframed = False

        async def send_unframed(message: Message) -> None:
            nonlocal is_unframed
            if message["type"] == "http.response.start":
                names = {name.lower() for name, _ in message.get("headers", ())}
                is_unframed = b"content-length" not in names
                if is_unframed:
                    self.cycle.chunked_encoding = False
            elif is_unframed:
                self.cycle.expected_content_length = len(message.get("body", b""))
            await send(message)

        try:
            await self._app(scope, receive, send_unframed)
        except BaseException:
            if is_unframed:
                reset(self._transport)
            raise


def reset(transport: asyncio.Transport) -> None:
    """Close a connection so that its other end sees an error, and not an end."""
    connection = transport.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    transport.abort()


class WebSocket(WebSocketsSansIOProtocol):
    """A websocket with a place: a node's once it has spoken, else that of a screen."""

    config: DoorsConfig
    _is_node = False

    def connection_lost(self, exc: Exception | None) -> None:
        """It has gone."""
        self.config.doors.go(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take in frames; each ping is answered, so one that does not read must not go on."""
        if self.transport.get_write_buffer_size() > _UNREAD_BYTES_MAX:
            self.transport.abort()
        else:
            super().data_received(data)

    def handle_connect(self, event: Request) -> None:
        """Is there room?"""
        doors = self.config.doors
        self._is_node = event.path.partition("?")[0] == INGEST_PATH
        if not self._is_node:
            self.conn.max_message_size = SAID_ON_LIVE_BYTES_MAX
        named = event.headers.get_all("X-Forwarded-For")
        client = self.config.forwarded_client(_address(self.client), named)
        if doors.nodes_are_full if self._is_node else not doors.admit(self.transport, client):
            self.app = refuse
        super().handle_connect(event)
        if not self.close_sent:
            # An extension's content is a dict by the specification; its reader is our own route.
            self.scope["extensions"] = {
                **(self.scope["extensions"] or {}),
                OUTLET: {"outlet": self},
            }

    @property
    def is_ready(self) -> bool:
        """Has what was written before gone, but for what a transport holds (64 KiB)?"""
        return self.writable.is_set()

    def write(self, framed: bytes) -> None:
        """Write whole frames beside uvicorn's own `send`, which frames each message anew."""
        if not (self.close_sent or self.disconnected or self.transport.is_closing()):
            self.transport.write(framed)

    def hang_up(self, code: int, reason: str) -> None:
        """Say why it ends, to one who does not read as well: behind all that was written before.

        As uvicorn's own close, but without waiting for room. Until the other end has answered, or
        for `close_timeout`, the connection stays open and what comes is left unheard: to close it
        before that would be a reset, which takes back what was said.
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
        """A message, or the end; the first word of a node gets it its place, if there is one."""
        event = await super().receive()
        is_word = self._is_node and event["type"] == "websocket.receive"
        if is_word and not self.config.doors.admit_node(self.transport):
            with suppress(ClientDisconnected, RuntimeError):  # it has gone, or was told why
                await self.send(
                    {"type": "websocket.close", "code": Close.TRY_LATER, "reason": _TOO_MANY}
                )
            return {"type": "websocket.disconnect", "code": Close.TRY_LATER}
        return event

    async def run_asgi(self) -> None:
        """Serve it; then it only has to go, which one that does not read does not do by itself."""
        await super().run_asgi()
        self.config.doors.rest(self.transport)


def _address(peer: tuple[str, int] | None) -> str:
    return peer[0] if peer else ""


async def send(socket: StarletteWebSocket, message: str | bytes) -> None:
    """Send a message on an open websocket, once there is room for it.

    Raises:
        WebSocketDisconnect: it has gone; where this end has closed it meanwhile, starlette and
            uvicorn say so with a RuntimeError, which must not be taken for another's.
    """
    try:
        if isinstance(message, str):
            await socket.send_text(message)
        else:
            await socket.send_bytes(message)
    except RuntimeError as error:
        raise WebSocketDisconnect(CloseCode.ABNORMAL_CLOSURE) from error


async def refuse(scope: Scope, receive: Receive, send: Send) -> None:
    """Say that there is no room, in the way of the one who asks."""
    if scope["type"] == "websocket":
        chosen = SUBPROTOCOL if SUBPROTOCOL in scope["subprotocols"] else None
        await receive()
        await send({"type": "websocket.accept", "subprotocol": chosen})
        await send({"type": "websocket.close", "code": Close.TRY_LATER, "reason": _TOO_MANY})
        return
    headers = {"connection": "close", "retry-after": str(_RETRY_AFTER_S)}
    answer = problem(scope["path"], HTTPStatus.SERVICE_UNAVAILABLE, _TOO_MANY, headers)
    await answer(scope, receive, send)


async def accept(listening: socket.socket, make: Callable[[], Any], doors: Doors) -> None:
    """Take in connections until cancelled, one after the other.

    An event loop's own server takes in all that are there before it tells of one, and, out of
    descriptors, closes whoever comes: nodes as well.

    Args:
        listening: the socket they come to.
        make: a protocol for each.
        doors: counts them.
    """
    loop = asyncio.get_running_loop()
    listening.setblocking(False)
    while True:
        if doors.is_full:
            doors.turn_out()
            await asyncio.sleep(_PAUSE_S)
            continue
        try:
            connection, _ = await loop.sock_accept(listening)
        except OSError as error:
            is_starved = error.errno in _STARVED  # or it has gone already
            if is_starved:
                doors.say("starved", f"no connection can be taken in for now: {error}")
                doors.turn_out()
            await asyncio.sleep(_STARVED_PAUSE_S if is_starved else _PAUSE_S)
            continue
        try:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            await loop.connect_accepted_socket(make, connection)
        except Exception as error:
            if not isinstance(error, OSError):
                log.exception("a connection is closed: this is a bug; others are taken in")
            connection.close()
