"""HTTP responses of other programs: captive portals, proxies, other servers."""

from __future__ import annotations

import re
from collections.abc import Mapping
from http import HTTPStatus
from urllib.parse import urljoin, urlsplit

_TEXT_MAX = 200


def explain_foreign_response(
    url: str, status: int, headers: Mapping[str, str], *, expected: str = ""
) -> str | None:
    """Return the sender and the remedy of a foreign response; None for a foottile server's.

    Args:
        url: requested address.
        status: HTTP status.
        headers: headers, with names in lower case.
        expected: expected content; with it every response counts as foreign, not only HTML pages
            and redirects.
    """
    url = re.sub("^ws", "http", url)
    is_redirect = status in range(300, 400) and status != HTTPStatus.NOT_MODIFIED
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    is_page = kind in ("text/html", "application/xhtml+xml")
    wants_login = status == HTTPStatus.NETWORK_AUTHENTICATION_REQUIRED
    if not (is_redirect or is_page or wants_login or expected):
        return None
    program = f" of {_printable(headers['server'])}" if headers.get("server") else ""
    problem = f"HTTP {status}{program}"
    remedy = (
        f"Open {_origin(url)} in a browser: a network may ask for a login, or another program has "
        "this address"
    )
    if is_redirect:
        target = urljoin(url, headers.get("location", ""))
        problem += f", which leads to {_printable(target)}"
        if _is_same_but_secure(url, target):
            remedy = f"Use the address with https://, {_printable(_origin(target))}"
    elif is_page:
        problem += " with an HTML page"
    elif kind:
        problem += f" with {_printable(kind)}"
    return f"{problem}; expected {expected or 'the answer'} of a foottile server. {remedy}"


def _is_same_but_secure(url: str, target: str) -> bool:
    source, parts = urlsplit(url), urlsplit(target)
    return source.scheme == "http" and parts.scheme == "https" and source.hostname == parts.hostname


def _origin(url: str) -> str:
    parts = urlsplit(url)
    return f"{parts.scheme}://{parts.netloc}"


def _printable(text: str) -> str:
    return "".join(letter for letter in text if letter.isprintable())[:_TEXT_MAX]
