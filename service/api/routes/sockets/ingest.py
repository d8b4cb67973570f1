"""The server's end of the link: takes in what a node sends, and hangs up with a reason."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from devices.errors import FileFormatError, LinkError, StorageError
from devices.words import printable
from service.api.protocols import send
from service.link import (
    MESSAGE_BYTES_MAX,
    PROTOCOL,
    SILENCE_S,
    SUBPROTOCOL,
    Ack,
    ClockRow,
    Close,
    FramesOf,
    FromNode,
    HangUp,
    Hello,
    Lost,
    Probe,
    SaidByNode,
    Status,
    Welcome,
    checked,
    close_reason,
    heard,
    say,
    understood,
)
from service.server.node import ServerNode
from service.server.server import Link, Server
from service.server.streams import ServerStream
from service.server_clock import utc_ns

log = logging.getLogger("foottile.ingest")


async def ingest(socket: WebSocket, server: Server) -> None:
    """Serve one node's connection until it ends; whatever is said on it, nothing else ends."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        hello = await _greeting(socket, offered)
        with _joined(server, hello) as link:
            await _welcome(socket, server, link)
            await _serve(socket, server, link)
    except HangUp as end:
        await _close(socket, end)
    except WebSocketDisconnect:  # it went away, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; a node's connection ends, the server goes on")
        await _close(socket, HangUp(Close.BUG, "the server has a bug; its log says which"))


async def _greeting(socket: WebSocket, offered: list[str]) -> Hello:
    if SUBPROTOCOL not in offered:
        raise HangUp(
            Close.WRONG_VERSION,
            f"subprotocol {', '.join(offered) or 'none'} offered; this server speaks {SUBPROTOCOL}",
        )
    first = await _receive(socket)
    if (protocol := _protocol_of(first)) is not None and protocol != PROTOCOL:
        # Before it is read: another version's hello has other fields.
        raise HangUp(
            Close.WRONG_VERSION,
            f"protocol {protocol}; this server speaks {PROTOCOL}: update the "
            + ("node" if protocol < PROTOCOL else "server"),
        )
    if isinstance(first, bytes):
        raise HangUp(Close.REFUSED, "the first message has to be hello, in text")
    hello = _parse(first)
    if not isinstance(hello, Hello):
        raise HangUp(Close.REFUSED, "the first message has to be hello")
    return hello


@contextmanager
def _joined(server: Server, hello: Hello) -> Iterator[Link]:
    """A node's place among those that are connected, for as long as it is."""
    name, boot_id = hello.array_info.node, hello.array_info.boot_id
    other = server.links.get(name)
    if other is not None:
        # A node that was switched off and on again knows the stream it had before.
        known = {boot_id, *(stream.array_info.boot_id for stream in hello.earlier)}
        if other.node.boot_id not in known:
            raise HangUp(
                Close.NAME_TAKEN,
                f"a node {name!r} is connected already; give this one another name (--name)",
            )
        other.end(Close.SUPERSEDED, "the same node has connected again")
    is_new = server.nodes.find(name) is None
    try:
        node = server.nodes.greet(hello)
        node.attach(hello, utc_ns())
        server.recorder.know(node)
        server.settling.follow(node)
    except Exception as error:
        if is_new:
            server.nodes.forget(name)
        if not isinstance(error, LinkError | StorageError):
            raise
        code = Close.TRY_LATER if isinstance(error, StorageError) else Close.REFUSED
        raise HangUp(code, str(error)) from error
    link = server.links[name] = Link(node)
    node.connected = True
    try:
        yield link
    finally:
        if server.links.get(name) is link:
            del server.links[name]
            node.detach()
            server.tell_node(node)
            log.info("node %s has gone", name)


async def _welcome(socket: WebSocket, server: Server, link: Link) -> None:
    node = link.node
    link.wanted = server.recorder.wanted(node.name)
    lacks = node.lacks(server.recorder.needed(node.name))
    welcome = Welcome(protocol=PROTOCOL, server_id=server.id, lacks=lacks, wanted=link.wanted)
    await send(socket, say(welcome))
    log.info("node %s connected, stream %s", node.name, node.boot_id)
    server.tell_node(node)


