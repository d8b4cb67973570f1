"""Recording: a session has exactly its frames, whatever happens to node and server meanwhile."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import service.api.routes.sessions
import service.server.recorder
from devices.frames import FRAME_COLUMNS, FrameBatch
from storage.sessions.file import SessionReader

COUNT_KPA = 130 / 1023

Running = Any
FakeNode = Any
Until = Callable[..., Any]


@pytest.fixture(autouse=True)
def quick_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stop answers soon: the scripted node sends what passes it only afterwards."""
    monkeypatch.setattr(service.api.routes.sessions, "SETTLE_S", 0.02)


def start(running: Running, **body: object) -> dict[str, Any]:
    answer = running.http.post("/sessions", json={"node": "bench", "name": "trial"} | body)
    assert answer.status_code == 201, answer.text
    session: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/api/v1/sessions/{session['id']}"
    return session


def stop(running: Running, session: dict[str, Any]) -> dict[str, Any]:
    answer = running.http.post(f"/sessions/{session['id']}/stop")
    assert answer.status_code == 200, answer.text
    content: dict[str, Any] = answer.json()
    return content


def reader(running: Running, session: dict[str, Any]) -> SessionReader:
    return SessionReader(running.data / "sessions" / session["id"] / "frames.parquet")


def frames_of(running: Running, session: dict[str, Any]) -> FrameBatch:
    with reader(running, session) as file:
        return FrameBatch.concatenate([batch for batch, _ in file.batches()])


def column(running: Running, session: dict[str, Any], name: str) -> np.ndarray:
    path = running.data / "sessions" / session["id"] / "frames.parquet"
    return pq.read_table(path, columns=[name])[name].to_numpy()


def assert_same(found: FrameBatch, sent: FrameBatch) -> None:
    for name in FRAME_COLUMNS:
        np.testing.assert_array_equal(getattr(found, name), getattr(sent, name), err_msg=name)


def taken_in(running: Running, node: FakeNode, until: Until) -> None:
    until(lambda: running.node(node.name)["last_seq"] == node.seq - 1)


@pytest.fixture
def tared(running: Running, node: FakeNode, until: Until) -> FakeNode:
    """A connected node with a tare, all of whose 70 frames have come."""
    node.connect()
    node.tared()
    taken_in(running, node, until)
    return node


def test_a_session_has_exactly_the_frames_between_start_and_stop(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running, notes="wet", subject="A", tags=["mud", "slow"])
    assert session["state"] == "recording"
    tared.send(400, [20.0, 60.0], noise=1)
    taken_in(running, tared, until)
    assert running.node()["recording"] == [session["id"]]
    assert running.session(session["id"])["frames"] == 400
    marked = running.http.post(f"/sessions/{session['id']}/events", json={"label": "stone"})
    assert marked.status_code == 201
    stopped = stop(running, session)
    assert stopped["state"] == "pending"
    tared.send(30, now=True)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] is True
    assert sealed["frames"] == 400
    assert sealed["problem"] is None
    assert sealed["parts"] == [{"boot_id": tared.boot_id, "seq_first": 70, "seq_last": 469}]
    assert_same(frames_of(running, session), tared.all_sent().rows(70, 470))
    assert set(column(running, session, "part")) == {0}
    assert running.node()["recording"] == []
    assert sealed["duration_s"] == pytest.approx(399 * 0.002)
    path = running.data / "sessions" / session["id"] / "frames.parquet"
    assert sealed["bytes"] == path.stat().st_size


