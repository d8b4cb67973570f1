"""The live websocket for screens."""

from __future__ import annotations

import asyncio
import json
import logging
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from service.api.protocols import OUTLET, send_text
from service.link import SUBPROTOCOL, Close, HangUp, close_reason
from service.server.index import age_of
from service.server.screens.fan_out import RATES_HZ, Outlet, framed
from service.server.screens.picture import dumps
from service.server.screens.views import SessionView
from service.server.server import Server
from service.server_clock import utc_ns
from service.version import SOFTWARE

log = logging.getLogger("foottile.live")

PROTOCOL = 1
"""Of this socket; the nodes' link counts its own."""
RATE_HZ = 30.0
_PARAMETERS = {"node", "rate_hz", "format", "policy"}
_TEXT_MAX = 1000


async def live(socket: WebSocket, server: Server) -> None:
    """Serve one screen until it leaves."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        node, rate_hz = _query(socket, server)
        outlet: Outlet = socket.scope["extensions"][OUTLET]["outlet"]
        outlet.write(framed([dumps(_hello(server, node))]))
        viewer = server.hub.join(outlet, rate_hz, node)
        reading = asyncio.create_task(_read(socket))
        try:
            ends: tuple[asyncio.Future[None], ...] = (viewer.over, reading)
            await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
            for end in ends:
                if end.done():
                    end.result()
        finally:
            server.hub.leave(viewer)
            reading.cancel()
            await asyncio.gather(reading, return_exceptions=True)
    except HangUp as end:
        if socket.application_state is not WebSocketState.DISCONNECTED:
            with suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
                async with asyncio.timeout(1.0):
                    await socket.close(end.code, close_reason(end.reason))
    except WebSocketDisconnect:  # it went away, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; one screen's connection ends, the server goes on")


def _query(socket: WebSocket, server: Server) -> tuple[str | None, float]:
    given = socket.query_params
    if unknown := set(given) - _PARAMETERS:
        raise HangUp(Close.POLICY, f"unknown parameter {sorted(unknown)[0]!r}")
    for name, only in (("format", "json"), ("policy", "latest")):
        if given.get(name, only) != only:
            raise HangUp(Close.POLICY, f"{name}={given[name]!r} is not offered; {only!r} is")
    try:
        rate_hz = float(given.get("rate_hz", RATE_HZ))
    except ValueError:
        rate_hz = float("nan")
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[-1]:
        raise HangUp(Close.POLICY, f"rate_hz has to be {RATES_HZ[0]:g} to {RATES_HZ[-1]:g}")
    node = given.get("node")
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
        "problems": server.problems,
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
        said = None
        if text is not None and len(text) <= _TEXT_MAX:
            with suppress(ValueError, RecursionError):
                said = json.loads(text)
        if not isinstance(said, dict) or said.get("type") != "ping":
            raise HangUp(Close.POLICY, 'only {"type":"ping","t_ms":NUMBER} is understood here')
        t_ms = said.get("t_ms")
        if isinstance(t_ms, bool) or not isinstance(t_ms, int | float) or not abs(t_ms) < 1e18:
            raise HangUp(Close.POLICY, "ping needs t_ms, a number")
        await send_text(socket, dumps({"type": "pong", "t_ms": t_ms, "t_ns": utc_ns()}))
