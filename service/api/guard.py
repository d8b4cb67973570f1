"""Who may ask: Host and Origin are checked, and except on loopback a token for every change.

A web page of another site can make a browser send requests here; it cannot choose the Host header
nor hide its Origin. On loopback that is what has to be kept out; on a network others are, too.
"""

from __future__ import annotations

import hmac
import ipaddress
import re
from collections.abc import Iterable, Sequence
from http import HTTPStatus

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.problems import problem
from service.link import LIVE_PATH

BODY_BYTES_MAX = 64 << 10
"""Longest body of a request: names and notes."""

_ASKED = (
    "To change something here the server's token is needed: it is shown, or where it is, on the "
    "computer on which `foottile serve` runs. A program sends it as Authorization: Bearer TOKEN"
)
_WRONG = (
    "This is not the server's token: that is shown, or where it is, on the computer on which "
    "`foottile serve` runs"
)
_HOST = re.compile(r"(?:(?P<name>[A-Za-z0-9._-]+)|\[(?P<address>[0-9A-Fa-f:.]+)\])(?::[0-9]{1,5})?")
"""As browsers write it: a name or an address, and a port; no user, no path."""
SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
_DEFAULT_HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",  # ask again: after an update the page must not be the old one
}


class Guard:
    """ASGI middleware that lets through what may pass.

    Args:
        app: what is guarded.
        hosts: names under which it is reached, in addition to addresses of this machine.
        token: asked for on every change of state and on ingest; None: only for loopback.
    """

    def __init__(self, app: ASGIApp, *, hosts: Iterable[str], token: str | None) -> None:
        self._app = app
        self._hosts = frozenset(host.lower() for host in hosts)
        self._token = token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if (refusal := self._refusal(scope)) is not None:
            status, detail = refusal
            extra = {"www-authenticate": "Bearer"} if status == HTTPStatus.UNAUTHORIZED else {}
            await problem(scope["path"], status, detail, extra)(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            await self._app(scope, _Limited(receive), _hardened(send))

    def _refusal(self, scope: Scope) -> tuple[HTTPStatus, str] | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        if len(headers.getlist("host")) != 1 or not self._is_ours(host):
            what = f"Host {host[:80]!r} is not this server; name it with --allow-host"
            return HTTPStatus.FORBIDDEN, what
        websocket = scope["type"] == "websocket"
        changes = not websocket and scope["method"] not in SAFE_METHODS
        for origin in headers.getlist("origin") if websocket or changes else ():
            if origin not in (f"http://{host}", f"https://{host}"):
                what = f"Origin {origin[:80]!r} is another site than {host[:80]!r}"
                return HTTPStatus.FORBIDDEN, what
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > BODY_BYTES_MAX:
            what = f"A body of {length[:20]} bytes; at most {BODY_BYTES_MAX} are taken"
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, what
        if any(ord(character) < ord(" ") for character in scope["path"]):
            return HTTPStatus.BAD_REQUEST, "The path has control characters in it"
        # Every websocket but the live one, so that no other way of writing a path is a way in.
        needs_token = changes or (websocket and scope["path"] != LIVE_PATH)
        if needs_token and self._token is not None:
            given = bearer_token(headers.getlist("authorization"))
            if given is None or not hmac.compare_digest(given.encode(), self._token.encode()):
                return HTTPStatus.UNAUTHORIZED, _ASKED if given is None else _WRONG
        return None

    def _is_ours(self, host: str) -> bool:
        found = _HOST.fullmatch(host)
        if found is None:
            return False
        name = (found["name"] or found["address"]).lower()
        if name == "localhost" or name in self._hosts:
            return True
        try:
            # A foreign DNS can point a name here, but not an address.
            ipaddress.ip_address(name)
        except ValueError:
            return False
        return True


def bearer_token(given: Sequence[str]) -> str | None:
    """The token in a request's Authorization headers; None unless it is one `Bearer TOKEN`."""
    scheme, _, token = (given[0] if len(given) == 1 else "").partition(" ")
    return token.strip() or None if scheme.lower() == "bearer" else None


class _Limited:
    """Counts a body that does not state its length."""

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._bytes = 0

    async def __call__(self) -> Message:
        message = await self._receive()
        self._bytes += len(message.get("body", b""))
        if self._bytes > BODY_BYTES_MAX:
            raise HTTPException(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"A body of more than {BODY_BYTES_MAX} bytes"
            )
        return message


def _hardened(send: Send) -> Send:
    async def with_headers(message: Message) -> None:
        if message["type"] == "http.response.start":
            present = {name for name, _ in message["headers"]}
            extra = [(n.encode(), v.encode()) for n, v in _DEFAULT_HEADERS.items()]
            message["headers"] = [
                *message["headers"],
                *(header for header in extra if header[0] not in present),
            ]
        await send(message)

    return with_headers
