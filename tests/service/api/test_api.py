"""The REST API as a whole: errors, pages, its own description, and that reading changes nothing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from devices.errors import StorageError
from service.api.app import make_app
from service.api.guard import BODY_BYTES_MAX
from service.api.logins import Logins
from service.server.server import Server
from storage.sessions.folder import Part, Session, make_session_id
from tests.service.fake_node import FakeNode
from tests.service.running import Running
from tests.storage.faulty_disk import refusing
from tests.tokens import SHARED_TOKEN
from tests.waiting import until

UNKNOWN_ID = "20200101T000000Z-000000"


def assert_problem(answer: httpx.Response, status: int, path: str) -> None:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    content = answer.json()
    assert set(content) == {"type", "title", "status", "detail", "instance"}
    assert content["type"] == "about:blank"
    assert content["status"] == status
    assert content["title"]
    assert content["detail"]
    assert content["instance"] == path


WRONG: tuple[tuple[str, str, bytes | None, int], ...] = (
    ("GET", "/nothing", None, 404),
    ("GET", f"/sessions/{UNKNOWN_ID}", None, 404),
    ("GET", f"/sessions/{UNKNOWN_ID}/nothing", None, 404),
    ("POST", "/nothing", b"{}", 404),
    ("PUT", "/sessions", b"{}", 405),
    ("DELETE", "/sessions", None, 405),
    ("POST", "/health", b"{}", 405),
    ("GET", f"/sessions/{UNKNOWN_ID}/stop", None, 405),
    ("POST", "/sessions", b"", 422),
    ("POST", "/sessions", b"{", 422),
    ("POST", "/sessions", b"[]", 422),
    ("POST", "/sessions", b"{}", 422),
    ("POST", "/sessions", b'{"node":"a","name":""}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"   "}', 422),
    ("POST", "/sessions", b'{"node":"a","name":5}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"x","surprise":1}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"x","pre_roll_s":-1}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"x","pre_roll_s":NaN}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"x","pre_roll_s":1e400}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"' + b"x" * 300 + b'"}', 422),
    ("POST", "/sessions", b'{"node":"a","name":"\xff"}', 400),
    ("POST", "/sessions", b'{"node":"a","name":"\\ud800"}', 422),
    ("POST", "/sessions", b"[" * 60_000, 400),
    ("PATCH", f"/sessions/{UNKNOWN_ID}", b'{"name":""}', 422),
    ("PATCH", f"/sessions/{UNKNOWN_ID}", b'{"sha256":"x"}', 422),
    ("PATCH", f"/sessions/{UNKNOWN_ID}", b'{"name":"x"}', 404),
    (
        "POST",
        f"/sessions/{UNKNOWN_ID}/markers",
        b'{"label":"x","t_ns":9223372036854775808}',
        422,
    ),
    ("POST", f"/sessions/{UNKNOWN_ID}/markers", b'{"label":"x","t_ns":1.5}', 422),
    ("GET", "/sessions?limit=0", None, 422),
    ("GET", "/sessions?limit=501", None, 422),
    ("GET", "/sessions?limit=many", None, 422),
    ("GET", "/sessions?q=" + "x" * 201, None, 422),
    ("GET", "/sessions?from=yesterday", None, 422),
    ("GET", "/sessions?to=2026-13-01", None, 422),
    ("GET", "/sessions?complete=yes", None, 422),
)


def test_every_error_is_a_problem(running: Running) -> None:
    for method, path, body, status in WRONG:
        answer = running.http.request(
            method, path, content=body, headers={"Content-Type": "application/json"}
        )
        assert_problem(answer, status, "/api/v1" + path.split("?")[0])


def test_a_body_of_another_type_is_a_problem(running: Running) -> None:
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        answer = running.http.post(
            "/sessions", content=b'{"node":"bench","name":"x"}', headers={"Content-Type": kind}
        )
        assert answer.status_code in (415, 422), kind
        assert_problem(answer, answer.status_code, "/api/v1/sessions")


def test_a_path_outside_the_api_is_a_problem_too(running: Running) -> None:
    for path in ("/nothing", "/static/nothing.js", "/static/%2e%2e/pyproject.toml", "/api"):
        answer = running.http.get(running.url + path)
        assert answer.status_code == 404, path
        assert answer.headers["content-type"] == "application/problem+json"


def test_a_body_that_is_too_long_is_a_problem(running: Running) -> None:
    long = b'{"node":"a","name":"' + b"x" * BODY_BYTES_MAX + b'"}'
    assert_problem(running.http.post("/sessions", content=long), 413, "/api/v1/sessions")


def test_a_body_in_chunks_that_is_too_long_is_a_problem(running: Running) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(BODY_BYTES_MAX // 1000 + 5):
            yield b"x" * 1000

    answer = running.http.post(
        "/sessions", content=chunks(), headers={"Content-Type": "application/json"}
    )
    assert_problem(answer, 413, "/api/v1/sessions")
    assert running.http.get("/health").status_code == 200


def test_a_mistake_of_the_server_is_a_problem_without_its_inside(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(running.server, "check_writable", refusing(ZeroDivisionError, "secret"))
    answer = running.http.get("/ready")
    assert_problem(answer, 500, "/api/v1/ready")
    assert "secret" not in answer.text


def test_a_recording_that_a_full_disk_did_not_take_was_never_begun(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as context:
        refuse = refusing(StorageError, "no space")
        context.setattr("storage.checksummed_json.write_atomically", refuse)
        answer = running.http.post("/sessions", json={"node": "bench", "name": "trial"})
        assert_problem(answer, 507, "/api/v1/sessions")
    assert running.sessions() == []
    assert list((running.data / "sessions").glob("*")) == []
    running.restart()
    assert not running.server.sessions.has_unreadable


def test_a_full_disk_is_a_problem_that_says_so(
    running: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = refusing(StorageError, "No space left on device", remedy="Free space")
    monkeypatch.setattr(running.server, "check_writable", full)
    assert_problem(running.http.get("/ready"), 507, "/api/v1/ready")


@pytest.fixture
def many(running: Running, node: FakeNode) -> list[str]:
    """Ids of 23 sessions, newest first; several began at the same instant."""
    node.connect()
    node.send(10)
    until(lambda: running.node()["last_seq"] == 9)
    begin_ns = time.time_ns()
    sessions = [
        Session(
            id=make_session_id(datetime(2026, 1, 1, tzinfo=UTC)),
            name=f"{'mud' if i % 3 else 'Sand'} {i}",
            node="bench" if i % 2 else "other",
            tags=("Odd", "third") if i % 3 else ("odd",),
            state="recording",
            started_t_ns=begin_ns + i // 4,
            parts=(Part(stream_id=node.stream_id, seq_first=0, seq_last=0),),
            scene="test",
        )
        for i in range(23)
    ]
    for session in sessions:
        running.call(partial(running.server.sessions.save, session))
    sessions.sort(key=lambda s: (s.started_t_ns, s.id), reverse=True)
    return [session.id for session in sessions]


def pages(
    running: Running, limit: int, q: str | None = None, **wanted: Any
) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    query: dict[str, Any] = {"limit": limit, **wanted} | ({} if q is None else {"q": q})
    for _ in range(30):
        page = running.http.get("/sessions", params=query).json()
        assert len(page["items"]) <= limit
        found += page["items"]
        if page["next_cursor"] is None:
            return found
        query["cursor"] = page["next_cursor"]
    pytest.fail("the pages do not end")


def test_pages_lose_and_repeat_nothing(running: Running, many: list[str]) -> None:
    for limit in (1, 2, 5, 22, 23, 24, 500):
        assert [session["id"] for session in pages(running, limit, None)] == many
        for q, count in (("sand", 8), ("MUD", 15), ("nothing", 0)):
            found = pages(running, limit, q)
            ids = [session["id"] for session in found]
            assert ids == [one for one in many if one in ids]
            assert len(ids) == count
            assert all(q.casefold() in session["name"].casefold() for session in found)


def test_pages_of_what_is_asked_for_have_that_and_nothing_else(
    running: Running, many: list[str]
) -> None:
    every = pages(running, 500)
    instants = sorted({one["started_t_ns"] for one in every})
    since, until_ = instants[1], instants[4]

    def is_within(one: dict[str, Any]) -> bool:
        return bool(since <= one["started_t_ns"] < until_)

    meant: list[tuple[dict[str, Any], Callable[[dict[str, Any]], bool]]] = [
        ({"node": "bench"}, lambda one: one["node"] == "bench"),
        ({"node": ["bench", "other"]}, lambda one: True),
        ({"tag": "odd"}, lambda one: True),
        ({"tag": ["THIRD", "odd"]}, lambda one: len(one["tags"]) == 2),
        ({"from": since, "to": until_}, is_within),
        (
            {"from": since, "to": until_, "node": "bench", "q": "mud"},
            lambda one: is_within(one) and one["node"] == "bench" and "mud" in one["name"],
        ),
        ({"to": "2000-01-01"}, lambda one: False),
        ({"from": "2000-01-01T00:00:00Z"}, lambda one: True),
        ({"complete": "false"}, lambda one: one["complete"] is False),
        ({"complete": "lossy"}, lambda one: one["complete"] == "lossy"),
    ]
    for wanted, is_meant in meant:
        for limit in (1, 3, 500):
            found = [one["id"] for one in pages(running, limit, **wanted)]
            assert found == [one["id"] for one in every if is_meant(one)], wanted


def test_a_cursor_that_is_none_harms_nothing(running: Running, many: list[str]) -> None:
    for cursor in ("", "x", "1", "1.", ".x", "-5.a", "9" * 30 + ".a", "\N{SUPERSCRIPT TWO}.a"):
        answer = running.http.get("/sessions", params={"cursor": cursor})
        assert answer.status_code in (200, 422), cursor


def test_every_operation_is_described(tmp_path: Path) -> None:
    server = Server(tmp_path)
    try:
        schema = make_app(server, logins=Logins(SHARED_TOKEN)).openapi()
    finally:
        server.data_folder.release_lock()
    ids = []
    for path, operations in schema["paths"].items():
        for method, operation in operations.items():
            where = f"{method} {path}"
            ids.append(operation["operationId"])
            assert operation["summary"], where
            assert operation["description"], where
            if "{" in path:
                problem = operation["responses"]["404"]
                assert "application/problem+json" in problem["content"], where
            for status, answer in operation["responses"].items():
                assert answer["description"], where
                if int(status) >= 400:
                    assert set(answer["content"]) == {"application/problem+json"}, (where, status)
    assert len(set(ids)) == len(ids)
    assert len(ids) >= 18


def test_the_history_of_tares_says_why_and_where_the_baselines_are_going(
    running: Running, node: FakeNode
) -> None:
    node.next_t_mono_ns -= 900_000_000_000
    node.connect()
    node.tared()
    node.next_t_mono_ns += 900_000_000_000  # a quarter of an hour later, one count more
    node.send(300, 1.0, alive=True)
    node.taken_in()
    answer = running.http.post("/nodes/bench/tare", json={"reason": "  new shoe "})
    assert answer.status_code == 201, answer.text
    assert answer.json()["reason"] == "new shoe"
    assert answer.json()["temperature_raw_counts"] == [480.0, 480.0]
    page = running.http.get("/nodes/bench/tares").json()
    said = [(tare["source"], tare["reason"]) for tare in page["items"]]
    assert said == [("unloaded", "new shoe"), ("lead", "unloaded lead of the emulation")]
    per_hour = [4 * 130 / 1023] * 2
    assert page["drift"]["kpa_per_hour"] == pytest.approx(per_hour, rel=0.01)
    assert page["drift"]["n_per_hour"] == pytest.approx([4.0, 4.0], rel=0.01)
    assert page["drift"]["grf_n_per_hour"] == pytest.approx(8.0, rel=0.01)
    assert page["drift"]["kelvin_since_tare"] == [0.0, 0.0]
    shown = running.node()
    assert shown["drift"] == page["drift"]
    assert shown["auto_tare"] == "on"
    assert shown["tare_warnings"] == []
    assert running.http.post("/nodes/bench/tare", json={"why": "?"}).status_code == 422
    assert running.http.post("/nodes/bench/tare").status_code in (201, 409)


def test_a_node_without_a_tare_has_no_drift(running: Running, node: FakeNode) -> None:
    node.connect()
    shown = running.node()
    assert shown["tare"] is None
    assert shown["tare_problem"] == "not tared: lift the foot, hold it still, and tare"
    assert shown["drift"]["kpa_per_hour"] == [None, None]
    assert shown["drift"]["grf_n_per_hour"] is None
    assert shown["drift"]["kelvin_since_tare"] == [None, None]


def test_no_get_changes_anything(running: Running, node: FakeNode) -> None:
    node.connect()
    node.tared()
    node.taken_in()
    node.acknowledged(node.seq - 1)
    session = node.record()
    schema = make_app(
        running.server, logins=running.logins
    ).openapi_schema  # made without asking for it
    assert schema is None
    paths = [
        *("/health", "/ready", "/version", "/nodes", "/nodes/bench", "/nodes/bench/scene"),
        *("/nodes/bench/tares", "/nodes/bench/tare", "/sessions", session.url),
        *(f"{session.url}/{rest}" for rest in ("events", "ledger", "data?format=csv")),
        *(f"{session.url}/{rest}" for rest in ("stop", "data")),
    ]

    def state() -> object:
        files = {
            str(path): path.read_bytes()
            for path in sorted(running.data.rglob("*"))
            # What a server writes by itself while frames and clocks come in is not asked for.
            if path.is_file()
            and path.suffix not in (".arrows", ".idx", ".tmp")
            and path.name not in ("stream.json", "clock.jsonl")
        }
        return files, running.node(), session.now()

    before = state()
    for path in paths:
        for method in ("GET", "HEAD", "OPTIONS"):
            assert running.http.request(method, path).status_code < 500, path
    assert state() == before


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
def test_what_is_allowed_is_all_of_it(running: Running, path: str, allowed: set[str]) -> None:
    for method in ("OPTIONS", "PUT"):
        answer = running.http.request(method, path)
        assert answer.status_code == (204 if method == "OPTIONS" else 405)
        assert set(answer.headers["allow"].split(", ")) == {*allowed, "OPTIONS"}


@pytest.mark.parametrize("wrong", [False, True, "1", 1.5, "2020-01-01", -1, 2**63, [], {}])
def test_an_instant_is_a_number_and_nothing_like_it(
    running: Running, tared: FakeNode, wrong: object
) -> None:
    recording = tared.record()
    answer = running.http.post(f"{recording.url}/markers", json={"label": "x", "t_ns": wrong})
    assert answer.status_code == 422, answer.text
    assert recording.now()["id"] == recording.id
    assert running.http.get(f"{recording.url}/markers").json()["items"] == []


@pytest.mark.parametrize("wrong", [True, "1", [1], -1, 601, None])
def test_a_pre_roll_is_a_number_and_nothing_like_it(running: Running, wrong: object) -> None:
    body = {"node": "bench", "name": "x", "pre_roll_s": wrong}
    assert running.http.post("/sessions", json=body).status_code == 422
