"""Protocols of uvicorn with limits on headers, bodies and connections.

uvicorn limits neither the size of headers nor their time, and counts connections only once their
headers are complete. Its protocol classes can be replaced (`http=`, `ws=`), so the limits are added
to them here; parsing and answering stay uvicorn's.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import socket
import ssl
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
from uvicorn.protocols.http.flow_control import FlowControl
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle
from uvicorn.protocols.utils import ClientDisconnected
from websockets.frames import CloseCode
from websockets.http11 import Request

from service.api.connection_limits import ConnectionLimiter
from service.api.message_limits import MessageLimiter, SlicedWebSocket
from service.api.problems import problem_response
from service.protocol.codec import LinkCloseCode
from service.protocol.link import INGEST_PATH, SUBPROTOCOL

log = logging.getLogger("foottile.connections")

SOCKET_EXTENSION = "foottile.outlet"
"""Extension in a websocket's scope with its connection, a `SubscriberSocket`."""
CLIENT_MESSAGE_BYTES_MAX = 4096
"""Size limit of a message by clients other than nodes."""
_BUFFER_BYTES = 64 << 10
_HEAD_SLICE_BYTES = 1 << 10
"""Bytes that are parsed before it shows whether a request waits: forty small ones at most."""
_BODY_SLICE_BYTES = 16 << 10
_TIMED_BODY_BYTES = 256 << 10
_UNREAD_BYTES_MAX = 1 << 20
"""Limit of unsent bytes for a client that sends requests and does not read."""
_OUT_OF_RESOURCES = {errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM}
_OUT_OF_RESOURCES_PAUSE_S = 0.1
_PAUSE_S = 0.01
_RETRY_AFTER_S = 5
_REFUSAL_DELAY_S = 1.0
_TOO_MANY = "There are too many connections; try again in some seconds"


class LimitedConfig(uvicorn.Config):
    """Configuration of uvicorn with the connection limiter."""

    limiter: ConnectionLimiter
    messages: MessageLimiter
    proxies: ProxyHeadersMiddleware

    def find_forwarded_client(self, peer: str, forwarded_for: Sequence[str]) -> str | None:
        """Return the client's address as named by a trusted proxy; None: the peer's.

        uvicorn puts it into the scope of a request only after this check.
        """
        trusted = self.proxies.trusted_hosts
        if not forwarded_for or peer not in trusted:
            return None
        return trusted.get_trusted_client_address(", ".join(forwarded_for))[0] or None


class HeldFlow(FlowControl):
    """Flow control of a connection that reads nothing while received bytes wait."""

    is_held = False

    def resume_reading(self) -> None:
        """Read on, unless bytes wait."""
        if not self.is_held:
            super().resume_reading()


