"""Credentials of requests: the token, or a cookie obtained with a ticket or the token.

A ticket is for a person with a phone: short-lived, valid once, and never the token itself. Only
digests of tickets and cookies are kept, in memory: they end with the server.
"""

from __future__ import annotations

import hashlib
import hmac
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum

from starlette.requests import HTTPConnection

TICKET_S = 300.0
LOGIN_S = 12 * 3600.0
"""Lifetime of a login: a day in the field."""
TICKETS_MAX = 32
LOGINS_MAX = 256
_SECRET_BYTES = 16


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
