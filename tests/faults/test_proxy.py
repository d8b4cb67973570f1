"""The bad link by itself: what it does to plain TCP connections."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress

import pytest

from tests.faults.proxy import Proxy, Quality
from tests.waiting import PATIENCE_S


class Echo:
    """A server that sends back what it hears."""

    def __init__(self, port: int = 0) -> None:
        self._listening = socket.create_server(("127.0.0.1", port))
        self.port: int = self._listening.getsockname()[1]
        self._open: list[socket.socket] = []
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def stop(self) -> None:
        self._listening.shutdown(socket.SHUT_RDWR)
        self._listening.close()
        for connection in self._open:
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(5.0)
            assert not thread.is_alive()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._listening.accept()
                self._open.append(connection)
                thread = threading.Thread(target=self._serve, args=(connection,))
                self._threads.append(thread)
                thread.start()

    @staticmethod
    def _serve(connection: socket.socket) -> None:
        with connection, suppress(OSError):
            while data := connection.recv(65536):
                connection.sendall(data)


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
    with suppress(OSError):
        server.stop()


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


def test_in_a_black_hole_nobody_hears_anything_and_it_all_comes_late(proxy: Proxy) -> None:
    with connect(proxy) as connection:
        assert answer(connection, b"hello") == b"hello"
        proxy.black_hole()
        connection.sendall(b"lost?")
        connection.settimeout(0.2)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        proxy.mend()
        connection.settimeout(10.0)
        assert connection.recv(5) == b"lost?"


def test_a_connection_begun_in_a_black_hole_is_open_and_silent(proxy: Proxy) -> None:
    proxy.black_hole()
    with connect(proxy) as connection:
        connection.sendall(b"hello")
        connection.settimeout(0.2)
        with pytest.raises(TimeoutError):
            connection.recv(1)
        proxy.mend()
        connection.settimeout(10.0)
        assert connection.recv(5) == b"hello"


def test_what_is_delayed_comes_in_order_and_not_before(proxy: Proxy) -> None:
    proxy.quality = Quality(delay_s=0.1, jitter_s=0.1)
    with connect(proxy) as connection:
        begin_s = time.monotonic()
        data = bytes(range(256)) * 100
        assert answer(connection, data) == data
        assert time.monotonic() - begin_s >= 0.2  # both ways


def test_a_throttled_link_takes_as_long_as_it_must(proxy: Proxy) -> None:
    proxy.quality = Quality(bytes_per_s=100_000)
    with connect(proxy) as connection:
        begin_s = time.monotonic()
        data = bytes(40_000)
        assert answer(connection, data) == data
        assert time.monotonic() - begin_s >= 0.35


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
    echo.stop()
    with suppress(ConnectionResetError), connect(proxy) as connection:
        assert connection.recv(1) == b""
    again = Echo(echo.port)
    try:
        with connect(proxy) as connection:
            assert answer(connection, b"again") == b"again"
    finally:
        again.stop()
