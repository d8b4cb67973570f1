"""Access control: credentials of requests, checks of Host and Origin, a role for every change.

A web page of another site can make a browser send requests here; it cannot choose the Host header
nor hide its Origin. The address of a peer is no proof of identity: through a reverse proxy, `ssh
-L` or a container's port everybody comes from loopback.

Credentials are the token, or a cookie obtained with a ticket or the token. A ticket is for a person
with a phone: short-lived, valid once, and never the token itself. Only digests of tickets and
cookies are kept, in memory: they end with the server.
"""

from __future__ import annotations

import hashlib
import hmac
import ipaddress
import re
import secrets
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from enum import IntEnum
from http import HTTPStatus

from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.requests import HTTPConnection
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from service.api.problems import problem_response
from service.protocol.live import LIVE_PATH
from service.server.calibrations import CONTENT_BYTES_MAX

TICKET_S = 300.0
LOGIN_S = 12 * 3600.0
"""Lifetime of a login: a day in the field."""
TICKETS_MAX = 32
LOGINS_MAX = 256
_SECRET_BYTES = 16
BODY_BYTES_MAX = 64 << 10
"""Size limit of a request's body: names and notes."""
CALIBRATIONS_PATH = "/api/v1/calibrations"
FILM_BYTES_MAX = 64 << 30
_FILMS_PATH = re.compile(r"/api/v1/sessions/[^/]+/videos")

LOGIN_PATH = "/api/v1/login"
TICKETS_PATH = "/api/v1/tickets"

_HERE = "the computer on which `foottile serve` runs"
_AS_PROGRAM = (
    "A program sends the token as Authorization: Bearer TOKEN, and commands of foottile take it "
    "from FOOTTILE_TOKEN; the server keeps it in the file `token` of its data folder, unless it "
    "was given one, and `foottile invite --data` takes it from there"
)
_CREDENTIALS_NEEDED = (
    "A change needs the server's token or a login: `foottile invite`, on "
    f"{_HERE}, prints a link that logs a browser in. {_AS_PROGRAM}"
)
_PRIVATE_SERVER = (
    "This server is private: reading needs the server's token or a login: "
    f"`foottile invite`, on {_HERE}, prints a link that logs a browser in. {_AS_PROGRAM}"
)
_WRONG_TOKEN = f"This is not the server's token. {_AS_PROGRAM}"
_LOGIN_EXPIRED = (
    "This login has expired: the server was restarted, or 12 hours have passed. "
    f"`foottile invite` creates a new one, on {_HERE}"
)
_VIEWER_ONLY = (
    "This login is a viewer's and may not change anything. `foottile invite` creates "
    f"an operator's, on {_HERE}"
)
_TOKEN_NEEDED = "A login is not enough for this: it needs the server's token"  # noqa: S105  # words
_PUBLIC_PATHS = re.compile(
    rf"/|/worker\.js|/nodes|/calibrate|/clock|/docs(?:/[^/]+)?|/sessions(?:/[^/]+)?|/static/.*|{LOGIN_PATH}|/api/v1/ready"
)
"""Paths that a private server also serves without credentials: pages and files without data, login,
and the readiness probe."""
_HOST_HEADER = re.compile(
    r"(?:(?P<name>[A-Za-z0-9._-]+)|\[(?P<address>[0-9A-Fa-f:.]+)(?P<zone>%[A-Za-z0-9._~%-]{1,40})?\])"
    r"(?::[0-9]{1,5})?"
)
"""Host header as browsers write it: a name or an address, and a port; no user, no path.

A link-local address may have a zone, the name of an interface behind `%` or `%25` (RFC 6874): some
clients send it, and the client has used it before the request arrives here.
"""
SAFE_METHODS = {"GET", "HEAD", "OPTIONS"}
_DEFAULT_HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' data:; "
    "media-src 'self' data:; frame-ancestors 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cache-control": "no-cache",  # revalidate: after an update the page must be new
}


class Role(IntEnum):
    """Role of a client; each includes those before it."""

    VIEWER = 1
    """Watch, list, download."""
    OPERATOR = 2
    """Also change something."""
    OWNER = 3
    """Also create tickets and be a node: has the token itself."""


@dataclass(frozen=True)
class Grant:
    """Role that was granted until a time of the boot clock."""

    role: Role
    ends_s: float


