"""TCP connection to a server with overlapping attempts, and backoff between connections.

While a link is down an attempt waits for its timeout, and the kernel repeats its first packet after
one second, three, seven: it would detect a returned link only seconds later. So a new attempt
begins each half second beside the waiting ones, and the first success wins. Earlier attempts go on,
for slow links.
"""

from __future__ import annotations

import asyncio
import random
import socket
from http import HTTPStatus
from urllib.parse import urlsplit, urlunsplit

from websockets.exceptions import ConnectionClosed

from devices.errors import UsageError
from foottile.address import decode_zone
from foottile.foreign_response import explain_foreign_response
from foottile.tls import explain_tls
from foottile.websocket import UpgradeRejection
from service.protocol import INGEST_PATH, LinkCloseCode

ATTEMPT_INTERVAL_S = 0.5
"""Interval of attempts, and so the longest delay after the link's return."""
CONNECT_TIMEOUT_S = 5.0
"""Timeout of all attempts; then the address is looked up again."""
_UNSENT_BYTES = 16 << 10
"""Limit of unsent bytes in the kernel: some messages of frames."""


def make_ingest_url(server: str) -> str:
    """Build the websocket address of a server's ingest.

    Raises:
        UsageError: `server` is no address.
    """
    expected = "one such as http://192.168.4.1:8000"
    try:
        parts = urlsplit(decode_zone(server))
        known = parts.hostname is not None and parts.port != 0
    except ValueError as error:
        raise UsageError(f"{server!r} is no server address", expected=expected) from error
    scheme = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}.get(parts.scheme)
    if scheme is None or not known:
        raise UsageError(f"{server!r} is no server address", expected=expected)
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/") + INGEST_PATH, "", ""))


async def connect_tcp(url: str) -> socket.socket:
    """Connect a TCP socket to a server, with an attempt each half second.

    Args:
        url: the server's websocket address.

    Raises:
        OSError: the server refuses, or does not answer in time.
    """
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "wss" else 80)
    loop = asyncio.get_running_loop()
    end_s = loop.time() + CONNECT_TIMEOUT_S
    attempts: set[asyncio.Task[socket.socket]] = set()
    refused: OSError | None = None
    try:
        while loop.time() < end_s and refused is None:
            attempts.add(asyncio.create_task(_connect_once(host, port)))
            done, attempts = await asyncio.wait(
                attempts, timeout=ATTEMPT_INTERVAL_S, return_when=asyncio.FIRST_COMPLETED
            )
            for attempt in done:
                error = attempt.exception()
                if error is None:
                    return attempt.result()
                if not isinstance(error, OSError):
                    raise error
                refused = error
    finally:
        for attempt in attempts:
            attempt.cancel()
        for left in await asyncio.gather(*attempts, return_exceptions=True):
            if isinstance(left, socket.socket):  # two attempts succeeded at once
                left.close()
    raise refused or TimeoutError(f"no answer for {CONNECT_TIMEOUT_S:g} s")


async def _connect_once(host: str, port: int) -> socket.socket:
    loop = asyncio.get_running_loop()
    error: OSError | None = None
    for family, kind, protocol, _, address in await loop.getaddrinfo(
        host, port, type=socket.SOCK_STREAM
    ):
        connection = socket.socket(family, kind, protocol)
        try:
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            if hasattr(socket, "TCP_NOTSENT_LOWAT"):
                # Newer frames cannot overtake bytes in the kernel's buffer.
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT_BYTES)
            await loop.sock_connect(connection, address)
        except OSError as refused:
            connection.close()
            error = refused
        except BaseException:
            connection.close()
            raise
        else:
            return connection
    raise error or OSError(f"{host} has no address")


BACKOFF_S = (0.1, 0.5)
"""Shortest and longest delay while the server is unreachable: live data return within a second."""
REFUSED_BACKOFF_S = (0.2, 5.0)
"""Shortest and longest delay while the server refuses the node."""


class ReconnectBackoff:
    """Exponential backoff with jitter between connections."""

    def __init__(self) -> None:
        self._bounds = BACKOFF_S
        self._wait_s = 0.0

    def reset(self) -> None:
        """Reset after acknowledged frames.

        A welcome is not enough: a node whose frames are refused would reconnect at once.
        """
        self._bounds, self._wait_s = BACKOFF_S, 0.0

    def set_delays_for(self, error: Exception) -> None:
        """Choose the delays by the error that ended an attempt or a connection."""
        bounds = REFUSED_BACKOFF_S if _is_refusal(error) else BACKOFF_S
        if bounds != self._bounds:
            self._bounds, self._wait_s = bounds, bounds[0]

    def next_delay_s(self) -> float:
        """Return the next delay: twice the previous one, with jitter so that nodes spread."""
        least, most = self._bounds
        self._wait_s = min(max(2.0 * self._wait_s, least), most)
        return self._wait_s * random.uniform(0.5, 1.0)  # noqa: S311  # no secret


def _is_refusal(error: BaseException) -> bool:
    if isinstance(error, ConnectionClosed):
        # A restarting server will be back, and damaged messages are sent again.
        soon = (LinkCloseCode.RESTART, LinkCloseCode.MALFORMED)
        return error.rcvd is not None and error.rcvd.code not in soon
    return isinstance(error, UpgradeRejection)


def explain_connection_error(error: Exception, url: str = "") -> str:
    """Explain in words why the connection to an address failed."""
    if isinstance(error, ConnectionClosed) and error.rcvd is not None:
        return error.rcvd.reason or f"closed with code {error.rcvd.code}"
    if isinstance(error, UpgradeRejection):
        return _explain_refusal(error, url)
    return explain_tls(error) or str(error) or type(error).__name__


def _explain_refusal(error: UpgradeRejection, url: str) -> str:
    foreign_response = explain_foreign_response(url, error.status, error.headers)
    if foreign_response is not None:
        return foreign_response
    if error.status == HTTPStatus.UNAUTHORIZED:
        is_wrong = b"is not the server's token" in error.body
        what = (
            "FOOTTILE_TOKEN is not the server's token" if is_wrong else "the server wants its token"
        )
        return (
            f"{what}: set FOOTTILE_TOKEN to the one that `foottile serve` shows or keeps in a file"
        )
    return f"HTTP {error.status} {error.body.decode(errors='replace')[:300]}".strip()
