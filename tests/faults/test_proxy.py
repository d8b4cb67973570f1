"""The bad link by itself: what it does to plain TCP connections."""

from __future__ import annotations

import socket
import socketserver
import threading
import time
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import Any

import pytest

from tests.faults.proxy import Proxy, Quality
from tests.waiting import PATIENCE_S


class Echo(socketserver.ThreadingTCPServer):
    """A server that sends back what it hears, in a thread of its own."""

    allow_reuse_address = True
    daemon_threads, block_on_close = True, False

    def __init__(self, port: int = 0) -> None:
        self._open: list[socket.socket] = []
        super().__init__(("127.0.0.1", port), None)  # type: ignore[arg-type]  # `finish_request` is ours
        self.port: int = self.server_address[1]
        self._thread = threading.Thread(target=self.serve_forever, args=(0.02,))
        self._thread.start()

    def process_request(self, request: Any, client_address: Any) -> None:
        self._open.append(request)  # here: when the server has shut down, all are in the list
        super().process_request(request, client_address)

    def finish_request(self, request: Any, client_address: Any) -> None:
        with suppress(OSError):
            while data := request.recv(65536):
                request.sendall(data)

    def close(self) -> None:
        self.shutdown()
        for connection in self._open:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self.server_close()
        self._thread.join(5.0)
        assert not self._thread.is_alive()


class Heard:
    """A tap that keeps everything."""

    def __init__(self) -> None:
        self.node = b""
        self.server = b""

    def to_server(self, data: bytes) -> None:
        self.node += data

    def to_node(self, data: bytes) -> None:
        self.server += data


@pytest.fixture
def echo() -> Iterator[Echo]:
    server = Echo()
    yield server
    server.close()


@pytest.fixture
def proxy(echo: Echo) -> Iterator[Proxy]:
    with Proxy(echo.port, seed=1) as running:
        yield running


def connect(proxy: Proxy) -> socket.socket:
    return socket.create_connection(("127.0.0.1", proxy.port), timeout=PATIENCE_S)


def answer(connection: socket.socket, data: bytes) -> bytes:
    sender = threading.Thread(target=connection.sendall, args=(data,))
    sender.start()
    got = b""
    while len(got) < len(data):
        piece = connection.recv(65536)
        assert piece, "closed"
        got += piece
    sender.join(10.0)
    return got


def test_a_good_link_changes_nothing(proxy: Proxy) -> None:
    with connect(proxy) as connection:
        data = bytes(range(256)) * 2000
        assert answer(connection, data) == data


def test_a_cut_link_resets_what_is_open_and_what_is_opened_and_comes_back_on_the_same_port(
    proxy: Proxy,
) -> None:
    with connect(proxy) as connection:
        assert answer(connection, b"hello") == b"hello"
        proxy.cut()
        with pytest.raises(ConnectionResetError):
            connection.recv(1)
    with suppress(ConnectionResetError), connect(proxy) as connection:
        assert connection.recv(1) == b"not reached"
    proxy.mend()
    with connect(proxy) as connection:
        assert answer(connection, b"again") == b"again"


@pytest.mark.parametrize("is_begun_before", [True, False])
def test_in_a_black_hole_nobody_hears_anything_and_it_all_comes_late(
    proxy: Proxy, is_begun_before: bool
) -> None:
    if not is_begun_before:
        proxy.black_hole()
    with connect(proxy) as connection:
        if is_begun_before:
            assert answer(connection, b"hello") == b"hello"
            proxy.black_hole()
        connection.sendall(b"lost?")
        connection.settimeout(0.2)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        proxy.mend()
        connection.settimeout(PATIENCE_S)
        assert connection.recv(5) == b"lost?"


@pytest.mark.parametrize(
    ("quality", "size", "least_s"),
    [
        (Quality(delay_s=0.1, jitter_s=0.1), 25_600, 0.2),  # both ways
        (Quality(bytes_per_s=100_000), 40_000, 0.35),
    ],
)
def test_delayed_or_throttled_bytes_come_in_order_and_not_early(
    proxy: Proxy, quality: Quality, size: int, least_s: float
) -> None:
    proxy.quality = quality
    with connect(proxy) as connection:
        begin_s = time.monotonic()
        data = (bytes(range(256)) * 200)[:size]
        assert answer(connection, data) == data
        assert time.monotonic() - begin_s >= least_s


def test_bits_flip_on_the_way_to_the_server_only_and_are_counted(echo: Echo) -> None:
    heard = Heard()
    with Proxy(echo.port, seed=1, tap=lambda: heard) as proxy:
        proxy.quality = Quality(flip_every_bytes=5000)
        with connect(proxy) as connection:
            data = bytes(100_000)
            got = answer(connection, data)
        wrong = [byte for byte in got if byte]
        assert 5 < len(wrong) < 60
        assert proxy.flips == sum(byte.bit_count() for byte in wrong)
        assert heard.node == data, "a tap sees what was sent"
        assert heard.server == got


def test_bits_that_begin_to_flip_while_a_connection_is_open_flip(proxy: Proxy) -> None:
    with connect(proxy) as connection:
        assert answer(connection, bytes(20_000)) == bytes(20_000)
        proxy.quality = Quality(flip_every_bytes=1000)
        assert answer(connection, bytes(100_000)) != bytes(100_000)


def test_a_dead_server_is_a_reset_and_one_that_is_back_is_reached(proxy: Proxy, echo: Echo) -> None:
    echo.close()
    with suppress(ConnectionResetError), connect(proxy) as connection:
        assert connection.recv(1) == b""
    again = Echo(echo.port)
    with closing(again), connect(proxy) as connection:
        assert answer(connection, b"again") == b"again"
