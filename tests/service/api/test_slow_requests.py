"""Requests that come slowly, do not end or are none: what is made of them, byte by byte."""

from __future__ import annotations

import json
import re
import socket
import time
from collections.abc import Iterator
from typing import Any

import pytest

from service.api.connection_limits import LimitSettings
from tests.service.running import Running, ServeWith
from tests.tokens import SHARED_TOKEN
from tests.waiting import PATIENCE_S

TOKEN = "secret"  # noqa: S105  # of these tests
SHOWN = f"Authorization: Bearer {SHARED_TOKEN}"


@pytest.fixture
def raw(strict: Running) -> Iterator[socket.socket]:
    with socket.create_connection(("127.0.0.1", strict.port), timeout=PATIENCE_S) as connection:
        yield connection


def all_of(connection: socket.socket) -> bytes:
    """What it says until it is closed."""
    said = b""
    try:
        while piece := connection.recv(65536):
            said += piece
    except ConnectionResetError:
        pass
    return said


def problem_of(said: bytes) -> tuple[int, dict[str, Any]]:
    head, _, body = said.partition(b"\r\n\r\n")
    assert b"content-type: application/problem+json" in head
    status = re.match(rb"HTTP/1.1 (\d+) ", head)
    assert status is not None
    return int(status[1]), json.loads(body)


def test_a_connection_that_says_nothing_is_closed(raw: socket.socket) -> None:
    assert all_of(raw) == b""


@pytest.mark.parametrize("begun", [b"G", b"GET / HTTP/1.1\r\nHost: localhost\r\nX: y", b"POST /"])
def test_headers_that_do_not_come_to_an_end_are_given_up(raw: socket.socket, begun: bytes) -> None:
    raw.sendall(begun)
    status, said = problem_of(all_of(raw))
    assert status == 408
    assert "in time" in said["detail"]


def test_empty_lines_for_ever_are_no_request(raw: socket.socket) -> None:
    raw.sendall(b"\r\n\r\n")
    assert all_of(raw) == b""


def test_a_body_that_does_not_come_is_given_up(raw: socket.socket) -> None:
    raw.sendall(
        head(
            "POST /api/v1/sessions", SHOWN, "Content-Length: 100", "Content-Type: application/json"
        )
        + b'{"node"'
    )
    assert problem_of(all_of(raw))[0] == 408


def test_a_connection_does_not_wait_for_its_next_request_for_ever(raw: socket.socket) -> None:
    raw.sendall(b"GET /api/v1/health HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert all_of(raw).startswith(b"HTTP/1.1 200 ")


def test_the_first_byte_of_a_next_request_does_not_keep_it_open(raw: socket.socket) -> None:
    raw.sendall(b"GET /api/v1/health HTTP/1.1\r\nHost: localhost\r\n\r\n")
    assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")
    raw.sendall(b"G")
    assert b"408" in all_of(raw)


@pytest.mark.parametrize("piece", [b"X: " + b"y" * 60 + b"\r\n", b"Y" * 1000, b"X: " + b"z" * 5000])
def test_headers_that_are_too_long_are_refused(raw: socket.socket, piece: bytes) -> None:
    raw.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n")
    sent = 0
    try:
        while sent < 1 << 20:
            sent += raw.send(piece)
    except (ConnectionResetError, BrokenPipeError):
        pass
    said = all_of(raw)
    assert said == b"" or problem_of(said)[0] == 431  # a reset may overtake it


def head(asked: str, *headers: str) -> bytes:
    """A request without its body."""
    lines = (f"{asked} HTTP/1.1", "Host: localhost", *headers, "", "")
    return "\r\n".join(lines).encode()


HEALTH = head("GET /api/v1/health")
CHUNKED = head("POST /api/v1/sessions", SHOWN, "Transfer-Encoding: chunked")


@pytest.mark.parametrize(
    ("begun", "piece"),
    [
        (CHUNKED + b"0\r\nX: ", b"y" * 1000),
        (CHUNKED + b"0\r\n", b"X: " + b"y" * 60 + b"\r\n"),
        (CHUNKED + b"0\r\n", b"Y" * 1000),
        (CHUNKED + b"1;x=", b"y" * 1000),
        (HEALTH, b"\r\n" * 500),
    ],
    ids=["one trailer", "trailers", "name of a trailer", "words of a chunk", "empty lines"],
)
@pytest.mark.parametrize("token", [None, TOKEN], ids=["waited for", "refused already"])
def test_what_is_neither_request_nor_body_has_an_end(
    serve_with: ServeWith, begun: bytes, piece: bytes, token: str | None
) -> None:
    running = serve_with(bounds=LimitSettings(max_header_bytes=4096), token=token)
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as raw:
        raw.sendall(begun)
        if token is not None:
            assert raw.recv(65536).startswith((b"HTTP/1.1 401 ", b"HTTP/1.1 200 "))
        with pytest.raises(OSError, match=r"reset|pipe"):
            raw.sendall(piece * (16_000_000 // len(piece)))


def test_a_token_behind_the_body_opens_nothing(serve_with: ServeWith) -> None:
    running = serve_with(token=TOKEN)
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as raw:
        asked = head("POST /api/v1/sessions", "Connection: close", "Transfer-Encoding: chunked")
        raw.sendall(asked + f"0\r\nAuthorization: Bearer {TOKEN}\r\n\r\n".encode())
        assert problem_of(all_of(raw))[0] == 401


@pytest.mark.parametrize(
    "behind",
    [head("POST /api/v1/sessions", SHOWN, "Content-Length: 9"), HEALTH[:-2]],
    ids=["body", "head"],
)
def test_a_request_that_does_not_come_waits_for_the_answer_to_the_one_before(
    strict: Running, raw: socket.socket, behind: bytes, monkeypatch: Any
) -> None:
    monkeypatch.setattr(strict.server, "check_writable", lambda: time.sleep(1.0))
    raw.sendall(head("GET /api/v1/ready") + behind)
    first, _, second = all_of(raw).partition(b"HTTP/1.1 408 ")
    assert first.startswith(b"HTTP/1.1 200 ")
    assert problem_of(b"HTTP/1.1 408 " + second)[1]["detail"] == "The request did not come in time"


def test_a_body_in_very_small_pieces_is_no_header(running: Running) -> None:
    def pieces() -> Iterator[bytes]:
        for byte in json.dumps({"node": "x", "name": "y" * 60_000}).encode():
            yield bytes([byte])

    answer = running.http.post(
        "/sessions", content=pieces(), headers={"content-type": "application/json"}
    )
    assert answer.status_code in (404, 422), answer.text


def test_headers_that_are_nearly_too_long_pass_in_whatever_pieces(raw: socket.socket) -> None:
    head = b"GET /api/v1/health HTTP/1.1\r\nHost: localhost\r\nX: " + b"y" * 3900 + b"\r\n\r\n"
    for begin in range(0, len(head), 600):
        raw.sendall(head[begin : begin + 600])
    assert raw.recv(65536).startswith(b"HTTP/1.1 200 ")


@pytest.mark.parametrize("said", [b"\x16\x03\x01\x02\x00", b"GET\r\n\r\n", b"HELO robot\r\n\r\n"])
def test_what_is_not_http_is_said_to_be_so(raw: socket.socket, said: bytes) -> None:
    raw.sendall(said)
    assert problem_of(all_of(raw))[0] == 400
