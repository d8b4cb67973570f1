"""Dialling: at once where somebody listens, and soon where a link returns."""

from __future__ import annotations

import asyncio
import socket

import pytest
from websockets.exceptions import ConnectionClosed, ConnectionClosedError
from websockets.frames import Close

from service.node import server_connection
from service.node.server_connection import ReconnectBackoff, connect_tcp
from tests.waiting import in_a_loop


def listening() -> socket.socket:
    server = socket.socket()
    server.bind(("127.0.0.1", 0))
    server.listen(4)
    return server


def test_a_listening_server_is_connected_to() -> None:
    with listening() as server:
        port = server.getsockname()[1]
        found = asyncio.run(connect_tcp(f"ws://127.0.0.1:{port}"))
        assert found.getpeername() == ("127.0.0.1", port)
        assert found.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        found.close()


def test_a_port_without_a_listener_is_refused_at_once() -> None:
    with listening() as server:
        port = server.getsockname()[1]
    with pytest.raises(ConnectionRefusedError):
        asyncio.run(connect_tcp(f"ws://127.0.0.1:{port}"))


def test_a_name_that_is_none_is_an_error() -> None:
    with pytest.raises(OSError, match=r"."):
        asyncio.run(connect_tcp("ws://no-such-host.invalid:1"))


@in_a_loop
async def test_a_link_that_returns_is_noticed_by_a_fresh_attempt_beside_those_that_wait(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The kernel repeats its first packet after 1, 3, 7 s only."""
    monkeypatch.setattr(server_connection, "ATTEMPT_INTERVAL_S", 0.02)
    begun: list[int] = []

    loop = asyncio.get_running_loop()
    real = loop.sock_connect

    async def connect(sock: socket.socket, address: tuple[str, int]) -> None:
        begun.append(len(begun))
        if begun[-1] < 3:
            await asyncio.sleep(60.0)
        await real(sock, address)

    monkeypatch.setattr(loop, "sock_connect", connect)
    with listening() as server:
        (await connect_tcp(f"ws://127.0.0.1:{server.getsockname()[1]}")).close()
    assert asyncio.all_tasks() == {asyncio.current_task()}
    assert len(begun) >= 4


@in_a_loop
async def test_of_attempts_that_succeed_at_once_one_is_used_and_the_others_are_closed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(server_connection, "ATTEMPT_INTERVAL_S", 0.02)
    opened: list[socket.socket] = []
    all_begun = asyncio.Event()

    async def connect(sock: socket.socket, address: tuple[str, int]) -> None:
        opened.append(sock)
        if len(opened) == 3:
            all_begun.set()
        await all_begun.wait()

    monkeypatch.setattr(asyncio.get_running_loop(), "sock_connect", connect)
    used = await connect_tcp("ws://127.0.0.1:1")
    assert [sock for sock in opened if sock.fileno() >= 0] == [used]
    used.close()


@in_a_loop
async def test_a_server_that_never_answers_times_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server_connection, "ATTEMPT_INTERVAL_S", 0.01)
    monkeypatch.setattr(server_connection, "CONNECT_TIMEOUT_S", 0.05)

    loop = asyncio.get_running_loop()

    async def connect(sock: socket.socket, address: tuple[str, int]) -> None:
        await asyncio.sleep(60.0)

    monkeypatch.setattr(loop, "sock_connect", connect)
    with pytest.raises(TimeoutError, match="no answer"):
        await connect_tcp("ws://127.0.0.1:9")


def let_go_with(code: int) -> ConnectionClosed:
    return ConnectionClosedError(Close(code, "for this test"), None)


def test_a_node_that_is_let_go_for_what_it_sends_comes_back_ever_later(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A welcome is no success: it would be let go for the same again, twice a second."""
    monkeypatch.setattr(server_connection, "REFUSED_BACKOFF_S", (0.2, 5.0))
    back_off, waits = ReconnectBackoff(), []
    for _ in range(8):
        back_off.set_delays_for(let_go_with(4001))
        waits.append(back_off.next_delay_s())
    assert waits[0] <= 0.5
    assert 2.5 <= waits[-1] <= 5.0
    back_off.reset()  # frames were acknowledged
    assert back_off.next_delay_s() <= 0.5


def test_a_node_whose_message_was_damaged_on_its_way_sends_it_again_soon() -> None:
    back_off = ReconnectBackoff()
    for _ in range(8):
        back_off.set_delays_for(let_go_with(4004))
        assert back_off.next_delay_s() <= 0.5
