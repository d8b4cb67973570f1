"""Recording: a session has exactly its frames, whatever happens to node and server meanwhile."""

from __future__ import annotations

import numpy as np
import pytest

import service.api.routes.recordings.sessions
import service.server.recorder
from devices.frames import FrameBatch
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, assert_refused
from tests.waiting import PATIENCE_S, until


def test_a_session_has_exactly_the_frames_between_start_and_stop(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record(notes="wet", subject="A", tags=["mud", "slow"])
    assert session["state"] == "recording"
    tared.deliver(400, [20.0, 60.0], noise=1)
    assert running.node()["recording"] == [session.id]
    assert session.now()["frames"] == 400
    marked = running.http.post(f"{session.url}/markers", json={"label": "stone"})
    assert marked.status_code == 201
    stopped = session.stop()
    assert stopped["state"] == "pending"
    tared.send(30, now=True)
    sealed = session.sealed()
    assert sealed["complete"] is True
    assert sealed["frames"] == 400
    assert sealed["problem"] is None
    assert sealed["parts"] == [{"stream_id": tared.stream_id, "seq_first": 70, "seq_last": 469}]
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 470))
    assert set(session.column("part")) == {0}
    assert running.node()["recording"] == []
    assert sealed["duration_s"] == pytest.approx(399 * 0.002)
    path = session.folder / "frames.parquet"
    assert sealed["bytes"] == path.stat().st_size


