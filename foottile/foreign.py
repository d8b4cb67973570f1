"""Answers that are not a foottile server's: of captive portals, proxies and other programs."""

from __future__ import annotations

import re
from collections.abc import Mapping
from http import HTTPStatus
from urllib.parse import urljoin, urlsplit

_TEXT_MAX = 200


def explain_foreign(
    url: str, status: int, headers: Mapping[str, str], *, expected: str = ""
) -> str | None:
    """Return who answered in place of a foottile server and what to do; None if it is one.

    Args:
        url: what was asked for.
        status: of the answer.
        headers: of the answer, their names in small letters.
        expected: what has to come, if anything but an HTML page is not enough: `JSON`.
    """
    url = re.sub("^ws", "http", url)
    is_redirect = status in range(300, 400) and status != HTTPStatus.NOT_MODIFIED
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    is_page = kind in ("text/html", "application/xhtml+xml")
    wants_login = status == HTTPStatus.NETWORK_AUTHENTICATION_REQUIRED
    if not (is_redirect or is_page or wants_login or expected):
        return None
    program = f" of {_shown(headers['server'])}" if headers.get("server") else ""
    came = f"HTTP {status}{program}"
    remedy = (
        f"Open {_origin(url)} in a browser: a network may ask for a login, or another program has "
        "this address"
    )
    if is_redirect:
        target = urljoin(url, headers.get("location", ""))
        came += f", which leads to {_shown(target)}"
        if _is_same_but_secure(url, target):
            remedy = f"Use the address with https://, {_shown(_origin(target))}"
    elif is_page:
        came += " with an HTML page"
    elif kind:
        came += f" with {_shown(kind)}"
    return f"{came}; expected {expected or 'the answer'} of a foottile server. {remedy}"


def _is_same_but_secure(url: str, target: str) -> bool:
    asked, led = urlsplit(url), urlsplit(target)
    return asked.scheme == "http" and led.scheme == "https" and asked.hostname == led.hostname


def _origin(url: str) -> str:
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}"


def _shown(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable())[:_TEXT_MAX]
