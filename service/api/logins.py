"""Who has shown what: the token, or a cookie that a ticket or the token was changed for.

A ticket is for a person with a phone: short-lived, used once, and never the token itself. All that
is kept of tickets and cookies are digests, in memory: they end when the server does.
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
"""A day in the field."""
TICKETS_MAX = 32
LOGINS_MAX = 256
_SECRET_BYTES = 16


class Right(IntEnum):
    """What somebody may do; each includes those before it."""

    LOOK = 1
    """Watch, list, download."""
    PRESS = 2
    """Change something, too."""
    OWN = 3
    """Give tickets and be a node, too: who has the token itself."""


@dataclass(frozen=True)
class Given:
    """A right that was given, until an instant of the clock that counts."""

    right: Right
    ends_s: float


def _boot_s() -> float:
    # Unlike the monotonic clock it goes on while a laptop sleeps.
    return time.clock_gettime(time.CLOCK_BOOTTIME)


class Secrets:
    """Random secrets that were given out, known by their digests; each ends by itself.

    Args:
        lasts_s: for how long one is good.
        most: how many there are at once; one more pushes the oldest out.
        now_s: a clock that never steps.
    """

    def __init__(self, *, lasts_s: float, most: int, now_s: Callable[[], float] = _boot_s) -> None:
        self._lasts_s = lasts_s
        self._most = most
        self._now_s = now_s
        self._given: dict[bytes, Given] = {}

    def new(self, right: Right) -> str:
        """A secret for a right."""
        self._forget_old()
        while len(self._given) >= self._most:
            del self._given[next(iter(self._given))]
        secret = secrets.token_urlsafe(_SECRET_BYTES)
        self._given[_digest(secret)] = Given(right, self._now_s() + self._lasts_s)
        return secret

    def find(self, secret: str) -> Given | None:
        """What it was given for; None: it is unknown, has ended, or was taken."""
        found = self._find(secret)
        return None if found is None else self._given[found]

    def take(self, secret: str) -> Given | None:
        """The same, and it is good for nothing from now on."""
        found = self._find(secret)
        return None if found is None else self._given.pop(found)

    def left_s(self, given: Given) -> float:
        """For how long it is still good."""
        return given.ends_s - self._now_s()

    def _find(self, secret: str) -> bytes | None:
        self._forget_old()
        digest, found = _digest(secret), None
        for known in self._given:  # all of them, so that the time says nothing
            if hmac.compare_digest(known, digest):
                found = known
        return found

    def _forget_old(self) -> None:
        now_s = self._now_s()
        self._given = {d: given for d, given in self._given.items() if given.ends_s > now_s}


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode("utf-8", "surrogatepass")).digest()


@dataclass(frozen=True)
class Shown:
    """What a request shows of who asks."""

    right: Right | None
    """None: nothing that counts."""
    has_wrong_token: bool = False
    has_ended: bool = False
    """It has a cookie of this server that is good for nothing any more."""
    left_s: float | None = None
    """For how long its cookie is still good."""


class Logins:
    """The token of a server, its tickets, and the cookies they were changed for.

    Args:
        token: of the server.
        is_private: is a login asked for to look, too?
        now_s: a clock that never steps.
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
        """What a request shows; of a token and a cookie only the token counts."""
        if "authorization" in request.headers:
            given = bearer_token(request.headers.getlist("authorization"))
            if given is not None and hmac.compare_digest(given.encode(), self.token.encode()):
                return Shown(Right.OWN)
            return Shown(None, has_wrong_token=given is not None)
        cookie = self.cookie_of(request)
        if cookie is None:
            return Shown(None)
        login = self.cookies.find(cookie)
        if login is None:
            return Shown(None, has_ended=True)
        return Shown(login.right, left_s=self.cookies.left_s(login))

    def cookie_of(self, request: HTTPConnection) -> str | None:
        """The secret in a request's cookie, if it has one of this server's name."""
        return request.cookies.get(cookie_name(request))


def cookie_name(request: HTTPConnection) -> str:
    """With the server's port: to a browser all ports of a machine have the same cookies."""
    server = request.scope.get("server")
    return f"foottile_{server[1] if server else 0}"


def bearer_token(given: Sequence[str]) -> str | None:
    """The token in a request's Authorization headers; None unless it is one `Bearer TOKEN`."""
    scheme, _, token = (given[0] if len(given) == 1 else "").partition(" ")
    return token.strip() or None if scheme.lower() == "bearer" else None
