"""Sessions over REST: lists in pages, metadata, tiles, verification and damage."""

from __future__ import annotations

import json
import os
import shutil
import stat
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import httpx
import pytest

from devices.errors import FootTileError
from service.api.address import load_or_create_token
from service.estimation import LIVE_LAG_MS, OFFLINE_LAG_MS
from service.protocol.codec import format_close_reason
from service.server.data_folder import SERVER_NAME
from service.user_folders import register_private_folder, strip_private_folders
from storage.durable_files import set_aside_damaged
from storage.intervals import NO_END, Intervals
from storage.permissions import set_umask_and_create_private_folder
from storage.sessions.folder import Part, Session, make_session_id
from storage.verify.session import verify_session
from tests.service.api.sealed import Sealed
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, assert_refused
from tests.storage.faulty_disk import flip_bits
from tests.waiting import PATIENCE_S

JSON = {"Content-Type": "application/json"}


# --- in pages -------------------------------------------------------------------------------------


@pytest.fixture
def many(running: Running, node: FakeNode) -> list[dict[str, Any]]:
    """List 23 sessions, newest first; several began at the same instant."""
    node.connect()
    node.send(10)
    node.taken_in()
    begin_ns = time.time_ns()
    for i in range(23):
        session = Session(
            id=make_session_id(datetime(2026, 1, 1, tzinfo=UTC)),
            name=f"{'mud' if i % 3 else 'Sand'} {i}",
            node="bench" if i % 2 else "other",
            tags=("Odd", "third") if i % 3 else ("odd",),
            state="recording",
            started_t_ns=begin_ns + i // 4,
            parts=(Part(stream_id=node.stream_id, seq_first=0, seq_last=0),),
            scene="test",
        )
        running.call(partial(running.server.sessions.save, session))
    sessions = list_pages(running, 500)
    order = [(session["started_t_ns"], session["id"]) for session in sessions]
    assert order == sorted(order, reverse=True)
    assert len(sessions) == 23
    return sessions


