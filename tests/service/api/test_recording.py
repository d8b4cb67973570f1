"""Recording: exactly its frames whatever happens, and repeated requests that are one recording."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np
import pytest

import service.api.routes.recordings.sessions
import service.server.recorder
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, assert_refused, content_of
from tests.waiting import PATIENCE_S, until


def test_a_session_has_exactly_the_frames_between_start_and_stop(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record(notes="wet", subject="A", tags=["mud", "slow"])
    assert session["state"] == "recording"
    tared.deliver(400, [20.0, 60.0], noise=1)
    assert running.node()["recording"] == [session.id]
    assert session.now()["frames"] == 400
    assert session.stop()["state"] == "pending"
    tared.send(30, now=True)
    sealed = session.sealed()
    assert (sealed["complete"], sealed["frames"], sealed["problem"]) == (True, 400, None)
    assert sealed["parts"] == [{"stream_id": tared.stream_id, "seq_first": 70, "seq_last": 469}]
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 470))
    assert set(session.column("part")) == {0}
    assert running.node()["recording"] == []
    assert sealed["duration_s"] == pytest.approx(399 * 0.002)
    assert sealed["bytes"] == (session.folder / "frames.parquet").stat().st_size


def test_a_stop_waits_for_the_seal_while_the_node_streams(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.api.routes.recordings.sessions, "SEAL_TIMEOUT_S", PATIENCE_S)
    with Play(tared, 10.0):
        until(lambda: running.node()["last_seq"] > 100)
        session = tared.record()
        until(lambda: session.now()["frames"] > 100)
        stopped = session.stop()
    assert (stopped["state"], stopped["complete"]) == ("sealed", True)
    found = session.frames()
    np.testing.assert_array_equal(np.diff(found.seq), 1)
    first, last = int(found.seq[0]), int(found.seq[-1])
    assert_same_bits(found, tared.all_sent().slice_rows(first, last + 1))
    assert int(found.t_ns[-1]) <= stopped["stopped_t_ns"]
    assert int(tared.all_sent().t_ns[last + 1]) > stopped["stopped_t_ns"]


def test_a_node_without_new_frames_is_not_recorded(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    def start(reason: str) -> None:
        answer = running.http.post("/sessions", json={"node": "bench", "name": "x"})
        assert_refused(answer, 409, reason)

    node.connect()
    start("sends no frames")
    node.deliver(10)
    with monkeypatch.context() as patch:
        patch.setattr(service.server.recorder, "MAX_DELAY_S", 2.0)
        start("behind")
    node.leave()
    start("sends no frames")


def test_a_session_stopped_without_its_node_is_completed_later(tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(50)
    tared.leave()
    tared.frames(80)  # taken before the stop, on the node only
    assert session.stop()["state"] == "pending"
    assert session.ledger()["complete"] is False
    tared.frames(40, now=True)
    assert tared.connect() == [(120, None)]
    for batch in tared.sent[-2:]:
        tared.send_again(batch)
    assert session.sealed()["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 200))


@pytest.mark.parametrize("is_evicted", [False, True], ids=["sent later", "evicted by the node"])
def test_a_session_waits_for_a_gap_until_it_is_lost(tared: FakeNode, is_evicted: bool) -> None:
    session = tared.record()
    tared.send(50)
    gap = tared.frames(30)
    tared.deliver(50)
    session.stop()
    tared.send(10, now=True)
    until(lambda: session.now()["parts"][0]["seq_last"] == 199)
    assert session.ledger()["parts"][0]["pending"] == 30
    assert session.now()["state"] == "pending"
    if is_evicted:
        tared.say_lost(evicted=[[0, 149]])
        sealed = session.sealed()
        assert (sealed["complete"], sealed["frames"]) == ("lossy", 100)
        assert session.ledger()["parts"][0]["lost"] == {"evicted": 30}
        assert 120 not in session.frames().seq
    else:
        tared.send_again(gap)
        assert session.sealed()["complete"] is True
        assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 200))


def test_a_node_with_other_tiles_begins_another_session(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    session = tared.record(name="mud", subject="leg 2", tags=["wet"])
    first = tared.deliver(100, 10.0)
    tared.leave()
    other = node_of(running, tiles=3, secret=tared.secret)
    other.connect()
    second = other.send(30)
    assert len(session.sealed()["parts"]) == 1
    assert_same_bits(session.frames(), first)
    following = running.only_session(but=session)
    expected = {"name": "mud (2)", "subject": "leg 2", "tags": ["wet"], "state": "recording"}
    assert {name: following[name] for name in expected} == expected
    other.taken_in()
    assert other.finish(following)["complete"] is True
    assert_same_bits(following.frames().slice_rows(0, 30), second)


def test_a_recording_continues_over_a_restart_of_the_server(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    tared.deliver(50, 10.0)
    running.restart()
    assert session.now()["state"] == "recording"
    tared.frames(20, 10.0)
    assert tared.connect() == [(120, None)]
    tared.send_again(tared.sent[-1])
    tared.deliver(30, 10.0)
    session.stop()
    running.restart()
    assert session.now()["state"] == "pending"
    tared.connect()
    tared.send(10, now=True)
    assert session.sealed()["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 170))
    assert len(running.sessions()) == 1
    assert session.column("force_n_0")[30:70] == pytest.approx(np.full(40, 10.0), abs=0.1)


def test_a_pre_roll_begins_before_the_start(tared: FakeNode) -> None:
    tared.deliver(500)
    session = tared.record(pre_roll_s=0.2)
    first = session["parts"][0]["seq_first"]
    # By whole messages of ten frames.
    assert 570 - 100 - 11 <= first <= 570 - 100
    assert tared.record(pre_roll_s=600)["parts"][0]["seq_first"] == 0
    tared.deliver(50)
    assert tared.finish(session)["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(first, 620))


# --- repeated requests: with the same key they are one recording ----------------------------------


KEY = {"Idempotency-Key": "8e03978e-40d5-43dd-bc93-6894a57f9324"}
BODY: dict[str, object] = {"node": "bench", "name": "trial", "tags": ["mud"]}


def post(running: Running, path: str = "/sessions", **body: object) -> httpx.Response:
    return running.http.post(path, json=(BODY if path == "/sessions" else {}) | body, headers=KEY)


def test_a_repeated_start_is_the_same_session(running: Running, tared: FakeNode) -> None:
    first = content_of(post(running), 201)
    again = post(running, subject=None, notes="")  # the defaults
    assert content_of(again, 201)["id"] == first["id"]
    assert again.headers["location"] == f"/api/v1/sessions/{first['id']}"
    tared.deliver(50)
    tared.finish(running.session(first["id"]))
    assert content_of(post(running), 201)["state"] == "sealed"
    tared.leave()
    running.restart()
    # The node is away, so that another session cannot begin.
    assert content_of(post(running), 201)["id"] == first["id"]
    assert [one["id"] for one in running.sessions()] == [first["id"]]
    assert running.http.post("/sessions", json=BODY).status_code == 409


def test_simultaneous_starts_are_one_session(running: Running, tared: FakeNode) -> None:
    with ThreadPoolExecutor(8) as pool:
        answers = list(pool.map(lambda _: post(running), range(8)))
    assert len({content_of(answer, 201)["id"] for answer in answers}) == 1
    assert len(running.sessions()) == 1


def test_each_key_and_each_request_without_key_is_a_session(
    running: Running, tared: FakeNode
) -> None:
    ids = {content_of(post(running), 201)["id"]}
    for headers in ({}, {}, {"Idempotency-Key": "another"}):
        ids.add(content_of(running.http.post("/sessions", json=BODY, headers=headers), 201)["id"])
    assert len(ids) == 4


def test_a_key_of_another_request_is_refused(running: Running, tared: FakeNode) -> None:
    first = content_of(post(running), 201)
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
    assert content_of(post(running), 201)["state"] == "recording"


def test_a_deleted_session_does_not_begin_again(running: Running, tared: FakeNode) -> None:
    first = content_of(post(running), 201)
    tared.finish(running.session(first["id"]))
    running.http.delete(f"/sessions/{first['id']}")
    assert_refused(post(running), 409, "in the trash", "Restore it")
    running.http.post(f"/trash/{first['id']}/restore")
    assert content_of(post(running), 201)["id"] == first["id"]
    running.http.delete(f"/sessions/{first['id']}")
    running.http.delete("/trash")
    assert content_of(post(running), 201)["id"] != first["id"]


def test_a_repeated_take_and_its_stops_are_one(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    other = node_of(running, "other")
    other.connect()
    other.tared()
    nodes = ["bench", "other", "nobody"]
    first = content_of(post(running, "/takes", name="both", nodes=nodes), 201)
    again = content_of(post(running, "/takes", name="both", nodes=nodes), 201)
    ids = [one["id"] for one in first["sessions"]]
    assert (again["id"], again["failed"]) == (first["id"], first["failed"])
    assert [one["id"] for one in again["sessions"]] == ids
    running.restart()
    after = content_of(post(running, "/takes", name="both", nodes=nodes), 201)
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
