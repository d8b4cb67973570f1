"""Repeated requests: with the same key they are one recording."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, assert_refused

KEY = {"Idempotency-Key": "8e03978e-40d5-43dd-bc93-6894a57f9324"}
BODY: dict[str, object] = {"node": "bench", "name": "trial", "tags": ["mud"]}


def post(running: Running, path: str = "/sessions", **body: object) -> httpx.Response:
    return running.http.post(path, json=(BODY if path == "/sessions" else {}) | body, headers=KEY)


def content_of(answer: httpx.Response) -> dict[str, Any]:
    assert answer.status_code == 201, answer.text
    content: dict[str, Any] = answer.json()
    return content


def test_a_repeated_start_is_the_same_session(running: Running, tared: FakeNode) -> None:
    first = content_of(post(running))
    again = post(running, subject=None, notes="")  # the defaults
    assert content_of(again)["id"] == first["id"]
    assert again.headers["location"] == f"/api/v1/sessions/{first['id']}"
    tared.deliver(50)
    tared.finish(running.session(first["id"]))
    assert content_of(post(running))["state"] == "sealed"
    tared.leave()
    running.restart()
    # The node is away, so that another session cannot begin.
    assert content_of(post(running))["id"] == first["id"]
    assert [one["id"] for one in running.sessions()] == [first["id"]]
    assert running.http.post("/sessions", json=BODY).status_code == 409


def test_simultaneous_starts_are_one_session(running: Running, tared: FakeNode) -> None:
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: post(running), range(8)))
    assert len({content_of(answer)["id"] for answer in answers}) == 1
    assert len(running.sessions()) == 1


def test_each_key_and_each_request_without_key_is_a_session(
    running: Running, tared: FakeNode
) -> None:
    ids = {content_of(post(running))["id"]}
    for headers in ({}, {}, {"Idempotency-Key": "another"}):
        ids.add(content_of(running.http.post("/sessions", json=BODY, headers=headers))["id"])
    assert len(ids) == 4


def test_a_key_of_another_request_is_refused(running: Running, tared: FakeNode) -> None:
    first = content_of(post(running))
    for answer in (
        post(running, name="another"),
        post(running, pre_roll_s=1.0),
        post(running, "/takes", name="trial"),
    ):
        assert_refused(answer, 422, "used by another request", first["id"], "new key")
    assert len(running.sessions()) == 1


@pytest.mark.parametrize("key", [b"", b"two words", b"x" * 201, b"\xa3"])
def test_a_wrong_key_is_refused(shared: Running, key: bytes) -> None:
    answer = shared.http.post("/sessions", json=BODY, headers=[(b"Idempotency-Key", key)])
    assert_refused(answer, 422, "idempotency-key")


def test_a_refused_start_is_tried_again(running: Running, node: FakeNode) -> None:
    node.connect()
    assert_refused(post(running), 409, "sends no frames")
    node.tared()
    assert content_of(post(running))["state"] == "recording"


def test_a_deleted_session_does_not_begin_again(running: Running, tared: FakeNode) -> None:
    first = content_of(post(running))
    tared.finish(running.session(first["id"]))
    running.http.delete(f"/sessions/{first['id']}")
    assert_refused(post(running), 409, "in the trash", "Restore it")
    running.http.post(f"/trash/{first['id']}/restore")
    assert content_of(post(running))["id"] == first["id"]
    running.http.delete(f"/sessions/{first['id']}")
    running.http.delete("/trash")
    assert content_of(post(running))["id"] != first["id"]


def test_a_repeated_take_and_its_stops_are_one(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    other = node_of(running, "other")
    other.connect()
    other.tared()
    nodes = ["bench", "other", "nobody"]
    first = content_of(post(running, "/takes", name="both", nodes=nodes))
    again = content_of(post(running, "/takes", name="both", nodes=nodes))
    ids = [one["id"] for one in first["sessions"]]
    assert (again["id"], again["failed"]) == (first["id"], first["failed"])
    assert [one["id"] for one in again["sessions"]] == ids
    running.restart()
    after = content_of(post(running, "/takes", name="both", nodes=nodes))
    assert (after["id"], list(after["failed"])) == (first["id"], ["nobody"])
    assert len(running.sessions()) == 2
    assert_refused(post(running, "/takes", name="both"), 422, "used by another request")
    stops = [running.http.post(f"/takes/{first['id']}/stop").json() for _ in range(2)]
    assert stops[1]["failed"] == {}
    instants = [[one["stopped_t_ns"] for one in stop["sessions"]] for stop in stops]
    assert instants[0] == instants[1]


def test_a_repeated_stop_is_the_first_one(tared: FakeNode) -> None:
    session = tared.record()
    stopped = session.stop()
    tared.send(10, now=True)
    assert session.sealed()["stopped_t_ns"] == stopped["stopped_t_ns"]
    assert session.stop() == session.now()