def test_a_sealed_session_has_estimates_with_the_tare_in_force(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(200, [20.0, 60.0])
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(30, now=True)
    sealed = running.sealed(session["id"])
    middle = slice(60, 140)
    for tile, force_n in enumerate((20.0, 60.0)):
        found = column(running, session, f"force_n_{tile}")[middle]
        assert found == pytest.approx(np.full(80, force_n), abs=0.01)
        found = column(running, session, f"gauge_kpa_{tile}")[middle]
        assert found == pytest.approx(np.full(80, force_n * COUNT_KPA), abs=0.001)
    assert column(running, session, "grf_n")[middle] == pytest.approx(np.full(80, 80.0), abs=0.02)
    with reader(running, session) as file:
        notes = file.notes
    assert notes["session"]["id"] == session["id"]
    assert notes["session"]["parts"] == sealed["parts"]
    assert notes["ledger"]["complete"] is True
    assert notes["ledger"]["parts"][0]["recorded"] == 200
    assert notes["calibration"]["name"] == "by hand"
    assert notes["calibration_id"] == sealed["calibration_id"]
    assert notes["tare"]["source"] == "lead"
    assert notes["tare"]["frames"] == 60
    assert notes["emulated"] is False
    assert sealed["absolute_scale"] == "measured"


def test_a_stop_answers_sealed_while_the_node_streams(
    running: Running,
    tared: FakeNode,
    play: Callable[..., Any],
    until: Until,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(service.api.routes.sessions, "SETTLE_S", 5.0)
    with play(tared, 10.0):
        until(lambda: running.node()["last_seq"] > 100)
        session = start(running)
        until(lambda: running.session(session["id"])["frames"] > 100)
        stopped = stop(running, session)
    assert stopped["state"] == "sealed"
    assert stopped["complete"] is True
    found = frames_of(running, session)
    np.testing.assert_array_equal(np.diff(found.seq), 1)
    first, last = int(found.seq[0]), int(found.seq[-1])
    assert_same(found, tared.all_sent().rows(first, last + 1))
    assert int(found.t_ns[-1]) <= stopped["stopped_t_ns"]
    assert int(tared.all_sent().t_ns[last + 1]) > stopped["stopped_t_ns"]


def test_a_session_is_stopped_once(running: Running, tared: FakeNode) -> None:
    session = start(running)
    stop(running, session)
    answer = running.http.post(f"/sessions/{session['id']}/stop")
    assert answer.status_code == 409
    assert "stopped already" in answer.json()["detail"]


def test_a_node_that_is_away_cannot_be_recorded(running: Running, tared: FakeNode) -> None:
    tared.leave()
    answer = running.http.post("/sessions", json={"node": "bench", "name": "x"})
    assert answer.status_code == 409
    assert "not sending" in answer.json()["detail"]


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
    answer = running.http.request(method, path, json=body)
    assert answer.status_code == 404
    assert "'nobody'" in answer.json()["detail"]


def test_a_session_that_is_stopped_while_the_node_is_away_completes_when_it_is_back(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(50)
    tared.acknowledged(119)
    tared.leave()
    tared.frames(80)  # taken before the stop, on the node only
    assert stop(running, session)["state"] == "pending"
    ledger = running.http.get(f"/sessions/{session['id']}/ledger").json()
    assert ledger["complete"] is False
    tared.frames(40, now=True)
    assert tared.connect() == [(120, None)]
    for batch in tared.sent[-2:]:
        tared.send_again(batch)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] is True
    assert_same(frames_of(running, session), tared.all_sent().rows(70, 200))


def test_a_gap_within_a_session_is_waited_for(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(50)
    gap = tared.frames(30)
    tared.send(50)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    until(lambda: running.session(session["id"])["parts"][0]["seq_last"] == 199)
    ledger = running.http.get(f"/sessions/{session['id']}/ledger").json()
    assert ledger["parts"][0]["pending"] == 30
    assert running.session(session["id"])["state"] == "pending"
    tared.send_again(gap)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] is True
    assert_same(frames_of(running, session), tared.all_sent().rows(70, 200))


def test_frames_that_the_node_has_evicted_are_lost_and_said_to_be(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(50)
    tared.frames(30)
    tared.send(50)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    tared.socket.send(
        json.dumps({"type": "lost", "boot_id": tared.boot_id, "lost": {"evicted": [[0, 149]]}})
    )
    sealed = running.sealed(session["id"])
    assert sealed["complete"] == "lossy"
    assert sealed["frames"] == 100
    ledger = running.http.get(f"/sessions/{session['id']}/ledger").json()
    assert ledger["parts"][0]["lost"] == {"evicted": 30}
    assert 120 not in frames_of(running, session).seq


def test_a_node_that_is_switched_on_anew_goes_on_in_a_second_part(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    first = tared.send(100, 10.0)
    tared.acknowledged(169)
    first_boot_id = tared.boot_id
    tared.leave()
    tared.reboot()
    assert tared.connect() == [(0, None)]
    second = tared.send(60, 10.0)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] == "lossy"
    assert [part["boot_id"] for part in sealed["parts"]] == [first_boot_id, tared.boot_id]
    found = frames_of(running, session)
    assert_same(found, FrameBatch.concatenate([first, second]))
    np.testing.assert_array_equal(column(running, session, "part"), [0] * 100 + [1] * 60)
    ledger = running.http.get(f"/sessions/{session['id']}/ledger").json()
    assert [part["recorded"] for part in ledger["parts"]] == [100, 60]
    assert ledger["parts"][0]["unsynced_tail_max"] >= 1
    assert ledger["lossy"] is True


def test_a_node_that_comes_back_with_other_tiles_ends_its_recording(
    running: Running, tared: FakeNode, node_of: Callable[..., FakeNode], until: Until
) -> None:
    session = start(running)
    first = tared.send(100, 10.0)
    tared.acknowledged(169)
    tared.leave()
    other = node_of(running, tiles=3)
    other.connect()
    other.send(30)
    sealed = running.sealed(session["id"])
    assert len(sealed["parts"]) == 1
    assert_same(frames_of(running, session), first)


def test_another_session_takes_up_a_recording_whose_node_came_back_with_other_tiles(
    running: Running, tared: FakeNode, node_of: Callable[..., FakeNode], until: Until
) -> None:
    session = start(running, name="mud", subject="leg 2", tags=["wet"])
    tared.send(100, 10.0)
    tared.acknowledged(169)
    tared.leave()
    other = node_of(running, tiles=3)
    other.connect()
    new = other.send(30)
    sessions = running.http.get("/sessions").json()["items"]
    (taken_up,) = [s for s in sessions if s["id"] != session["id"]]
    assert taken_up["state"] == "recording"
    assert (taken_up["name"], taken_up["subject"], taken_up["tags"]) == (
        "mud (2)",
        "leg 2",
        ["wet"],
    )
    taken_in(running, other, until)
    stop(running, taken_up)
    other.send(10, now=True)
    sealed = running.sealed(taken_up["id"])
    assert sealed["complete"] is True
    frames = frames_of(running, taken_up)
    assert_same(frames.rows(0, 30), new)


def test_a_stream_that_ended_in_order_leaves_no_doubt_about_its_end(
    running: Running, tared: FakeNode, node_of: Callable[..., FakeNode]
) -> None:
    session = start(running)
    tared.send(100, 10.0)
    tared.acknowledged(169)
    tared.leave()
    other = node_of(running, tiles=3)
    tared.reboot()
    other.connect(earlier=(tared.before[0].said(held=()),))
    sealed = running.sealed(session["id"])
    assert sealed["parts"][0]["seq_last"] == 169
    assert sealed["complete"] is True, "nothing can be missing behind an end that was told"


def test_a_recording_goes_on_over_a_restart_of_the_server(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(50, 10.0)
    tared.acknowledged(119)
    running.restart()
    assert running.session(session["id"])["state"] == "recording"
    tared.frames(20, 10.0)
    [(first, _)] = tared.connect()
    assert first == 120
    tared.send_again(tared.sent[-1])
    tared.send(30, 10.0)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] is True
    assert_same(frames_of(running, session), tared.all_sent().rows(70, 170))
    assert len(running.http.get("/sessions").json()["items"]) == 1
    assert column(running, session, "force_n_0")[30:70] == pytest.approx(np.full(40, 10.0), abs=0.1)


def test_a_server_that_was_down_during_the_stop_of_a_session_seals_it_later(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(50)
    tared.acknowledged(119)
    stop(running, session)
    running.restart()
    assert running.session(session["id"])["state"] == "pending"
    tared.connect()
    tared.send(10, now=True)
    assert running.sealed(session["id"])["frames"] == 50


def test_a_pre_roll_begins_earlier(running: Running, tared: FakeNode, until: Until) -> None:
    tared.send(500)
    taken_in(running, tared, until)
    session = start(running, pre_roll_s=0.2)
    first = session["parts"][0]["seq_first"]
    # Roughly: by whole messages of ten frames.
    assert 570 - 100 - 11 <= first <= 570 - 100
    tared.send(50)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] is True
    assert_same(frames_of(running, session), tared.all_sent().rows(first, 620))


def test_a_pre_roll_reaches_no_further_than_what_is_held(running: Running, tared: FakeNode) -> None:
    assert start(running, pre_roll_s=600)["parts"][0]["seq_first"] == 0


def test_a_tare_under_load_is_refused_and_names_the_tile(
    running: Running, tared: FakeNode, until: Until
) -> None:
    # Longer than the ten seconds that a tare looks back.
    tared.next_t_mono_ns += 11_000_000_000
    tared.send(300, [0.0, 40.0])
    taken_in(running, tared, until)
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 409
    assert "T02" in answer.json()["detail"]
    assert "loaded" in answer.json()["detail"]
    assert len(running.http.get("/nodes/bench/tares").json()["items"]) == 1


def test_a_tare_without_load_is_in_force_until_it_is_undone(
    running: Running, tared: FakeNode, until: Until
) -> None:
    def force_n() -> list[float]:
        with running.socket("/api/v1/live?rate_hz=60") as live:
            tared.send(60, 3.0)
            while True:
                message = json.loads(live.recv(timeout=5.0))
                if message["type"] == "frame" and message["seq"] >= tared.seq - 20:
                    values: list[float] = message["force_n"]
                    return values

    by_lead = running.node()["tare"]
    tared.next_t_mono_ns += 11_000_000_000
    tared.send(300, 2.0, alive=True)  # warmer by two counts
    taken_in(running, tared, until)
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 201, answer.text
    tare = answer.json()
    assert tare["source"] == "unloaded"
    rise = np.subtract(tare["baseline_kpa"], by_lead["baseline_kpa"])
    assert rise == pytest.approx([2 * COUNT_KPA] * 2, abs=1e-6)
    assert running.node()["tare"]["id"] == tare["id"]
    assert force_n() == pytest.approx([1.0, 1.0], abs=0.05)
    assert running.http.delete(f"/nodes/bench/tares/{tare['id']}").status_code == 204
    assert running.node()["tare"]["id"] == by_lead["id"]
    assert force_n() == pytest.approx([3.0, 3.0], abs=0.05)
    history = running.http.get("/nodes/bench/tares").json()["items"]
    assert [(t["id"], t["undone"]) for t in history] == [(tare["id"], True), (by_lead["id"], False)]
    assert running.http.delete(f"/nodes/bench/tares/{tare['id']}").status_code == 404


def test_tares_outlive_the_server(running: Running, tared: FakeNode) -> None:
    before = running.node()["tare"]
    running.restart()
    assert running.node()["tare"] == before


def test_a_node_that_is_away_is_not_tared(running: Running, tared: FakeNode) -> None:
    tared.leave()
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 409
    assert "away" in answer.json()["detail"]


def test_a_tare_during_a_recording_serves_from_then_on(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(300, 2.0, alive=True, now=True)
    taken_in(running, tared, until)
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 201, answer.text
    tared.send(100, 2.0)
    taken_in(running, tared, until)
    # The stop has to lie after them on the node's clock, too.
    until(lambda: time.monotonic_ns() > tared.next_t_mono_ns)
    stop(running, session)
    tared.send(10, now=True)
    running.sealed(session["id"])
    force_n = column(running, session, "force_n_0")
    assert len(force_n) == 400
    assert force_n[50:200] == pytest.approx(np.full(150, 2.0), abs=0.01)
    assert force_n[330:390] == pytest.approx(np.zeros(60), abs=0.01)
    with reader(running, session) as file:
        assert [tare["source"] for tare in file.notes["tares"]] == ["lead", "unloaded"]


def test_what_people_say_of_a_session_outlives_the_server(
    running: Running, tared: FakeNode
) -> None:
    session = start(running)
    change = {"name": "new", "subject": "B", "notes": "zwei\nZeilen", "tags": ["a", "b"]}
    answer = running.http.patch(f"/sessions/{session['id']}", json=change)
    assert answer.status_code == 200
    running.restart()
    found = running.session(session["id"])
    assert {name: found[name] for name in change} == change
    partly = running.http.patch(f"/sessions/{session['id']}", json={"notes": ""}).json()
    assert (partly["name"], partly["notes"]) == ("new", "")


def test_a_renamed_session_keeps_its_data(running: Running, tared: FakeNode, until: Until) -> None:
    session = start(running)
    tared.send(20)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    sealed = running.sealed(session["id"])
    answer = running.http.patch(f"/sessions/{session['id']}", json={"name": "other"}).json()
    assert answer["name"] == "other"
    assert answer["sha256"] == sealed["sha256"]


def test_an_event_after_sealing_is_in_the_events_file(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    url = f"/sessions/{session['id']}/events"
    running.http.post(url, json={"label": "before", "t_ns": 2})
    tared.send(20)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    running.sealed(session["id"])
    path = running.data / "sessions" / session["id"] / "events.parquet"
    assert pq.read_table(path)["label"].to_pylist() == ["before"]
    running.http.post(url, json={"label": "after", "t_ns": 1})
    assert sorted(pq.read_table(path)["label"].to_pylist()) == ["after", "before"]
    listed = running.http.get(url).json()["items"]
    assert [event["label"] for event in listed] == ["after", "before"]  # in order of time


def test_clock_measurements_are_kept_beside_the_session(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.socket.send(
        '{"type":"clock","t_mono_ns":5,"server_minus_node_ns":1000,"uncertainty_ns":7}'
    )
    tared.send(20)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    running.sealed(session["id"])
    path = running.data / "sessions" / session["id"] / "clock.parquet"
    at_connecting, later = pq.read_table(path).to_pylist()
    assert at_connecting["server_minus_node_ns"] == 0
    assert [later] == [
        {
            "boot_id": tared.boot_id,
            "t_mono_ns": 5,
            "server_minus_node_ns": 1000,
            "uncertainty_ns": 7,
        }
    ]


def test_clock_measurements_outlive_the_server_without_rewriting_the_session_each_time(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    written = (running.data / "sessions" / session["id"] / "session.json").read_bytes()
    for number in range(3):
        row = {"t_mono_ns": 10**15 + number, "server_minus_node_ns": number, "uncertainty_ns": 7}
        tared.socket.send(json.dumps({"type": "clock", **row}))
    tared.send(20)
    taken_in(running, tared, until)
    assert (running.data / "sessions" / session["id"] / "session.json").read_bytes() == written
    running.restart()
    tared.connect()
    stop(running, session)
    tared.send(10, now=True)
    running.sealed(session["id"])
    path = running.data / "sessions" / session["id"] / "clock.parquet"
    offsets = pq.read_table(path)["server_minus_node_ns"].to_pylist()
    assert offsets == [0, 0, 1, 2, 0]  # at connecting, three later, and after the restart


def test_a_pre_roll_has_the_clock_measurements_of_its_time(
    running: Running, tared: FakeNode, until: Until
) -> None:
    begin_ns = int(tared.sent[0].t_mono_ns[0])
    for number, t_mono_ns in enumerate((-2000, -1000, 10_000_000, 20_000_000)):
        row = {
            "t_mono_ns": begin_ns + t_mono_ns,
            "server_minus_node_ns": number,
            "uncertainty_ns": 7,
        }
        tared.socket.send(json.dumps({"type": "clock", **row}))
    tared.send(20)
    taken_in(running, tared, until)
    session = start(running, pre_roll_s=600)
    found = json.loads((running.data / "sessions" / session["id"] / "session.json").read_bytes())
    assert [row["server_minus_node_ns"] for row in found["clock"]] == [1, 2, 3]


def test_a_session_ends_by_the_servers_clock(
    running: Running, tared: FakeNode, until: Until
) -> None:
    # The node's clock is an hour behind; it says so.
    hour_ns = 3_600_000_000_000
    tared.leave()
    tared.reboot()
    tared.utc_offset_ns -= hour_ns
    tared.connect()
    row = {"t_mono_ns": 5, "server_minus_node_ns": hour_ns, "uncertainty_ns": 7}
    tared.socket.send(json.dumps({"type": "clock", **row}))
    tared.send(20)
    taken_in(running, tared, until)
    session = start(running)
    tared.send(30)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    assert running.sealed(session["id"])["frames"] == 30


def test_a_session_without_calibration_is_sealed_raw_and_says_why(
    running: Running, node_of: Callable[..., FakeNode], until: Until
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.send(10)
    taken_in(running, node, until)
    session = start(running)
    node.send(50)
    taken_in(running, node, until)
    stop(running, session)
    node.send(10, now=True)
    sealed = running.sealed(session["id"])
    assert sealed["complete"] is True
    assert sealed["calibration_id"] is None
    assert sealed["absolute_scale"] is None
    assert "no estimates" in sealed["problem"]
    assert_same(frames_of(running, session), node.all_sent().rows(10, 60))
    path = running.data / "sessions" / session["id"] / "frames.parquet"
    assert not any(name.startswith("force_n") for name in pq.read_schema(path).names)
    with reader(running, session) as file:
        assert "no estimates" in file.notes["estimates"]


def test_a_session_without_tare_is_sealed_raw_and_says_why(
    running: Running, node: FakeNode, until: Until
) -> None:
    node.connect()
    node.send(10, 50.0)
    taken_in(running, node, until)
    session = start(running)
    node.send(50, 50.0)
    taken_in(running, node, until)
    stop(running, session)
    node.send(10, 50.0, now=True)
    sealed = running.sealed(session["id"])
    assert "no estimates" in sealed["problem"]
    assert sealed["frames"] == 50


def test_a_part_without_frames_has_lost_none(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.leave()
    tared.reboot()
    tared.connect()
    tared.send(20)
    taken_in(running, tared, until)
    ledger = running.http.get(f"/sessions/{session['id']}/ledger").json()
    assert ledger["parts"][0]["recorded"] == 0
    assert ledger["parts"][0]["lost"] == {}
    assert ledger["parts"][1]["recorded"] == 20


def test_a_session_without_frames_says_so(running: Running, tared: FakeNode) -> None:
    session = start(running)
    stop(running, session)
    tared.send(10, now=True)
    sealed = running.sealed(session["id"])
    assert sealed["problem"] == "not one frame was recorded"
    assert sealed["frames"] == 0
    assert sealed["complete"] is True


@pytest.mark.parametrize(
    "text", ["=1+1", "<script>alert(1)</script>", "naïve 😀", '"\\', "a\u2028b"]
)
def test_what_people_write_comes_back_as_it_is(
    running: Running, tared: FakeNode, text: str
) -> None:
    session = start(running, name=text, notes=text)
    url = f"/sessions/{session['id']}"
    running.http.post(f"{url}/events", json={"label": text})
    answer = running.http.get(url)
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.json()["name"] == answer.json()["notes"] == text
    assert running.http.get(f"{url}/events").json()["items"][0]["label"] == text
    assert running.http.get("/sessions", params={"q": text}).json()["items"]


def test_a_session_is_sealed_again_when_the_disk_was_full(
    running: Running, tared: FakeNode, until: Until, monkeypatch: pytest.MonkeyPatch
) -> None:
    import service.server.recorder
    from devices.errors import StorageError

    seal = service.server.recorder.seal
    tried = threading.Event()

    def refusing(*arguments: Any) -> Any:
        if not tried.is_set():
            tried.set()
            raise StorageError("No space left on device")
        return seal(*arguments)

    monkeypatch.setattr(service.server.recorder, "seal", refusing)
    monkeypatch.setattr(service.server.recorder, "_SEAL_AGAIN_S", 0.2)
    session = start(running)
    tared.send(20)
    taken_in(running, tared, until)
    stop(running, session)
    tared.send(10, now=True)
    until(lambda: "No space left" in (running.session(session["id"])["problem"] or ""))
    sealed = running.sealed(session["id"])
    assert sealed["frames"] == 20
    assert sealed["problem"] is None


# What a hostile tester found


def test_tares_count_by_the_frames_own_time_however_wrong_the_nodes_date_is(
    running: Running, node: FakeNode, until: Until
) -> None:
    years_ns = 4 * 365 * 86_400 * 1_000_000_000
    node.utc_offset_ns += years_ns
    node.connect()
    row = {"type": "clock", "t_mono_ns": 5, "uncertainty_ns": 7}
    node.socket.send(json.dumps(row | {"server_minus_node_ns": -years_ns}))
    node.tared()
    taken_in(running, node, until)
    session = start(running)
    node.send(300, [10.0, 10.0])
    taken_in(running, node, until)
    node.leave()
    stop(running, session)
    node.reboot()  # and its clock's offset is not known when the session is sealed
    node.connect()
    sealed = running.sealed(session["id"])
    assert sealed["problem"] is None
    np.testing.assert_allclose(column(running, session, "force_n_0"), 10.0, atol=0.1)


def test_a_recording_keeps_the_calibration_it_was_begun_with(
    running: Running, tared: FakeNode, until: Until
) -> None:
    session = start(running)
    tared.send(200, [10.0, 10.0])
    taken_in(running, tared, until)
    tared.leave()
    stop(running, session)
    tared.reboot()
    tripled = tared.hello().calibration.tiles
    tripled = tuple(t.model_copy(update={"f_scale_n": 3.0 * t.f_scale_n}) for t in tripled)
    tared.calibration = tared.hello().calibration.model_copy(update={"tiles": tripled})
    tared.connect()
    sealed = running.sealed(session["id"])
    assert sealed["calibration_id"] != tared.calibration.id
    np.testing.assert_allclose(column(running, session, "force_n_0"), 10.0, atol=0.1)


def test_a_node_that_is_still_catching_up_is_not_recorded(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.server.recorder, "BEHIND_S", 2.0)
    answer = running.http.post("/sessions", json={"node": "bench", "name": "too early"})
    assert answer.status_code == 409
    assert "behind" in answer.json()["detail"]


def test_why_a_recording_ended_is_said_together_with_why_it_has_no_estimates(
    running: Running, node_of: Callable[..., FakeNode], until: Until
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.send(50)
    taken_in(running, node, until)
    session = start(running)
    node.send(50)
    taken_in(running, node, until)
    node.leave()
    node.reboot()
    node.tiles += 1
    node.connect()
    problem = running.sealed(session["id"])["problem"]
    assert "other tiles" in problem
    assert "no estimates" in problem
