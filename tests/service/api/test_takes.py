"""Several nodes at once: one session each, with one name and one take."""

from __future__ import annotations

import errno
import json
from typing import Any

import pytest

import service.api.routes.recordings.sessions
import service.server.recorder
from devices.errors import StorageError
from service.sessions.sealing import rebuild_damaged_session_json
from storage.sessions.folder import SessionsFolder
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, assert_refused
from tests.waiting import until

NOBODY = "20200101T000000Z-000000"


@pytest.fixture(autouse=True)
def _frames_of_long_ago(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(service.server.recorder, "MAX_DELAY_S", 1e9)
    monkeypatch.setattr(service.api.routes.recordings.sessions, "SEAL_TIMEOUT_S", 0.2)


@pytest.fixture
def feet(running: Running, node_of: NodeOf) -> dict[str, FakeNode]:
    """Three nodes that have sent something."""
    found = {name: node_of(running, name) for name in ("left", "right", "spare")}
    for node in found.values():
        node.connect()
        node.tared()
        node.acknowledged(69)
    return found


def take(running: Running, **body: object) -> dict[str, Any]:
    answer = running.http.post("/takes", json={"name": "both"} | body)
    assert answer.status_code == 201, answer.text
    made: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/api/v1/takes/{made['id']}"
    return made


def nodes_of(view: dict[str, Any]) -> list[str]:
    return [session["node"] for session in view["sessions"]]


def test_a_take_is_a_session_of_each_connected_node_with_one_name(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    feet["spare"].leave()
    until(lambda: not running.node("spare")["connected"])
    made = take(running, notes="wet", subject="A", tags=["mud"])
    assert nodes_of(made) == ["left", "right"]
    assert made["failed"] == {}
    for session in made["sessions"]:
        said = {name: session[name] for name in ("name", "take", "notes", "subject", "state")}
        assert said == {
            "name": "both",
            "take": made["id"],
            "notes": "wet",
            "subject": "A",
            "state": "recording",
        }
    for name in ("left", "right"):
        feet[name].deliver(50, [5.0, 10.0])
    stopped = running.http.post(f"/takes/{made['id']}/stop").json()
    assert nodes_of(stopped) == ["left", "right"]
    for name in ("left", "right"):
        feet[name].send(30, now=True)
    for session in made["sessions"]:
        recording = running.session(session["id"])
        sealed = recording.sealed()
        assert sealed["frames"] == 50
        assert sealed["take"] == made["id"]
        written = json.loads((recording.folder / "session.json").read_text())
        assert written["take"] == made["id"]


def test_a_node_that_cannot_be_recorded_says_why_and_the_others_are_recorded(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    feet["right"].leave()
    until(lambda: not running.node("right")["connected"])
    made = take(running, nodes=["left", "right", "nobody", "left"])
    assert nodes_of(made) == ["left"]
    assert sorted(made["failed"]) == ["nobody", "right"]
    assert "'right' sends no frames" in made["failed"]["right"]
    assert "no node 'nobody'" in made["failed"]["nobody"]


def test_a_disk_that_takes_one_session_and_not_the_other_is_said_of_that_node(
    running: Running, feet: dict[str, FakeNode], monkeypatch: pytest.MonkeyPatch
) -> None:
    keep = running.server.sessions.save

    def full_for_right(session: Any) -> Any:
        if session.node == "right":
            raise StorageError("the disk is full", errno=errno.ENOSPC)
        return keep(session)

    monkeypatch.setattr(running.server.sessions, "save", full_for_right)
    made = take(running, nodes=["left", "right", "spare"])
    assert nodes_of(made) == ["left", "spare"]
    assert "full" in made["failed"]["right"]
    assert running.node("right")["recording"] == []


def test_a_take_that_could_be_recorded_nowhere_is_refused(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    answer = running.http.post("/takes", json={"name": "x", "nodes": ["nobody", "noone"]})
    assert_refused(answer, 409, "'nobody'", "'noone'")
    for node in feet.values():
        node.leave()
    until(lambda: not any(running.node(name)["connected"] for name in feet))
    assert_refused(running.http.post("/takes", json={"name": "x"}), 409, "no node is connected")
    assert running.sessions() == []


def test_marking_a_take_marks_all_of_it_at_one_instant_and_once(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    made = take(running)
    event = {"label": "a stone", "t_ns": 10**18, "id": "0123456789ab"}
    for _ in range(2):  # the answer was lost
        answer = running.http.post(f"/takes/{made['id']}/markers", json=event)
        assert answer.status_code == 201
        assert nodes_of(answer.json()) == ["left", "right", "spare"]
    for session in made["sessions"]:
        markers = running.http.get(f"/sessions/{session['id']}/markers").json()["items"]
        assert [{name: marker[name] for name in event} for marker in markers] == [event]
    now = running.http.post(f"/takes/{made['id']}/markers", json={"label": "now"}).json()
    instants = {
        running.http.get(f"/sessions/{session['id']}/markers").json()["items"][-1]["t_ns"]
        for session in now["sessions"]
    }
    assert len(instants) == 1


def test_a_node_that_is_lost_in_between_is_marked_and_stopped_with_the_others(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    made = take(running, nodes=["left", "right"])
    feet["left"].deliver(50)
    feet["right"].deliver(50)
    feet["right"].leave()
    until(lambda: not running.node("right")["connected"])
    marked = running.http.post(f"/takes/{made['id']}/markers", json={"label": "gone"}).json()
    assert nodes_of(marked) == ["left", "right"]
    stopped = running.http.post(f"/takes/{made['id']}/stop").json()
    assert stopped["failed"] == {}
    assert [session["state"] for session in stopped["sessions"]] == ["pending", "pending"]
    feet["left"].send(30, now=True)
    left, right = (running.session(session["id"]) for session in made["sessions"])
    assert left.sealed()["complete"] is True
    assert right.now()["state"] == "pending"
    feet["right"].come_back()
    feet["right"].send(30, now=True)
    assert right.sealed()["complete"] is True


def test_what_was_stopped_alone_is_not_marked_with_its_take_and_stays_as_it_was_stopped(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    made = take(running, nodes=["left", "right"])
    alone = running.session(made["sessions"][0]["id"]).stop()
    marked = running.http.post(f"/takes/{made['id']}/markers", json={"label": "x"}).json()
    assert nodes_of(marked) == ["right"]
    stopped = running.http.post(f"/takes/{made['id']}/stop").json()
    assert nodes_of(stopped) == ["left", "right"]
    assert stopped["sessions"][0]["stopped_t_ns"] == alone["stopped_t_ns"]
    assert nodes_of(running.http.get(f"/takes/{made['id']}").json()) == ["left", "right"]
    answer = running.http.post(f"/takes/{made['id']}/markers", json={"label": "late"})
    assert_refused(answer, 409, "stopped already")


def test_sessions_are_listed_by_take(running: Running, feet: dict[str, FakeNode]) -> None:
    first, second = take(running, nodes=["left", "right"]), take(running, nodes=["left"])
    alone = feet["spare"].record()
    for made in (first, second):
        listed = running.http.get("/sessions", params={"take": made["id"]}).json()["items"]
        assert sorted(s["id"] for s in listed) == sorted(s["id"] for s in made["sessions"])
    page = running.http.get("/sessions", params={"take": first["id"], "limit": 1}).json()
    more = {"take": first["id"], "limit": 1, "cursor": page["next_cursor"]}
    assert len(running.http.get("/sessions", params=more).json()["items"]) == 1
    assert running.http.get("/sessions", params={"take": "x"}).json()["items"] == []
    assert alone.now()["take"] is None


@pytest.mark.parametrize("take_id", ["x", "0" * 12, "..", "%2e%2e", "0" * 300, NOBODY])
def test_a_take_that_there_is_not_is_not_found(running: Running, take_id: str) -> None:
    for method, path, body in (
        ("GET", "", None),
        ("POST", "/stop", None),
        ("POST", "/markers", {"label": "x"}),
    ):
        answer = running.http.request(method, f"/takes/{take_id}{path}", json=body)
        is_index = answer.url.path == "/api/v1"  # of two dots a client makes that
        assert answer.status_code in (404, 405) or is_index, (method, path)


@pytest.mark.parametrize(
    "body",
    [
        *({}, {"name": ""}, {"name": "x", "nodes": []}, {"name": "x", "nodes": "left"}),
        *({"name": "x", "node": "left"}, {"name": "x", "nodes": [1]}),
        {"name": "x", "pre_roll_s": -1},
    ],
)
def test_what_is_no_take_is_refused(running: Running, body: dict[str, object]) -> None:
    assert running.http.post("/takes", json=body).status_code == 422


def test_a_session_that_is_made_again_from_its_file_is_still_of_its_take(
    running: Running, feet: dict[str, FakeNode]
) -> None:
    made = take(running, nodes=["left"])
    feet["left"].deliver(50)
    running.http.post(f"/takes/{made['id']}/stop")
    feet["left"].send(30, now=True)
    recording = running.session(made["sessions"][0]["id"])
    recording.sealed()
    (recording.folder / "session.json").unlink()
    again = rebuild_damaged_session_json(SessionsFolder(recording.folder.parent), recording.id)
    assert again is not None
    assert again.take == made["id"]
