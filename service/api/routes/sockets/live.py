"""Live websocket: summaries for the page, every frame for programs."""

from __future__ import annotations

import asyncio
import json
import logging
import re
from collections.abc import Awaitable
from contextlib import aclosing, suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

from devices.errors import UsageError
from service.api.protocols import SOCKET_EXTENSION, send_message
from service.api.protocols import LimitedWebSocket as Connection
from service.protocol import SUBPROTOCOL, CloseConnection, LinkCloseCode, format_close_reason
from service.server.broadcast.broadcaster import RATES_HZ, TOO_SLOW_S, encode_websocket_messages
from service.server.broadcast.summary import encode_json
from service.server.broadcast.views import SessionView
from service.server.data_folder import start_key
from service.server.live_feed.encoder import ArrowEncoder, check_columns
from service.server.live_feed.events import FeedEvent, Gap, Position, StreamStart
from service.server.live_feed.reader import (
    POLICIES,
    FeedReader,
    Policy,
    check_stream_and_get_requested_position,
)
from service.server.node import ServerNode
from service.server.server import Server
from service.server_clock import server_utc_ns
from service.user_folders import strip_private_folders
from service.version import SOFTWARE_VERSION

PARAMETERS = {"node", "format", "policy", "stream_id", "from_seq", "columns"}
PROTOCOL = 1
"""Version of these messages."""
_STREAM_ID = re.compile(r"[0-9a-f]{32}")
_SEQ = re.compile(r"[0-9]{1,15}")


