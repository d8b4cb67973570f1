"""Publisher of a node's frames: connects to the server, with endless retries.

The journal stores all frames, and the next connection continues with the server's missing ones.
"""

from __future__ import annotations

import asyncio
import socket as sockets
import ssl
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.frames import CloseCode

from devices.errors import LinkError
from foottile.connection import AsyncWebsocket, make_context, make_local_context
from foottile.local_server import find_local_server
from service.node.frame_sender import EstablishedLink, NodeCallbacks
from service.node.server_connection import (
    ReconnectBackoff,
    ServerConnection,
    connect_tcp,
    explain_connection_error,
    make_ingest_url,
    parse_server_message,
)
from service.protocol.codec import LinkCloseCode, encode_link_message
from service.protocol.link import (
    LINK_TIMEOUT_S,
    MESSAGE_BYTES_MAX,
    PROTOCOL,
    SUBPROTOCOL,
    Challenge,
    Identify,
    Proof,
    Welcome,
    compute_fingerprint,
    make_proof,
)


class Publisher:
    """Publisher of a node's streams to a server, over successive connections.

    Args:
        server: http(s) or ws(s) address of the server.
        source: callbacks of the node.
        token: the server's token; None: the token of this user's server on this machine.
        ca_path: file or folder of CA certificates, in addition to the system's.
        report: called with a message for every change.
        find_server: returns the address in place of `server`, anew before each attempt.
    """

    def __init__(
        self,
        server: str,
        source: NodeCallbacks,
        *,
        token: str | None,
        report: Callable[[str], None],
        ca_path: Path | None = None,
        find_server: Callable[[], Awaitable[str]] | None = None,
    ) -> None:
        self._server = server
        self._find_server = find_server
        self._url = make_ingest_url(server)
        is_tls = find_server is not None or self._url.startswith("wss:")
        # Of a server that any machine may have announced, no other CA can prove the identity.
        self._context = (
            make_context(ca_path, is_exclusive=find_server is not None) if is_tls else None
        )
        self._has_ca = ca_path is not None
        self._source = source
        self._token = token
        self._report = report
        self._last_report = ""
        self.is_connected = False
        """True while a server has accepted the node."""
        self._fingerprint = ""
        """Fingerprint of the last used secret."""
        self._is_refused = False
        """True after a refusal as another machine: then the node sends its secret, so that a person
        can accept it."""
        self._wake_sender = asyncio.Event()
        self._new_stream_began = asyncio.Event()

    def notify_new_frames(self) -> None:
        """Wake the sender: there are new frames."""
        self._wake_sender.set()

    def reconnect_for_new_stream(self) -> None:
        """Reconnect with a new hello: another stream has begun."""
        self._new_stream_began.set()

    async def publish_forever(self) -> None:
        """Publish until cancelled."""
        back_off = ReconnectBackoff()
        while True:
            self._new_stream_began.clear()
            self._url = ""
            try:
                # Before each attempt: the server may be started after its node.
                if self._find_server is not None:
                    self._server = await self._find_server()
                server, token, context = self._server, self._token, self._context
                local = find_local_server(server)
                if local is not None and (token is None or local.ca):
                    server, token = local.url, token or local.token
                if local is not None and local.ca and not self._has_ca:
                    context = make_local_context(local.ca)
                self._url = make_ingest_url(server)
                tcp = await connect_tcp(self._url)
                try:
                    context = context if self._url.startswith("wss:") else None
                    await self._serve_connection(tcp, token, context, back_off)
                finally:
                    tcp.close()  # if the websocket does not own it
            except (OSError, ValueError, WebSocketException) as error:
                reason = explain_connection_error(error, self._url)
                if _is_wrong_identity(error):
                    self._is_refused = True
                    reason += f" (this machine: {self._fingerprint or 'its disk keeps no secret'})"
                where = f" to {self._url}" if self._url else ""
                self._report_change(f"not connected{where}: {reason}; trying again")
                back_off.set_delays_for(error)
            self.is_connected = False
            await asyncio.sleep(back_off.next_delay_s())

    async def _serve_connection(
        self,
        tcp: sockets.socket,
        token: str | None,
        context: ssl.SSLContext | None,
        back_off: ReconnectBackoff,
    ) -> None:
        async with connect(
            self._url,
            sock=tcp,
            ssl=context,
            create_connection=AsyncWebsocket,
            subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
            compression=None,  # costs three times the CPU, saves little (performance.md)
            max_size=MESSAGE_BYTES_MAX,
            ping_interval=None,  # `FrameSender` sends its own pings
            open_timeout=LINK_TIMEOUT_S,
            close_timeout=1.0,
            additional_headers={"Authorization": f"Bearer {token}"} if token else {},
            proxy=None,
        ) as socket:
            link = await self._handshake(socket)
            self._is_refused = False
            connection = ServerConnection(link, on_acknowledged=back_off.reset)
            self._report_change(f"connected to {self._url}")
            self.is_connected = True
            await connection.exchange_messages(self._new_stream_began)
            await socket.close(CloseCode.GOING_AWAY, "another stream has begun")

    async def _handshake(self, socket: ClientConnection) -> EstablishedLink:
        if socket.subprotocol != SUBPROTOCOL:
            raise LinkError(
                f"the server does not speak {SUBPROTOCOL}", where=self._url, expected=SUBPROTOCOL
            )
        node = self._source.get_present_stream().info.node
        await socket.send(encode_link_message(Identify(protocol=PROTOCOL, node=node)))
        challenge = await _receive_message(socket, Challenge)
        # In threads: both read or write the disk.
        secret = await asyncio.to_thread(self._source.get_secret, challenge.server_id)
        self._fingerprint = "" if secret is None else compute_fingerprint(secret)
        if secret is not None and challenge.is_known and not self._is_refused:
            proof = Proof(proof=make_proof(secret, challenge, node))
        else:
            proof = Proof(secret=secret)
        await socket.send(encode_link_message(proof))
        hello = await asyncio.to_thread(self._source.make_hello)
        await socket.send(encode_link_message(hello))
        welcome = await _receive_message(socket, Welcome)
        return EstablishedLink(
            socket, self._source, challenge.server_id, hello, welcome, self._wake_sender
        )

    def _report_change(self, message: str) -> None:
        if message != self._last_report:
            self._report(message)
        self._last_report = message


_Kind = TypeVar("_Kind", Challenge, Welcome)


async def _receive_message(socket: ClientConnection, kind: type[_Kind]) -> _Kind:
    """Receive the next message, which has to be of a kind."""
    async with asyncio.timeout(LINK_TIMEOUT_S):
        answer = parse_server_message(await socket.recv())
    if not isinstance(answer, kind):
        expected = kind.model_fields["type"].default
        raise LinkError(f"the server sent {answer.type!r}", expected=expected)
    return answer


def _is_wrong_identity(error: Exception) -> bool:
    return (
        isinstance(error, ConnectionClosed)
        and error.rcvd is not None
        and error.rcvd.code == LinkCloseCode.WRONG_IDENTITY
    )
