"""How many connections there may be, who leaves when there are more, and who is too slow."""

from __future__ import annotations

import asyncio
import errno
import json
import socket
import time
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed

from service.api.connection_limits import OWN_FILES, RESERVE, ConnectionLimiter, LimitSettings
from service.api.protocols import accept_connections
from service.protocol import INGEST_PATH, LIVE_PATH, PROTOCOL, Identify, LinkCloseCode
from tests.service.fake_node import NodeOf, Play, Spoken
from tests.service.running import Running, ServeWith, closed
from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S, in_a_loop, until

PLENTY = 10_000
"""Of descriptors."""


class Guest:
    """A transport that only knows whether it was closed."""

    is_out = False

    def abort(self) -> None:
        self.is_out = True


def guests(doors: ConnectionLimiter, n: int, address: str = "a") -> list[Guest]:
    come = [Guest() for _ in range(n)]
    for guest in come:
        doors.add_connection(guest, address)
    return come


def test_requests_beyond_the_bound_are_refused_until_one_is_done() -> None:
    doors = ConnectionLimiter(LimitSettings(max_connections=2), PLENTY)
    first, second, third = guests(doors, 3)
    assert doors.acquire(first)
    assert doors.acquire(second)
    assert not doors.acquire(third)
    doors.release(first)
    assert doors.acquire(third)
    assert doors.acquire(third)  # it asks twice: it is inside already


def test_one_address_does_not_take_all_places() -> None:
    doors = ConnectionLimiter(
        LimitSettings(max_connections=3, max_connections_per_address=2), PLENTY
    )
    first, second, third = guests(doors, 3, "greedy")
    (other,) = guests(doors, 1, "other")
    assert doors.acquire(first)
    assert doors.acquire(second)
    assert not doors.acquire(third)
    assert doors.acquire(other)


def test_the_one_that_waits_longest_goes_of_the_address_that_has_most() -> None:
    doors = ConnectionLimiter(LimitSettings(max_connections=1), PLENTY)
    (modest,) = guests(doors, 1, "modest")
    greedy = guests(doors, RESERVE, "greedy")
    assert greedy[0].is_out
    assert not any(guest.is_out for guest in (modest, *greedy[1:]))


def test_nobody_takes_a_nodes_place() -> None:
    doors = ConnectionLimiter(LimitSettings(max_connections=4, max_nodes=2), PLENTY)
    for guest in guests(doors, 4):
        assert doors.acquire(guest)
    node, *flood = guests(doors, 10 * RESERVE)
    assert node.is_out  # it said nothing before all these came
    node = flood[-1]
    assert doors.acquire_node(node)
    guests(doors, 10 * RESERVE)
    assert not node.is_out
    assert not doors.has_max_nodes


def test_nodes_beyond_the_bound_are_refused_until_one_has_gone() -> None:
    doors = ConnectionLimiter(LimitSettings(max_nodes=2), PLENTY)
    first, second, third = guests(doors, 3)
    assert doors.acquire_node(first)
    assert doors.acquire_node(second)
    assert not doors.acquire_node(third)
    assert doors.acquire_node(first), "it speaks again: it is inside already"
    doors.remove_connection(first)
    assert doors.acquire_node(third)


def test_what_recording_needs_is_not_given_to_connections(caplog: Any) -> None:
    doors = ConnectionLimiter(LimitSettings(), 256)
    assert doors.connections_max * 2 + OWN_FILES <= 256
    assert "only 256 files" in caplog.text


