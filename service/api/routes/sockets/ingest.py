"""Server's end of the link to a node: receives its messages, and closes with a reason."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TypeVar

from starlette.websockets import WebSocket, WebSocketDisconnect, WebSocketState

from devices.clock import server_utc_ns
from devices.errors import LinkError, StorageError, escape_control_chars
from service.api.protocols import SOCKET_EXTENSION, send_message
from service.protocol.codec import (
    CloseConnection,
    LinkCloseCode,
    decode_link_message,
    encode_link_message,
    format_close_reason,
    run_until_first_ends,
    strip_binary_crc,
)
from service.protocol.link import (
    LINK_TIMEOUT_S,
    MESSAGE_BYTES_MAX,
    NODE_MESSAGES,
    PROTOCOL,
    SUBPROTOCOL,
    Ack,
    ClockProbe,
    ClockSample,
    Hello,
    Identify,
    LossReport,
    NodeStatus,
    Proof,
    StreamSelect,
    Welcome,
)
from service.server.node import ServerNode
from service.server.nodes import IdentityClaim, ProvenOrFirstContact, is_valid_node_name
from service.server.server import NodeLink, Server
from service.server.streams import ServerStream

log = logging.getLogger("foottile.ingest")

_Message = TypeVar("_Message", Identify, Proof, Hello)


async def serve_node(socket: WebSocket, server: Server) -> None:
    """Serve one node's connection until it ends; an error ends only this connection."""
    offered = socket.scope.get("subprotocols", [])
    await socket.accept(subprotocol=SUBPROTOCOL if SUBPROTOCOL in offered else None)
    try:
        claim = await _challenge_node(socket, server, offered)
        hello = await _receive_hello(socket, claim)
        with _registered_node(server, hello, claim) as link:
            socket.scope["extensions"][SOCKET_EXTENSION]["outlet"].has_free_messages = True
            await _send_welcome(socket, server, link)
            await _run_tasks(socket, server, link)
    except CloseConnection as end:
        await _close_socket(socket, end)
    except WebSocketDisconnect:  # it disconnected, perhaps while we were sending
        pass
    except Exception:
        log.exception("this is a bug; a node's connection ends, the server goes on")
        await _close_socket(
            socket, CloseConnection(LinkCloseCode.BUG, "bug in the server; see its log")
        )


async def _challenge_node(socket: WebSocket, server: Server, offered: list[str]) -> IdentityClaim:
    """Request a proof that the connecting machine is the node that it names."""
    if SUBPROTOCOL not in offered:
        raise CloseConnection(
            LinkCloseCode.WRONG_VERSION,
            f"subprotocol {', '.join(offered) or 'none'} offered; this server speaks {SUBPROTOCOL}",
        )
    first = await _receive_message(socket)
    if (protocol := _read_protocol(first)) is not None and protocol != PROTOCOL:
        # Before parsing: another version's first message has other fields.
        raise CloseConnection(
            LinkCloseCode.WRONG_VERSION,
            f"protocol {protocol}; this server speaks {PROTOCOL}: update the "
            + ("node" if protocol < PROTOCOL else "server"),
        )
    who = _require_message(Identify, first)
    if not is_valid_node_name(who.node):
        raise CloseConnection(
            LinkCloseCode.REFUSED,
            f"{who.node[:80]!r} is no name of a node: letters, digits, '.', '_', '-'",
        )
    with _close_on_storage_error():
        challenge = server.identities.read_secret_and_make_challenge(who.node, server.id)
    await send_message(socket, encode_link_message(challenge))
    answer = _require_message(Proof, await _receive_message(socket))
    client = socket.client
    return IdentityClaim(who.node, challenge, answer, client.host if client is not None else "")


async def _receive_hello(socket: WebSocket, claim: IdentityClaim) -> Hello:
    hello = _require_message(Hello, await _receive_message(socket))
    if hello.array_info.node != claim.node:
        raise CloseConnection(
            LinkCloseCode.REFUSED,
            f"node {claim.node!r} sends hello as {hello.array_info.node[:80]!r}",
        )
    return hello