def _boot_s() -> float:
    # Unlike the monotonic clock it runs while a laptop sleeps.
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class SecretStore:
    """Random secrets, stored as digests with a role; each expires.

    Args:
        lifetime_s: lifetime of a secret.
        max_count: limit of valid secrets; a further one replaces the oldest.
        now_s: clock that never steps.
    """

    def __init__(
        self, *, lifetime_s: float, max_count: int, now_s: Callable[[], float] = _boot_s
    ) -> None:
        self._lifetime_s = lifetime_s
        self._max_count = max_count
        self._now_s = now_s
        self._grants: dict[bytes, Grant] = {}

    def create(self, role: Role) -> str:
        """Create a secret for a role."""
        self._remove_expired()
        while len(self._grants) >= self._max_count:
            del self._grants[next(iter(self._grants))]
        secret = secrets.token_urlsafe(_SECRET_BYTES)
        self._grants[_digest(secret)] = Grant(role, self._now_s() + self._lifetime_s)
        return secret

    def find_grant(self, secret: str) -> Grant | None:
        """Return the grant of a secret; None: unknown, expired or used."""
        found = self._find_digest(secret)
        return None if found is None else self._grants[found]

    def redeem(self, secret: str) -> Grant | None:
        """Return the grant of a secret and invalidate the secret."""
        found = self._find_digest(secret)
        return None if found is None else self._grants.pop(found)

    def remaining_s(self, grant: Grant) -> float:
        """Return the remaining lifetime of a grant."""
        return grant.ends_s - self._now_s()

    def _find_digest(self, secret: str) -> bytes | None:
        self._remove_expired()
        digest, found = _digest(secret), None
        for stored in self._grants:  # compare all: constant time
            if hmac.compare_digest(stored, digest):
                found = stored
        return found

    def _remove_expired(self) -> None:
        now_s = self._now_s()
        self._grants = {d: grant for d, grant in self._grants.items() if grant.ends_s > now_s}


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()


@dataclass(frozen=True)
class Credentials:
    """Result of checking a request's token or cookie."""

    role: Role | None
    """None: no valid credentials."""
    has_wrong_token: bool = False
    is_expired: bool = False
    """True: it has a cookie of this server that is no longer valid."""
    cookie_remaining_s: float | None = None
    """Remaining lifetime of its cookie; None without one."""


class Logins:
    """Token of a server, its tickets and its login cookies.

    Args:
        token: token of the server.
        is_private: True: reading needs a login, too.
        now_s: clock that never steps.
    """

    def __init__(
        self,
        token: str,
        *,
        is_private: bool = False,
        now_s: Callable[[], float] = _boot_s,
    ) -> None:
        self.token = token
        self.is_private = is_private
        self.tickets = SecretStore(lifetime_s=TICKET_S, max_count=TICKETS_MAX, now_s=now_s)
        self.cookies = SecretStore(lifetime_s=LOGIN_S, max_count=LOGINS_MAX, now_s=now_s)

    def check_credentials(self, request: HTTPConnection) -> Credentials:
        """Check the credentials of a request; the token takes precedence over a cookie."""
        if "authorization" in request.headers:
            token = parse_bearer_token(request.headers.getlist("authorization"))
            if token is not None and hmac.compare_digest(token.encode(), self.token.encode()):
                return Credentials(Role.OWNER)
            return Credentials(None, has_wrong_token=token is not None)
        cookie = self.read_cookie(request)
        if cookie is None:
            return Credentials(None)
        login = self.cookies.find_grant(cookie)
        if login is None:
            return Credentials(None, is_expired=True)
        return Credentials(login.role, cookie_remaining_s=self.cookies.remaining_s(login))

    def read_cookie(self, request: HTTPConnection) -> str | None:
        """Return the secret in a request's cookie, if it has one of this server's name."""
        return request.cookies.get(cookie_name(request))


def cookie_name(request: HTTPConnection) -> str:
    """Return the cookie's name, with the server's port: browsers share cookies between ports."""
    server = request.scope.get("server")
    return f"foottile_{server[1] if server else 0}"


def parse_bearer_token(headers: Sequence[str]) -> str | None:
    """Return the token in Authorization headers; None unless they are one `Bearer TOKEN`."""
    scheme, _, token = (headers[0] if len(headers) == 1 else "").partition(" ")
    return token.strip() or None if scheme.lower() == "bearer" else None


