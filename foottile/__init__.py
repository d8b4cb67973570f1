"""Python client of a FootTile server; independent of the code of servers and nodes.

    import foottile

    with foottile.connect("http://laptop.local:8000") as server:
        for batch in server.live("left", columns=["grf_n", "cop_x_m"]):
            print(batch["grf_n"][-1])

It lists, searches and opens sessions as Arrow, pandas and numpy; the server cuts the slices. It
tares and records nodes, and adds markers. `connect_async` is the same for asyncio. All its errors
are `ClientError`s.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import os

    from foottile.asyncio_client import AsyncClient as AsyncClient
    from foottile.client import Client as Client
    from foottile.errors import AccessDeniedError as AccessDeniedError
    from foottile.errors import ClientError as ClientError
    from foottile.errors import ConflictError as ConflictError
    from foottile.errors import DamagedError as DamagedError
    from foottile.errors import FramesLostWarning as FramesLostWarning
    from foottile.errors import InvalidRequestError as InvalidRequestError
    from foottile.errors import NotFoundError as NotFoundError
    from foottile.errors import ServerUnavailableError as ServerUnavailableError
    from foottile.live import FrameLoss as FrameLoss
    from foottile.live import LiveStream as LiveStream
    from foottile.sessions import RemoteSession as RemoteSession
    from foottile.sessions import SessionData as SessionData
    from foottile.sessions import SessionMarker as SessionMarker

_MODULES = {
    "AccessDeniedError": "errors",
    "AsyncClient": "asyncio_client",
    "Client": "client",
    "ClientError": "errors",
    "ConflictError": "errors",
    "DamagedError": "errors",
    "FrameLoss": "live",
    "FramesLostWarning": "errors",
    "InvalidRequestError": "errors",
    "LiveStream": "live",
    "NotFoundError": "errors",
    "RemoteSession": "sessions",
    "ServerUnavailableError": "errors",
    "SessionData": "sessions",
    "SessionMarker": "sessions",
}
"""Module of each public name; imported at first use, because importing Arrow is slow."""

__all__ = sorted([*_MODULES, "connect", "connect_async"])  # noqa: PLE0605  # names of the table above


def connect(
    url: str,
    token: str | None = None,
    *,
    timeout_s: float = 10.0,
    ca: str | os.PathLike[str] | None = None,
) -> Client:
    """Return a client of a server, without a request yet; a context manager, or `close` it.

    Args:
        url: address of the server, `http://HOST:PORT`.
        token: its token; None: FOOTTILE_TOKEN, else the token of a server which this user runs on
            this machine. Reading needs a token only on a private server.
        timeout_s: timeout of a request.
        ca: file or folder of further CA certificates in PEM, for example a laboratory's.

    Raises:
        InvalidRequestError: invalid address, token or certificate.
    """
    from foottile.client import Client

    return Client(url, token, timeout_s=timeout_s, ca=ca)


def connect_async(
    url: str,
    token: str | None = None,
    *,
    timeout_s: float = 10.0,
    ca: str | os.PathLike[str] | None = None,
) -> AsyncClient:
    """Return a client for asyncio; arguments and errors as for `connect`."""
    from foottile.asyncio_client import AsyncClient

    return AsyncClient(url, token, timeout_s=timeout_s, ca=ca)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module 'foottile' has no attribute {name!r}")
    from importlib import import_module

    return getattr(import_module(f"foottile.{_MODULES[name]}"), name)


def __dir__() -> list[str]:
    return [*globals(), *_MODULES]