def _require_message(kind: type[_Message], message: str | bytes) -> _Message:
    name = kind.model_fields["type"].default
    if isinstance(message, bytes):
        raise CloseConnection(LinkCloseCode.REFUSED, f"{name} was expected, in text")
    parsed = decode_link_message(NODE_MESSAGES, message)
    if not isinstance(parsed, kind):
        raise CloseConnection(LinkCloseCode.REFUSED, f"{name} was expected, not {parsed.type}")
    return parsed


def _verify_claim(server: Server, claim: IdentityClaim) -> ProvenOrFirstContact:
    before = server.identities.refused_machines.get(claim.node)
    try:
        with _close_on_storage_error():
            return server.identities.verify_or_refuse_claim(claim, server_utc_ns())
    except CloseConnection:
        asking, node = (
            server.identities.refused_machines.get(claim.node),
            server.nodes.find(claim.node),
        )
        # A refused machine retries for ever: notify subscribers once per machine.
        is_new = asking is not None and (before is None or before.secret != asking.secret)
        if node is not None and is_new:
            server.notify_node_changed(node)
        raise


@contextmanager
def _close_on_storage_error() -> Iterator[None]:
    try:
        yield
    except StorageError as error:
        raise CloseConnection(LinkCloseCode.TRY_LATER, str(error)) from error


@contextmanager
def _registered_node(server: Server, hello: Hello, claim: IdentityClaim) -> Iterator[NodeLink]:
    """Context manager: register a node's connection while the block runs."""
    name, stream_id = hello.array_info.node, hello.array_info.stream_id
    verified = _verify_claim(server, claim)
    other = server.links.get(name)
    if other is not None:
        # A node that was restarted lists the stream it had before. The ids of streams are
        # public, so without a secret they prove nothing.
        known_ids = {stream_id, *(stream.array_info.stream_id for stream in hello.earlier)}
        if verified != "proven" or other.node.stream_id not in known_ids:
            raise CloseConnection(
                LinkCloseCode.NAME_TAKEN,
                f"a node {name!r} is connected already; give this one another name (--name)",
            )
        other.request_close(LinkCloseCode.SUPERSEDED, "the same node has connected again")
    is_new = server.nodes.find(name) is None
    try:
        node = server.nodes.check_hello_and_get_or_create(hello)
        node.apply_checked_hello(hello, server_utc_ns())
        server.recorder.clocks.cache_missing_rows(node)
        server.recorder.extend_node_sessions(node)
    except Exception as error:
        if is_new:
            server.nodes.remove_from_memory(name)
        if not isinstance(error, LinkError | StorageError):
            raise
        code = LinkCloseCode.TRY_LATER if isinstance(error, StorageError) else LinkCloseCode.REFUSED
        raise CloseConnection(code, str(error)) from error
    if verified == "first_contact":
        server.identities.try_store_claimed_secret(claim)
    link = server.links[name] = NodeLink(node)
    node.is_connected = True
    try:
        yield link
    finally:
        if server.links.get(name) is link:
            del server.links[name]
            node.mark_disconnected()
            server.notify_node_changed(node)
            log.info("node %s has gone", name)


async def _send_welcome(socket: WebSocket, server: Server, link: NodeLink) -> None:
    node = link.node
    link.retention_request = server.recorder.make_retention_request(node.name)
    lacks = node.needed_and_present_frames_to_request(
        server.recorder.collect_needed_frames(node.name)
    )
    welcome = Welcome(protocol=PROTOCOL, missing=lacks, retention=link.retention_request)
    await send_message(socket, encode_link_message(welcome))
    log.info("node %s connected, stream %s", node.name, node.stream_id)
    server.notify_node_changed(node)


async def _run_tasks(socket: WebSocket, server: Server, link: NodeLink) -> None:
    requested = link.close_requested
    await run_until_first_ends(
        _receive_messages(socket, server, link), _send_updates(socket, server, link), requested
    )
    raise CloseConnection(*requested.result())