class AccessGuard:
    """ASGI middleware that rejects forbidden requests.

    Args:
        app: application behind it.
        hosts: names of the server, in addition to addresses of this machine; may grow.
        logins: required for every change of state, and for ingest.
    """

    def __init__(self, app: ASGIApp, *, hosts: Collection[str], logins: Logins) -> None:
        self._app = app
        self._hosts = hosts
        self._logins = logins

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Serve one connection."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        if (refusal := self._find_refusal(scope)) is not None:
            status, detail = refusal
            extra = {"www-authenticate": "Bearer"} if status == HTTPStatus.UNAUTHORIZED else {}
            await problem_response(scope["path"], status, detail, extra)(scope, receive, send)
        elif scope["type"] == "websocket":
            await self._app(scope, receive, send)
        else:
            await self._app(
                scope, _LimitedBody(receive, _body_limit_bytes(scope)), _with_security_headers(send)
            )

    def _find_refusal(self, scope: Scope) -> tuple[HTTPStatus, str] | None:
        headers = Headers(scope=scope)
        host = headers.get("host", "")
        # HTTP/1.0 needs no Host, and no browser speaks it: watchdogs and load balancers do.
        is_old = scope.get("http_version") == "1.0" and "host" not in headers
        if not is_old and (len(headers.getlist("host")) != 1 or not self._is_own_host(host)):
            what = f"Host {host[:80]!r} is not this server; name it with --allow-host"
            return HTTPStatus.FORBIDDEN, what
        websocket = scope["type"] == "websocket"
        changes = not websocket and scope["method"] not in SAFE_METHODS
        # Behind an untrusted TLS proxy, https looks like http here.
        is_https = scope["scheme"] in ("https", "wss")
        ours = {f"https://{host}"} if is_https else {f"http://{host}", f"https://{host}"}
        for origin in headers.getlist("origin") if websocket or changes else ():
            if origin not in ours:
                what = (
                    f"Origin {origin[:80]!r} is another site than {host[:80]!r}; a reverse proxy "
                    "has to pass on the Host header that the browser sent"
                )
                return HTTPStatus.FORBIDDEN, what
        length = headers.get("content-length", "0")
        if not length.isdigit() or int(length) > _body_limit_bytes(scope):
            what = f"A body of {length[:20]} bytes; at most {_body_limit_bytes(scope)} are accepted"
            return HTTPStatus.REQUEST_ENTITY_TOO_LARGE, what
        if any(ord(character) < ord(" ") for character in scope["path"]):
            return HTTPStatus.BAD_REQUEST, "The path has control characters in it"
        needed = self._required_role(scope)
        if needed is None:
            return None
        credentials = self._logins.check_credentials(HTTPConnection(scope))
        if credentials.cookie_remaining_s is not None and changes and "origin" not in headers:
            # Cookies come from browsers, which state the Origin of every change.
            credentials = Credentials(None)
        return _check_role(needed, credentials)

    def _required_role(self, scope: Scope) -> Role | None:
        path, looking = scope["path"], Role.VIEWER if self._logins.is_private else None
        if scope["type"] == "websocket":
            # Every path but the live one, so that no spelling of a path bypasses the check.
            return looking if path == LIVE_PATH else Role.OWNER
        if path == LOGIN_PATH:
            return None
        if scope["method"] in SAFE_METHODS:
            return None if _PUBLIC_PATHS.fullmatch(path) else looking
        return Role.OWNER if path == TICKETS_PATH else Role.OPERATOR

    def _is_own_host(self, host: str) -> bool:
        found = _HOST_HEADER.fullmatch(host)
        if found is None:
            return False
        name = (found["name"] or found["address"]).lower()
        if name == "localhost" or any(name == own.lower() for own in self._hosts):
            return True
        try:
            # DNS rebinding can point a name here, but not an address.
            address = ipaddress.ip_address(name)
        except ValueError:
            return False
        return found["zone"] is None or address.is_link_local


def parse_host(header: str) -> str | None:
    """Return the host of a Host header, without its port; None: it is none."""
    found = _HOST_HEADER.fullmatch(header)
    if found is None:
        return None
    return found["name"] or f"[{found['address']}{found['zone'] or ''}]"


def _body_limit_bytes(scope: Scope) -> int:
    """Return the limit of the body: whole files are accepted on two paths only."""
    path = scope["path"] if scope["type"] == "http" else ""
    if _FILMS_PATH.fullmatch(path):
        return FILM_BYTES_MAX
    return CONTENT_BYTES_MAX if path == CALIBRATIONS_PATH else BODY_BYTES_MAX


def _check_role(required: Role, credentials: Credentials) -> tuple[HTTPStatus, str] | None:
    """Return the refusal if the credentials lack the required role."""
    if credentials.role is None:
        what = _PRIVATE_SERVER if required is Role.VIEWER else _CREDENTIALS_NEEDED
        if credentials.has_wrong_token:
            what = _WRONG_TOKEN
        return HTTPStatus.UNAUTHORIZED, _LOGIN_EXPIRED if credentials.is_expired else what
    if credentials.role < required:
        return HTTPStatus.FORBIDDEN, _VIEWER_ONLY if required is Role.OPERATOR else _TOKEN_NEEDED
    return None


class _LimitedBody:
    """ASGI `receive` that limits a body without a stated length."""

    def __init__(self, receive: Receive, most: int) -> None:
        self._receive = receive
        self._most = most
        self._bytes = 0

    async def __call__(self) -> Message:
        message = await self._receive()
        self._bytes += len(message.get("body", b""))
        if self._bytes > self._most:
            raise HTTPException(
                HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"A body of more than {self._most} bytes"
            )
        return message


def _with_security_headers(send: Send) -> Send:
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