class LimitedHttp(HttpToolsProtocol):
    """HTTP with limits on the size and time of headers and bodies.

    Requests behind an unanswered one stay unparsed, beside those of the same slice: a read of 256
    KiB may have ten thousand, and each would take memory and time.
    """

    config: LimitedConfig
    flow: HeldFlow
    _timer: asyncio.TimerHandle | None = None
    _in_head = False
    _unparsed_bytes = 0
    """Bytes since the last parsed element: an endless header, also behind the body, and an endless
    name of a chunk reach no callback before they end."""
    _head_bytes = 0
    """Size of headers, with those behind the body."""
    _body_bytes = 0
    """Size of the body since its timeout began."""
    _is_too_long = False
    _is_upgraded = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as uvicorn
        """Add the connection as idle."""
        super().connection_made(transport)
        self.flow = HeldFlow(transport)
        self._unparsed = bytearray()
        transport.set_write_buffer_limits(_BUFFER_BYTES)  # with TLS the default is eight times this
        self._unanswered: deque[RequestResponseCycle] = deque()
        """Requests without an answer, in their order; uvicorn has only the newest."""
        self.config.limiter.add_connection(transport, _address(self.client))
        self._start_timeout(self.config.limiter.limits.header_timeout_s)

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection."""
        self._start_timeout(None)
        self.config.limiter.remove_connection(self.transport)
        self._drop_unanswered()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Parse bytes slice by slice, until a request waits for the answer to another."""
        self._unparsed += data
        self._parse_slices()

    def _parse_slices(self) -> None:
        while self._unparsed and not self.pipeline and not self.transport.is_closing():
            is_body = bool(self._unanswered) and self._unanswered[-1].more_body
            piece = bytes(self._unparsed[: _BODY_SLICE_BYTES if is_body else _HEAD_SLICE_BYTES])
            del self._unparsed[: len(piece)]
            self._parse(piece)
            if self._is_upgraded:
                return
        if self.transport.is_closing():
            self._unparsed.clear()
        self.flow.is_held = bool(self._unparsed)
        if self.flow.is_held:
            self.flow.pause_reading()

    def _parse(self, data: bytes) -> None:
        """Parse a slice, up to the limit of headers."""
        self._unparsed_bytes += len(data)
        super().data_received(data)
        if self.transport.is_closing() or self._is_upgraded:
            return
        if self._unparsed_bytes > 2 * self.config.limiter.limits.max_header_bytes:
            self._is_too_long = True
            self.send_400_response("")
        elif self._timer is None and not self._unanswered:  # of a request, or empty lines
            self._start_timeout(self.config.limiter.limits.header_timeout_s)

    def on_message_begin(self) -> None:
        """Start the limits of a request."""
        super().on_message_begin()
        self._in_head = True
        self._unparsed_bytes = self._head_bytes = self._body_bytes = 0

    def on_url(self, url: bytes) -> None:
        """Add to the size of the request line."""
        self._count_head_bytes(len(url))
        super().on_url(url)

    def on_header(self, name: bytes, value: bytes) -> None:
        """Add a header; headers behind the body are ignored."""
        self._count_head_bytes(len(name) + len(value) + 4)
        if self._in_head:
            super().on_header(name, value)

    def on_headers_complete(self) -> None:
        """Reject the request if the limit is reached, else run it."""
        self._in_head = False
        self._start_timeout(None)
        is_websocket = self.parser.should_upgrade() and self._should_upgrade()
        named = [v.decode("latin-1") for name, v in self.headers if name == b"x-forwarded-for"]
        client = self.config.find_forwarded_client(_address(self.client), named)
        if not is_websocket and not self.config.limiter.acquire(self.transport, client):
            self.app = refuse_connection
        app = self.app
        without_chunks = UnchunkedApp(app, self.transport)
        if self.parser.get_http_version() == "1.0":
            self.app = without_chunks
        before: RequestResponseCycle | None = self.cycle  # None before the first one
        super().on_headers_complete()
        without_chunks.cycle, self.app = self.cycle, app
        if self.cycle is not before:
            self._unanswered.append(self.cycle)
            self._start_next_timeout()

    def on_chunk_header(self) -> None:
        """Reset the limit at a piece of the body."""
        self._unparsed_bytes = 0

    def on_body(self, body: bytes) -> None:
        """Pass on a piece of the body; a film's upload has the timeout for each 256 KiB."""
        self._unparsed_bytes = 0
        super().on_body(body)
        self._body_bytes += len(body)
        if self._body_bytes > _TIMED_BODY_BYTES and self._unanswered:
            self._body_bytes = 0
            self._start_next_timeout()

    def on_message_complete(self) -> None:
        """Stop the timeout of the body."""
        self._start_timeout(None)
        self._unparsed_bytes = 0
        super().on_message_complete()

    def on_response_complete(self) -> None:
        """Make the connection idle, unless another request follows."""
        is_last = not self.pipeline
        self._unanswered.popleft()
        self._start_next_timeout()
        super().on_response_complete()
        if is_last:
            self.config.limiter.release(self.transport)
        if self._unparsed:
            self.loop.call_soon(self._parse_waiting)

    def _parse_waiting(self) -> None:
        if not self.transport.is_closing():
            self.flow.is_held = False
            self.flow.resume_reading()
            self._parse_slices()

    def handle_websocket_upgrade(self) -> None:
        """Hand the connection over to the websocket."""
        self._is_upgraded = True
        super().handle_websocket_upgrade()

    def send_400_response(self, msg: str) -> None:
        """Answer a malformed request with a problem, and close."""
        if self._is_too_long:
            what = f"Headers of more than {self.config.limiter.limits.max_header_bytes} bytes"
            self._refuse_and_close(HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE, what)
        else:
            self._refuse_and_close(HTTPStatus.BAD_REQUEST, "This is not HTTP/1.1")

    def _count_head_bytes(self, more: int) -> None:
        self._head_bytes += more
        if self._head_bytes > self.config.limiter.limits.max_header_bytes:
            self._is_too_long = True
            raise ValueError(
                "headers are too long"
            )  # the parser stops; `send_400_response` answers

    def _start_timeout(self, within_s: float | None) -> None:
        if self._timer is not None:
            self._timer.cancel()
        late = self._on_timeout
        self._timer = self.loop.call_later(within_s, late) if within_s is not None else None

    def _start_next_timeout(self) -> None:
        """Start the timeout of the first unanswered request; later ones may not even be read."""
        if not self._unanswered:
            if self._in_head:
                self._start_timeout(self.config.limiter.limits.header_timeout_s)
        elif self._unanswered[0].more_body:
            self._start_timeout(self.config.limiter.limits.body_timeout_s)

    def _on_timeout(self) -> None:
        self._timer = None
        if self.flow.read_paused and self._unanswered and self._unanswered[0].more_body:
            self._start_next_timeout()  # the server itself does not read: no fault of the client
            return
        self._refuse_and_close(HTTPStatus.REQUEST_TIMEOUT, "The request did not come in time")

    def _refuse_and_close(self, status: HTTPStatus, detail: str) -> None:
        if self.transport.is_closing():
            return
        waits = not self._unanswered[0].response_started if self._unanswered else self._in_head
        if waits:
            answer = problem_response("", status, detail, {"connection": "close"})
            head = [f"HTTP/1.1 {status.value} {status.phrase}".encode()]
            head += [name + b": " + value for name, value in answer.raw_headers]
            self.transport.write(b"\r\n".join([*head, b"", bytes(answer.body)]))
        self._drop_unanswered()
        self.transport.close()

    def _drop_unanswered(self) -> None:
        """Mark unanswered requests as disconnected, so that no answer is written."""
        for cycle in self._unanswered:
            cycle.disconnected = True
            cycle.message_event.set()