def test_a_flood_is_said_once(caplog: Any) -> None:
    doors = ConnectionLimiter(LimitSettings(max_connections=1), PLENTY)
    inside, *others = guests(doors, 30)
    doors.acquire(inside)
    assert not any(doors.acquire(other) for other in others)
    assert len(caplog.records) == 1


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 80), st.integers(0, 3)), max_size=400))
def test_whatever_they_do_there_are_never_more_than_descriptors_for_them(
    steps: list[tuple[int, int, int]],
) -> None:
    doors = ConnectionLimiter(LimitSettings(max_connections=8, max_nodes=4), PLENTY)
    inside: list[Guest] = []
    for what, which, address in steps:
        if what <= 1 and not doors.is_full:
            inside += guests(doors, 1, str(address))
        elif inside:
            guest = inside[which % len(inside)]
            if what == 2:
                doors.acquire(guest)
            elif what == 3:
                doors.acquire_node(guest)
            elif what == 4:
                doors.release(guest)
            else:
                doors.remove_connection(guest)
                inside.remove(guest)
        gone(doors, inside)
        assert len(inside) <= 8 + 4 + RESERVE
        while doors.is_full:  # there is somebody to turn out, or nobody would ever get in again
            doors.evict_idle()
            assert gone(doors, inside)


def gone(doors: ConnectionLimiter, inside: list[Guest]) -> list[Guest]:
    """Those who were turned out, and have left."""
    out = [guest for guest in inside if guest.is_out]
    for guest in out:
        inside.remove(guest)  # as its transport does, which was aborted
        doors.remove_connection(guest)
    return out


@in_a_loop
async def test_a_bug_while_one_is_taken_in_does_not_keep_out_the_next(caplog: Any) -> None:
    makes = iter([ZeroDivisionError("a bug")])

    def make() -> asyncio.Protocol:
        for error in makes:
            raise error
        return Greeting()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        taking = asyncio.create_task(
            accept_connections(listening, make, ConnectionLimiter(LimitSettings(), PLENTY))
        )
        said = []
        for _ in range(2):
            reader, writer = await asyncio.open_connection(*listening.getsockname())
            said.append(await asyncio.wait_for(reader.read(), 5.0))
            writer.close()
        taking.cancel()
    assert said == [b"", b"welcome"]
    assert "a bug" in caplog.text


@in_a_loop
async def test_a_socket_that_goes_on_failing_does_not_take_the_loop(monkeypatch: Any) -> None:
    loop, tries = asyncio.get_running_loop(), 0

    async def fail(_: socket.socket) -> None:
        nonlocal tries
        tries += 1
        raise OSError(errno.EPERM, "a firewall")

    monkeypatch.setattr(loop, "sock_accept", fail)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        taking = asyncio.create_task(
            accept_connections(
                listening, asyncio.Protocol, ConnectionLimiter(LimitSettings(), PLENTY)
            )
        )
        await asyncio.sleep(0.1)
        taking.cancel()
    assert 0 < tries < 50


