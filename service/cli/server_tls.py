"""TLS of `foottile serve`: certificates by its settings, and the page that hands out the CA."""

from __future__ import annotations

import asyncio
import socket
import ssl
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

from devices.errors import LinkError, require_extra
from service.api.address import (
    is_wildcard,
    list_addresses,
    list_own_names,
    list_urls,
    open_listening_socket,
    parse_advertised_url,
)
from service.api.settings import Settings
from service.cli.options import remark
from service.cli.tickets import get_host, is_reachable, show_qr_code
from service.discovery import SERVER_HOST

if TYPE_CHECKING:
    from service.api.certificates import OwnAuthority

_RENEWAL_PERIOD_S = 10.0
"""Interval at which the names of the machine are compared with those of the certificate."""
_PORT_MAX = 65535


@dataclass(frozen=True)
class ServerTls:
    """TLS of a server.

    Attributes:
        context: context of the server.
        ca_path: certificate that a client of this user trusts.
        authority: the server's own CA; None: the certificate was given.
        uncovered_names: names of the machine that its certificate does not cover.
    """

    context: ssl.SSLContext
    ca_path: Path
    authority: OwnAuthority | None = None
    uncovered_names: Sequence[str] = ()


def open_tls(settings: Settings) -> ServerTls | None:
    """Return the TLS that the settings ask for, None without; a CA is made at the first start.

    Raises:
        UsageError: a given file cannot be used.
        StorageError, DamagedFileError: a file of the data folder cannot be used.
    """
    if not settings.tls and settings.tls_cert is None:
        return None
    with require_extra("tls", "https"):
        from service.api.certificates import OwnAuthority, load_given_context
    if settings.tls_cert is not None and settings.tls_key is not None:
        context, remarks = load_given_context(settings.tls_cert, settings.tls_key)
        for each in remarks:
            remark(each)
        return ServerTls(context, settings.tls_cert)
    names, now = _list_names(settings), datetime.now(UTC)
    authority = OwnAuthority(settings.data, names, now)
    outside = authority.certify(names, now)
    authority.load()
    if outside:
        remark(authority.explain_outside(outside))
    return ServerTls(authority.context, authority.ca_path, authority, outside)


def _list_names(settings: Settings) -> list[str]:
    """Return the names and addresses under which a server may be reached now."""
    names = [f"{SERVER_HOST}.local", "localhost", "127.0.0.1", "::1", *list_own_names()]
    names += [*settings.allow_host, *list_addresses(include_ipv6=True)]
    if settings.advertise is not None:
        names.append(get_host(parse_advertised_url(settings.advertise, port=1)))
    return names if is_wildcard(settings.host) else [*names, settings.host]


@asynccontextmanager
async def hand_out_ca(
    tls: ServerTls | None,
    settings: Settings,
    listening: socket.socket,
    list_announced: Callable[[], list[str]],
) -> AsyncIterator[None]:
    """Context manager: serve the page of the CA, and renew the certificate when names change.

    Args:
        tls: TLS of the server; nothing is done unless it made its CA itself.
        settings: settings of the server.
        listening: socket of the server.
        list_announced: returns the names announced in the network.
    """
    if tls is None or tls.authority is None:
        yield
        return
    from service.api.app import run_uvicorn
    from service.api.ca_page import LIMITS, make_ca_page

    authority, port = tls.authority, listening.getsockname()[1]
    page = make_ca_page(authority.certificate_pem, authority.fingerprint, port)
    with _open_next(settings.host, port) as plain:
        url = list_urls(plain, settings.host)[0]
        async with run_uvicorn(page, plain, LIMITS):
            remark(f"phones and laptops first have to trust it: {url}")
            remark(f"compare there: SHA-256 {authority.fingerprint}")
            remark(f"a node trusts it by --ca and a copy of {authority.ca_path}")
            if is_reachable(url):
                show_qr_code(url, purpose="for a phone, once, before it opens the page")
            renewing = asyncio.create_task(
                _renew_forever(authority, settings, list_announced, tls.uncovered_names)
            )
            try:
                yield
            finally:
                renewing.cancel()
                await asyncio.gather(renewing, return_exceptions=True)


def _open_next(host: str, port: int) -> socket.socket:
    """Open a listening socket on the next port, or on any if that is in use."""
    try:
        return open_listening_socket(host, port + 1 if port < _PORT_MAX else 0)
    except LinkError:
        return open_listening_socket(host, 0)


async def _renew_forever(
    authority: OwnAuthority,
    settings: Settings,
    list_announced: Callable[[], list[str]],
    remarked_names: Sequence[str],
) -> None:
    """Renew the certificate when the names of the machine change, and when it ends."""
    before: tuple[list[str], int] | None = None
    reported = ""
    while True:
        await asyncio.sleep(_RENEWAL_PERIOD_S)
        now = datetime.now(UTC)
        try:
            current = ([*_list_names(settings), *list_announced()], now.toordinal())
            if current != before:
                outside = await asyncio.to_thread(authority.certify, current[0], now)
                authority.load()
                if outside and outside != remarked_names:
                    remark(authority.explain_outside(outside))
                before, remarked_names = current, outside
        except Exception as error:  # a bug, too: it is tried again
            if (what := f"the certificate is not renewed: {str(error) or repr(error)}") != reported:
                remark(what)
            reported = what