class UnchunkedApp:
    """Application for one request of HTTP/1.0, which has no chunks.

    uvicorn sends chunks nevertheless. Here a body of unknown length is sent as it is, and ends with
    the connection. An aborted body resets the connection, else it would look complete.

    Args:
        app: application.
        transport: transport of the connection.
    """

    cycle: RequestResponseCycle
    """Cycle of this request; set before it is answered."""

    def __init__(self, app: Any, transport: asyncio.Transport) -> None:
        self._app = app
        self._transport = transport

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer the request."""
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
                reset_connection(self._transport)
            raise


def reset_connection(transport: asyncio.Transport) -> None:
    """Close a connection so that the peer sees an error, not an end."""
    connection = transport.get_extra_info("socket")
    if connection is not None:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    transport.abort()


class LimitedWebSocket(SlicedWebSocket):
    """Websocket with a place: a node's after its first message, else a subscriber's."""

    config: LimitedConfig
    _is_node = False

    def connection_lost(self, exc: Exception | None) -> None:
        """Remove the connection."""
        self.config.limiter.remove_connection(self.transport)
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Read frames; each ping is answered, so a client that does not read is disconnected."""
        if self.transport.get_write_buffer_size() > _UNREAD_BYTES_MAX:
            self.transport.abort()
        else:
            super().data_received(data)

    def handle_connect(self, event: Request) -> None:
        """Reject the connection if the limit is reached, else accept it."""
        limiter = self.config.limiter
        self._is_node = event.path.partition("?")[0] == INGEST_PATH
        if not self._is_node:
            self.conn.max_message_size = CLIENT_MESSAGE_BYTES_MAX
        named = event.headers.get_all("X-Forwarded-For")
        client = self.config.find_forwarded_client(_address(self.client), named)
        messages = self.config.messages
        if self._is_node:
            allowance = None if limiter.has_max_nodes else messages.make_node_allowance()
        else:
            address = client if client is not None else _address(self.client)
            allowance = messages.admit_subscriber(address)
            if allowance is not None and not limiter.acquire(self.transport, client):
                allowance = None
        self.allowance = allowance or messages.make_refused_allowance()
        if allowance is None:
            self._pause_reading()
            self.app = refuse_connection
        super().handle_connect(event)
        if not self.close_sent:
            # ASGI requires a dict; the live route reads it.
            self.scope["extensions"] = {
                **(self.scope["extensions"] or {}),
                SOCKET_EXTENSION: {"outlet": self},
            }

    def send_receive_event_to_app(self) -> None:
        """Pass on a message; a text that is no UTF-8 ends the connection.

        uvicorn would log a traceback, as of an own fault, for what any viewer may send.
        """
        if self.curr_msg_data_type == "text" and not self.close_sent:
            try:
                b"".join(self.frames).decode()
            except UnicodeDecodeError:
                self.conn.send_close(CloseCode.INVALID_DATA, "a text is no UTF-8")
                self.handle_parser_exception()
                return
        super().send_receive_event_to_app()

    @property
    def is_writable(self) -> bool:
        """True if all earlier writes are sent, up to the transport buffer (64 KiB)."""
        return self.writable.is_set()

    def write_framed_unless_closed(self, framed: bytes) -> None:
        """Write whole frames beside uvicorn's own `send`, which frames each message again."""
        if not (self.close_sent or self.disconnected or self.transport.is_closing()):
            self.transport.write(framed)

    async def receive(self) -> ASGIReceiveEvent:
        """Return a message, or the end; the first message of a node acquires its place."""
        event = await super().receive()
        is_word = self._is_node and event["type"] == "websocket.receive"
        if is_word and not self.config.limiter.acquire_node(self.transport):
            with suppress(ClientDisconnected, RuntimeError):  # it has disconnected, or got a reason
                await self.send(
                    {
                        "type": "websocket.close",
                        "code": LinkCloseCode.TRY_LATER,
                        "reason": _TOO_MANY,
                    }
                )
            return {"type": "websocket.disconnect", "code": LinkCloseCode.TRY_LATER}
        return event

    async def run_asgi(self) -> None:
        """Run the app; then make the connection idle, so that it can be closed."""
        await super().run_asgi()
        self.config.limiter.release(self.transport)


