"""Limits of connections and requests: how many, how slow, how long; and what is closed then."""

from __future__ import annotations

import asyncio
import errno
import json
import re
import socket
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from websockets.exceptions import ConnectionClosed

from service.api.connection_limits import OWN_FILES, RESERVE, ConnectionLimiter
from service.api.protocols import LimitedHttp, accept_connections
from service.api.settings import LimitSettings
from service.protocol.codec import LinkCloseCode
from service.protocol.link import INGEST_PATH, PROTOCOL, Identify
from service.protocol.live import LIVE_PATH
from tests.service.api.access import TOKEN
from tests.service.fake_node import NodeOf, Play, Spoken
from tests.service.patient import patient_server
from tests.service.running import Running, ServeWith, assert_refused, closed
from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S, in_a_loop, until


class Transport:
    """A transport that only knows whether it is aborted."""

    is_aborted = False

    def abort(self) -> None:
        self.is_aborted = True


def make_limiter(**settings: int) -> ConnectionLimiter:
    """Return a limiter with descriptors for all connections."""
    return ConnectionLimiter(LimitSettings.model_validate(settings), 10_000)


def connect(limiter: ConnectionLimiter, n: int, address: str = "a") -> list[Transport]:
    transports = [Transport() for _ in range(n)]
    for transport in transports:
        limiter.add_connection(transport, address)
    return transports


@pytest.mark.parametrize(
    ("acquire", "release"),
    [
        (ConnectionLimiter.acquire, ConnectionLimiter.release),
        (ConnectionLimiter.acquire_node, ConnectionLimiter.remove_connection),
    ],
    ids=["requests", "nodes"],
)
def test_places_are_refused_until_one_is_free(
    acquire: Callable[..., bool], release: Callable[..., None]
) -> None:
    limiter = make_limiter(max_connections=2, max_nodes=2)
    first, second, third = connect(limiter, 3)
    assert acquire(limiter, first)
    assert acquire(limiter, second)
    assert not acquire(limiter, third)
    assert acquire(limiter, first)  # it has a place already
    release(limiter, first)
    assert acquire(limiter, third)


def test_one_address_does_not_take_all_places() -> None:
    limiter = make_limiter(max_connections=3, max_connections_per_address=2)
    first, second, third = connect(limiter, 3, "greedy")
    (other,) = connect(limiter, 1, "other")
    assert limiter.acquire(first)
    assert limiter.acquire(second)
    assert not limiter.acquire(third)
    assert limiter.acquire(other)


def test_the_oldest_of_the_address_with_most_connections_is_closed() -> None:
    limiter = make_limiter(max_connections=1)
    (modest,) = connect(limiter, 1, "modest")
    greedy = connect(limiter, RESERVE, "greedy")
    assert greedy[0].is_aborted
    assert not any(each.is_aborted for each in (modest, *greedy[1:]))


def test_no_other_connection_takes_the_place_of_a_node() -> None:
    limiter = make_limiter(max_connections=4, max_nodes=2)
    for transport in connect(limiter, 4):
        assert limiter.acquire(transport)
    silent, *flood = connect(limiter, 10 * RESERVE)
    assert silent.is_aborted
    node = flood[-1]
    assert limiter.acquire_node(node)
    connect(limiter, 10 * RESERVE)
    assert not node.is_aborted
    assert not limiter.has_max_nodes


def test_recording_keeps_descriptors(caplog: pytest.LogCaptureFixture) -> None:
    limiter = ConnectionLimiter(LimitSettings(), 256)
    assert limiter.connections_max * 2 + OWN_FILES <= 256
    assert "only 256 files" in caplog.text


def test_a_flood_is_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    limiter = make_limiter(max_connections=1)
    inside, *others = connect(limiter, 30)
    limiter.acquire(inside)
    assert not any(limiter.acquire(other) for other in others)
    assert len(caplog.records) == 1


@given(st.lists(st.tuples(st.integers(0, 5), st.integers(0, 80), st.integers(0, 3)), max_size=400))
def test_connections_never_exceed_their_descriptors(steps: list[tuple[int, int, int]]) -> None:
    limiter = make_limiter(max_connections=8, max_nodes=4)
    inside: list[Transport] = []

    def remove_aborted() -> int:
        aborted = [each for each in inside if each.is_aborted]
        for each in aborted:
            inside.remove(each)
            limiter.remove_connection(each)
        return len(aborted)

    for action, which, address in steps:
        if action <= 1 and not limiter.is_full:
            inside += connect(limiter, 1, str(address))
        elif inside:
            one = inside[which % len(inside)]
            if action == 2:
                limiter.acquire(one)
            elif action == 3:
                limiter.acquire_node(one)
            elif action == 4:
                limiter.release(one)
            else:
                limiter.remove_connection(one)
                inside.remove(one)
        remove_aborted()
        assert len(inside) <= 8 + 4 + RESERVE
        while limiter.is_full:  # otherwise no connection would ever be accepted again
            limiter.evict_idle()
            assert remove_aborted()


