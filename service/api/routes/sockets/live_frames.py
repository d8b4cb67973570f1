"""Live websocket for programs: every frame of a node with its estimates, as Arrow."""

from __future__ import annotations

import asyncio
import re
from contextlib import aclosing

from starlette.websockets import WebSocket

from devices.errors import UsageError
from service.api.protocols import send_message
from service.protocol import CloseConnection, LinkCloseCode
from service.server.broadcast.broadcaster import TOO_SLOW_S
from service.server.broadcast.summary import encode_json
from service.server.live_feed.arrow_encoder import ArrowEncoder, check_columns
from service.server.live_feed.events import FeedEvent, Gap, Position, StreamStart
from service.server.live_feed.reader import POLICIES, FeedReader, Policy, start_position
from service.server.node import ServerNode
from service.server.server import Server
from service.server_clock import server_utc_ns
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
        position = start_position(
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
        async with aclosing(self._reader.events()) as items:
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