def _address(peer: tuple[str, int] | None) -> str:
    return peer[0] if peer else ""


async def send_message(socket: StarletteWebSocket, message: str | bytes) -> None:
    """Send a message on an open websocket, once there is room for it.

    Raises:
        WebSocketDisconnect: the connection is closed; if this end has closed it, starlette and
            uvicorn raise a RuntimeError, which is converted here.
    """
    try:
        if isinstance(message, str):
            await socket.send_text(message)
        else:
            await socket.send_bytes(message)
    except RuntimeError as error:
        raise WebSocketDisconnect(CloseCode.ABNORMAL_CLOSURE) from error


async def refuse_connection(scope: Scope, receive: Receive, send: Send) -> None:
    """Refuse a connection for lack of room: HTTP at once, a websocket later, as it comes again."""
    if scope["type"] == "websocket":
        await asyncio.sleep(_REFUSAL_DELAY_S)
        chosen = SUBPROTOCOL if SUBPROTOCOL in scope["subprotocols"] else None
        await receive()
        await send({"type": "websocket.accept", "subprotocol": chosen})
        await send(
            {"type": "websocket.close", "code": LinkCloseCode.TRY_LATER, "reason": _TOO_MANY}
        )
        return
    headers = {"connection": "close", "retry-after": str(_RETRY_AFTER_S)}
    answer = problem_response(scope["path"], HTTPStatus.SERVICE_UNAVAILABLE, _TOO_MANY, headers)
    await answer(scope, receive, send)


