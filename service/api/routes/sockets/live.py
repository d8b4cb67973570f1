"""Live websocket: summaries for the page, every frame for programs."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Awaitable
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect

from service.api.protocols import OUTLET, send
from service.api.protocols import WebSocket as Connection
from service.api.routes.sockets.live_frames import LiveFrames
from service.link import SUBPROTOCOL, Close, HangUp, close_reason
from service.private_paths import without_folders
from service.server.index import age_of
from service.server.screens.fan_out import RATES_HZ, framed
from service.server.screens.picture import dumps
from service.server.screens.views import SessionView
from service.server.server import Server
from service.server_clock import utc_ns
from service.version import SOFTWARE

log = logging.getLogger("foottile.live")

PROTOCOL = 1
"""Version of this socket's messages; the nodes' link has another one."""
RATE_HZ = 30.0
_PARAMETERS = {"node", "rate_hz", "format", "policy"}
_TEXT_MAX = 1000


async def live(socket: WebSocket, server: Server) -> None:
    """Serve one page, or one program, until it disconnects."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    outlet: Connection = socket.scope["extensions"][OUTLET]["outlet"]
    try:
        if socket.query_params.get("format") == "arrow":
            await _first_of(LiveFrames(socket, server).run(), _read(socket))
        else:
            await _show(socket, server, outlet)
    except HangUp as end:
        outlet.hang_up(end.code, close_reason(end.reason))
    except WebSocketDisconnect:  # it disconnected, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; one live connection ends, the server goes on")


async def _show(socket: WebSocket, server: Server, outlet: Connection) -> None:
    node, rate_hz = _query(socket, server)
    outlet.write(framed([dumps(_hello(server, node))]))
    viewer = server.hub.join(outlet, rate_hz, node)
    try:
        await _first_of(viewer.over, _read(socket))
    finally:
        server.hub.leave(viewer)


async def _first_of(*ends: Awaitable[None]) -> None:
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


def _query(socket: WebSocket, server: Server) -> tuple[str | None, float]:
    parameters = socket.query_params
    if unknown := set(parameters) - _PARAMETERS:
        raise HangUp(Close.POLICY, f"unknown parameter {sorted(unknown)[0]!r}")
    if (form := parameters.get("format", "json")) != "json":
        raise HangUp(Close.POLICY, f"format={form[:40]!r} is not offered; 'json' and 'arrow' are")
    if (policy := parameters.get("policy", "latest")) != "latest":
        what = f"policy={policy[:40]!r} is not offered in JSON; 'latest' is, and with format=arrow"
        raise HangUp(Close.POLICY, what + " all are")
    try:
        rate_hz = float(parameters.get("rate_hz", RATE_HZ))
    except ValueError:
        rate_hz = float("nan")
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[-1]:
        raise HangUp(Close.POLICY, f"rate_hz has to be {RATES_HZ[0]:g} to {RATES_HZ[-1]:g}")
    node = parameters.get("node")
    if node is not None and all(known.name != node for known in server.nodes):
        raise HangUp(Close.POLICY, f"no node {node[:60]!r}")
    return node, rate_hz


def _hello(server: Server, node: str | None) -> dict[str, object]:
    recorder = server.recorder
    return {
        "type": "hello",
        "protocol": PROTOCOL,
        "software": SOFTWARE,
        "t_ns": utc_ns(),
        "problems": [without_folders(text) for text in server.problems],
        "nodes": [
            view
            for known in server.nodes
            if node in (None, known.name) and (view := server.node_as_json(known)) is not None
        ],
        "recording": [
            SessionView.of(session, recorder).model_dump(mode="json")
            for session in sorted(server.sessions.unsealed(node), key=age_of, reverse=True)
            if session.state == "recording"
        ],
    }


async def _read(socket: WebSocket) -> None:
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
            raise HangUp(Close.POLICY, 'only {"type":"ping","t_ms":NUMBER} is accepted here')
        t_ms = content.get("t_ms")
        if isinstance(t_ms, bool) or not isinstance(t_ms, int | float) or not abs(t_ms) < 1e18:
            raise HangUp(Close.POLICY, "ping needs t_ms, a number")
        await send(socket, dumps({"type": "pong", "t_ms": t_ms, "t_ns": utc_ns()}))
