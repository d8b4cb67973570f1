"""A TCP connection as soon as there can be one.

While a link is down an attempt waits for its time-out, and the kernel repeats its first packet
after one second, three, seven: a link that returns would not be noticed for seconds. So a new
attempt begins each half second beside those that wait, and the first that succeeds is taken. A slow
link is given the time it needs.
"""

from __future__ import annotations

import asyncio
import socket
from urllib.parse import urlsplit, urlunsplit

from devices.errors import UsageError
from service.link import INGEST_PATH

EVERY_S = 0.5
"""So soon at most does a link that has returned carry an attempt."""
GIVE_UP_S = 5.0
"""After that the address is looked up again."""
_UNSENT_BYTES = 16 << 10
"""Some messages of frames."""


def ingest_url(server: str) -> str:
    """The websocket address of a server's ingest.

    Raises:
        UsageError: `server` is no address.
    """
    expected = "one such as http://192.168.4.1:8000"
    try:
        parts = urlsplit(server)
        known = parts.hostname is not None and parts.port != 0
    except ValueError as error:
        raise UsageError(f"{server!r} is no server address", expected=expected) from error
    scheme = {"http": "ws", "https": "wss", "ws": "ws", "wss": "wss"}.get(parts.scheme)
    if scheme is None or not known:
        raise UsageError(f"{server!r} is no server address", expected=expected)
    return urlunsplit((scheme, parts.netloc, parts.path.rstrip("/") + INGEST_PATH, "", ""))


async def dial(url: str) -> socket.socket:
    """Connect to a server.

    Args:
        url: its websocket address.

    Raises:
        OSError: it refuses, or does not answer.
    """
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or (443 if parts.scheme == "wss" else 80)
    loop = asyncio.get_running_loop()
    end_s = loop.time() + GIVE_UP_S
    attempts: set[asyncio.Task[socket.socket]] = set()
    refused: OSError | None = None
    try:
        while loop.time() < end_s and refused is None:
            attempts.add(asyncio.create_task(_attempt(host, port)))
            done, attempts = await asyncio.wait(
                attempts, timeout=EVERY_S, return_when=asyncio.FIRST_COMPLETED
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
            if isinstance(left, socket.socket):  # two came through at once
                left.close()
    raise refused or TimeoutError(f"no answer for {GIVE_UP_S:g} s")


async def _attempt(host: str, port: int) -> socket.socket:
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
                # What waits in the kernel cannot be overtaken by newer frames.
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