class _Handshake:
    """TLS handshake of a connection; an idle connection until it is done.

    Args:
        connection: accepted socket.
        address: address of the peer.
        context: TLS of the server.
        make_protocol: creates the protocol of the connection.
        limiter: limiter of connections.
    """

    def __init__(
        self,
        connection: socket.socket,
        address: str,
        context: ssl.SSLContext,
        make_protocol: Callable[[], Any],
        limiter: ConnectionLimiter,
    ) -> None:
        self._connection = connection
        self._limiter = limiter
        self.task = asyncio.create_task(
            asyncio.get_running_loop().connect_accepted_socket(
                make_protocol,
                connection,
                ssl=context,
                ssl_handshake_timeout=limiter.limits.header_timeout_s,
            )
        )
        self.task.add_done_callback(self._end)
        limiter.add_connection(self, address)

    def abort(self) -> None:
        """Close the connection now."""
        self.task.cancel()

    def _end(self, task: asyncio.Task[Any]) -> None:
        self._limiter.remove_connection(self)
        error = None if task.cancelled() else task.exception()
        if task.cancelled() or error is not None:
            self._connection.close()
        # No TLS, too slow, or the certificate is not trusted: an OSError.
        if error is not None and not isinstance(error, OSError):
            log.error("a connection is closed: this is a bug; others are accepted", exc_info=error)


async def accept_connections(
    listening: socket.socket,
    make_protocol: Callable[[], Any],
    limiter: ConnectionLimiter,
    context: ssl.SSLContext | None = None,
) -> None:
    """Accept connections until cancelled, one after the other.

    An event loop's own server accepts all pending ones before it reports any, and, out of
    descriptors, closes whatever comes: nodes as well.

    Args:
        listening: listening socket.
        make_protocol: creates a protocol for each connection.
        limiter: limiter of connections.
        context: TLS of the server; None without.
    """
    loop = asyncio.get_running_loop()
    handshakes: set[asyncio.Task[Any]] = set()
    listening.setblocking(False)
    try:
        while True:
            if limiter.is_full:
                limiter.evict_idle()
                await asyncio.sleep(_PAUSE_S)
                continue
            try:
                connection, peer = await loop.sock_accept(listening)
            except OSError as error:
                is_starved = error.errno in _OUT_OF_RESOURCES  # or the client has disconnected
                if is_starved:
                    limiter.log_limited("starved", f"no connection can be accepted now: {error}")
                    limiter.evict_idle()
                await asyncio.sleep(_OUT_OF_RESOURCES_PAUSE_S if is_starved else _PAUSE_S)
                continue
            try:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                if context is not None:  # others are accepted meanwhile
                    task = _Handshake(connection, peer[0], context, make_protocol, limiter).task
                    handshakes.add(task)
                    task.add_done_callback(handshakes.discard)
                else:
                    await loop.connect_accepted_socket(make_protocol, connection)
            except Exception as error:
                if not isinstance(error, OSError):
                    log.exception("a connection is closed: this is a bug; others are accepted")
                connection.close()
    finally:
        for task in handshakes:
            task.cancel()
