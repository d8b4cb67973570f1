"""A request that is sent again, because nobody heard the answer: it is the same recording."""

from __future__ import annotations

import threading
from typing import Any

import httpx
import pytest

from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused

KEY = {"Idempotency-Key": "8e03978e-40d5-43dd-bc93-6894a57f9324"}
BODY: dict[str, object] = {"node": "bench", "name": "trial", "tags": ["mud"]}


def post(running: Running, path: str = "/sessions", **body: object) -> httpx.Response:
    return running.http.post(path, json=(BODY if path == "/sessions" else {}) | body, headers=KEY)


def begun(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 201, answer.text
    content: dict[str, Any] = answer.json()
    return content


def test_the_same_request_with_the_same_key_is_the_same_session_also_after_a_restart(
    running: Running, tared: FakeNode
) -> None:
    first = begun(post(running))
    again = post(running, subject=None, notes="")  # as it is if nothing is said
    assert begun(again)["id"] == first["id"]
    assert again.headers["location"] == f"/api/v1/sessions/{first['id']}"
    session = Recording(running, first)
    tared.deliver(50)
    tared.finish(session)
    assert begun(post(running))["state"] == "sealed"
    tared.leave()
    running.restart()
    # The node is away, so that another session could not even be begun.
    assert begun(post(running))["id"] == first["id"]
    assert [one["id"] for one in running.sessions()] == [first["id"]]
    assert running.http.post("/sessions", json=BODY).status_code == 409


def test_requests_that_come_at_once_begin_one_session(running: Running, tared: FakeNode) -> None:
    found: list[str] = []
    threads = [
        threading.Thread(target=lambda: found.append(begun(post(running))["id"])) for _ in range(8)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(found) == 8
    assert len(set(found)) == 1
    assert len(running.sessions()) == 1


def test_without_a_key_or_with_another_one_each_request_is_a_recording_of_its_own(
    running: Running, tared: FakeNode
) -> None:
    ids = {begun(post(running))["id"]}
    ids.add(begun(running.http.post("/sessions", json=BODY))["id"])
    ids.add(begun(running.http.post("/sessions", json=BODY))["id"])
    other = running.http.post("/sessions", json=BODY, headers={"Idempotency-Key": "another"})
    assert len(ids | {begun(other)["id"]}) == 4


def test_a_key_that_came_with_another_request_is_refused(running: Running, tared: FakeNode) -> None:
    first = begun(post(running))
    for answer in (
        post(running, name="another"),
        post(running, pre_roll_s=1.0),
        post(running, "/takes", name="trial"),
    ):
        assert_refused(answer, 422, "used by another request", first["id"], "new key")
    assert len(running.sessions()) == 1


@pytest.mark.parametrize("key", [b"", b"two words", b"x" * 201, b"\xa3"])
def test_a_key_that_is_none_is_refused(running: Running, tared: FakeNode, key: bytes) -> None:
    answer = running.http.post("/sessions", json=BODY, headers=[(b"Idempotency-Key", key)])
    assert_refused(answer, 422, "idempotency-key")
    assert running.sessions() == []


def test_a_request_that_was_refused_is_tried_anew(running: Running, node: FakeNode) -> None:
    node.connect()
    assert_refused(post(running), 409, "sends no frames")
    node.tared()
    assert begun(post(running))["state"] == "recording"


def test_what_was_begun_and_deleted_is_not_begun_again(running: Running, tared: FakeNode) -> None:
    first = begun(post(running))
    tared.finish(Recording(running, first))
    running.http.delete(f"/sessions/{first['id']}")
    assert_refused(post(running), 409, "in the trash", "Restore it")
    running.http.post(f"/trash/{first['id']}/restore")
    assert begun(post(running))["id"] == first["id"]
    running.http.delete(f"/sessions/{first['id']}")
    running.http.delete("/trash")
    assert begun(post(running))["id"] != first["id"]


@pytest.fixture
def feet(running: Running, tared: FakeNode, node_of: NodeOf) -> FakeNode:
    """A second node, beside `bench`."""
    other = node_of(running, "other")
    other.connect()
    other.tared()
    return other


def test_the_same_take_is_begun_once_with_what_was_said_of_the_others(
    running: Running, feet: FakeNode
) -> None:
    nodes = ["bench", "other", "nobody"]
    first = begun(post(running, "/takes", name="both", nodes=nodes))
    again = begun(post(running, "/takes", name="both", nodes=nodes))
    assert again["id"] == first["id"]
    assert [one["id"] for one in again["sessions"]] == [one["id"] for one in first["sessions"]]
    assert again["failed"] == first["failed"]
    running.restart()
    after = begun(post(running, "/takes", name="both", nodes=nodes))
    assert after["id"] == first["id"]
    assert list(after["failed"]) == ["nobody"]
    assert len(running.sessions()) == 2
    assert_refused(post(running, "/takes", name="both"), 422, "used by another request")


def test_to_stop_twice_is_to_stop_once(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    stopped = session.stop()
    tared.send(10, now=True)
    sealed = session.sealed()
    assert session.stop() == sealed
    assert session.stop()["stopped_t_ns"] == stopped["stopped_t_ns"]


def test_to_stop_a_take_twice_is_to_stop_it_once(running: Running, feet: FakeNode) -> None:
    made = running.http.post("/takes", json={"name": "both"}).json()
    url = f"/takes/{made['id']}/stop"
    first = running.http.post(url).json()
    again = running.http.post(url)
    assert again.status_code == 200
    assert [one["stopped_t_ns"] for one in again.json()["sessions"]] == [
        one["stopped_t_ns"] for one in first["sessions"]
    ]
    assert again.json()["failed"] == {}
