"""Connections of a client: TLS, websockets without redirects, closing, foreign responses."""

from __future__ import annotations

import os
import re
import ssl
import stat
from abc import ABC, abstractmethod
from collections.abc import Mapping
from http import HTTPStatus
from pathlib import Path
from typing import Any, Self
from urllib.parse import urljoin, urlsplit

from websockets.asyncio.client import ClientConnection as AsyncClientConnection
from websockets.exceptions import InvalidHandshake, InvalidStatus
from websockets.http11 import Response
from websockets.sync.client import ClientConnection

from foottile.errors import InvalidRequestError

_BYTES_MAX = 16 << 20
"""Size limit of a file of CAs: 70 times Debian's."""


def make_context(
    ca: str | os.PathLike[str] | None = None, *, is_exclusive: bool = False
) -> ssl.SSLContext:
    """Return a context that trusts the CAs of this machine and of a file.

    The machine's CAs are OpenSSL's, or those of the variables SSL_CERT_FILE and SSL_CERT_DIR.

    Args:
        ca: certificates in PEM, or a folder prepared by `openssl rehash`.
        is_exclusive: trust no other CA than these.

    Raises:
        InvalidRequestError: no readable certificate.
    """
    if ca is None:
        return ssl.create_default_context()
    context = (
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT) if is_exclusive else ssl.create_default_context()
    )
    path = Path(ca)
    count_before = len(context.get_ca_certs())
    try:
        if path.is_dir():
            context.load_verify_locations(capath=path)  # read on demand
            has_certs = any(each.suffix in (".pem", ".crt", ".0") for each in path.iterdir())
        else:
            _check_file(path)
            context.load_verify_locations(cafile=path)
            has_certs = len(context.get_ca_certs()) > count_before or _is_trusted(path)
    except (OSError, ValueError) as error:  # an ssl.SSLError is an OSError
        raise InvalidRequestError(
            f"{str(path)!r}: no CA certificates can be read: {error}; expected a file in PEM"
        ) from error
    if not has_certs:
        raise InvalidRequestError(
            f"{str(path)!r}: there is no CA certificate in it; expected a file in PEM"
        )
    return context


def make_local_context(ca: str) -> ssl.SSLContext:
    """Return a context that trusts only the CA, or the certificate, of this user's own server.

    Its name is not compared: it listens on a loopback address, and its file is this user's.

    Raises:
        InvalidRequestError: there is no readable certificate.
    """
    try:
        context = ssl.create_default_context(cafile=ca)
    except OSError as error:
        raise InvalidRequestError(
            f"{ca!r}: the certificate of the local server: {error}"
        ) from error
    context.check_hostname = False
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    return context


def _check_file(path: Path) -> None:
    """Reject a pipe, on which OpenSSL would block, and a huge file."""
    found = path.stat()
    if not stat.S_ISREG(found.st_mode) or found.st_size > _BYTES_MAX:
        raise ValueError(f"not a file of at most {_BYTES_MAX >> 20} MiB")


def _is_trusted(path: Path) -> bool:
    """Return whether the certificates of a file are already in the machine's trust store."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.load_verify_locations(cafile=path)
    return bool(context.get_ca_certs())


def explain_tls(error: BaseException | None) -> str | None:
    """Return problem and remedy of a TLS failure; None for other errors.

    Args:
        error: exception, perhaps with a TLS error as its cause.
    """
    while error is not None and not isinstance(error, ssl.SSLError):
        error = error.__cause__ or error.__context__
    if error is None:
        return None
    if isinstance(error, ssl.SSLCertVerificationError):
        remedy = "Name the file of its CA: --ca, `ca=` in Python, or SSL_CERT_FILE"
        if "valid" in error.verify_message or "expired" in error.verify_message:
            remedy = "Is the clock of this machine right?"
        elif "mismatch" in error.verify_message:
            remedy = "Use a name that the certificate has"
        return f"its certificate is not trusted: {error.verify_message}. {remedy}"
    return f"TLS failed: {error.reason or error}. If it speaks plain HTTP, use http://"


class UpgradeRejection(InvalidHandshake):
    """HTTP response in place of a websocket.

    Attributes:
        status: HTTP status.
        headers: headers, with names in lower case.
        body: content.
    """

    def __init__(self, response: Response) -> None:
        super().__init__(f"HTTP {response.status_code}")
        self.status = response.status_code
        self.headers = {name.lower(): value for name, value in response.headers.raw_items()}
        self.body = bytes(response.body or b"")


class Websocket(ClientConnection):
    """Websocket for threads, as `create_connection` of `websockets.sync`."""

    def handshake(self, *args: Any, **options: Any) -> None:
        """Perform the websocket handshake.

        Raises:
            UpgradeRejection: the server sent an HTTP response.
        """
        try:
            super().handshake(*args, **options)
        except InvalidStatus as error:
            raise UpgradeRejection(error.response) from error


class AsyncWebsocket(AsyncClientConnection):
    """Websocket for an event loop, as `create_connection` of `websockets.asyncio`."""

    async def handshake(self, *args: Any, **options: Any) -> None:
        """Perform the websocket handshake.

        Raises:
            UpgradeRejection: the server sent an HTTP response.
        """
        try:
            await super().handshake(*args, **options)
        except InvalidStatus as error:
            raise UpgradeRejection(error.response) from error


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


class Closeable(ABC):
    """Context manager that calls `close`."""

    @abstractmethod
    def close(self) -> None:
        """Release the connections."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class AsyncCloseable(ABC):
    """Asynchronous context manager that calls `close`."""

    @abstractmethod
    async def close(self) -> None:
        """Release the connections."""

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()
