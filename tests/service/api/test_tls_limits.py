"""Limits of connections hold with TLS: a handshake that does not end costs others nothing."""

from __future__ import annotations

import socket
import ssl
import time
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path

import pytest

from foottile.connection import make_context
from service.api.certificates import OwnAuthority
from service.api.connection_limits import RESERVE
from service.api.settings import LimitSettings
from tests.service.running import Running, ServeWith
from tests.waiting import until

HELLO = b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03"
"""Begin of a ClientHello."""
LIMITS = LimitSettings(
    max_connections=4, max_nodes=1, header_timeout_s=2.0, body_timeout_s=2.0, idle_timeout_s=2.0
)


@pytest.fixture
def authority(tmp_path: Path) -> OwnAuthority:
    now = datetime.now(UTC)
    authority = OwnAuthority(tmp_path, ["127.0.0.1"], now)
    authority.certify(["127.0.0.1"], now)
    authority.load()
    return authority


@pytest.fixture
def secure(serve_with: ServeWith, authority: OwnAuthority) -> Running:
    return serve_with(context=authority.context, bounds=LIMITS)


def connect(running: Running) -> socket.socket:
    return socket.create_connection(("127.0.0.1", running.port), 20.0)


def has_ended(connection: socket.socket) -> bool:
    try:
        while connection.recv(1 << 16):
            continue
    except ConnectionError:
        return True
    return True


@pytest.mark.parametrize("begin", [b"", HELLO, HELLO[:3]], ids=["nothing", "half", "a word"])
def test_a_handshake_that_does_not_end_is_closed(
    serve_with: ServeWith, authority: OwnAuthority, begin: bytes
) -> None:
    running = serve_with(context=authority.context, bounds=LimitSettings(header_timeout_s=0.5))
    with connect(running) as connection:
        connection.sendall(begin)
        begin_s = time.monotonic()
        assert has_ended(connection)
        assert time.monotonic() - begin_s > 0.25


def test_plain_http_is_closed(secure: Running) -> None:
    with connect(secure) as connection:
        connection.sendall(b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        assert has_ended(connection)


@pytest.mark.parametrize("begin", [b"", b"GET / HTTP/1.1\r\nHost: "])
def test_slow_headers_time_out_behind_the_handshake(
    secure: Running, authority: OwnAuthority, begin: bytes
) -> None:
    context = make_context(authority.ca_path)
    with (
        connect(secure) as plain,
        context.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
    ):
        connection.sendall(begin)
        answer = connection.recv(1 << 16)
        assert answer.startswith(b"HTTP/1.1 408") if begin else answer == b""


def test_a_flood_of_half_handshakes_keeps_nobody_out(
    secure: Running, authority: OwnAuthority
) -> None:
    context = make_context(authority.ca_path)
    with ExitStack() as stack:
        flood = [stack.enter_context(connect(secure)) for _ in range(4 * RESERVE)]
        for each in flood:
            each.sendall(HELLO)
        with (
            connect(secure) as plain,
            context.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
        ):
            connection.sendall(b"GET /api/v1/ready HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
            assert connection.recv(1 << 16).startswith(b"HTTP/1.1 200")
        # Most are closed long before their timeout, for lack of room.
        for each in flood:
            each.setblocking(False)

        def count_open() -> int:
            is_open = 0
            for each in flood:
                try:
                    is_open += bool(each.recv(1))
                except (BlockingIOError, ssl.SSLError):
                    is_open += 1
                except ConnectionError:
                    continue
            return is_open

        until(lambda: count_open() <= LIMITS.max_connections + RESERVE + LIMITS.max_nodes)


def test_a_server_ends_while_a_handshake_waits(secure: Running) -> None:
    with connect(secure) as connection:
        connection.sendall(HELLO)
        secure.stop()
        assert has_ended(connection)
