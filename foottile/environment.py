"""Settings of a client: the server's address, and variables of the environment."""

from __future__ import annotations

import logging
import os
import re

from foottile.errors import InvalidRequestError

log = logging.getLogger("foottile.environment")

TOKEN_VARIABLE = "FOOTTILE_TOKEN"  # noqa: S105  # a name

_TOKEN = re.compile(r"[!-~]{1,200}")
_KUBERNETES = re.compile(r"(?:tcp|udp|sctp)://\S+:\d+")


def read_variable(name: str) -> str | None:
    """Return the value of an environment variable; None if it is not set or empty.

    White space at both ends is removed, with the carriage return of an env file from Windows; so is
    one pair of quotes, which `docker run --env-file` leaves in the value. Kubernetes sets
    `NAME_PORT` to `tcp://10.0.0.1:8000` for a service of that name: such a value is ignored, with a
    warning.

    Raises:
        InvalidRequestError: a control character is in it.
    """
    value = os.environ.get(name, "").strip()
    if len(value) > 1 and value[0] == value[-1] and value[0] in "'\"":
        value = value[1:-1].strip()
    if any(ord(character) < ord(" ") or character == "\x7f" for character in value):
        raise InvalidRequestError(
            f"{name}: a control character is in its value; expected one line of text"
        )
    if name.endswith("_PORT") and _KUBERNETES.fullmatch(value):
        log.warning(
            "%s=%s is ignored: Kubernetes sets it for a service of this name; expected a number. "
            "Set enableServiceLinks: false, or rename the service",
            *(name, value),
        )
        return None
    return value or None


def read_token() -> str | None:
    """Return the token in `FOOTTILE_TOKEN`; None if it is not set or empty.

    Raises:
        InvalidRequestError: no HTTP header can carry it.
    """
    token = read_variable(TOKEN_VARIABLE)
    return None if token is None else check_token(token, TOKEN_VARIABLE)


def check_token(token: str, where: str) -> str:
    """Return a token without white space at its ends.

    Raises:
        InvalidRequestError: no HTTP header can carry it.
    """
    token = token.strip()
    if not _TOKEN.fullmatch(token):
        raise InvalidRequestError(
            f"{where} is no token; expected ASCII letters, digits and signs; no spaces. "
            "Copy the one that `foottile serve` shows or keeps in a file"
        )
    return token


def decode_zone(url: str) -> str:
    """Return an address with its IPv6 zone in the notation of sockets.

    A URL has `%25` in front of the zone (RFC 6874): `http://[fe80::1%25eth0]:8000`; a socket, `%`.
    """
    return re.sub(r"(?<=\[)[^]]*(?=])", lambda host: host[0].replace("%25", "%"), url, count=1)
