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


class Right(IntEnum):
    """Role of a client; each includes those before it."""

    LOOK = 1
    """Watch, list, download."""
    PRESS = 2
    """Also change something."""
    OWN = 3
    """Also create tickets and be a node: has the token itself."""


@dataclass(frozen=True)
class Given:
    """Role that was granted until a time of the boot clock."""

    right: Right
    ends_s: float


def _boot_s() -> float:
    # Unlike the monotonic clock it runs while a laptop sleeps.
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Secrets:
    """Random secrets, stored as digests with a role; each expires.

    Args:
        lifetime_s: lifetime of a secret.
        max_count: limit of valid secrets; a further one replaces the oldest.
        now_s: clock that never steps.
    """

    def __init__(self, *, lasts_s: float, most: int, now_s: Callable[[], float] = _boot_s) -> None:
        self._lasts_s = lasts_s
        self._most = most
        self._now_s = now_s
        self._given: dict[bytes, Given] = {}

    def new(self, right: Right) -> str:
        """Create a secret for a role."""
        self._forget_old()
        while len(self._given) >= self._most:
            del self._given[next(iter(self._given))]
        secret = secrets.token_urlsafe(_SECRET_BYTES)
        self._given[_digest(secret)] = Given(right, self._now_s() + self._lasts_s)
        return secret

    def find(self, secret: str) -> Given | None:
        """Return the grant of a secret; None: unknown, expired or used."""
        found = self._find(secret)
        return None if found is None else self._given[found]

    def take(self, secret: str) -> Given | None:
        """Return the grant of a secret and invalidate the secret."""
        found = self._find(secret)
        return None if found is None else self._given.pop(found)

    def left_s(self, given: Given) -> float:
        """Return the remaining lifetime of a grant."""
        return given.ends_s - self._now_s()

    def _find(self, secret: str) -> bytes | None:
        self._forget_old()
        digest, found = _digest(secret), None
        for stored in self._given:  # compare all: constant time
            if hmac.compare_digest(stored, digest):
                found = stored
        return found

    def _forget_old(self) -> None:
        now_s = self._now_s()
        self._given = {d: grant for d, grant in self._given.items() if grant.ends_s > now_s}


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()


@dataclass(frozen=True)
class Shown:
    """Result of checking a request's token or cookie."""

    right: Right | None
    """None: no valid credentials."""
    has_wrong_token: bool = False
    has_ended: bool = False
    """True: it has a cookie of this server that is no longer valid."""
    left_s: float | None = None
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
        self.tickets = Secrets(lasts_s=TICKET_S, most=TICKETS_MAX, now_s=now_s)
        self.cookies = Secrets(lasts_s=LOGIN_S, most=LOGINS_MAX, now_s=now_s)

    def shown_by(self, request: HTTPConnection) -> Shown:
        """Check the credentials of a request; the token takes precedence over a cookie."""
        if "authorization" in request.headers:
            token = bearer_token(request.headers.getlist("authorization"))
            if token is not None and hmac.compare_digest(token.encode(), self.token.encode()):
                return Shown(Right.OWN)
            return Shown(None, has_wrong_token=token is not None)
        cookie = self.cookie_of(request)
        if cookie is None:
            return Shown(None)
        login = self.cookies.find(cookie)
        if login is None:
            return Shown(None, has_ended=True)
        return Shown(login.right, left_s=self.cookies.left_s(login))

    def cookie_of(self, request: HTTPConnection) -> str | None:
        """Return the secret in a request's cookie, if it has one of this server's name."""
        return request.cookies.get(cookie_name(request))


def cookie_name(request: HTTPConnection) -> str:
    """Return the cookie's name, with the server's port: browsers share cookies between ports."""
    server = request.scope.get("server")
    return f"foottile_{server[1] if server else 0}"


def bearer_token(given: Sequence[str]) -> str | None:
    """Return the token in Authorization headers; None unless they are one `Bearer TOKEN`."""
    scheme, _, token = (given[0] if len(given) == 1 else "").partition(" ")
    return token.strip() or None if scheme.lower() == "bearer" else None