class Greeting(asyncio.Protocol):
    """Says a word and goes."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        transport.write(b"welcome")
        transport.close()


def test_beyond_the_bound_a_screen_is_told_1013_and_a_request_503(strict: Running) -> None:
    with ExitStack() as screens:
        for _ in range(3):
            screens.enter_context(strict.socket(LIVE_PATH)).recv(timeout=PATIENCE_S)
        with strict.socket(LIVE_PATH) as further:
            code, reason = closed(further)
        assert code == LinkCloseCode.TRY_LATER
        assert "too many" in reason
        answer = strict.http.get("/health")
        assert answer.status_code == 503
        assert (
            answer.json()["detail"] == "There are too many connections; try again in some seconds"
        )
        assert answer.headers["retry-after"] == "5"
    until(lambda: strict.http.get("/health").status_code == 200)


def test_a_node_gets_in_when_screens_have_taken_every_place(
    strict: Running, node_of: NodeOf
) -> None:
    with ExitStack() as others:
        for _ in range(3):
            others.enter_context(strict.socket(LIVE_PATH)).recv(timeout=PATIENCE_S)
        for _ in range(2 * RESERVE):
            others.enter_context(socket.create_connection(("127.0.0.1", strict.port)))
        node = node_of(strict)
        node.connect()
        node.deliver(50)


def test_more_nodes_than_may_be_are_told_to_come_later(
    serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with(bounds=LimitSettings(max_nodes=1))
    node = node_of(running)
    node.connect()
    with running.socket(INGEST_PATH) as further:
        assert closed(further)[0] == LinkCloseCode.TRY_LATER
    node.deliver(10)


def test_more_nodes_than_may_be_that_speak_at_once_are_told_to_come_later(
    serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with(bounds=LimitSettings(max_nodes=2))
    nodes = [node_of(running, f"leg{number}") for number in range(6)]
    with ExitStack() as sockets:
        dialled = [Spoken(sockets.enter_context(running.socket(INGEST_PATH))) for _ in nodes]
        for node, spoken in zip(nodes, dialled, strict=True):
            spoken.send(Identify(protocol=PROTOCOL, node=node.name).model_dump_json())
        told = [first_word(spoken) for spoken in dialled]
    assert sorted(map(str, told)) == ["1013"] * 4 + ["challenge"] * 2
    until(lambda: not any(node["connected"] for node in running.http.get("/nodes").json()["items"]))
    nodes[-1].connect()


def test_one_that_was_let_go_and_goes_on_sending_takes_no_nodes_place(
    serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with(bounds=LimitSettings(max_nodes=1))
    word = b"\x81\x81" + bytes(4) + b"x"
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as connection:
        connection.sendall(upgrade(INGEST_PATH) + word)
        read_until(connection, b"\x88")  # a close frame, never answered
        for _ in range(3):
            connection.sendall(word)
            time.sleep(0.05)
        node_of(running).connect()


def test_one_that_goes_on_talking_is_not_cut_off_before_it_has_heard_why(running: Running) -> None:
    word = b"\x81\x81" + bytes(4) + b"x"
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as connection:
        connection.sendall(upgrade(LIVE_PATH))
        read_until(connection, b"hello")
        connection.sendall(word)
        read_until(connection, b"only {")  # of the close frame
        for _ in range(100):  # into a closed connection: the first brings a reset, the next breaks
            connection.sendall(word)
        connection.sendall(b"\x88\x82" + bytes(4) + int(LinkCloseCode.POLICY).to_bytes(2))
        while connection.recv(65536):  # to the end, which is not a reset
            pass


def read_until(connection: socket.socket, wanted: bytes) -> None:
    """Read until these bytes have come, which have to come before the end."""
    said = b""
    while wanted not in said:
        more = connection.recv(65536)
        assert more, f"it ended with {said!r}"
        said += more


def upgrade(path: str) -> bytes:
    """A request for a websocket."""
    return (
        f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n"
        f"Authorization: Bearer {SHARED_TOKEN}\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        "Sec-WebSocket-Version: 13\r\n\r\n"
    ).encode()


def first_word(spoken: Spoken) -> int | str:
    """What the first message of the server is, or with which code it closes."""
    try:
        return str(json.loads(spoken.recv(timeout=PATIENCE_S))["type"])
    except ConnectionClosed as end:
        return int(end.rcvd.code) if end.rcvd is not None else "cut off"


def test_a_websocket_has_no_time_for_headers_to_come(strict: Running, node_of: NodeOf) -> None:
    node = node_of(strict)
    node.connect()
    with strict.socket(LIVE_PATH) as live, Play(node) as play:
        for _ in range(20):
            live.recv(timeout=PATIENCE_S)
    assert play.problem is None


def test_one_that_pings_and_does_not_read_is_let_go(serve_with: ServeWith) -> None:
    running = serve_with()
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as connection:
        connection.sendall(upgrade(LIVE_PATH))
        ping = b"\x89\xfd" + bytes(4) + bytes(125)
        with pytest.raises(OSError, match=r"reset|pipe"):
            connection.sendall(ping * 500_000)


def test_what_a_screen_may_say_is_short(running: Running) -> None:
    with running.socket(LIVE_PATH) as live:
        live.send("x" * 5000)
        assert closed(live)[0] == LinkCloseCode.TOO_BIG


def test_a_recording_goes_on_while_the_doors_are_stormed(strict: Running, node_of: NodeOf) -> None:
    node = node_of(strict)
    node.connect()
    node.tared()
    with Play(node), ExitStack() as storm:
        recording = node.record()
        for _ in range(300):
            storm.enter_context(socket.create_connection(("127.0.0.1", strict.port)))
        recording.stop()
        sealed = recording.sealed()
    assert sealed["complete"] is True
