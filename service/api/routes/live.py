"""The live websocket for screens."""

from __future__ import annotations

import asyncio
import json
import logging
from contextlib import suppress

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from service.link import SUBPROTOCOL, Close, HangUp, close_reason
from service.server.live import Subscriber, dumps
from service.server.server import Server
from service.server.views import SessionView
from service.server_clock import utc_ns
from service.version import SOFTWARE

log = logging.getLogger("foottile.live")

PROTOCOL = 1
"""Of this socket; the nodes' link counts its own."""
RATES_HZ = (1.0, 60.0)
RATE_HZ = 30.0
SEND_TIMEOUT_S = 10.0
"""A client that does not read for so long is let go; it may come back."""
_PARAMETERS = {"node", "rate_hz", "format", "policy"}
_TEXT_MAX = 1000


async def live(socket: WebSocket, server: Server) -> None:
    """Serve one screen until it leaves."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    subscriber: Subscriber | None = None
    try:
        node, rate_hz = _query(socket, server)
        await socket.send_text(dumps(_hello(server, node)))
        subscriber = server.hub.join(node)
        sending = asyncio.create_task(_send(socket, server, subscriber, rate_hz))
        reading = asyncio.create_task(_read(socket, subscriber))
        try:
            await asyncio.wait({sending, reading}, return_when=asyncio.FIRST_COMPLETED)
            for task in (sending, reading):
                if task.done():
                    task.result()
        finally:
            sending.cancel()
            reading.cancel()
            await asyncio.gather(sending, reading, return_exceptions=True)
    except HangUp as end:
        if socket.application_state is not WebSocketState.DISCONNECTED:
            with suppress(RuntimeError, WebSocketDisconnect, TimeoutError):
                async with asyncio.timeout(1.0):
                    await socket.close(end.code, close_reason(end.reason))
    except (WebSocketDisconnect, RuntimeError):  # it went away, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; one screen's connection ends, the server goes on")
    finally:
        if subscriber is not None:
            server.hub.leave(subscriber)


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
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise HangUp(Close.POLICY, f"rate_hz has to be {RATES_HZ[0]:g} to {RATES_HZ[1]:g}")
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
            for session in server.sessions.all()
            if session.state == "recording" and node in (None, session.node)
        ],
    }


async def _send(socket: WebSocket, server: Server, subscriber: Subscriber, rate_hz: float) -> None:
    loop = asyncio.get_running_loop()
    due_s = loop.time()
    while True:
        await subscriber.news.wait()
        due_s = max(due_s + 1.0 / rate_hz, loop.time())
        now_t_ns = utc_ns()
        ages_ms = {
            known.name: (now_t_ns - known.server_t_ns(known.shown_t_ns)) * 1e-6
            for known in server.nodes
            if known.clock is not None and known.shown_t_ns is not None
        }
        texts = subscriber.take(ages_ms, server.hub.encoder)
        try:
            async with asyncio.timeout(SEND_TIMEOUT_S):
                for text in texts:
                    await socket.send_text(text)
        except TimeoutError as error:
            raise HangUp(Close.TOO_SLOW, "this client does not read") from error
        await asyncio.sleep(due_s - loop.time())


async def _read(socket: WebSocket, subscriber: Subscriber) -> None:
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
        subscriber.answer({"type": "pong", "t_ms": t_ms, "t_ns": utc_ns()})
