"""Runs the application in uvicorn on a socket known to be ours, until it is told to stop."""

from __future__ import annotations

import asyncio
import logging
import re
import secrets
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from pathlib import Path

import uvicorn
from fastapi import FastAPI

from devices.errors import DamagedFileError, LinkError
from service.api.doors import Bounds, Doors, open_files_max
from service.api.guard import is_loopback
from service.api.protocols import DoorsConfig, Http, WebSocket, accept
from service.estimation.warm import warm_up
from service.link import MESSAGE_BYTES_MAX
from storage.durable import put_aside, read_whole, storage_errors, write_whole

log = logging.getLogger("foottile.serve")

KEPT_IN = "token"
"""File of the data folder with the token that was made."""
_BACKLOG = 128
_GRACE_S = 3
_UNREAD_MS = 60_000
"""A connection whose other end takes nothing of what is sent for so long is closed by the kernel:
no time-out of ours sees how much of a download has arrived."""


def listen(host: str, port: int) -> socket.socket:
    """A listening socket; port 0 is any that is free.

    Raises:
        LinkError: the port is in use, or the address is not this machine's.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        listening = socket.socket(family, kind, protocol)
    except OSError as error:
        raise LinkError(f"cannot listen on {host}: {error}") from error
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        if hasattr(socket, "TCP_USER_TIMEOUT"):  # those that come to it inherit this
            listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, _UNREAD_MS)
        listening.bind(address)
        listening.listen(_BACKLOG)
    except OSError as error:
        listening.close()
        raise LinkError(
            f"cannot listen on {host} port {port}: {error.strerror}",
            remedy="Stop what uses the port, or choose another one with --port",
        ) from error
    return listening


def urls_of(listening: socket.socket, host: str) -> list[str]:
    """Addresses under which it is reached, from other machines first if they can."""
    port = listening.getsockname()[1]
    names = [host]
    if host in ("0.0.0.0", "::", ""):  # noqa: S104  # compared only
        names = [*_own_addresses(), "127.0.0.1"]
    return [f"http://[{n}]:{port}" if ":" in n else f"http://{n}:{port}" for n in names]


def _own_addresses() -> list[str]:
    """This machine's address towards other networks, if it is in one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Nothing is sent: connecting a datagram socket only chooses the way out.
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return []
        return [name for name in (probe.getsockname()[0],) if not is_loopback(name)]


def token_for(host: str, given: str | None, data: Path) -> str | None:
    """The token to ask for: the one given; off loopback one that is kept in the data folder.

    Raises:
        StorageError: it cannot be read or kept.
    """
    if given or is_loopback(host):
        return given or None
    path = data / KEPT_IN
    try:
        kept = read_whole(path).decode("ascii", "replace").strip()
        if not _TOKEN.fullmatch(kept):
            raise DamagedFileError("it holds no token", where=str(path))  # noqa: TRY301  # caught below
    except FileNotFoundError:
        pass
    except DamagedFileError as error:
        log.warning("%s, and a new token is made", put_aside(path, error))
    else:
        return kept
    with storage_errors(path):
        data.mkdir(parents=True, exist_ok=True)
        kept = secrets.token_urlsafe(18)
        write_whole(path, kept.encode() + b"\n", mode=0o600)
    return kept


_TOKEN = re.compile(r"[!-~]{8,200}")
"""What people may have put there themselves, too."""


@asynccontextmanager
async def serving(
    app: FastAPI, listening: socket.socket, bounds: Bounds | None = None
) -> AsyncIterator[None]:
    """Serve while the block runs; on a new machine the models are compiled before, in seconds."""
    await asyncio.to_thread(warm_up)
    bounds = bounds if bounds is not None else Bounds()
    config = DoorsConfig(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        http=Http,
        ws=WebSocket,  # on websockets' sans-I/O, the fastest that is kept up (performance.md)
        ws_max_size=MESSAGE_BYTES_MAX,
        ws_per_message_deflate=False,
        ws_ping_interval=20.0,
        ws_ping_timeout=20.0,
        timeout_keep_alive=bounds.idle_timeout_s,  # type: ignore[arg-type]  # it takes fractions
        timeout_graceful_shutdown=_GRACE_S,
    )
    config.doors = Doors(bounds, open_files_max())
    logging.getLogger("uvicorn.error").addFilter(_is_news)
    server = _Uvicorn(config)
    task = asyncio.create_task(server.serve([listening]))
    try:
        while not server.started and not task.done():
            await asyncio.sleep(0.01)
        if task.done():
            task.result()
        yield
    finally:
        server.should_exit = True
        await task


_NO_NEWS = (
    # We refuse a handshake with an HTTP answer that says why; uvicorn takes that for a mistake.
    "without completing handshake",
    # It is told to the one who sent it; a log that others can fill is no log.
    "Invalid HTTP request received",
    "Unsupported upgrade request",
)


def _is_news(record: logging.LogRecord) -> bool:
    return not any(text in record.getMessage() for text in _NO_NEWS)


class _Uvicorn(uvicorn.Server):
    """Leaves signals to its caller, and takes connections in through the doors."""

    config: DoorsConfig

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets=[])
        self._accepting = [
            asyncio.create_task(accept(each, self._protocol, self.config.doors))
            for each in sockets or ()
        ]

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        for task in self._accepting:
            task.cancel()
        await asyncio.gather(*self._accepting, return_exceptions=True)
        await super().shutdown(sockets)

    def _protocol(self) -> asyncio.Protocol:
        return Http(self.config, self.server_state, self.lifespan.state)

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield
