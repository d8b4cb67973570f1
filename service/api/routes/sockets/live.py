"""Live websocket: summaries for the page, every frame for programs."""

from __future__ import annotations

import asyncio
import logging
from contextlib import aclosing
from typing import TypeVar

from pydantic import ValidationError
from starlette.websockets import WebSocket, WebSocketDisconnect

from devices.clock import server_utc_ns
from devices.errors import UsageError
from service.api.protocols import SOCKET_EXTENSION, send_message
from service.api.protocols import LimitedWebSocket as Connection
from service.protocol.codec import (
    CloseConnection,
    LinkCloseCode,
    decode_message,
    encode_message,
    format_close_reason,
    run_until_first_ends,
)
from service.protocol.link import SUBPROTOCOL
from service.protocol.live import (
    PING,
    FeedGap,
    FeedHello,
    FeedMessage,
    FeedQuery,
    FeedStream,
    PageHello,
    PageQuery,
    Pong,
)
from service.server.broadcast.broadcaster import TOO_SLOW_S, encode_websocket_messages
from service.server.broadcast.views import make_session_view
from service.server.live_feed.events import (
    ArrowEncoder,
    FeedEvent,
    Gap,
    Position,
    StreamStart,
    check_columns,
)
from service.server.live_feed.reader import FeedReader, check_stream_and_get_requested_position
from service.server.node import ServerNode
from service.server.server import Server
from service.server.session_store import start_key
from service.version import SOFTWARE_VERSION

_Query = TypeVar("_Query", PageQuery, FeedQuery)


class LiveFeedSession:
    """One connection of the live feed.

    Args:
        socket: websocket of the client.
        server: server of the nodes.

    Raises:
        CloseConnection: the query is invalid, or its stream or columns do not exist.
    """

    def __init__(self, socket: WebSocket, server: Server) -> None:
        query = _parse_query(FeedQuery, socket)
        self._socket = socket
        self._node = _select_node(server, query.node)
        self._policy = query.policy
        names = [name.strip() for name in query.columns.split(",")]
        self._columns = tuple(name for name in names if name)
        try:
            check_columns(self._node.last_info, self._columns)
        except UsageError as error:
            raise CloseConnection(LinkCloseCode.POLICY, error.what) from error
        position = check_stream_and_get_requested_position(
            self._node, query.stream_id, None if query.from_seq is None else int(query.from_seq)
        )
        node, self._memory = self._node, server.live_feeds.get_or_create(self._node.name)
        self._reader = FeedReader(
            node,
            self._memory,
            self._policy,
            position,
            needed_frames=lambda: server.recorder.collect_needed_frames(node.name),
            invalidate_damaged=lambda error: server.recorder.invalidate_and_request_resend(
                node, error, "a live client"
            ),
        )
        self._encoder: ArrowEncoder | None = None
        self._position = position
        """First frame that was not sent."""

    async def send_frames(self) -> None:
        """Send frames until the connection ends.

        Raises:
            CloseConnection: it cannot go on; the reason has the position to resume from.
            WebSocketDisconnect: the client has disconnected.
        """
        await self._send_message(
            FeedHello(
                software=SOFTWARE_VERSION,
                t_ns=server_utc_ns(),
                node=self._node.name,
                policy=self._policy,
            )
        )
        async with aclosing(self._reader.iterate_events_until_closed()) as items:
            async for item in items:
                await self._send_event(item)

    async def _send_event(self, item: FeedEvent) -> None:
        match item:
            case StreamStart(stream_id=stream_id, first_seq=seq):
                stream = self._node.streams.get(stream_id)
                info = self._node.last_info if stream is None else stream.info
                try:
                    self._encoder = ArrowEncoder(info, self._columns)
                except UsageError as error:  # it came back with other tiles
                    raise CloseConnection(LinkCloseCode.POLICY, error.what) from error
                self._position = Position(stream_id, seq)
                await self._send_message(FeedStream(stream_id=stream_id, from_seq=seq))
                await self._send_message(self._encoder.encode_schema())
            case Gap(stream_id=stream_id, first_seq=first, last_seq=last, reason=reason):
                await self._send_message(
                    FeedGap(
                        type="lost" if self._policy == "lossless" else "dropped",
                        stream_id=stream_id,
                        from_seq=first,
                        to_seq=last,
                        reason=reason,
                    )
                )
                self._position = Position(stream_id, last + 1)
            case _:
                assert self._encoder is not None  # noqa: S101  # a stream has begun before
                for message, next_seq in self._encoder.encode_rows(item, self._memory.encode_cache):
                    await self._send_message(message)
                    self._position = Position(item.stream_id, next_seq)

    async def _send_message(self, message: FeedMessage | bytes) -> None:
        """Send one message, once there is room for it.

        Raises:
            CloseConnection: the client has read nothing for too long.
        """
        try:
            async with asyncio.timeout(TOO_SLOW_S):
                await send_message(
                    self._socket, message if isinstance(message, bytes) else encode_message(message)
                )
        except TimeoutError as error:
            where = "" if self._position is None else f"; {self._position}"
            raise CloseConnection(
                LinkCloseCode.TOO_SLOW, f"this client does not read{where}"
            ) from error