def list_pages(running: Running, limit: int, **wanted: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = []
    query: dict[str, Any] = {"limit": limit, **wanted}
    for _ in range(30):
        page = running.http.get("/sessions", params=query).json()
        assert len(page["items"]) <= limit
        found += page["items"]
        if page["next_cursor"] is None:
            return found
        query["cursor"] = page["next_cursor"]
    pytest.fail("the pages do not end")


def test_pages_have_every_matching_session_once(
    running: Running, many: list[dict[str, Any]]
) -> None:
    instants = sorted({one["started_t_ns"] for one in many})
    since, end = instants[1], instants[4]

    def is_within(one: dict[str, Any]) -> bool:
        return bool(since <= one["started_t_ns"] < end)

    cases: list[tuple[dict[str, Any], Callable[[dict[str, Any]], bool]]] = [
        ({}, lambda one: True),
        ({"q": "sand"}, lambda one: "Sand" in one["name"]),
        ({"q": "MUD"}, lambda one: "mud" in one["name"]),
        ({"q": "nothing"}, lambda one: False),
        ({"node": "bench"}, lambda one: one["node"] == "bench"),
        ({"node": ["bench", "other"]}, lambda one: True),
        ({"tag": "odd"}, lambda one: True),
        ({"tag": ["THIRD", "odd"]}, lambda one: len(one["tags"]) == 2),
        ({"from": since, "to": end}, is_within),
        (
            {"from": since, "to": end, "node": "bench", "q": "mud"},
            lambda one: is_within(one) and one["node"] == "bench" and "mud" in one["name"],
        ),
        ({"to": "2000-01-01"}, lambda one: False),
        ({"from": "2000-01-01T00:00:00Z"}, lambda one: True),
        ({"complete": "false"}, lambda one: one["complete"] is False),
        ({"complete": "lossy"}, lambda one: one["complete"] == "lossy"),
    ]
    for query, is_meant in cases:
        expected = [one["id"] for one in many if is_meant(one)]
        for limit in (1, 3, 22, 23, 24, 500):
            found = list_pages(running, limit, **query)
            assert [one["id"] for one in found] == expected, (query, limit)


def test_a_wrong_cursor_is_harmless(shared: Running) -> None:
    for cursor in ("", "x", "1", "1.", ".x", "-5.a", "9" * 30 + ".a", "\N{SUPERSCRIPT TWO}.a"):
        answer = shared.http.get("/sessions", params={"cursor": cursor})
        assert answer.status_code in (200, 422), cursor


# --- metadata -------------------------------------------------------------------------------------


def test_metadata_survive_a_restart_and_keep_the_data(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(20)
    sealed = tared.finish(session)
    change = {"name": "new", "subject": "B", "notes": "zwei\n\tZeilen", "tags": ["a", "b"]}
    assert running.http.patch(session.url, json=change).status_code == 200
    running.restart()
    found = session.now()
    assert {name: found[name] for name in change} == change
    assert found["sha256"] == sealed["sha256"]
    partly = running.http.patch(session.url, json={"notes": ""}).json()
    assert (partly["name"], partly["notes"]) == ("new", "")


@pytest.mark.parametrize(
    "text",
    [
        *("=1+1", "<script>alert(1)</script>", "naïve 😀", '"\\', "a\u2028b"),
        "\u0645\u06cc\u200c\u062e \U0001f469\u200d\U0001f52c",  # with joiners
    ],
)
def test_a_text_comes_back_unchanged(sealed: Sealed, text: str) -> None:
    http, url = sealed.running.http, sealed.recording.url
    http.patch(url, json={"name": text, "notes": text})
    marker = http.post(f"{url}/markers", json={"label": text}).json()
    assert marker["label"] == text
    answer = http.get(url)
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.json()["name"] == answer.json()["notes"] == text
    assert text in [item["label"] for item in http.get(f"{url}/markers").json()["items"]]
    assert http.get("/sessions", params={"q": text}).json()["items"]


@pytest.mark.parametrize(
    "wrong",
    [
        *("a\x1b[2J", "a\x07b", "a\x00b", "a\x7fb", "a\x9bb", "a\u202eb", "a\u2066b", "\ufeffa"),
        *("\ud800", "ab\udfff"),
    ],
    ids=ascii,
)
def test_an_invisible_text_is_refused(sealed: Sealed, wrong: str) -> None:
    http, url = sealed.running.http, sealed.session.url
    before = sealed.session.now()
    # JSON of a lone surrogate is refused before the rules of texts.
    reason = "" if any("\ud800" <= letter <= "\udfff" for letter in wrong) else "U+"
    for body in ({"name": wrong}, {"subject": wrong}, {"tags": [wrong]}, {"notes": wrong}):
        answer = http.patch(url, content=json.dumps(body), headers=JSON)
        assert_refused(answer, 422, reason)
    answer = http.post(f"{url}/markers", content=json.dumps({"label": wrong}), headers=JSON)
    assert_refused(answer, 422, reason)
    assert sealed.session.now() == before


def test_only_notes_have_line_breaks(sealed: Sealed) -> None:
    http, url = sealed.running.http, sealed.session.url
    for body in ({"name": "one\ntwo"}, {"subject": "one\ttwo"}, {"tags": ["one\ntwo"]}):
        assert_refused(http.patch(url, json=body), 422, "line break or tab")
    assert_refused(http.post(f"{url}/markers", json={"label": "one\ntwo"}), 422, "line break")
    assert_refused(http.post(f"{url}/markers", json={"label": ""}), 422, "label")


def test_a_change_needs_the_revision_that_its_client_saw(running: Running, tared: FakeNode) -> None:
    http, session = running.http, tared.record()
    tared.finish(session)
    seen = {"If-Match": f'"{session.now()["revision"]}"'}
    assert http.patch(session.url, json={"notes": "mine"}, headers=seen).status_code == 200
    late = http.patch(session.url, json={"notes": "yours"}, headers=seen)
    assert_refused(late, 412, "changed by another client")
    assert_refused(http.delete(session.url, headers=seen), 412, "changed by another client")
    assert session.now()["notes"] == "mine"
    # A marker is no change of the session, and a client may leave the revision out.
    seen = {"If-Match": session.now()["revision"]}
    http.post(f"{session.url}/markers", json={"label": "a third"})
    assert http.patch(session.url, json={"tags": ["wet"]}, headers=seen).status_code == 200
    for headers in ({}, {"If-Match": "*"}):
        assert http.patch(session.url, json={"name": "x"}, headers=headers).status_code == 200
    seen = {"If-Match": session.now()["revision"]}
    assert http.delete(session.url, headers=seen).status_code == 204


# --- tiles ----------------------------------------------------------------------------------------


def test_a_session_has_its_tiles_and_their_estimator(running: Running, tared: FakeNode) -> None:
    node = running.node()
    session = tared.record()
    tared.deliver(50, [20.0, 60.0])
    recording = running.http.get(f"{session.url}/tiles").json()
    tared.finish(session)
    sealed = running.http.get(f"{session.url}/tiles").json()
    names = ("tiles", "servo", "calibration", "node", "nominal_rate_hz")
    tare = {"t_ns": node["tare"]["t_ns"], "source": node["tare"]["source"]}
    for found in (recording, sealed):
        assert {name: found[name] for name in names} == {name: node[name] for name in names}
        assert (found["estimates_problem"], found["tares"]) == (None, [tare])
    assert (recording["lag_ms"], sealed["lag_ms"]) == (LIVE_LAG_MS, OFFLINE_LAG_MS)
    assert sealed["tiles"][0]["full_scale_n"] > 0


def test_tiles_without_a_calibration_have_no_scale(running: Running, node_of: NodeOf) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(10)
    session = node.record_sealed(50, [0.0, 30.0])
    found = running.http.get(f"{session.url}/tiles").json()
    assert (found["calibration"], found["lag_ms"]) == (None, None)
    assert found["estimates_problem"] == "the node had no calibration"
    assert [tile["full_scale_n"] for tile in found["tiles"]] == [None, None]
    assert [tile["serial"] for tile in found["tiles"]] == list(node.info.serials)


# --- verification, damage, permissions ------------------------------------------------------------


def test_a_session_is_verified_and_not_changed(running: Running, tared: FakeNode) -> None:
    http, session = running.http, tared.record()
    url = f"{session.url}/verification"
    assert_refused(http.get(url), 409, "recording", "Stop it")
    tared.deliver(200, [20.0, 60.0], alive=True)
    tared.finish(session)
    found = http.get(url).json()
    assert found | {"unproven": []} == verify_session(session.folder).to_json_dict()
    assert (found["problems"], found["complete"]) == ([], True)
    assert found["sha256"] == session.now()["sha256"]
    for name in ("frames.parquet", "markers.parquet", "clock.parquet"):
        flip_bits(session.folder / name)
        before = {one.name: one.read_bytes() for one in session.folder.iterdir()}
        found = http.get(url).json()
        assert any(name in problem for problem in found["problems"])
        assert found["complete"] is False
        assert {one.name: one.read_bytes() for one in session.folder.iterdir()} == before
    shutil.rmtree(session.folder)
    assert_refused(http.get(url), 404, "no such folder")
    assert_refused(http.get("/sessions/none/verification"), 404, "none")


def test_a_damaged_description_is_rebuilt_or_named(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(20)
    sealed, recording = node.record(), node.record()
    node.deliver(50)
    node.finish(sealed)
    content = sealed.data().content
    running.stop()
    for session in (sealed, recording):
        path = session.folder / "session.json"
        path.write_bytes(path.read_bytes().replace(b'"node"', b'"nude"', 1))
    running.start()
    listed = running.http.get("/sessions").json()
    assert [one["id"] for one in listed["items"]] == [sealed.id]
    assert "was rebuilt from frames.parquet" in listed["items"][0]["problem"]
    assert sealed.data().content == content
    assert list(listed["unreadable"]) == [recording.id]
    refused = running.http.get(recording.url)
    assert_refused(refused, 409, "cannot be read", "foottile verify")
    needed = running.call(lambda: running.server.recorder.collect_needed_frames("bench"))
    assert needed == {node.stream_id: Intervals([(0, NO_END)])}
    assert (recording.folder / "session.json").is_file()


def test_no_answer_names_the_data_folder(
    running: Running, tared: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    session = tared.record_sealed(100, [20.0, 60.0])
    running.stop()
    folders = [session.folder, running.data / "nodes" / "bench"]
    for path in (path for folder in folders for path in folder.rglob("*") if path.is_file()):
        if path.name != "session.json":
            flip_bits(path, bits=0xFF)
    other = session.folder.with_name("20200101T000000Z-00000a")
    other.mkdir()
    (other / "session.json").write_text("{")
    running.start()
    names = defaultdict(lambda: "x", session_id=session.id, node="bench", name="bench")
    failed = 0
    for route, operations in running.http.get("/openapi.json").json()["paths"].items():
        path = route.removeprefix("/api/v1").format_map(names)
        for query in ("", "?format=csv", "?ids=" + session.id) if "get" in operations else ():
            try:
                answer = running.http.get(path + query)
            except httpx.RemoteProtocolError:  # a zip file breaks off at the damage
                continue
            if "parquet" not in answer.headers.get("content-type", ""):
                failed += answer.status_code >= 400
                assert str(running.data) not in answer.text, (path, query)
    assert failed > 10
    assert f"{session.id}/frames.parquet" in running.http.get(f"{session.url}/data?format=csv").text
    listed = running.http.get("/sessions").json()["unreadable"]
    assert "sessions/20200101T000000Z-00000a/session.json" in str(listed)
    with running.socket("/api/v1/live") as live:
        assert str(running.data) not in live.recv(timeout=PATIENCE_S)
    assert str(running.data) in caplog.text  # a reader of the log has to find the file


def test_a_shortened_reason_has_no_part_of_the_data_folder(tmp_path: Path) -> None:
    folder = tmp_path / ("long" * 40) / "data"
    folder.mkdir(parents=True)
    register_private_folder(folder)
    error = FootTileError("cannot be read", where=str(folder / "sessions" / "x.parquet"))
    assert strip_private_folders(str(error)) == "sessions/x.parquet: cannot be read"
    assert format_close_reason(str(error)) == "sessions/x.parquet: cannot be read"
    assert strip_private_folders(f"{folder}: gone") == "the data folder: gone"
    assert str(folder) in str(error)
    assert strip_private_folders("no folder") == "no folder"


@pytest.fixture
def umask() -> Iterator[None]:
    before = os.umask(0o022)
    yield
    os.umask(before)


@pytest.mark.usefixtures("umask")
def test_a_used_data_folder_is_closed_to_others(running: Running, tared: FakeNode) -> None:
    load_or_create_token(None, running.data)
    session = tared.record_sealed(10)
    assert running.http.delete(session.url).status_code == 204
    assert running.http.get("/ready").status_code == 200
    running.stop()
    set_aside_damaged(running.data / SERVER_NAME)
    running.start()
    running.data.chmod(0o755)
    set_umask_and_create_private_folder(running.data)
    assert stat.S_IMODE(running.data.stat().st_mode) == 0o700, os.listdir(running.data)
