"""Live websocket for programs: every frame of a node with its estimates, as Arrow."""

from __future__ import annotations

import asyncio
import re
from contextlib import aclosing

from starlette.websockets import WebSocket

from devices.errors import UsageError
from service.api.protocols import send
from service.link import Close, HangUp
from service.server.full_rate.arrow import Encoder, check_columns
from service.server.full_rate.items import Begins, Item, Missing, Position
from service.server.full_rate.reading import POLICIES, Policy, Reader, first_position
from service.server.node import ServerNode
from service.server.screens.fan_out import TOO_SLOW_S
from service.server.screens.picture import dumps
from service.server.server import Server
from service.server_clock import utc_ns
from service.version import SOFTWARE

PARAMETERS = {"node", "format", "policy", "boot_id", "from_seq", "columns"}
PROTOCOL = 1
"""Version of these messages."""
_BOOT_ID = re.compile(r"[0-9a-f]{32}")
_SEQ = re.compile(r"[0-9]{1,15}")


class LiveFrames:
    """One connection of the live feed.

    Args:
        socket: websocket of the client.
        server: server of the nodes.

    Raises:
        HangUp: the query is invalid, or its stream or columns do not exist.
    """

    def __init__(self, socket: WebSocket, server: Server) -> None:
        parameters = socket.query_params
        if unknown := set(parameters) - PARAMETERS:
            raise HangUp(Close.POLICY, f"unknown parameter {sorted(unknown)[0][:60]!r}")
        self._socket = socket
        self._node = _node(server, parameters.get("node"))
        self._policy = _policy(parameters.get("policy", "lossless"))
        names = [name.strip() for name in parameters.get("columns", "").split(",")]
        self._columns = tuple(name for name in names if name)
        try:
            check_columns(self._node.info, self._columns)
        except UsageError as error:
            raise HangUp(Close.POLICY, error.what) from error
        position = first_position(
            self._node,
            _matching(parameters.get("boot_id"), _BOOT_ID, "boot_id", "32 hex digits"),
            _number(parameters.get("from_seq")),
        )
        node, self._memory = self._node, server.frames.of(self._node.name)
        self._reader = Reader(
            node,
            self._memory,
            self._policy,
            position,
            needed=lambda: server.recorder.needed(node.name),
            drop_damaged=lambda error: server.settling.drop_damaged(node, error, "a live client"),
        )
        self._encoder: Encoder | None = None
        self._at = position
        """First frame that was not sent."""

    async def run(self) -> None:
        """Send frames until the connection ends.

        Raises:
            HangUp: it cannot go on; the reason has the position to resume from.
            WebSocketDisconnect: the client has disconnected.
        """
        hello = {
            "type": "hello",
            "protocol": PROTOCOL,
            "software": SOFTWARE,
            "t_ns": utc_ns(),
            "node": self._node.name,
            "policy": self._policy,
        }
        await self._send(dumps(hello))
        async with aclosing(self._reader.items()) as items:
            async for item in items:
                await self._tell(item)

    async def _tell(self, item: Item) -> None:
        match item:
            case Begins(boot_id=boot_id, from_seq=seq):
                stream = self._node.streams.get(boot_id)
                info = self._node.info if stream is None else stream.info
                try:
                    self._encoder = Encoder(info, self._columns)
                except UsageError as error:  # it came back with other tiles
                    raise HangUp(Close.POLICY, error.what) from error
                self._at = Position(boot_id, seq)
                await self._send(dumps({"type": "stream", "boot_id": boot_id, "from_seq": seq}))
                await self._send(self._encoder.header())
            case Missing(boot_id=boot_id, from_seq=first, to_seq=last, reason=reason):
                kind = "lost" if self._policy == "lossless" else "dropped"
                fields = {"boot_id": boot_id, "from_seq": first, "to_seq": last, "reason": reason}
                await self._send(dumps({"type": kind, **fields}))
                self._at = Position(boot_id, last + 1)
            case _:
                assert self._encoder is not None  # noqa: S101  # a stream has begun before
                for message, following in self._encoder.messages(item, self._memory.shared):
                    await self._send(message)
                    self._at = Position(item.boot_id, following)

    async def _send(self, message: str | bytes) -> None:
        """Send one message, once there is room for it.

        Raises:
            HangUp: the client has read nothing for too long.
        """
        try:
            async with asyncio.timeout(TOO_SLOW_S):
                await send(self._socket, message)
        except TimeoutError as error:
            where = "" if self._at is None else f"; {self._at}"
            raise HangUp(Close.TOO_SLOW, f"this client does not read{where}") from error


def _node(server: Server, name: str | None) -> ServerNode:
    all_nodes = list(server.nodes)
    if name is None:
        if len(all_nodes) == 1:
            return all_nodes[0]
        names = ", ".join(node.name for node in all_nodes)
        raise HangUp(Close.POLICY, f"node= is missing; nodes: {names or 'none so far'}"[:120])
    found = server.nodes.find(name)
    if found is None:
        raise HangUp(Close.POLICY, f"no node {name[:60]!r}")
    return found


def _policy(given: str) -> Policy:
    for known in POLICIES:
        if given == known:
            return known
    raise HangUp(Close.POLICY, f"policy={given[:40]!r}: expected {', '.join(POLICIES)}")


def _matching(given: str | None, shape: re.Pattern[str], name: str, expected: str) -> str | None:
    if given is not None and shape.fullmatch(given) is None:
        raise HangUp(Close.POLICY, f"{name}={given[:40]!r}: expected {expected}")
    return given


def _number(given: str | None) -> int | None:
    found = _matching(given, _SEQ, "from_seq", "a frame's number, from 0")
    return None if found is None else int(found)
