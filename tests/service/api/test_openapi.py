"""Routes and their description, and GET as clients send it: HEAD, and HTTP/1.0."""

from __future__ import annotations

import re
import socket
from collections.abc import Iterator
from http.client import HTTPResponse
from itertools import count

import httpx
import pytest

from service.api.app import make_app
from service.api.routes import downloads
from storage.formats.writers.registry import FORMATS
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.tokens import SHARED_BEARER
from tests.waiting import PATIENCE_S, until

PAGES = (
    *(
        "/",
        "/nodes",
        "/calibrate",
        "/clock",
        "/sessions",
        "/docs",
        "/docs/swagger-ui.css",
        "/static/app.js",
    ),
    "/no-such-page",
)
TARE = "POST /api/v1/nodes/bench/tare HTTP/1.0\r\nOrigin: http://evil.example\r\n\r\n"


def request(running: Running, path: str, method: str = "GET") -> httpx.Response:
    headers = {"Accept-Encoding": "identity"}
    answer = running.http.request(method, running.url + path, headers=headers)
    assert answer.status_code < 500, path
    return answer


def list_paths(sealed: Sealed) -> list[str]:
    """Return every path of a GET in the index, with names of this server filled in."""
    names = {"session_id": sealed.id, "node": "bench", "take_id": "none", "job_id": "none"}
    names |= {"calibration_id": "none", "name": "none", "video_id": "none"}
    paths = [
        re.sub(r"\{(\w+)\}", lambda found: names[found[1]], route["href"])
        for route in request(sealed.running, "/api/v1").json()["routes"]
        if route["method"] == "GET"
    ]
    paths += [f"/api/v1/sessions/{sealed.id}/data?format={name}" for name in FORMATS]
    paths += [f"/api/v1/sessions/{sealed.id}/data?format=csv&start_s=0.1&end_s=0.2"]
    paths += [f"/api/v1/sessions/zip?ids={sealed.id}"]
    assert len(paths) > 40
    return [*paths, *PAGES, f"/sessions/{sealed.id}"]


def test_the_index_names_every_route(shared: Running) -> None:
    index = request(shared, "/api/v1").json()
    api = request(shared, index["openapi"]).json()
    named = {(route["method"], route["href"]) for route in index["routes"]}
    assert named == {(m.upper(), path) for path, methods in api["paths"].items() for m in methods}
    assert len(named) > 40
    for method, path in named:
        if method == "GET" and "{" not in path:
            # A zip file needs ids.
            status = 422 if path.endswith("/zip") else 200
            assert request(shared, path).status_code == status, path


def test_every_operation_is_described(shared: Running) -> None:
    api = request(shared, "/api/v1/openapi.json").json()
    assert api["openapi"].startswith("3.1")
    ids = []
    for path, operations in api["paths"].items():
        for method, operation in operations.items():
            where = f"{method} {path}"
            ids.append(operation["operationId"])
            assert operation["summary"], where
            assert operation["description"], where
            assert "{" not in path or "404" in operation["responses"], where
            for status, answer in operation["responses"].items():
                assert answer["description"], where
                if int(status) >= 400:
                    assert set(answer["content"]) == {"application/problem+json"}, (where, status)
    assert len(set(ids)) == len(ids)
    assert len(ids) >= 18


def test_the_documentation_loads_only_files_of_this_server(shared: Running) -> None:
    page = request(shared, "/docs")
    assert page.headers["content-security-policy"].startswith("default-src 'self'; ")
    assert "unsafe" not in page.headers["content-security-policy"]
    loaded = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert "/docs/swagger-ui-bundle.js" in loaded
    for path in loaded:
        assert path.startswith("/"), path
        assert request(shared, path).status_code == 200, path
    bundle = httpx.get(shared.url + "/docs/swagger-ui-bundle.js", trust_env=False)
    assert bundle.headers["content-encoding"] == "gzip"
    assert bundle.headers["content-type"].startswith("text/javascript")
    for name in ("redoc.standalone.js", "favicon.png", "__init__.py", "..%2f__init__.py"):
        answer = request(shared, f"/docs/{name}")
        assert answer.status_code == 404, name
        assert answer.headers["content-type"] == "application/problem+json"


@pytest.mark.parametrize(
    ("path", "allowed"),
    [
        ("/sessions", {"GET", "HEAD", "POST"}),
        ("/sessions/20200101T000000Z-000000", {"GET", "HEAD", "PATCH", "DELETE"}),
        ("/sessions/20200101T000000Z-000000/markers", {"GET", "HEAD", "POST"}),
        ("/sessions/20200101T000000Z-000000/data", {"GET", "HEAD"}),
        ("/sessions/20200101T000000Z-000000/stop", {"POST"}),
        ("/trash", {"GET", "HEAD", "DELETE"}),
        ("/health", {"GET", "HEAD"}),
    ],
)
def test_options_and_a_wrong_method_name_all_methods(
    shared: Running, path: str, allowed: set[str]
) -> None:
    for method, status in (("OPTIONS", 204), ("PUT", 405)):
        answer = shared.http.request(method, path)
        assert answer.status_code == status
        assert set(answer.headers["allow"].split(", ")) == {*allowed, "OPTIONS"}


