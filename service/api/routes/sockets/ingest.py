"""Server's end of the link to a node: receives its messages, and closes with a reason."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

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
    Identify,
    Lost,
    Probe,
    Proof,
    SaidByNode,
    Status,
    Welcome,
    checked,
    close_reason,
    heard,
    say,
    understood,
)
from service.server.identities import Claim
from service.server.node import ServerNode
from service.server.nodes import is_node_name
from service.server.server import Link, Server
from service.server.streams import ServerStream
from service.server_clock import utc_ns

log = logging.getLogger("foottile.ingest")

_Message = TypeVar("_Message", Identify, Proof, Hello)


async def ingest(socket: WebSocket, server: Server) -> None:
    """Serve one node's connection until it ends; an error ends only this connection."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        claim = await _challenge(socket, server, offered)
        hello = await _receive_hello(socket, claim)
        with _joined(server, hello, claim) as link:
            await _welcome(socket, server, link)
            await _serve(socket, server, link)
    except HangUp as end:
        await _close(socket, end)
    except WebSocketDisconnect:  # it disconnected, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; a node's connection ends, the server goes on")
        await _close(socket, HangUp(Close.BUG, "bug in the server; see its log"))


async def _challenge(socket: WebSocket, server: Server, offered: list[str]) -> Claim:
    """Request a proof that the connecting machine is the node that it names."""
    if SUBPROTOCOL not in offered:
        raise HangUp(
            Close.WRONG_VERSION,
            f"subprotocol {', '.join(offered) or 'none'} offered; this server speaks {SUBPROTOCOL}",
        )
    first = await _receive(socket)
    if (protocol := _protocol_of(first)) is not None and protocol != PROTOCOL:
        # Before parsing: another version's first message has other fields.
        raise HangUp(
            Close.WRONG_VERSION,
            f"protocol {protocol}; this server speaks {PROTOCOL}: update the "
            + ("node" if protocol < PROTOCOL else "server"),
        )
    who = _expect(Identify, first)
    if not is_node_name(who.node):
        raise HangUp(
            Close.REFUSED, f"{who.node[:80]!r} is no name of a node: letters, digits, '.', '_', '-'"
        )
    with _try_later():
        challenge = server.identities.challenge(who.node, server.id)
    await send(socket, say(challenge))
    answer = _expect(Proof, await _receive(socket))
    client = socket.client
    return Claim(who.node, challenge, answer, client.host if client is not None else "")


async def _receive_hello(socket: WebSocket, claim: Claim) -> Hello:
    hello = _expect(Hello, await _receive(socket))
    if hello.array_info.node != claim.node:
        raise HangUp(
            Close.REFUSED,
            f"node {claim.node!r} sends hello as {hello.array_info.node[:80]!r}",
        )
    return hello


def _expect(kind: type[_Message], message: str | bytes) -> _Message:
    name = kind.model_fields["type"].default
    if isinstance(message, bytes):
        raise HangUp(Close.REFUSED, f"{name} was expected, in text")
    parsed = _parse(message)
    if not isinstance(parsed, kind):
        raise HangUp(Close.REFUSED, f"{name} was expected, not {parsed.type}")
    return parsed


def _is_proven(server: Server, claim: Claim) -> bool:
    before = server.identities.replacements.get(claim.node)
    try:
        with _try_later():
            return server.identities.is_proven(claim, utc_ns())
    except HangUp:
        asking, node = server.identities.replacements.get(claim.node), server.nodes.find(claim.node)
        # A refused machine retries for ever: notify subscribers once per machine.
        is_new = asking is not None and (before is None or before.secret != asking.secret)
        if node is not None and is_new:
            server.tell_node(node)
        raise


@contextmanager
def _try_later() -> Iterator[None]:
    try:
        yield
    except StorageError as error:
        raise HangUp(Close.TRY_LATER, str(error)) from error


@contextmanager
def _joined(server: Server, hello: Hello, claim: Claim) -> Iterator[Link]:
    """Context manager: register a node's connection while the block runs."""
    name, boot_id = hello.array_info.node, hello.array_info.boot_id
    is_proven = _is_proven(server, claim)
    other = server.links.get(name)
    if other is not None:
        # A node that was restarted lists the stream it had before. The ids of streams are
        # public, so without a secret they prove nothing.
        known_ids = {boot_id, *(stream.array_info.boot_id for stream in hello.earlier)}
        if not is_proven or other.node.boot_id not in known_ids:
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
    if not is_proven:
        server.identities.keep_first(claim)
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
    welcome = Welcome(protocol=PROTOCOL, lacks=lacks, wanted=link.wanted)
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
        # Received messages are returned without waiting: without this line a node with a long
        # backlog would block all others.
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
            server.weighings.push(node, due)
            if node.estimates.live.tare is not tare_before:
                server.tell_node(node)
            continue
        parsed = _parse(message)
        match parsed:
            case Probe(id=number):
                await _answer(socket, Probe(id=number, server_t_ns=utc_ns()))
            case FramesOf(boot_id=boot_id):
                link.stream = _announced(node, boot_id)
            case ClockRow():
                server.recorder.note_clock(node, parsed, utc_ns())
            case Status():
                node.present.missed_slots = parsed.missed_slots
                node.troubles, node.fault_counts = parsed.troubles, parsed.counts
                server.tell_node(node)
            case Lost():
                _announced(node, parsed.boot_id).note_losses(parsed.lost)
            case Identify() | Proof() | Hello():
                raise HangUp(Close.REFUSED, f"{parsed.type} was sent before")


def _announced(node: ServerNode, boot_id: str) -> ServerStream:
    if boot_id not in node.order:
        raise HangUp(Close.REFUSED, f"stream {boot_id!r} was not announced")
    return node.streams[boot_id]


async def _answer(socket: WebSocket, probe: Probe) -> None:
    try:
        async with asyncio.timeout(SILENCE_S):
            await send(socket, say(probe))
    except TimeoutError as error:  # else the silence of the node would go unnoticed
        raise HangUp(Close.SILENT, f"nothing was read for {SILENCE_S:g} s") from error


async def _tell(socket: WebSocket, server: Server, link: Link) -> None:
    """Send acknowledgements, and the retention request whenever it changes."""
    while True:
        await link.news.wait()
        link.news.clear()
        # The retention request goes first: a node may drop frames once they are acknowledged.
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
        raise HangUp(Close.SILENT, f"nothing was received for {SILENCE_S:g} s") from error
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
    """Return the protocol of a first message, whatever else it has; None without one."""
    try:
        content = json.loads(message) if isinstance(message, str) else None
    except (ValueError, RecursionError):
        return None
    # Until protocol 2 the first message was hello.
    if not isinstance(content, dict) or content.get("type") not in ("identify", "hello"):
        return None
    protocol = content.get("protocol")
    return protocol if isinstance(protocol, int) else None


async def _close(socket: WebSocket, end: HangUp) -> None:
    reason = close_reason(end.reason)
    log.warning("link closed: %s", printable(end.reason))  # with local paths
    if socket.application_state is not WebSocketState.DISCONNECTED:
        with suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(end.code, reason)