def _select_node(server: Server, name: str | None) -> ServerNode:
    all_nodes = list(server.nodes)
    if name is None:
        if len(all_nodes) == 1:
            return all_nodes[0]
        names = ", ".join(node.name for node in all_nodes)
        raise CloseConnection(
            LinkCloseCode.POLICY, f"node= is missing; nodes: {names or 'none so far'}"[:120]
        )
    found = server.nodes.find(name)
    if found is None:
        raise CloseConnection(LinkCloseCode.POLICY, f"no node {name[:60]!r}")
    return found


log = logging.getLogger("foottile.live")

_PING_LENGTH_MAX = 1000


async def serve_live(socket: WebSocket, server: Server) -> None:
    """Serve one page, or one program, until it disconnects."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    outlet: Connection = socket.scope["extensions"][SOCKET_EXTENSION]["outlet"]
    try:
        if socket.query_params.get("format") == "arrow":
            await run_until_first_ends(
                LiveFeedSession(socket, server).send_frames(), _answer_pings(socket)
            )
        else:
            await _serve_page(socket, server, outlet)
    except CloseConnection as end:
        outlet.close_now(end.code, format_close_reason(end.reason))
    except WebSocketDisconnect:  # it disconnected, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; one live connection ends, the server goes on")


async def _serve_page(socket: WebSocket, server: Server, outlet: Connection) -> None:
    query = _parse_query(PageQuery, socket)
    if query.node is not None:
        _select_node(server, query.node)
    hello = encode_message(_make_hello(server, query.node))
    outlet.write_framed_unless_closed(encode_websocket_messages([hello]))
    subscriber = server.broadcaster.subscribe(outlet, query.rate_hz, query.node)
    try:
        await run_until_first_ends(subscriber.disconnected, _answer_pings(socket))
    finally:
        server.broadcaster.unsubscribe(subscriber)


def _parse_query(kind: type[_Query], socket: WebSocket) -> _Query:
    try:
        return kind.model_validate(dict(socket.query_params))
    except ValidationError as error:
        complaint = error.errors(include_url=False, include_context=False)[0]
        name = str(complaint["loc"][0])
        field = kind.model_fields.get(name)
        if field is None:
            what = f"unknown parameter {name[:30]!r}; known: {', '.join(kind.model_fields)}"
        else:
            what = f"{name}={complaint['input'][:40]!r}: expected {field.description}"
        raise CloseConnection(LinkCloseCode.POLICY, what) from error


def _make_hello(server: Server, node: str | None) -> PageHello:
    recorder = server.recorder
    return PageHello(
        software=SOFTWARE_VERSION,
        t_ns=server_utc_ns(),
        problems=server.file_problems,
        nodes=[
            view
            for known in server.nodes
            if node in (None, known.name) and (view := server.try_make_node_view(known)) is not None
        ],
        recording=[
            make_session_view(session, recorder)
            for session in sorted(server.sessions.list_unsealed(node), key=start_key, reverse=True)
            if session.state == "recording"
        ],
        trials=server.trials.make_view(),
    )


async def _answer_pings(socket: WebSocket) -> None:
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        text = message.get("text") or ""
        try:
            ping = decode_message(PING, text if len(text) <= _PING_LENGTH_MAX else "")
        except CloseConnection as error:
            raise CloseConnection(
                LinkCloseCode.POLICY, 'only {"type":"ping","t_ms":NUMBER} is accepted here'
            ) from error
        await send_message(socket, encode_message(Pong(t_ms=ping.t_ms, t_ns=server_utc_ns())))
