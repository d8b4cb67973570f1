"""FootTile from Python: a client of its server. Imports nothing of what servers and nodes run.

    import foottile

    with foottile.connect("http://laptop.local:8000") as server:
        for batch in server.live("left", columns=["grf_n", "cop_x_m"]):
            print(batch["grf_n"][-1])

Sessions are listed, searched, and opened as Arrow, pandas and numpy, cut on the server; nodes are
tared, recorded and marked. `connect_async` has the same for asyncio. Everything that this package
raises on purpose is a `FootTileError`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import os

    from foottile.data import Data as Data
    from foottile.errors import ConflictError as ConflictError
    from foottile.errors import DamagedError as DamagedError
    from foottile.errors import FootTileError as FootTileError
    from foottile.errors import FramesLostWarning as FramesLostWarning
    from foottile.errors import NoAnswerError as NoAnswerError
    from foottile.errors import RefusedError as RefusedError
    from foottile.errors import UnknownError as UnknownError
    from foottile.errors import UsageError as UsageError
    from foottile.live import Live as Live
    from foottile.live_protocol import Loss as Loss
    from foottile.server import Server as Server
    from foottile.sessions import Marker as Marker
    from foottile.sessions import Session as Session
    from foottile.with_asyncio import AsyncServer as AsyncServer

_PLACES = {
    "AsyncServer": "with_asyncio",
    "ConflictError": "errors",
    "DamagedError": "errors",
    "Data": "data",
    "FootTileError": "errors",
    "FramesLostWarning": "errors",
    "Live": "live",
    "Loss": "live_protocol",
    "Marker": "sessions",
    "NoAnswerError": "errors",
    "RefusedError": "errors",
    "Server": "server",
    "Session": "sessions",
    "UnknownError": "errors",
    "UsageError": "errors",
}
"""Modules are imported when they are first asked for: Arrow alone takes longer than all of ours."""

__all__ = sorted([*_PLACES, "connect", "connect_async"])  # noqa: PLE0605  # names of the table above


def connect(
    url: str,
    token: str | None = None,
    *,
    timeout_s: float = 10.0,
    ca: str | os.PathLike[str] | None = None,
) -> Server:
    """A server; use it as a context manager, or `close` it. Nothing is asked yet.

    Args:
        url: its address, `http://HOST:PORT`.
        token: its token; None: FOOTTILE_TOKEN, else that of a server which this user runs on this
            machine. To read, none is needed unless the server is private.
        timeout_s: how long an answer may keep one waiting.
        ca: file or folder of CA certificates in PEM, beside those that this machine trusts, as
            those of a laboratory.

    Raises:
        UsageError: that is no address, token or certificate.
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
    """The same for asyncio; arguments and errors as of `connect`."""
    from foottile.with_asyncio import AsyncServer

    return AsyncServer(url, token, timeout_s=timeout_s, ca=ca)


def __getattr__(name: str) -> Any:
    if name not in _PLACES:
        raise AttributeError(f"module 'foottile' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"foottile.{_PLACES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_PLACES]
