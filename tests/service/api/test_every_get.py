"""Every route of GET, asked in the ways in which clients ask: HEAD, and HTTP/1.0."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from http.client import HTTPResponse
from itertools import count

import httpx
import pytest

import service.api.routes.downloads.zips as zips
from storage.formats.writers.registry import FORMATS
from tests.service.api.sealed import Sealed
from tests.service.running import Running
from tests.tokens import SHARED_BEARER
from tests.waiting import PATIENCE_S, until

_PAGES = (
    "/",
    "/nodes",
    "/calibrate",
    "/sessions",
    "/docs",
    "/docs/swagger-ui.css",
    "/static/app.js",
    "/no-such-page",
)
BEARER = SHARED_BEARER["Authorization"]
_OF_NOW = {"date", "content-length"}
"""Headers of answers that tell the time, and so differ from one to the next."""


def routes_of(sealed: Sealed) -> list[str]:
    """Every address that can be got, of the index, with names of this server filled in."""
    take = sealed.session.now()["take"]
    names = {"session_id": sealed.id, "node": "bench", "take_id": take, "job_id": "none"}
    names |= {"calibration_id": "none", "name": "none"}
    listed = asked(sealed.running, "GET", "/api/v1").json()["routes"]
    paths = [
        re.sub(r"\{(\w+)\}", lambda found: names[found[1]], route["href"])
        for route in listed
        if route["method"] == "GET"
    ]
    made = [f"/api/v1/sessions/{sealed.id}/data?format={name}" for name in FORMATS]
    made += [f"/api/v1/sessions/{sealed.id}/data?format=csv&start_s=0.1&end_s=0.2"]
    made += [f"/api/v1/takes/{take}/data?format=mat", f"/api/v1/sessions/zip?ids={sealed.id}"]
    return [*paths, *made, *_PAGES, f"/sessions/{sealed.id}"]


def asked(running: Running, method: str, path: str) -> httpx.Response:
    answer = running.http.request(
        method, running.url + path, headers={"Accept-Encoding": "identity"}
    )
    assert answer.status_code < 500, path
    return answer


def is_steady(running: Running, path: str) -> bool:
    """Return whether two answers to GET are the same but for the time in them."""
    return asked(running, "GET", path).content == asked(running, "GET", path).content


def test_head_has_the_headers_of_get_and_no_body(sealed: Sealed) -> None:
    running = sealed.running
    paths = routes_of(sealed)
    assert len(paths) > 40
    for path in paths:
        got, head = asked(running, "GET", path), asked(running, "HEAD", path)
        assert head.status_code == got.status_code, path
        assert head.content == b"", path
        left_out = {"date"} if is_steady(running, path) else _OF_NOW
        left_out |= {"transfer-encoding"}  # RFC 9110 9.3.2: it may be left out
        ours = {k: v for k, v in head.headers.items() if k not in left_out}
        assert ours == {k: v for k, v in got.headers.items() if k not in left_out}, path


def endless(closed: list[int]) -> Iterator[bytes]:
    try:
        for number in count():
            closed[0] = number
            yield b"x" * 65536
    finally:
        closed[1] = 1


def test_head_does_not_make_what_it_does_not_send(
    sealed: Sealed, monkeypatch: pytest.MonkeyPatch
) -> None:
    state = [0, 0]
    monkeypatch.setattr(zips, "stream_zip", lambda _: endless(state))
    answer = asked(sealed.running, "HEAD", f"/api/v1/sessions/zip?ids={sealed.id}")
    assert answer.headers["content-type"] == "application/zip"
    until(lambda: state[1])
    assert state[0] < 8
    assert asked(sealed.running, "HEAD", "/api/v1/health").status_code == 200


def test_head_is_refused_where_get_is(sealed: Sealed) -> None:
    """The guard comes first, and what cannot be got has no HEAD."""
    http = sealed.running.http
    assert http.head("/health", headers={"Host": "evil.example"}).status_code == 403
    refused = http.head(f"/sessions/{sealed.id}/stop")
    assert refused.status_code == 405
    assert set(refused.headers["allow"].split(", ")) == {"POST", "OPTIONS"}


def got_by_old(running: Running, path: str, method: str = "GET") -> tuple[HTTPResponse, bytes]:
    """What follows the headers, byte by byte: until the server closes."""
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as raw:
        lines = (f"{method} {path} HTTP/1.0", "Host: localhost", f"Authorization: {BEARER}", "", "")
        raw.sendall("\r\n".join(lines).encode())
        answer = HTTPResponse(raw, method=method)
        answer.begin()
        assert answer.getheader("transfer-encoding") is None, path
        return answer, answer.fp.read()


def test_an_old_client_gets_the_body_and_no_chunks(sealed: Sealed) -> None:
    running = sealed.running
    for path in routes_of(sealed):
        now = asked(running, "GET", path)
        answer, body = got_by_old(running, path)
        assert answer.status == now.status_code, path
        if is_steady(running, path):
            assert body == now.content, path
        length = answer.getheader("content-length")
        assert length is None or int(length) == len(body), path
        assert got_by_old(running, path, "HEAD")[1] == b"", path


def test_an_old_client_needs_no_host_and_changes_nothing_of_another_site(sealed: Sealed) -> None:
    for asked_for, status in (
        ("GET /api/v1/health HTTP/1.0\r\n\r\n", 200),
        ("GET /api/v1/health HTTP/1.0\r\nHost: evil.example\r\n\r\n", 403),
        ("GET /api/v1/health HTTP/1.1\r\n\r\n", 403),
        ("POST /api/v1/nodes/bench/tare HTTP/1.0\r\nOrigin: http://evil.example\r\n\r\n", 403),
    ):
        port = sealed.running.port
        with socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S) as raw:
            raw.sendall(asked_for.encode())
            assert raw.recv(65536).split()[1] == str(status).encode(), asked_for


def broken(_: object) -> Iterator[bytes]:
    yield b"x" * 65536
    raise RuntimeError("a part of this test")


@pytest.mark.filterwarnings("default")
def test_to_an_old_client_an_answer_that_breaks_off_is_no_whole_one(
    sealed: Sealed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zips, "stream_zip", broken)
    with pytest.raises(ConnectionResetError):
        got_by_old(sealed.running, f"/api/v1/sessions/zip?ids={sealed.id}")


def test_two_requests_of_an_old_client_at_once_are_one(sealed: Sealed) -> None:
    path = f"/api/v1/sessions/{sealed.id}/data?format=csv"
    whole = asked(sealed.running, "GET", path).content
    one = f"GET {path} HTTP/1.0\r\nHost: localhost\r\nConnection: keep-alive\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", sealed.running.port), timeout=PATIENCE_S) as raw:
        raw.sendall(one + one)
        said = b""
        while piece := raw.recv(65536):
            said += piece
    assert said.partition(b"\r\n\r\n")[2] == whole
