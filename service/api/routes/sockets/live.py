"""Live websocket: summaries for the page, every frame for programs."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Awaitable
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

from service.api.protocols import SOCKET_EXTENSION, send_message
from service.api.protocols import LimitedWebSocket as Connection
from service.api.routes.sockets.live_frames import LiveFeedSession
from service.private_paths import strip_private_folders
from service.protocol import SUBPROTOCOL, CloseConnection, LinkCloseCode, format_close_reason
from service.server.broadcast.broadcaster import RATES_HZ, encode_websocket_messages
from service.server.broadcast.summary import encode_json
from service.server.broadcast.views import SessionView
from service.server.index import start_key
from service.server.server import Server
from service.server_clock import server_utc_ns
from service.version import SOFTWARE_VERSION

log = logging.getLogger("foottile.live")

PROTOCOL = 1
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
    outlet.write_framed(encode_websocket_messages([encode_json(_make_hello(server, node))]))
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
        "problems": [strip_private_folders(text) for text in server.problems],
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
