"""Recording: a session has exactly its frames, whatever happens to node and server meanwhile."""

from __future__ import annotations

import json
import threading
import time
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

import service.api.routes.sessions
import service.server.recorder
from devices.frames import FrameBatch
from service.sessions.sealing import seal
from tests.builders.arrays import COUNT_KPA
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running
from tests.waiting import until


def test_a_session_has_exactly_the_frames_between_start_and_stop(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record(notes="wet", subject="A", tags=["mud", "slow"])
    assert session["state"] == "recording"
    tared.deliver(400, [20.0, 60.0], noise=1)
    assert running.node()["recording"] == [session.id]
    assert session.now()["frames"] == 400
    marked = running.http.post(f"{session.url}/events", json={"label": "stone"})
    assert marked.status_code == 201
    stopped = session.stop()
    assert stopped["state"] == "pending"
    tared.send(30, now=True)
    sealed = session.sealed()
    assert sealed["complete"] is True
    assert sealed["frames"] == 400
    assert sealed["problem"] is None
    assert sealed["parts"] == [{"boot_id": tared.boot_id, "seq_first": 70, "seq_last": 469}]
    assert_same_bits(session.frames(), tared.all_sent().rows(70, 470))
    assert set(session.column("part")) == {0}
    assert running.node()["recording"] == []
    assert sealed["duration_s"] == pytest.approx(399 * 0.002)
    path = session.folder / "frames.parquet"
    assert sealed["bytes"] == path.stat().st_size


def test_a_sealed_session_has_estimates_with_the_tare_in_force(tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(200, [20.0, 60.0])
    session.stop()
    tared.send(30, now=True)
    sealed = session.sealed()
    middle = slice(60, 140)
    for tile, force_n in enumerate((20.0, 60.0)):
        found = session.column(f"force_n_{tile}")[middle]
        assert found == pytest.approx(np.full(80, force_n), abs=0.01)
        found = session.column(f"gauge_kpa_{tile}")[middle]
        assert found == pytest.approx(np.full(80, force_n * COUNT_KPA), abs=0.001)
    assert session.column("grf_n")[middle] == pytest.approx(np.full(80, 80.0), abs=0.02)
    with session.reader() as file:
        notes = file.notes
    assert notes["session"]["id"] == session.id
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
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(service.api.routes.sessions, "SETTLE_S", 5.0)
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
    assert_same_bits(found, tared.all_sent().rows(first, last + 1))
    assert int(found.t_ns[-1]) <= stopped["stopped_t_ns"]
    assert int(tared.all_sent().t_ns[last + 1]) > stopped["stopped_t_ns"]


def test_a_session_is_stopped_once(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    session.stop()
    answer = running.http.post(f"{session.url}/stop")
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
    assert_same_bits(session.frames(), tared.all_sent().rows(70, 200))


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
    assert_same_bits(session.frames(), tared.all_sent().rows(70, 200))


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
    first_boot_id = tared.boot_id
    tared.leave()
    tared.reboot()
    assert tared.connect() == [(0, None)]
    second = tared.deliver(60, 10.0)
    sealed = tared.finish(session)
    assert sealed["complete"] == "lossy"
    assert [part["boot_id"] for part in sealed["parts"]] == [first_boot_id, tared.boot_id]
    found = session.frames()
    assert_same_bits(found, FrameBatch.concatenate([first, second]))
    np.testing.assert_array_equal(session.column("part"), [0] * 100 + [1] * 60)
    ledger = session.ledger()
    assert [part["recorded"] for part in ledger["parts"]] == [100, 60]
    assert ledger["parts"][0]["unsynced_tail_max"] >= 1
    assert ledger["lossy"] is True


def test_a_node_that_comes_back_with_other_tiles_ends_its_recording(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    session = tared.record()
    first = tared.deliver(100, 10.0)
    tared.leave()
    other = node_of(running, tiles=3)
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
    other = node_of(running, tiles=3)
    other.connect()
    new = other.send(30)
    taken_up = running.only_session(but=session)
    assert taken_up["state"] == "recording"
    kept = {"name": "mud (2)", "subject": "leg 2", "tags": ["wet"]}
    assert {name: taken_up[name] for name in kept} == kept
    other.taken_in()
    assert other.finish(taken_up)["complete"] is True
    assert_same_bits(taken_up.frames().rows(0, 30), new)


def test_a_stream_that_ended_in_order_leaves_no_doubt_about_its_end(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    session = tared.record()
    tared.deliver(100, 10.0)
    tared.leave()
    other = node_of(running, tiles=3)
    tared.reboot()
    other.connect(earlier=(tared.before[0].said(held=()),))
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
    assert_same_bits(session.frames(), tared.all_sent().rows(70, 170))
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
    assert_same_bits(session.frames(), tared.all_sent().rows(first, 620))


def test_a_pre_roll_reaches_no_further_than_what_is_held(tared: FakeNode) -> None:
    assert tared.record(pre_roll_s=600)["parts"][0]["seq_first"] == 0


def test_a_tare_under_load_is_refused_and_names_the_tile(running: Running, tared: FakeNode) -> None:
    # Longer than the ten seconds that a tare looks back.
    tared.next_t_mono_ns += 11_000_000_000
    tared.deliver(300, [0.0, 40.0])
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 409
    assert "T02" in answer.json()["detail"]
    assert "loaded" in answer.json()["detail"]
    assert len(running.http.get("/nodes/bench/tares").json()["items"]) == 1


def test_a_tare_without_load_is_in_force_until_it_is_undone(
    running: Running, tared: FakeNode
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
    tared.taken_in()
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


def test_a_tare_during_a_recording_serves_from_then_on(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(300, 2.0, alive=True, now=True)
    answer = running.http.post("/nodes/bench/tare", json={})
    assert answer.status_code == 201, answer.text
    tared.deliver(100, 2.0)
    # The stop has to lie after them on the node's clock, too.
    until(lambda: time.monotonic_ns() > tared.next_t_mono_ns)
    tared.finish(session)
    force_n = session.column("force_n_0")
    assert len(force_n) == 400
    assert force_n[50:200] == pytest.approx(np.full(150, 2.0), abs=0.01)
    assert force_n[330:390] == pytest.approx(np.zeros(60), abs=0.01)
    with session.reader() as file:
        assert [tare["source"] for tare in file.notes["tares"]] == ["lead", "unloaded"]


def test_what_people_say_of_a_session_outlives_the_server(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    change = {"name": "new", "subject": "B", "notes": "zwei\nZeilen", "tags": ["a", "b"]}
    answer = running.http.patch(session.url, json=change)
    assert answer.status_code == 200
    running.restart()
    found = session.now()
    assert {name: found[name] for name in change} == change
    partly = running.http.patch(session.url, json={"notes": ""}).json()
    assert (partly["name"], partly["notes"]) == ("new", "")


def test_a_renamed_session_keeps_its_data(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(20)
    sealed = tared.finish(session)
    answer = running.http.patch(session.url, json={"name": "other"}).json()
    assert answer["name"] == "other"
    assert answer["sha256"] == sealed["sha256"]


def test_an_event_after_sealing_is_in_the_events_file(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    url = f"{session.url}/events"
    running.http.post(url, json={"label": "before", "t_ns": 2})
    tared.deliver(20)
    tared.finish(session)
    path = session.folder / "events.parquet"
    assert pq.read_table(path)["label"].to_pylist() == ["before"]
    running.http.post(url, json={"label": "after", "t_ns": 1})
    assert sorted(map(str, pq.read_table(path)["label"].to_pylist())) == ["after", "before"]
    listed = running.http.get(url).json()["items"]
    assert [event["label"] for event in listed] == ["after", "before"]  # in order of time


def test_clock_measurements_are_kept_beside_the_session(tared: FakeNode) -> None:
    session = tared.record()
    tared.say_clock(1000, t_mono_ns=5)
    tared.deliver(20)
    tared.finish(session)
    path = session.folder / "clock.parquet"
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
    running: Running, tared: FakeNode
) -> None:
    session = tared.record()
    written = (session.folder / "session.json").read_bytes()
    for number in range(3):
        tared.say_clock(number, t_mono_ns=10**15 + number)
    tared.deliver(20)
    assert (session.folder / "session.json").read_bytes() == written
    running.restart()
    tared.connect()
    tared.finish(session)
    path = session.folder / "clock.parquet"
    offsets = pq.read_table(path)["server_minus_node_ns"].to_pylist()
    assert offsets == [0, 0, 1, 2, 0]  # at connecting, three later, and after the restart


def test_a_pre_roll_has_the_clock_measurements_of_its_time(tared: FakeNode) -> None:
    begin_ns = int(tared.sent[0].t_mono_ns[0])
    for number, t_mono_ns in enumerate((-2000, -1000, 10_000_000, 20_000_000)):
        tared.say_clock(number, t_mono_ns=begin_ns + t_mono_ns)
    tared.deliver(20)
    session = tared.record(pre_roll_s=600)
    found = json.loads((session.folder / "session.json").read_bytes())
    assert [row["server_minus_node_ns"] for row in found["clock"]] == [1, 2, 3]


def test_a_session_ends_by_the_servers_clock(tared: FakeNode) -> None:
    # The node's clock is an hour behind; it says so.
    hour_ns = 3_600_000_000_000
    tared.leave()
    tared.reboot()
    tared.utc_offset_ns -= hour_ns
    tared.connect()
    tared.say_clock(hour_ns, t_mono_ns=5)
    tared.deliver(20)
    session = tared.record()
    tared.deliver(30)
    session.stop()
    tared.send(10, now=True)
    assert session.sealed()["frames"] == 30


def test_a_session_without_calibration_is_sealed_raw_and_says_why(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(10)
    session = running.record()
    node.deliver(50)
    sealed = node.finish(session)
    assert sealed["complete"] is True
    assert sealed["calibration_id"] is None
    assert sealed["absolute_scale"] is None
    assert "no estimates" in sealed["problem"]
    assert_same_bits(session.frames(), node.all_sent().rows(10, 60))
    path = session.folder / "frames.parquet"
    assert not any(name.startswith("force_n") for name in pq.read_schema(path).names)
    with session.reader() as file:
        assert "no estimates" in file.notes["estimates"]


def test_a_session_without_tare_is_sealed_raw_and_says_why(node: FakeNode) -> None:
    node.connect()
    node.deliver(10, 50.0)
    session = node.record()
    node.deliver(50, 50.0)
    session.stop()
    node.send(10, 50.0, now=True)
    sealed = session.sealed()
    assert "no estimates" in sealed["problem"]
    assert sealed["frames"] == 50


def test_a_part_without_frames_has_lost_none(tared: FakeNode) -> None:
    session = tared.record()
    tared.leave()
    tared.reboot()
    tared.connect()
    tared.deliver(20)
    ledger = session.ledger()
    assert ledger["parts"][0]["recorded"] == 0
    assert ledger["parts"][0]["lost"] == {}
    assert ledger["parts"][1]["recorded"] == 20


def test_a_session_without_frames_says_so(tared: FakeNode) -> None:
    session = tared.record()
    sealed = tared.finish(session)
    assert sealed["problem"] == "not one frame was recorded"
    assert sealed["frames"] == 0
    assert sealed["complete"] is True


@pytest.mark.parametrize(
    "text", ["=1+1", "<script>alert(1)</script>", "naïve 😀", '"\\', "a\u2028b"]
)
def test_what_people_write_comes_back_as_it_is(
    running: Running, tared: FakeNode, text: str
) -> None:
    session = tared.record(name=text, notes=text)
    url = session.url
    running.http.post(f"{url}/events", json={"label": text})
    answer = running.http.get(url)
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.json()["name"] == answer.json()["notes"] == text
    assert running.http.get(f"{url}/events").json()["items"][0]["label"] == text
    assert running.http.get("/sessions", params={"q": text}).json()["items"]


def test_a_session_is_sealed_again_when_the_disk_was_full(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    import service.server.recorder
    from devices.errors import StorageError

    tried = threading.Event()

    def refusing(*arguments: Any) -> Any:
        if not tried.is_set():
            tried.set()
            raise StorageError("No space left on device")
        return seal(*arguments)

    monkeypatch.setattr(service.server.recorder, "seal", refusing)
    monkeypatch.setattr(service.server.recorder, "_SEAL_AGAIN_S", 0.2)
    session = tared.record()
    tared.deliver(20)
    session.stop()
    tared.send(10, now=True)
    until(lambda: "No space left" in (session.now()["problem"] or ""))
    sealed = session.sealed()
    assert sealed["frames"] == 20
    assert sealed["problem"] is None


# What a hostile tester found


def test_tares_count_by_the_frames_own_time_however_wrong_the_nodes_date_is(node: FakeNode) -> None:
    years_ns = 4 * 365 * 86_400 * 1_000_000_000
    node.utc_offset_ns += years_ns
    node.connect()
    node.say_clock(-years_ns, t_mono_ns=5)
    node.tared()
    node.taken_in()
    session = node.record()
    node.deliver(300, [10.0, 10.0])
    node.leave()
    session.stop()
    node.reboot()  # and its clock's offset is not known when the session is sealed
    node.connect()
    sealed = session.sealed()
    assert sealed["problem"] is None
    np.testing.assert_allclose(session.column("force_n_0"), 10.0, atol=0.1)


def test_a_recording_keeps_the_calibration_it_was_begun_with(tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(200, [10.0, 10.0])
    tared.leave()
    session.stop()
    tared.reboot()
    before = tared.hello().calibration
    assert before is not None
    tripled = [t.model_copy(update={"f_scale_n": 3.0 * t.f_scale_n}) for t in before.tiles]
    tared.calibration = before.model_copy(update={"tiles": tuple(tripled)})
    tared.connect()
    sealed = session.sealed()
    assert sealed["calibration_id"] != tared.calibration.id
    np.testing.assert_allclose(session.column("force_n_0"), 10.0, atol=0.1)


def test_a_node_that_is_still_catching_up_is_not_recorded(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.server.recorder, "BEHIND_S", 2.0)
    answer = running.http.post("/sessions", json={"node": "bench", "name": "too early"})
    assert answer.status_code == 409
    assert "behind" in answer.json()["detail"]


def test_why_a_recording_ended_is_said_together_with_why_it_has_no_estimates(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(50)
    session = running.record()
    node.deliver(50)
    node.leave()
    node.reboot()
    node.tiles += 1
    node.connect()
    problem = session.sealed()["problem"]
    assert "other tiles" in problem
    assert "no estimates" in problem