class LiveFeedSession:
    """One connection of the live feed.

    Args:
        socket: websocket of the client.
        server: server of the nodes.

    Raises:
        CloseConnection: the query is invalid, or its stream or columns do not exist.
    """

    def __init__(self, socket: WebSocket, server: Server) -> None:
        parameters = socket.query_params
        if unknown := set(parameters) - PARAMETERS:
            raise CloseConnection(
                LinkCloseCode.POLICY, f"unknown parameter {sorted(unknown)[0][:60]!r}"
            )
        self._socket = socket
        self._node = _select_node(server, parameters.get("node"))
        self._policy = _parse_policy(parameters.get("policy", "lossless"))
        names = [name.strip() for name in parameters.get("columns", "").split(",")]
        self._columns = tuple(name for name in names if name)
        try:
            check_columns(self._node.last_info, self._columns)
        except UsageError as error:
            raise CloseConnection(LinkCloseCode.POLICY, error.what) from error
        position = check_stream_and_get_requested_position(
            self._node,
            _require_match(parameters.get("stream_id"), _STREAM_ID, "stream_id", "32 hex digits"),
            _parse_seq(parameters.get("from_seq")),
        )
        node, self._memory = self._node, server.live_feeds.get_or_create(self._node.name)
        self._reader = FeedReader(
            node,
            self._memory,
            self._policy,
            position,
            needed_frames=lambda: server.recorder.needed_frames(node.name),
            invalidate_damaged=lambda error: server.sealer.invalidate_and_request_resend(
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
        hello = {
            "type": "hello",
            "protocol": PROTOCOL,
            "software": SOFTWARE_VERSION,
            "t_ns": server_utc_ns(),
            "node": self._node.name,
            "policy": self._policy,
        }
        await self._send_message(encode_json(hello))
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
                await self._send_message(
                    encode_json({"type": "stream", "stream_id": stream_id, "from_seq": seq})
                )
                await self._send_message(self._encoder.encode_schema())
            case Gap(stream_id=stream_id, first_seq=first, last_seq=last, reason=reason):
                kind = "lost" if self._policy == "lossless" else "dropped"
                fields = {
                    "stream_id": stream_id,
                    "from_seq": first,
                    "to_seq": last,
                    "reason": reason,
                }
                await self._send_message(encode_json({"type": kind, **fields}))
                self._position = Position(stream_id, last + 1)
            case _:
                assert self._encoder is not None  # noqa: S101  # a stream has begun before
                for message, next_seq in self._encoder.encode_rows(item, self._memory.encode_cache):
                    await self._send_message(message)
                    self._position = Position(item.stream_id, next_seq)

    async def _send_message(self, message: str | bytes) -> None:
        """Send one message, once there is room for it.

        Raises:
            CloseConnection: the client has read nothing for too long.
        """
        try:
            async with asyncio.timeout(TOO_SLOW_S):
                await send_message(self._socket, message)
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


def _parse_policy(given: str) -> Policy:
    for known in POLICIES:
        if given == known:
            return known
    raise CloseConnection(
        LinkCloseCode.POLICY, f"policy={given[:40]!r}: expected {', '.join(POLICIES)}"
    )


def _require_match(
    given: str | None, shape: re.Pattern[str], name: str, expected: str
) -> str | None:
    if given is not None and shape.fullmatch(given) is None:
        raise CloseConnection(LinkCloseCode.POLICY, f"{name}={given[:40]!r}: expected {expected}")
    return given


def _parse_seq(given: str | None) -> int | None:
    found = _require_match(given, _SEQ, "from_seq", "a frame's number, from 0")
    return None if found is None else int(found)


log = logging.getLogger("foottile.live")

"""Version of this socket's messages; the nodes' link has another one."""
RATE_HZ = 30.0
_PARAMETERS = {"node", "rate_hz", "format", "policy"}
_TEXT_MAX = 1000


async def serve_live(socket: WebSocket, server: Server) -> None:
    """Serve one page, or one program, until it disconnects."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    outlet: Connection = socket.scope["extensions"][SOCKET_EXTENSION]["outlet"]
    try:
        if socket.query_params.get("format") == "arrow":
            await _run_until_first(
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
    node, rate_hz = _parse_query(socket, server)
    outlet.write_framed_unless_closed(
        encode_websocket_messages([encode_json(_make_hello(server, node))])
    )
    viewer = server.broadcaster.subscribe(outlet, rate_hz, node)
    try:
        await _run_until_first(viewer.disconnected, _answer_pings(socket))
    finally:
        server.broadcaster.unsubscribe(viewer)


async def _run_until_first(*ends: Awaitable[None]) -> None:
    """Run until the first of these ends, cancel the others, and return its result."""
    tasks = [asyncio.ensure_future(end) for end in ends]
    try:
        await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in tasks:
            if task.done():
                task.result()
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def _parse_query(socket: WebSocket, server: Server) -> tuple[str | None, float]:
    parameters = socket.query_params
    if unknown := set(parameters) - _PARAMETERS:
        raise CloseConnection(LinkCloseCode.POLICY, f"unknown parameter {sorted(unknown)[0]!r}")
    if (form := parameters.get("format", "json")) != "json":
        raise CloseConnection(
            LinkCloseCode.POLICY, f"format={form[:40]!r} is not offered; 'json' and 'arrow' are"
        )
    if (policy := parameters.get("policy", "latest")) != "latest":
        what = f"policy={policy[:40]!r} is not offered in JSON; 'latest' is, and with format=arrow"
        raise CloseConnection(LinkCloseCode.POLICY, what + " all are")
    try:
        rate_hz = float(parameters.get("rate_hz", RATE_HZ))
    except ValueError:
        rate_hz = float("nan")
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[-1]:
        raise CloseConnection(
            LinkCloseCode.POLICY, f"rate_hz has to be {RATES_HZ[0]:g} to {RATES_HZ[-1]:g}"
        )
    node = parameters.get("node")
    if node is not None and all(known.name != node for known in server.nodes):
        raise CloseConnection(LinkCloseCode.POLICY, f"no node {node[:60]!r}")
    return node, rate_hz


def _make_hello(server: Server, node: str | None) -> dict[str, object]:
    recorder = server.recorder
    return {
        "type": "hello",
        "protocol": PROTOCOL,
        "software": SOFTWARE_VERSION,
        "t_ns": server_utc_ns(),
        "problems": [strip_private_folders(text) for text in server.file_problems],
        "nodes": [
            view
            for known in server.nodes
            if node in (None, known.name) and (view := server.try_make_node_json(known)) is not None
        ],
        "recording": [
            SessionView.from_session(session, recorder).model_dump(mode="json")
            for session in sorted(server.sessions.list_unsealed(node), key=start_key, reverse=True)
            if session.state == "recording"
        ],
    }


async def _answer_pings(socket: WebSocket) -> None:
    while True:
        message = await socket.receive()
        if message["type"] == "websocket.disconnect":
            return
        text = message.get("text")
        content = None
        if text is not None and len(text) <= _TEXT_MAX:
            with suppress(ValueError, RecursionError):
                content = json.loads(text)
        if not isinstance(content, dict) or content.get("type") != "ping":
            raise CloseConnection(
                LinkCloseCode.POLICY, 'only {"type":"ping","t_ms":NUMBER} is accepted here'
            )
        t_ms = content.get("t_ms")
        if isinstance(t_ms, bool) or not isinstance(t_ms, int | float) or not abs(t_ms) < 1e18:
            raise CloseConnection(LinkCloseCode.POLICY, "ping needs t_ms, a number")
        await send_message(
            socket, encode_json({"type": "pong", "t_ms": t_ms, "t_ns": server_utc_ns()})
        )
