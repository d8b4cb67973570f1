"""Python client of a FootTile server; independent of the code of servers and nodes.

    import foottile

    with foottile.connect("http://laptop.local:8000") as server:
        for batch in server.live("left", columns=["grf_n", "cop_x_m"]):
            print(batch["grf_n"][-1])

It lists, searches and opens sessions as Arrow, pandas and numpy; the server cuts the slices. It
tares and records nodes, and adds markers. `connect_async` is the same for asyncio. All its errors
are `FootTileError`s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import os

    from foottile.asyncio_client import AsyncServer as AsyncServer
    from foottile.errors import AccessDeniedError as AccessDeniedError
    from foottile.errors import ConflictError as ConflictError
    from foottile.errors import DamagedError as DamagedError
    from foottile.errors import FootTileError as FootTileError
    from foottile.errors import FramesLostWarning as FramesLostWarning
    from foottile.errors import NotFoundError as NotFoundError
    from foottile.errors import ServerUnavailableError as ServerUnavailableError
    from foottile.errors import UsageError as UsageError
    from foottile.live import FrameLoss as FrameLoss
    from foottile.live import LiveStream as LiveStream
    from foottile.server import Server as Server
    from foottile.sessions import Marker as Marker
    from foottile.sessions import Session as Session
    from foottile.sessions import SessionData as SessionData

_MODULES = {
    "AccessDeniedError": "errors",
    "AsyncServer": "asyncio_client",
    "ConflictError": "errors",
    "DamagedError": "errors",
    "FootTileError": "errors",
    "FrameLoss": "live",
    "FramesLostWarning": "errors",
    "LiveStream": "live",
    "Marker": "sessions",
    "NotFoundError": "errors",
    "Server": "server",
    "ServerUnavailableError": "errors",
    "Session": "sessions",
    "SessionData": "sessions",
    "UsageError": "errors",
}
"""Module of each public name; imported at first use, because importing Arrow is slow."""

__all__ = sorted([*_MODULES, "connect", "connect_async"])  # noqa: PLE0605  # names of the table above


def connect(
    url: str,
    token: str | None = None,
    *,
    timeout_s: float = 10.0,
    ca: str | os.PathLike[str] | None = None,
) -> Server:
    """Return a client of a server, without a request yet; a context manager, or `close` it.

    Args:
        url: address of the server, `http://HOST:PORT`.
        token: its token; None: FOOTTILE_TOKEN, else the token of a server which this user runs on
            this machine. Reading needs a token only on a private server.
        timeout_s: timeout of a request.
        ca: file or folder of further CA certificates in PEM, for example a laboratory's.

    Raises:
        UsageError: invalid address, token or certificate.
    """
    from foottile.server import Server

    return Server(url, token, timeout_s=timeout_s, ca=ca)


def connect_async(
    url: str,
    token: str | None = None,
    *,
    timeout_s: float = 10.0,
    ca: str | os.PathLike[str] | None = None,
) -> AsyncServer:
    """Return a client for asyncio; arguments and errors as for `connect`."""
    from foottile.asyncio_client import AsyncServer

    return AsyncServer(url, token, timeout_s=timeout_s, ca=ca)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'foottile' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"foottile.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_MODULES]