async def _receive_messages(socket: WebSocket, server: Server, link: NodeLink) -> None:
    node = link.node
    while True:
        # Received messages are returned without waiting: without this line a node with a long
        # backlog would block all others.
        await asyncio.sleep(0)
        message = await _receive_message(socket)
        if isinstance(message, bytes):
            tare_before = node.estimator.live.tare_in_use_unless_lost
            try:
                due = node.receive_frames(link.stream, strip_binary_crc(message), server_utc_ns())
            except LinkError as error:
                raise CloseConnection(LinkCloseCode.REFUSED, str(error)) from error
            server.recorder.add_live_edges(node, link.stream, strip_binary_crc(message))
            server.broadcaster.add_to_history_and_updates(node, due)
            server.live_feeds.add_to_existing_buffer(node, due)
            server.weighings.feed_frames(node, due)
            server.trials.start_at_contact(node, due)
            if node.estimator.live.tare_in_use_unless_lost is not tare_before:
                server.notify_node_changed(node)
            continue
        parsed = decode_link_message(NODE_MESSAGES, message)
        match parsed:
            case ClockProbe(id=number):
                await _answer_probe(socket, ClockProbe(id=number, server_t_ns=server_utc_ns()))
            case StreamSelect(stream_id=stream_id):
                link.stream = _find_announced_stream(node, stream_id)
            case ClockSample():
                server.recorder.clocks.record_plausible_row(node, parsed, server_utc_ns())
            case NodeStatus():
                node.present_stream.missed_slots = parsed.missed_slots
                node.warnings, node.fault_counts = parsed.warnings, parsed.counts
                node.vitals = parsed.vitals
                server.notify_node_changed(node)
            case LossReport():
                _find_announced_stream(node, parsed.stream_id).set_node_losses(parsed.lost)
            case Identify() | Proof() | Hello():
                raise CloseConnection(LinkCloseCode.REFUSED, f"{parsed.type} was sent before")


def _find_announced_stream(node: ServerNode, stream_id: str) -> ServerStream:
    if stream_id not in node.announced_stream_order:
        raise CloseConnection(LinkCloseCode.REFUSED, f"stream {stream_id!r} was not announced")
    return node.streams[stream_id]


async def _answer_probe(socket: WebSocket, probe: ClockProbe) -> None:
    try:
        async with asyncio.timeout(LINK_TIMEOUT_S):
            await send_message(socket, encode_link_message(probe))
    except TimeoutError as error:  # else the silence of the node would go unnoticed
        raise CloseConnection(
            LinkCloseCode.SILENT, f"nothing was read for {LINK_TIMEOUT_S:g} s"
        ) from error


async def _send_updates(socket: WebSocket, server: Server, link: NodeLink) -> None:
    """Send acknowledgements, and the retention request whenever it changes."""
    while True:
        await link.has_outgoing.wait()
        link.has_outgoing.clear()
        # The retention request goes first: a node may drop frames once they are acknowledged.
        wanted = server.recorder.make_retention_request(link.node.name)
        if wanted != link.retention_request:
            link.retention_request = wanted
            await send_message(socket, encode_link_message(wanted))
        for stream_id, numbers in link.pop_acks().items():
            for first, last in numbers:
                ack = Ack(stream_id=stream_id, seq_first=first, seq_last=last)
                await send_message(socket, encode_link_message(ack))


async def _receive_message(socket: WebSocket) -> str | bytes:
    try:
        async with asyncio.timeout(LINK_TIMEOUT_S):
            message = await socket.receive()
    except TimeoutError as error:
        raise CloseConnection(
            LinkCloseCode.SILENT, f"nothing was received for {LINK_TIMEOUT_S:g} s"
        ) from error
    if message["type"] == "websocket.disconnect":
        raise WebSocketDisconnect(message.get("code", 1005))
    data: str | bytes | None = message.get("bytes")
    if data is None:
        data = message["text"]
    if len(data) > MESSAGE_BYTES_MAX:
        raise CloseConnection(LinkCloseCode.TOO_BIG, f"a message of {len(data)} bytes")
    return data


def _read_protocol(message: str | bytes) -> int | None:
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


async def _close_socket(socket: WebSocket, end: CloseConnection) -> None:
    reason = format_close_reason(end.reason)
    log.warning("link closed: %s", escape_control_chars(end.reason))  # with local paths
    if socket.application_state is not WebSocketState.DISCONNECTED:
        with suppress(RuntimeError, WebSocketDisconnect):
            await socket.close(end.code, reason)