# --- accepting ------------------------------------------------------------------------------------


class Greeting(asyncio.Protocol):
    """Sends a word and closes."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        assert isinstance(transport, asyncio.WriteTransport)
        transport.write(b"welcome")
        transport.close()


@in_a_loop
async def test_a_bug_in_one_connection_refuses_no_other(caplog: pytest.LogCaptureFixture) -> None:
    errors = iter([ZeroDivisionError("a bug")])

    def make() -> asyncio.Protocol:
        for error in errors:
            raise error
        return Greeting()

    with socket.create_server(("127.0.0.1", 0)) as listening:
        accepting = asyncio.create_task(accept_connections(listening, make, make_limiter()))
        contents = []
        for _ in range(2):
            reader, writer = await asyncio.open_connection(*listening.getsockname())
            contents.append(await asyncio.wait_for(reader.read(), 5.0))
            writer.close()
        accepting.cancel()
    assert contents == [b"", b"welcome"]
    assert "a bug" in caplog.text


@in_a_loop
async def test_a_failing_socket_does_not_busy_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    loop, tries = asyncio.get_running_loop(), 0

    async def fail(_: socket.socket) -> None:
        nonlocal tries
        tries += 1
        raise OSError(errno.EPERM, "a firewall")

    monkeypatch.setattr(loop, "sock_accept", fail)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        accepting = asyncio.create_task(
            accept_connections(listening, asyncio.Protocol, make_limiter())
        )
        await asyncio.sleep(0.1)
        accepting.cancel()
    assert 0 < tries < 50


# --- over sockets ---------------------------------------------------------------------------------

WORD = b"\x81\x81" + bytes(4) + b"x"
"""A text message of one letter."""


def upgrade(path: str) -> bytes:
    """Return a request for a websocket."""
    return (
        f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: Upgrade\r\n"
        f"Authorization: Bearer {SHARED_TOKEN}\r\n"
        "Upgrade: websocket\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n"
        "Sec-WebSocket-Version: 13\r\n\r\n"
    ).encode()


def read_until(connection: socket.socket, wanted: bytes) -> None:
    content = b""
    while wanted not in content:
        more = connection.recv(65536)
        assert more, f"it ended with {content!r}"
        content += more


def subscribe(stack: ExitStack, running: Running) -> None:
    """Take the three places of a strict server."""
    for _ in range(3):
        stack.enter_context(running.socket(LIVE_PATH)).recv(timeout=PATIENCE_S)


def dial(running: Running) -> socket.socket:
    return socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S)


def test_a_subscriber_beyond_the_limit_is_closed_and_a_request_is_503(strict: Running) -> None:
    with ExitStack() as stack:
        subscribe(stack, strict)
        with strict.socket(LIVE_PATH) as further:
            code, reason = closed(further)
        assert (code, "too many" in reason) == (LinkCloseCode.TRY_LATER, True)
        answer = strict.http.get("/health")
        assert_refused(answer, 503, "There are too many connections; try again in some seconds")
        assert answer.headers["retry-after"] == "5"
    until(lambda: strict.http.get("/health").status_code == 200)


def test_nodes_beyond_the_limit_are_closed(serve_with: ServeWith, node_of: NodeOf) -> None:
    running = serve_with(bounds=LimitSettings(max_nodes=2))
    nodes = [node_of(running, f"leg{number}") for number in range(6)]
    with ExitStack() as sockets:
        links = [Spoken(sockets.enter_context(running.socket(INGEST_PATH))) for _ in nodes]
        for node, link in zip(nodes, links, strict=True):
            link.send(Identify(protocol=PROTOCOL, node=node.name).model_dump_json())
        answers = []
        for link in links:
            try:
                answers.append(json.loads(link.recv(timeout=PATIENCE_S))["type"])
            except ConnectionClosed as end:
                answers.append(end.rcvd and str(int(end.rcvd.code)))
    assert sorted(answers) == ["1013"] * 4 + ["challenge"] * 2
    until(lambda: not any(node["connected"] for node in running.http.get("/nodes").json()["items"]))
    for node in nodes[:2]:
        node.connect()
    with running.socket(INGEST_PATH) as further:
        assert closed(further)[0] == LinkCloseCode.TRY_LATER
    nodes[0].deliver(10)


def test_a_closed_connection_that_sends_takes_no_place(
    serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with(bounds=LimitSettings(max_nodes=1))
    with dial(running) as connection:
        connection.sendall(upgrade(INGEST_PATH) + WORD)
        read_until(connection, b"\x88")  # a close frame, never answered
        for _ in range(3):
            connection.sendall(WORD)
            time.sleep(0.05)
        node_of(running).connect()


def test_a_connection_that_sends_on_can_read_the_reason_of_its_end(shared: Running) -> None:
    with dial(shared) as connection:
        connection.sendall(upgrade(LIVE_PATH))
        read_until(connection, b"hello")
        connection.sendall(WORD)
        read_until(connection, b"only {")  # of the close frame
        for _ in range(100):  # a closed connection would answer with a reset
            connection.sendall(WORD)
        connection.sendall(b"\x88\x82" + bytes(4) + int(LinkCloseCode.POLICY).to_bytes(2))
        while connection.recv(65536):  # to the end, which is no reset
            pass


def test_a_websocket_has_no_header_timeout(strict: Running, node_of: NodeOf) -> None:
    node = node_of(strict)
    node.connect()
    with strict.socket(LIVE_PATH) as live, Play(node) as play:
        for _ in range(20):
            live.recv(timeout=PATIENCE_S)
    assert play.problem is None


def test_a_subscriber_that_pings_without_reading_is_closed(shared: Running) -> None:
    with dial(shared) as connection:
        connection.sendall(upgrade(LIVE_PATH))
        ping = b"\x89\xfd" + bytes(4) + bytes(125)
        with pytest.raises(OSError, match=r"reset|pipe"):
            connection.sendall(ping * 500_000)


def test_a_message_of_a_subscriber_is_short(shared: Running) -> None:
    with shared.socket(LIVE_PATH) as live:
        live.send("x" * 5000)
        assert closed(live)[0] == LinkCloseCode.TOO_BIG


def test_a_recording_goes_on_in_a_flood(strict: Running, node_of: NodeOf) -> None:
    node = node_of(strict)
    node.connect()
    node.tared()
    with Play(node), ExitStack() as flood:
        recording = node.record()
        for _ in range(300):
            flood.enter_context(dial(strict))
        recording.stop()
        sealed: dict[str, Any] = recording.sealed()
    assert sealed["complete"] is True


# --- slow, endless and wrong requests, byte by byte -----------------------------------------------


AUTHORIZED = f"Authorization: Bearer {SHARED_TOKEN}"


@pytest.fixture
def raw(strict: Running) -> Iterator[socket.socket]:
    with dial(strict) as connection:
        yield connection


def read_all(connection: socket.socket) -> bytes:
    content = b""
    try:
        while piece := connection.recv(65536):
            content += piece
    except ConnectionResetError:
        pass
    return content


def parse_problem(content: bytes) -> tuple[int, dict[str, Any]]:
    head, _, body = content.partition(b"\r\n\r\n")
    assert b"content-type: application/problem+json" in head
    status = re.match(rb"HTTP/1.1 (\d+) ", head)
    assert status is not None
    return int(status[1]), json.loads(body)


def make_head(request: str, *headers: str) -> bytes:
    """Return a request without its body."""
    lines = (f"{request} HTTP/1.1", "Host: localhost", *headers, "", "")
    return "\r\n".join(lines).encode()


HEALTH = make_head("GET /api/v1/health")
CHUNKED = make_head("POST /api/v1/sessions", AUTHORIZED, "Transfer-Encoding: chunked")
JSON_BODY = make_head(
    *("POST /api/v1/sessions", AUTHORIZED, "Content-Length: 100", "Content-Type: application/json")
)


@pytest.mark.parametrize("begin", [b"", b"\r\n\r\n"], ids=["silent", "empty lines"])
def test_a_connection_without_a_request_is_closed(raw: socket.socket, begin: bytes) -> None:
    raw.sendall(begin)
    assert read_all(raw) == b""


@pytest.mark.parametrize(
    "begin",
    [b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: y", b"POST /", JSON_BODY + b'{"node"'],
    ids=["a letter", "headers", "a line", "a body"],
)
def test_an_unfinished_request_times_out(raw: socket.socket, begin: bytes) -> None:
    raw.sendall(begin)
    status, content = parse_problem(read_all(raw))
    assert (status, "in time" in content["detail"]) == (408, True)


@pytest.mark.parametrize("more", [b"", b"G"], ids=["silent", "a letter"])
def test_a_connection_is_closed_without_a_next_request(raw: socket.socket, more: bytes) -> None:
    raw.sendall(HEALTH)
    assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")
    raw.sendall(more)
    assert (b"408" in read_all(raw)) is bool(more)


@pytest.mark.parametrize("piece", [b"X: " + b"y" * 60 + b"\r\n", b"Y" * 1000, b"X: " + b"z" * 5000])
def test_too_long_headers_are_refused(raw: socket.socket, piece: bytes) -> None:
    raw.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
    sent = 0
    try:
        while sent < 1 << 20:
            sent += raw.send(piece)
    except (ConnectionResetError, BrokenPipeError):
        pass
    content = read_all(raw)
    assert content == b"" or parse_problem(content)[0] == 431  # a reset may overtake it


def test_pipelined_requests_wait_unparsed_and_are_answered_in_order(
    shared: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    most_waiting, on_response_complete = 0, LimitedHttp.on_response_complete

    def note_waiting(protocol: LimitedHttp) -> None:
        nonlocal most_waiting
        most_waiting = max(most_waiting, len(protocol.pipeline))
        on_response_complete(protocol)

    monkeypatch.setattr(LimitedHttp, "on_response_complete", note_waiting)
    requests = [make_head(f"GET /api/v1/{'health' if n % 3 else 'none'}") for n in range(900)]
    requests.append(make_head("GET /api/v1/health", "Connection: close"))
    with dial(shared) as connection:
        connection.sendall(b"".join(requests))
        statuses = [int(each) for each in re.findall(rb"HTTP/1.1 (\d+) ", read_all(connection))]
    assert statuses == [200 if n % 3 else 404 for n in range(900)] + [200]
    assert most_waiting <= 40


@pytest.fixture(scope="module", params=[None, TOKEN], ids=["waited for", "refused already"])
def limited(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Running]:
    """A server that accepts, or refuses, a request whose body has not come."""
    data, bounds = tmp_path_factory.mktemp("limited") / "data", LimitSettings(max_header_bytes=4096)
    with patient_server(data, bounds=bounds, token=request.param) as running:
        yield running


@pytest.mark.parametrize(
    ("begin", "piece"),
    [
        (CHUNKED + b"0\r\nX: ", b"y" * 1000),
        (CHUNKED + b"0\r\n", b"X: " + b"y" * 60 + b"\r\n"),
        (CHUNKED + b"0\r\n", b"Y" * 1000),
        (CHUNKED + b"1;x=", b"y" * 1000),
        (HEALTH, b"\r\n" * 500),
    ],
    ids=["one trailer", "trailers", "name of a trailer", "words of a chunk", "empty lines"],
)
def test_endless_bytes_beside_a_body_are_cut_off(
    limited: Running, begin: bytes, piece: bytes
) -> None:
    with dial(limited) as connection:
        connection.sendall(begin)
        if not limited.shown:
            assert connection.recv(65536).startswith((b"HTTP/1.1 401 ", b"HTTP/1.1 200 "))
        with pytest.raises(OSError, match=r"reset|pipe"):
            connection.sendall(piece * (16_000_000 // len(piece)))


def test_a_token_in_a_trailer_is_no_right(guarded: Running) -> None:
    with dial(guarded) as connection:
        request = make_head(
            "POST /api/v1/sessions", "Connection: close", "Transfer-Encoding: chunked"
        )
        connection.sendall(request + f"0\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode())
        assert parse_problem(read_all(connection))[0] == 401


@pytest.mark.parametrize(
    "behind",
    [make_head("POST /api/v1/sessions", AUTHORIZED, "Content-Length: 9"), HEALTH[:-2]],
    ids=["body", "head"],
)
def test_an_unfinished_request_times_out_behind_the_answer_before_it(
    strict: Running, raw: socket.socket, behind: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strict.server, "check_writable", lambda: time.sleep(1.0))
    raw.sendall(make_head("GET /api/v1/ready") + behind)
    first, _, second = read_all(raw).partition(b"HTTP/1.1 408 ")
    assert first.startswith(b"HTTP/1.1 200 ")
    problem = parse_problem(b"HTTP/1.1 408 " + second)[1]
    assert problem["detail"] == "The request did not come in time"


def test_small_pieces_of_a_body_are_no_headers(shared: Running) -> None:
    def pieces() -> Iterator[bytes]:
        for byte in json.dumps({"node": "x", "name": "y" * 60_000}).encode():
            yield bytes([byte])

    answer = shared.http.post(
        "/sessions", content=pieces(), headers={"content-type": "application/json"}
    )
    assert answer.status_code in (404, 422), answer.text


def test_long_headers_pass_in_pieces(raw: socket.socket) -> None:
    request = make_head("GET /api/v1/health", "X: " + "y" * 3900)
    for begin in range(0, len(request), 600):
        raw.sendall(request[begin : begin + 600])
    assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize("other", [b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", b"HELO robot\r\n\r\n"])
def test_another_protocol_is_refused(raw: socket.socket, other: bytes) -> None:
    raw.sendall(other)
    assert parse_problem(read_all(raw))[0] == 400
