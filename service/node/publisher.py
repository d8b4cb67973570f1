"""Publisher of a node's frames: connects to the server, with endless retries.

The journal stores all frames, and the next connection continues with the server's missing ones.
"""

from __future__ import annotations

import asyncio
import socket as sockets
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from websockets.asyncio.client import ClientConnection, connect
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.frames import CloseCode

from devices.errors import LinkError
from foottile.local_server import find_local_server
from foottile.tls import make_context
from foottile.websocket import AsyncConnection
from service.identity import fingerprint_of, make_proof
from service.link import (
    MESSAGE_BYTES_MAX,
    PROTOCOL,
    SILENCE_S,
    SUBPROTOCOL,
    Challenge,
    Close,
    Identify,
    Proof,
    SaidByServer,
    Welcome,
    say,
)
from service.node.connection import Connection, parse
from service.node.dial import BackOff, dial, ingest_url, reason_of
from service.node.sending import Greeted, Source


class Publisher:
    """Publisher of a node's streams to a server, over successive connections.

    Args:
        server: http(s) or ws(s) address of the server.
        source: callbacks of the node.
        token: the server's token; None: the token of this user's server on this machine.
        ca: file or folder of CA certificates, in addition to the system's.
        report: called with a message for every change.
    """

    def __init__(
        self,
        server: str,
        source: Source,
        *,
        token: str | None,
        report: Callable[[str], None],
        ca: Path | None = None,
    ) -> None:
        self._server = server
        self._url = ingest_url(server)
        self._context = make_context(ca) if self._url.startswith("wss:") else None
        self._source = source
        self._token = token
        self._report = report
        self._last_report = ""
        self._connected = False
        self._fingerprint = ""
        """Fingerprint of the last used secret."""
        self._is_refused = False
        """True after a refusal as another machine: then the node sends its secret, so that a person
        can accept it."""
        self._wake = asyncio.Event()
        self._renewed = asyncio.Event()

    def notify(self) -> None:
        """Wake the sender: there are new frames."""
        self._wake.set()

    def renew(self) -> None:
        """Reconnect with a new hello: another stream has begun."""
        self._renewed.set()

    async def run(self) -> None:
        """Publish until cancelled."""
        back_off = BackOff()
        while True:
            self._renewed.clear()
            # Before each attempt: the server may be started after its node.
            local = None if self._token else find_local_server(self._server)
            server, token = (local.url, local.token) if local else (self._server, self._token)
            self._url = ingest_url(server)
            try:
                tcp = await dial(self._url)
                try:
                    await self._speak(tcp, token, back_off)
                finally:
                    tcp.close()  # if the websocket does not own it
            except (OSError, ValueError, WebSocketException) as error:
                reason = reason_of(error, self._url)
                if _is_wrong_identity(error):
                    self._is_refused = True
                    reason += f" (this machine: {self._fingerprint or 'its disk keeps no secret'})"
                self._say(f"not connected to {self._url}: {reason}; trying again")
                back_off.failed(error)
            self._connected = False
            await asyncio.sleep(back_off.next_s())

    @property
    def is_connected(self) -> bool:
        """True while a server has accepted the node."""
        return self._connected

    async def _speak(self, tcp: sockets.socket, token: str | None, back_off: BackOff) -> None:
        async with connect(
            self._url,
            sock=tcp,
            ssl=self._context,
            create_connection=AsyncConnection,
            subprotocols=[SUBPROTOCOL],  # type: ignore[list-item]  # a NewType of str
            compression=None,  # costs three times the CPU, saves little (performance.md)
            max_size=MESSAGE_BYTES_MAX,
            ping_interval=None,  # `Sending` sends its own pings
            open_timeout=SILENCE_S,
            close_timeout=1.0,
            additional_headers={"Authorization": f"Bearer {token}"} if token else {},
            proxy=None,
        ) as socket:
            link = await self._greet(socket)
            self._is_refused = False
            connection = Connection(link, delivered=back_off.succeeded)
            self._say(f"connected to {self._url}")
            self._connected = True
            await connection.run(self._renewed)
            await socket.close(CloseCode.GOING_AWAY, "another stream has begun")

    async def _greet(self, socket: ClientConnection) -> Greeted:
        if socket.subprotocol != SUBPROTOCOL:
            raise LinkError(
                f"the server does not speak {SUBPROTOCOL}", where=self._url, expected=SUBPROTOCOL
            )
        node = self._source.present().info.node
        await socket.send(say(Identify(protocol=PROTOCOL, node=node)))
        challenge = await _answer(socket, Challenge)
        # In threads: both read or write the disk.
        secret = await asyncio.to_thread(self._source.secret, challenge.server_id)
        self._fingerprint = "" if secret is None else fingerprint_of(secret)
        if secret is not None and challenge.is_known and not self._is_refused:
            proof = Proof(proof=make_proof(secret, challenge, node))
        else:
            proof = Proof(secret=secret)
        await socket.send(say(proof))
        hello = await asyncio.to_thread(self._source.hello)
        await socket.send(say(hello))
        welcome = await _answer(socket, Welcome)
        return Greeted(socket, self._source, challenge.server_id, hello, welcome, self._wake)

    def _say(self, message: str) -> None:
        if message != self._last_report:
            self._report(message)
        self._last_report = message


_Kind = TypeVar("_Kind", Challenge, Welcome)


async def _answer(socket: ClientConnection, kind: type[_Kind]) -> _Kind:
    """Receive the next message, which has to be of a kind."""
    async with asyncio.timeout(SILENCE_S):
        answer: SaidByServer = parse(await socket.recv())
    if not isinstance(answer, kind):
        expected = kind.model_fields["type"].default
        raise LinkError(f"the server sent {answer.type!r}", expected=expected)
    return answer


def _is_wrong_identity(error: Exception) -> bool:
    return (
        isinstance(error, ConnectionClosed)
        and error.rcvd is not None
        and error.rcvd.code == Close.WRONG_IDENTITY
    )
