"""Errors of the API: each is a problem with its reason, whatever the request."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

import httpx
import pytest

from devices.errors import StorageError
from service.api.access import BODY_BYTES_MAX
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.storage.faulty_disk import refusing

UNKNOWN = "/sessions/20200101T000000Z-000000"
UNKNOWN_IDS = (
    *("nobody", "20200101T000000Z-000000", "0" * 12, "x" * 5000, "%ff", "..%5c.."),
    *("%2e%2e", "%2e%2e%2f%2e%2e%2fetc%2fpasswd", "20200101T000000Z-000000%00", "x%0a"),
)
JSON = {"Content-Type": "application/json"}


def assert_problem(answer: httpx.Response, status: int, path: str) -> None:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    content = answer.json()
    assert content.pop("title")
    assert content.pop("detail")
    assert content == {"type": "about:blank", "status": status, "instance": path}


def start(value: bytes) -> bytes:
    return b'{"node":"a","name":' + value + b"}"


@pytest.mark.parametrize(
    ("method", "path", "body", "status"),
    [
        ("GET", "/nothing", None, 404),
        ("GET", UNKNOWN, None, 404),
        ("GET", f"{UNKNOWN}/nothing", None, 404),
        ("GET", f"{UNKNOWN}/tiles", None, 404),
        ("POST", "/nothing", b"{}", 404),
        ("PUT", "/sessions", b"{}", 405),
        ("DELETE", "/sessions", None, 405),
        ("POST", "/health", b"{}", 405),
        ("GET", f"{UNKNOWN}/stop", None, 405),
        *[("POST", "/sessions", body, 422) for body in (b"", b"{", b"[]", b"{}")],
        *[("POST", "/sessions", start(name), 422) for name in (b'""', b'"   "', b"5")],
        ("POST", "/sessions", start(b'"x","surprise":1'), 422),
        ("POST", "/sessions", start(b'"x"'), 404),
        *[
            ("POST", "/sessions", start(b'"x","pre_roll_s":' + value), 422)
            for value in (b"-1", b"601", b"NaN", b"1e400", b"true", b'"1"', b"[1]", b"null")
        ],
        ("POST", "/sessions", start(b'"' + b"x" * 300 + b'"'), 422),
        ("POST", "/sessions", start(b'"\xff"'), 400),
        ("POST", "/sessions", start(b'"\\ud800"'), 422),
        ("POST", "/sessions", b"[" * 60_000, 400),
        ("POST", "/sessions", start(b'"' + b"x" * BODY_BYTES_MAX + b'"'), 413),
        ("PATCH", UNKNOWN, b'{"name":""}', 422),
        ("PATCH", UNKNOWN, b'{"sha256":"x"}', 422),
        ("PATCH", UNKNOWN, b'{"name":"x"}', 404),
        *[
            ("POST", f"{UNKNOWN}/markers", b'{"label":"x","t_ns":' + value + b"}", 422)
            for value in (b"false", b'"1"', b"1.5", b'"2020-01-01"', b"-1", b"[]", b"{}")
        ],
        ("POST", f"{UNKNOWN}/markers", b'{"label":"x","t_ns":9223372036854775808}', 422),
        *[("GET", f"/sessions?limit={limit}", None, 422) for limit in ("0", "501", "many")],
        ("GET", "/sessions?q=" + "x" * 201, None, 422),
        ("GET", "/sessions?from=yesterday", None, 422),
        ("GET", "/sessions?to=2026-13-01", None, 422),
        ("GET", "/sessions?complete=yes", None, 422),
    ],
    ids=lambda value: repr(value)[:60],
)
def test_an_error_is_a_problem(
    shared: Running, method: str, path: str, body: bytes | None, status: int
) -> None:
    answer = shared.http.request(method, path, content=body, headers=JSON)
    assert_problem(answer, status, "/api/v1" + path.split("?", maxsplit=1)[0])


def test_no_route_finds_an_unknown_id(shared: Running) -> None:
    bodies: dict[str, dict[str, Any]] = {
        "accept-replacement": {"fingerprint": "0000-0000-0000-0000"},
        "calibration": {"id": "0" * 16},
        "markers": {"label": "x"},
        "alignment": {
            "method": "hand",
            "pairs": [{"film_s": 0.0, "t_ns": 1, "sigma_ns": 1.0}],
        },
        "weighing": {"tiles": ["T01"], "weights": ["10 N"]},
    }
    asked = 0
    for path, methods in shared.http.get("/openapi.json").json()["paths"].items():
        for method in methods if "{" in path else ():
            queries = {"data": {"format": "mcap"}, "videos": {"name": "walk.mp4"}}
            queries["alignment"] = {"method": "light"}
            query = queries.get(path.rsplit("/", 1)[-1], {})
            is_sent = method in ("post", "put", "patch")
            body = bodies.get(path.rsplit("/", 1)[-1], {}) if is_sent else None
            for unknown in UNKNOWN_IDS:
                url = shared.url + re.sub(r"\{\w+\}", unknown, path)
                answer = shared.http.request(method, url, params=query, json=body)
                status = 400 if unknown.endswith(("%00", "%0a")) else 404
                assert answer.status_code == status, (method, url, answer.text)
                assert answer.headers["content-type"] == "application/problem+json"
                asked += 1
    assert asked > 200


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""]
)
def test_a_body_of_another_type_is_a_problem(shared: Running, kind: str) -> None:
    answer = shared.http.post(
        "/sessions", content=b'{"node":"bench","name":"x"}', headers={"Content-Type": kind}
    )
    assert answer.status_code in (415, 422)
    assert_problem(answer, answer.status_code, "/api/v1/sessions")


@pytest.mark.parametrize(
    "path", ["/nothing", "/static/nothing.js", "/static/%2e%2e/pyproject.toml", "/api"]
)
def test_an_unknown_path_is_a_problem(shared: Running, path: str) -> None:
    answer = shared.http.get(shared.url + path)
    assert answer.status_code == 404
    assert answer.headers["content-type"] == "application/problem+json"


def test_a_body_in_too_many_chunks_is_a_problem(shared: Running) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(BODY_BYTES_MAX // 1000 + 5):
            yield b"x" * 1000

    answer = shared.http.post("/sessions", content=chunks(), headers=JSON)
    assert_problem(answer, 413, "/api/v1/sessions")
    assert shared.http.get("/health").status_code == 200


def test_a_bug_and_a_full_disk_are_problems(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = refusing(StorageError, "No space left on device", remedy="Free space")
    with monkeypatch.context() as patch:
        patch.setattr(running.server, "check_writable", full)
        assert_problem(running.http.get("/ready"), 507, "/api/v1/ready")
    node.connect()
    node.deliver(10)
    with monkeypatch.context() as patch:
        patch.setattr("storage.documents.write_atomically", full)
        answer = running.http.post("/sessions", json={"node": "bench", "name": "trial"})
        assert_problem(answer, 507, "/api/v1/sessions")
    assert running.sessions() == []
    assert list((running.data / "sessions").glob("*")) == []
    assert node.finish(node.record())["complete"] is True
    node.leave()
    running.restart()
    assert not running.server.sessions.has_unreadable
    monkeypatch.setattr(running.server, "check_writable", refusing(ZeroDivisionError, "secret"))
    answer = running.http.get("/ready")
    assert_problem(answer, 500, "/api/v1/ready")
    assert "secret" not in answer.text


NUMBERS = ("NaN", "Infinity", "-Infinity", "-1", "1e308", "-1e308", "1" + "0" * 400, "1e999", "0x1")
"""In queries, and in JSON, where Python reads more numbers than RFC 8259 allows."""


def is_number(schema: dict[str, Any]) -> bool:
    return schema.get("type") in ("number", "integer") or any(
        is_number(one) for one in schema.get("anyOf", ())
    )


def test_an_impossible_number_is_a_problem_in_every_route(sealed: Sealed) -> None:
    http = sealed.running.http
    before = (sealed.running.sessions(), sealed.session.now())
    api = http.get("/openapi.json").json()
    names = {"session_id": sealed.id, "node": "bench", "tare_id": "x"}
    names |= {"take_id": "x", "marker_id": "x", "name": "x", "calibration_id": "x", "job_id": "x"}
    names |= {"video_id": "x"}
    tried = 0

    def check(answer: httpx.Response, about: object, statuses: tuple[int, ...]) -> None:
        nonlocal tried
        tried += 1
        assert answer.status_code in statuses, (about, answer.text)
        if answer.status_code >= 400:
            assert answer.headers["content-type"] == "application/problem+json", about
            assert len(answer.json()["detail"]) < 2000, about

    for path, operations in api["paths"].items():
        url = path.removeprefix("/api/v1").format(**names)
        for method, operation in operations.items():
            for parameter in operation.get("parameters", ()):
                if parameter["in"] == "query" and is_number(parameter["schema"]):
                    for value in NUMBERS:
                        answer = http.request(method, url, params={parameter["name"]: value})
                        is_possible = value in ("-1", "1e308") and answer.status_code < 500
                        statuses = (answer.status_code,) if is_possible else (422,)
                        check(answer, (url, parameter["name"], value), statuses)
            content = operation.get("requestBody", {}).get("content", {})
            reference = content.get("application/json", {}).get("schema", {}).get("$ref", "")
            body = api["components"]["schemas"].get(reference.rpartition("/")[2], {})
            for name, schema in body.get("properties", {}).items():
                others = {key: "trial" for key in body.get("required", ()) if key != name}
                if "node" in others:
                    others["node"] = "bench"
                for value in NUMBERS if is_number(schema) else ():
                    text = json.dumps(others)[:-1] + f', "{name}": {value}}}'
                    answer = http.request(method, url, content=text, headers=JSON)
                    check(answer, (url, name, value), (400, 422))
    assert tried >= 5 * len(NUMBERS)
    assert (sealed.running.sessions(), sealed.session.now()) == before
