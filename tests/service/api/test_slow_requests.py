"""Slow, endless and wrong requests, byte by byte."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest

from service.api.connection_limits import LimitSettings
from tests.service.api.access import TOKEN
from tests.service.patient import patient_server
from tests.service.running import Running
from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S

AUTHORIZED = f"Authorization: Bearer {SHARED_TOKEN}"


def dial(running: Running) -> socket.socket:
    return socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S)


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


def head(request: str, *headers: str) -> bytes:
    """Return a request without its body."""
    lines = (f"{request} HTTP/1.1", "Host: localhost", *headers, "", "")
    return "\r\n".join(lines).encode()


HEALTH = head("GET /api/v1/health")
CHUNKED = head("POST /api/v1/sessions", AUTHORIZED, "Transfer-Encoding: chunked")
JSON_BODY = head(
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
        request = head("POST /api/v1/sessions", "Connection: close", "Transfer-Encoding: chunked")
        connection.sendall(request + f"0\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode())
        assert parse_problem(read_all(connection))[0] == 401


@pytest.mark.parametrize(
    "behind",
    [head("POST /api/v1/sessions", AUTHORIZED, "Content-Length: 9"), HEALTH[:-2]],
    ids=["body", "head"],
)
def test_an_unfinished_request_times_out_behind_the_answer_before_it(
    strict: Running, raw: socket.socket, behind: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(strict.server, "check_writable", lambda: time.sleep(1.0))
    raw.sendall(head("GET /api/v1/ready") + behind)
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
    request = head("GET /api/v1/health", "X: " + "y" * 3900)
    for begin in range(0, len(request), 600):
        raw.sendall(request[begin : begin + 600])
    assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize("other", [b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", b"HELO robot\r\n\r\n"])
def test_another_protocol_is_refused(raw: socket.socket, other: bytes) -> None:
    raw.sendall(other)
    assert parse_problem(read_all(raw))[0] == 400