def test_a_stop_answers_sealed_while_the_node_streams(
    running: Running,
    tared: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(service.api.routes.recordings.sessions, "SEAL_TIMEOUT_S", PATIENCE_S)
    with Play(tared, 10.0):
        until(lambda: running.node()["last_seq"] > 100)
        session = tared.record()
        until(lambda: session.now()["frames"] > 100)
        stopped = session.stop()
    assert stopped["state"] == "sealed"
    assert stopped["complete"] is True
    found = session.frames()
    np.testing.assert_array_equal(np.diff(found.seq), 1)
    first, last = int(found.seq[0]), int(found.seq[-1])
    assert_same_bits(found, tared.all_sent().slice_rows(first, last + 1))
    assert int(found.t_ns[-1]) <= stopped["stopped_t_ns"]
    assert int(tared.all_sent().t_ns[last + 1]) > stopped["stopped_t_ns"]


def test_a_node_that_is_away_cannot_be_recorded(running: Running, tared: FakeNode) -> None:
    tared.leave()
    answer = running.http.post("/sessions", json={"node": "bench", "name": "x"})
    assert_refused(answer, 409, "sends no frames")


def test_a_node_without_frames_cannot_be_recorded(running: Running, node: FakeNode) -> None:
    node.connect()
    assert running.http.post("/sessions", json={"node": "bench", "name": "x"}).status_code == 409


@pytest.mark.parametrize(
    ("method", "path", "body"),
    [
        ("POST", "/sessions", {"node": "nobody", "name": "x"}),
        ("GET", "/nodes/nobody", None),
        ("GET", "/nodes/nobody/scene", None),
        ("GET", "/nodes/nobody/tares", None),
        ("POST", "/nodes/nobody/tare", {}),
        ("DELETE", "/nodes/nobody/tares/1", None),
    ],
)
def test_an_unknown_node_is_not_found(
    running: Running, method: str, path: str, body: object
) -> None:
    assert_refused(running.http.request(method, path, json=body), 404, "'nobody'")


def test_a_session_that_is_stopped_while_the_node_is_away_completes_when_it_is_back(
    tared: FakeNode,
) -> None:
    session = tared.record()
    tared.deliver(50)
    tared.leave()
    tared.frames(80)  # taken before the stop, on the node only
    assert session.stop()["state"] == "pending"
    ledger = session.ledger()
    assert ledger["complete"] is False
    tared.frames(40, now=True)
    assert tared.connect() == [(120, None)]
    for batch in tared.sent[-2:]:
        tared.send_again(batch)
    sealed = session.sealed()
    assert sealed["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 200))


def test_a_gap_within_a_session_is_waited_for(tared: FakeNode) -> None:
    session = tared.record()
    tared.send(50)
    gap = tared.frames(30)
    tared.deliver(50)
    session.stop()
    tared.send(10, now=True)
    until(lambda: session.now()["parts"][0]["seq_last"] == 199)
    ledger = session.ledger()
    assert ledger["parts"][0]["pending"] == 30
    assert session.now()["state"] == "pending"
    tared.send_again(gap)
    sealed = session.sealed()
    assert sealed["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 200))


def test_frames_that_the_node_has_evicted_are_lost_and_said_to_be(tared: FakeNode) -> None:
    session = tared.record()
    tared.send(50)
    tared.frames(30)
    tared.deliver(50)
    session.stop()
    tared.send(10, now=True)
    tared.say_lost(evicted=[[0, 149]])
    sealed = session.sealed()
    assert sealed["complete"] == "lossy"
    assert sealed["frames"] == 100
    ledger = session.ledger()
    assert ledger["parts"][0]["lost"] == {"evicted": 30}
    assert 120 not in session.frames().seq


def test_a_node_that_is_switched_on_anew_goes_on_in_a_second_part(tared: FakeNode) -> None:
    session = tared.record()
    first = tared.deliver(100, 10.0)
    first_stream_id = tared.stream_id
    tared.restart()
    assert tared.connect() == [(0, None)]
    second = tared.deliver(60, 10.0)
    sealed = tared.finish(session)
    assert sealed["complete"] == "lossy"
    assert [part["stream_id"] for part in sealed["parts"]] == [first_stream_id, tared.stream_id]
    found = session.frames()
    assert_same_bits(found, FrameBatch.concatenate([first, second]))
    np.testing.assert_array_equal(session.column("part"), [0] * 100 + [1] * 60)
    ledger = session.ledger()
    assert [part["recorded"] for part in ledger["parts"]] == [100, 60]
    assert ledger["parts"][0]["max_lost_tail_frames"] >= 1
    assert ledger["lossy"] is True


def test_a_node_that_comes_back_with_other_tiles_ends_its_recording(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    session = tared.record()
    first = tared.deliver(100, 10.0)
    tared.leave()
    other = node_of(running, tiles=3, secret=tared.secret)
    other.connect()
    other.send(30)
    sealed = session.sealed()
    assert len(sealed["parts"]) == 1
    assert_same_bits(session.frames(), first)


def test_another_session_takes_up_a_recording_whose_node_came_back_with_other_tiles(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    session = tared.record(name="mud", subject="leg 2", tags=["wet"])
    tared.deliver(100, 10.0)
    tared.leave()
    other = node_of(running, tiles=3, secret=tared.secret)
    other.connect()
    new = other.send(30)
    taken_up = running.only_session(but=session)
    assert taken_up["state"] == "recording"
    kept = {"name": "mud (2)", "subject": "leg 2", "tags": ["wet"]}
    assert {name: taken_up[name] for name in kept} == kept
    other.taken_in()
    assert other.finish(taken_up)["complete"] is True
    assert_same_bits(taken_up.frames().slice_rows(0, 30), new)


def test_a_stream_that_ended_in_order_leaves_no_doubt_about_its_end(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    session = tared.record()
    tared.deliver(100, 10.0)
    tared.leave()
    other = node_of(running, tiles=3, secret=tared.secret)
    tared.reboot()
    other.connect(earlier=(tared.before[0].said(stored=()),))
    sealed = session.sealed()
    assert sealed["parts"][0]["seq_last"] == 169
    assert sealed["complete"] is True, "nothing can be missing behind an end that was told"


def test_a_recording_goes_on_over_a_restart_of_the_server(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    tared.deliver(50, 10.0)
    running.restart()
    assert session.now()["state"] == "recording"
    tared.frames(20, 10.0)
    [(first, _)] = tared.connect()
    assert first == 120
    tared.send_again(tared.sent[-1])
    tared.deliver(30, 10.0)
    sealed = tared.finish(session)
    assert sealed["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(70, 170))
    assert len(running.sessions()) == 1
    assert session.column("force_n_0")[30:70] == pytest.approx(np.full(40, 10.0), abs=0.1)


def test_a_server_that_was_down_during_the_stop_of_a_session_seals_it_later(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    tared.deliver(50)
    session.stop()
    running.restart()
    assert session.now()["state"] == "pending"
    tared.connect()
    tared.send(10, now=True)
    assert session.sealed()["frames"] == 50


def test_a_pre_roll_begins_earlier(tared: FakeNode) -> None:
    tared.deliver(500)
    session = tared.record(pre_roll_s=0.2)
    first = session["parts"][0]["seq_first"]
    # Roughly: by whole messages of ten frames.
    assert 570 - 100 - 11 <= first <= 570 - 100
    tared.deliver(50)
    sealed = tared.finish(session)
    assert sealed["complete"] is True
    assert_same_bits(session.frames(), tared.all_sent().slice_rows(first, 620))


def test_a_pre_roll_reaches_no_further_than_what_is_held(tared: FakeNode) -> None:
    assert tared.record(pre_roll_s=600)["parts"][0]["seq_first"] == 0


def test_a_session_ends_by_the_servers_clock(tared: FakeNode) -> None:
    # The node's clock is an hour behind; it says so.
    hour_ns = 3_600_000_000_000
    tared.restart()
    tared.utc_offset_ns -= hour_ns
    tared.connect()
    tared.say_clock(hour_ns)
    tared.deliver(20)
    session = tared.record()
    tared.deliver(30)
    session.stop()
    tared.send(10, now=True)
    assert session.sealed()["frames"] == 30


def test_a_part_without_frames_has_lost_none(tared: FakeNode) -> None:
    session = tared.record()
    tared.restart()
    tared.connect()
    tared.deliver(20)
    ledger = session.ledger()
    assert ledger["parts"][0]["recorded"] == 0
    assert ledger["parts"][0]["lost"] == {}
    assert ledger["parts"][1]["recorded"] == 20


def test_a_node_that_is_still_catching_up_is_not_recorded(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.server.recorder, "MAX_DELAY_S", 2.0)
    answer = running.http.post("/sessions", json={"node": "bench", "name": "too early"})
    assert_refused(answer, 409, "behind")
