"""What a sealed session has beside its frames: estimates, tares, clock, notes; and why not."""

from __future__ import annotations

import csv
import json
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import service.api.routes.recordings.sessions
import service.server.sealer
from devices.errors import StorageError
from service.sessions.sealing import seal_session
from tests.builders.arrays import COUNT_KPA
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, ServeWith, assert_refused
from tests.storage.faulty_disk import failing_once
from tests.waiting import PATIENCE_S, until


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
        # Rounded to an eighth of a noise of half a count, so half of that off.
        assert found == pytest.approx(np.full(80, force_n * COUNT_KPA), abs=COUNT_KPA / 32)
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


def test_a_download_before_the_seal_has_the_rounded_estimates_of_the_sealed_file(
    tared: FakeNode,
) -> None:
    session = tared.record()
    tared.deliver(200, [20.0, 60.0], noise=1)
    before = pa.ipc.open_file(session.data(format="arrow").content).read_all()
    tared.finish(session)
    sealed = pq.read_table(session.folder / "frames.parquet")
    said = {field.name: field.metadata or {} for field in sealed.schema}
    steps = {name: float(m[b"rounded_to"]) for name, m in said.items() if b"rounded_to" in m}
    assert {"force_n_0", "force_n_1", "grf_n", "grf_sigma_n"} <= set(steps)
    for name, step in steps.items():
        assert (before.schema.field(name).metadata or {})[b"rounded_to"] == repr(step).encode()
        found = before[name].to_numpy()[:100]  # later ones had less look-ahead
        np.testing.assert_array_equal(found, sealed[name].to_numpy()[:100], err_msg=name)
        whole = found.astype(np.float64) / step
        np.testing.assert_array_equal(whole, np.rint(whole), err_msg=name)


def test_of_tiles_in_one_row_neither_file_nor_answer_has_a_number_across_it(
    tared: FakeNode,
) -> None:
    session = tared.record()
    tared.deliver(200, [20.0, 60.0])
    tared.finish(session)
    sealed = pq.ParquetFile(session.folder / "frames.parquet")
    frames = sealed.read(["cop_x_m", "cop_y_m", "cop_sigma_y_m"])
    assert np.isfinite(frames["cop_x_m"].to_numpy()).any()
    for name in ("cop_y_m", "cop_sigma_y_m"):
        assert not np.isfinite(frames[name].to_numpy()).any()
    group = sealed.metadata.row_group(0)
    (statistics,) = (
        group.column(i).statistics
        for i in range(group.num_columns)
        if group.column(i).path_in_schema == "cop_y_m"
    )
    assert statistics is None or not statistics.has_min_max
    rows = list(csv.DictReader(session.data(format="csv").text.splitlines()))
    assert any(row["cop_x_m"] for row in rows)
    assert {row["cop_y_m"] for row in rows} == {""}
    get = session.running.http.get
    bins = get(f"{session.url}/timeseries").json()["columns"]
    assert any(value is not None for value in bins["cop_x_m_max"])
    for name in ("cop_y_m_min", "cop_y_m_max", "cop_y_low_m_min", "cop_y_high_m_max"):
        assert set(bins[name]) == {None}


def test_a_server_that_is_told_so_seals_estimates_as_computed(
    serve_with: ServeWith, node_of: NodeOf
) -> None:
    running = serve_with(unquantized=True)
    node = node_of(running)
    node.connect()
    node.tared()
    node.acknowledged(69)
    session = node.record()
    node.deliver(200, [20.0, 60.0], noise=1)
    node.finish(session)
    schema = pq.read_schema(session.folder / "frames.parquet")
    assert not any(b"rounded_to" in (field.metadata or {}) for field in schema)
    with session.reader() as file:
        assert file.notes["rounded_to"] == {}


def test_a_tare_under_load_is_refused_and_names_the_tile(running: Running, tared: FakeNode) -> None:
    # Longer than the ten seconds that a tare looks back.
    tared.next_t_mono_ns += 11_000_000_000
    tared.deliver(300, [0.0, 40.0])
    assert_refused(running.http.post("/nodes/bench/tare", json={}), 409, "T02", "loaded")
    assert len(running.http.get("/nodes/bench/tares").json()["items"]) == 1


def test_a_tare_without_load_is_in_force_until_it_is_undone(
    running: Running, tared: FakeNode
) -> None:
    def force_n() -> list[float]:
        with running.socket("/api/v1/live?rate_hz=60") as live:
            tared.send(60, 3.0)
            while True:
                message = json.loads(live.recv(timeout=PATIENCE_S))
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
    assert_refused(running.http.post("/nodes/bench/tare", json={}), 409, "not connected")


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
    url = f"{session.url}/markers"
    running.http.post(url, json={"label": "before", "t_ns": 2})
    tared.deliver(20)
    tared.finish(session)
    path = session.folder / "markers.parquet"
    assert pq.read_table(path)["label"].to_pylist() == ["before"]
    running.http.post(url, json={"label": "after", "t_ns": 1})
    assert sorted(map(str, pq.read_table(path)["label"].to_pylist())) == ["after", "before"]
    listed = running.http.get(url).json()["items"]
    assert [event["label"] for event in listed] == ["after", "before"]  # in order of time


def test_clock_measurements_are_kept_beside_the_session(tared: FakeNode) -> None:
    session = tared.record()
    t_mono_ns = tared.next_t_mono_ns
    tared.say_clock(1000)
    tared.deliver(20)
    tared.finish(session)
    path = session.folder / "clock.parquet"
    at_connecting, later = pq.read_table(path).to_pylist()
    assert at_connecting["server_minus_node_ns"] == 0
    assert [later] == [
        {
            "stream_id": tared.stream_id,
            "t_mono_ns": t_mono_ns,
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
        tared.say_clock(number, t_mono_ns=time.monotonic_ns())
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
    assert_same_bits(session.frames(), node.all_sent().slice_rows(10, 60))
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


def test_a_session_without_frames_says_so(tared: FakeNode) -> None:
    session = tared.record()
    sealed = tared.finish(session)
    assert sealed["problem"] == "no frame was recorded"
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
    running.http.post(f"{url}/markers", json={"label": text})
    answer = running.http.get(url)
    assert answer.headers["content-type"] == "application/json"
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.json()["name"] == answer.json()["notes"] == text
    assert running.http.get(f"{url}/markers").json()["items"][0]["label"] == text
    assert running.http.get("/sessions", params={"q": text}).json()["items"]


def test_a_session_is_sealed_again_when_the_disk_was_full(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    refusing = failing_once(seal_session, StorageError, "No space left on device")
    monkeypatch.setattr(service.server.sealer, "seal_session", refusing)
    monkeypatch.setattr(service.server.sealer, "_RETRY_S", 0.2)
    session = tared.record()
    tared.deliver(20)
    session.stop()
    tared.send(10, now=True)
    until(lambda: "No space left" in (session.now()["problem"] or ""))
    sealed = session.sealed()
    assert sealed["frames"] == 20
    assert sealed["problem"] is None


def test_tares_count_by_the_frames_own_time_however_wrong_the_nodes_date_is(node: FakeNode) -> None:
    years_ns = 4 * 365 * 86_400 * 1_000_000_000
    node.utc_offset_ns += years_ns
    node.connect()
    node.say_clock(-years_ns)
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


def test_why_a_recording_ended_is_said_together_with_why_it_has_no_estimates(
    running: Running, node_of: NodeOf
) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(50)
    session = running.record()
    node.deliver(50)
    node.restart()
    node.tiles += 1
    node.connect()
    problem = session.sealed()["problem"]
    assert "other tiles" in problem
    assert "no estimates" in problem