def test_no_get_changes_anything(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    app = make_app(running.server, logins=running.logins)
    assert app.openapi_schema is None  # made on the first request
    paths = [
        *("/health", "/ready", "/version", "/nodes", "/nodes/bench", "/nodes/bench/scene"),
        *("/nodes/bench/tares", "/nodes/bench/tare", "/sessions", session.url),
        *(f"{session.url}/{rest}" for rest in ("markers", "ledger", "data?format=csv")),
        *(f"{session.url}/{rest}" for rest in ("stop", "data")),
    ]

    def state() -> object:
        files = {
            str(path): path.read_bytes()
            for path in sorted(running.data.rglob("*"))
            # A server writes the others while frames and clock samples arrive.
            if path.is_file()
            and path.suffix not in (".arrows", ".idx", ".tmp")
            and path.name not in ("stream.json", "clock.jsonl")
        }
        # The rate of a silent node falls, whoever looks.
        return files, running.node() | {"rate_hz": None}, session.now()

    before = state()
    for path in paths:
        for method in ("GET", "HEAD", "OPTIONS"):
            assert running.http.request(method, path).status_code < 500, path
    assert state() == before


# --- HEAD, and HTTP/1.0 ---------------------------------------------------------------------------


def test_head_has_the_headers_of_get_and_no_body(sealed: Sealed) -> None:
    running = sealed.running
    for path in list_paths(sealed):
        got, head, again = (request(running, path, method) for method in ("GET", "HEAD", "GET"))
        assert head.status_code == got.status_code, path
        assert head.content == b"", path
        # RFC 9110 9.3.2 lets HEAD leave out the transfer encoding.
        left_out = {"date", "transfer-encoding"}
        # Some answers have the time in them.
        left_out |= set() if got.content == again.content else {"content-length"}
        headers = {k: v for k, v in head.headers.items() if k not in left_out}
        assert headers == {k: v for k, v in got.headers.items() if k not in left_out}, path


def test_head_ends_the_encoder(sealed: Sealed, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers, ended = [0], [False]

    def encode_endlessly(_: object) -> Iterator[bytes]:
        try:
            for numbers[0] in count():
                yield b"x" * 65536
        finally:
            ended[0] = True

    monkeypatch.setattr(downloads, "stream_zip", encode_endlessly)
    answer = request(sealed.running, f"/api/v1/sessions/zip?ids={sealed.id}", "HEAD")
    assert answer.headers["content-type"] == "application/zip"
    until(lambda: ended[0])
    assert numbers[0] < 8
    assert request(sealed.running, "/api/v1/health", "HEAD").status_code == 200


def test_head_is_refused_where_get_is(sealed: Sealed) -> None:
    http = sealed.running.http
    assert http.head("/health", headers={"Host": "evil.example"}).status_code == 403
    refused = http.head(f"{sealed.session.url}/stop")
    assert refused.status_code == 405
    assert set(refused.headers["allow"].split(", ")) == {"POST", "OPTIONS"}


def request_1_0(running: Running, path: str, method: str = "GET") -> tuple[HTTPResponse, bytes]:
    """Return answer and body of HTTP/1.0: the body ends with the connection."""
    token = SHARED_BEARER["Authorization"]
    with socket.create_connection(("127.0.0.1", running.port), timeout=PATIENCE_S) as raw:
        lines = (f"{method} {path} HTTP/1.0", "Host: localhost", f"Authorization: {token}", "", "")
        raw.sendall("\r\n".join(lines).encode())
        answer = HTTPResponse(raw, method=method)
        answer.begin()
        assert answer.getheader("transfer-encoding") is None, path
        return answer, answer.fp.read()


def test_http_1_0_has_the_body_without_chunks(sealed: Sealed) -> None:
    running = sealed.running
    for path in list_paths(sealed):
        got = request(running, path)
        answer, body = request_1_0(running, path)
        assert answer.status == got.status_code, path
        if got.content == request(running, path).content:
            assert body == got.content, path
        length = answer.getheader("content-length")
        assert length is None or int(length) == len(body), path
        assert request_1_0(running, path, "HEAD")[1] == b"", path


@pytest.mark.parametrize(
    ("text", "status"),
    [
        ("GET /api/v1/health HTTP/1.0\r\n\r\n", 200),
        ("GET /api/v1/health HTTP/1.0\r\nHost: evil.example\r\n\r\n", 403),
        ("GET /api/v1/health HTTP/1.1\r\n\r\n", 403),
        (TARE, 403),
    ],
)
def test_only_http_1_0_needs_no_host(shared: Running, text: str, status: int) -> None:
    with socket.create_connection(("127.0.0.1", shared.port), timeout=PATIENCE_S) as raw:
        raw.sendall(text.encode())
        assert raw.recv(65536).split()[1] == str(status).encode()


@pytest.mark.filterwarnings("default")
def test_a_broken_answer_to_http_1_0_is_a_reset(
    sealed: Sealed, monkeypatch: pytest.MonkeyPatch
) -> None:
    def encode_and_fail(_: object) -> Iterator[bytes]:
        yield b"x" * 65536
        raise RuntimeError("a part of this test")

    monkeypatch.setattr(downloads, "stream_zip", encode_and_fail)
    with pytest.raises(ConnectionResetError):
        request_1_0(sealed.running, f"/api/v1/sessions/zip?ids={sealed.id}")


def test_of_two_requests_of_http_1_0_one_is_answered(sealed: Sealed) -> None:
    path = f"/api/v1/sessions/{sealed.id}/data?format=csv"
    one = f"GET {path} HTTP/1.0\r\nHost: localhost\r\nConnection: keep-alive\r\n\r\n".encode()
    with socket.create_connection(("127.0.0.1", sealed.running.port), timeout=PATIENCE_S) as raw:
        raw.sendall(one + one)
        content = b""
        while piece := raw.recv(65536):
            content += piece
    assert content.partition(b"\r\n\r\n")[2] == request(sealed.running, path).content