async def _serve(socket: WebSocket, server: Server, link: Link) -> None:
    tasks = [
        asyncio.create_task(_take(socket, server, link)),
        asyncio.create_task(_tell(socket, server, link)),
        asyncio.create_task(link.ended.wait()),
    ]
    try:
        done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        for task in done:
            task.result()
        if link.closing is not None:
            raise HangUp(*link.closing)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def _take(socket: WebSocket, server: Server, link: Link) -> None:
    node = link.node
    while True:
        # What has come already is given without waiting: a node that brings home what it took on
        # its way, or talks without end, would have all others wait until the last of it is done.
        await asyncio.sleep(0)
        message = await _receive(socket)
        if isinstance(message, bytes):
            tare_before = node.estimates.live.tare
            try:
                *_, due = node.take(link.stream, _frames(message), utc_ns())
            except LinkError as error:
                raise HangUp(Close.REFUSED, str(error)) from error
            server.hub.publish(node, due)
            server.frames.publish(node, due)
            if node.estimates.live.tare is not tare_before:
                server.tell_node(node)
            continue
        said = _parse(message)
        match said:
            case Probe(id=number):
                await _answer(socket, Probe(id=number, server_t_ns=utc_ns()))
            case FramesOf(boot_id=boot_id):
                link.stream = _announced(node, boot_id)
            case ClockRow():
                server.recorder.note_clock(node, said, utc_ns())
            case Status():
                node.present.missed_slots = said.missed_slots
                node.troubles, node.fault_counts = said.troubles, said.counts
                server.tell_node(node)
            case Lost():
                _announced(node, said.boot_id).note_losses(said.lost)
            case Hello():
                raise HangUp(Close.REFUSED, "hello was said before")


def _announced(node: ServerNode, boot_id: str) -> ServerStream:
    if boot_id not in node.order:
        raise HangUp(Close.REFUSED, f"stream {boot_id!r} was not announced")
    return node.streams[boot_id]


async def _answer(socket: WebSocket, probe: Probe) -> None:
    try:
        async with asyncio.timeout(SILENCE_S):
            await send(socket, say(probe))
    except TimeoutError as error:  # else nobody would notice that nothing is heard either
        raise HangUp(Close.SILENT, f"nothing was read for {SILENCE_S:g} s") from error


async def _tell(socket: WebSocket, server: Server, link: Link) -> None:
    """Tell the node what is on the disk, and what sessions need whenever that changes."""
    while True:
        await link.news.wait()
        link.news.clear()
        # What the node must keep goes first: it may forget frames once they are acknowledged.
        wanted = server.recorder.wanted(link.node.name)
        if wanted != link.wanted:
            link.wanted = wanted
            await send(socket, say(wanted))
        for boot_id, numbers in link.acks().items():
            for first, last in numbers:
                ack = Ack(boot_id=boot_id, seq_first=first, seq_last=last)
                await send(socket, say(ack))


async def _receive(socket: WebSocket) -> str | bytes:
    try:
        async with asyncio.timeout(SILENCE_S):
            message = await socket.receive()
    except TimeoutError as error:
        raise HangUp(Close.SILENT, f"nothing was heard for {SILENCE_S:g} s") from error
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    data: str | bytes | None = message.get("bytes")
    if data is None:
        data = message["text"]
    if len(data) > MESSAGE_BYTES_MAX:
        raise HangUp(Close.TOO_BIG, f"a message of {len(data)} bytes")
    return data


def _parse(message: str) -> SaidByNode:
    try:
        text = heard(message)
    except LinkError as error:
        raise HangUp(Close.MALFORMED, str(error)) from error
    try:
        return understood(FromNode, text)
    except LinkError as error:
        raise HangUp(Close.REFUSED, str(error)) from error


def _frames(message: bytes) -> bytes:
    try:
        return checked(message)
    except FileFormatError as error:
        raise HangUp(Close.MALFORMED, str(error)) from error


def _protocol_of(message: str | bytes) -> int | None:
    """The protocol version in a hello, whatever else the hello holds; None without one."""
    try:
        said = json.loads(message) if isinstance(message, str) else None
    except (ValueError, RecursionError):
        return None
    if not isinstance(said, dict) or said.get("type") != "hello":
        return None
    protocol = said.get("protocol")
    return protocol if isinstance(protocol, int) else None


async def _close(socket: WebSocket, end: HangUp) -> None:
    reason = close_reason(end.reason)
    log.warning("link closed: %s", printable(end.reason))  # with paths as they are here
    if socket.application_state is not WebSocketState.DISCONNECTED:
        with suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(end.code, reason)
