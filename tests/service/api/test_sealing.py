"""Sealed sessions: their estimates, notes, clock samples, and problems."""

from __future__ import annotations

import csv
import json
import time

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import service.server.recorder
from devices.errors import StorageError
from service.sessions.sealing import write_sealed_files
from tests.builders.arrays import COUNT_KPA
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, ServeWith
from tests.storage.faulty_disk import failing_once
from tests.waiting import until


def test_a_sealed_session_has_estimates_and_notes(tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(200, [20.0, 60.0])
    sealed = tared.finish(session)
    middle = slice(60, 140)
    for tile, force_n in enumerate((20.0, 60.0)):
        found = session.column(f"force_n_{tile}")[middle]
        assert found == pytest.approx(np.full(80, force_n), abs=0.01)
        found = session.column(f"gauge_kpa_{tile}")[middle]
        # Rounded to an eighth of half a count of noise.
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
    assert (notes["tare"]["source"], notes["tare"]["frames"]) == ("lead", 60)
    assert notes["emulated"] is False
    assert sealed["absolute_scale"] == "measured"


def test_a_download_before_the_seal_has_its_rounded_estimates(tared: FakeNode) -> None:
    session = tared.record()
    tared.deliver(200, [20.0, 60.0], noise=1)
    before = pa.ipc.open_file(session.data(format="arrow").content).read_all()
    tared.finish(session)
    sealed = pq.read_table(session.folder / "frames.parquet")
    metadata = {field.name: field.metadata or {} for field in sealed.schema}
    steps = {name: float(m[b"rounded_to"]) for name, m in metadata.items() if b"rounded_to" in m}
    assert {"force_n_0", "force_n_1", "grf_n", "grf_sigma_n"} <= set(steps)
    for name, step in steps.items():
        assert (before.schema.field(name).metadata or {})[b"rounded_to"] == repr(step).encode()
        found = before[name].to_numpy()[:100]  # later frames had less look-ahead
        np.testing.assert_array_equal(found, sealed[name].to_numpy()[:100], err_msg=name)
        whole = found.astype(np.float64) / step
        np.testing.assert_array_equal(whole, np.rint(whole), err_msg=name)


def test_tiles_in_one_row_have_no_cop_across_it(tared: FakeNode) -> None:
    session = tared.record_sealed(200, [20.0, 60.0])
    sealed = pq.ParquetFile(session.folder / "frames.parquet")
    frames = sealed.read(["cop_x_m", "cop_y_m", "cop_sigma_y_m"])
    assert np.isfinite(frames["cop_x_m"].to_numpy()).any()
    for name in ("cop_y_m", "cop_sigma_y_m"):
        assert not np.isfinite(frames[name].to_numpy()).any()
    group = sealed.metadata.row_group(0)
    columns = [group.column(i) for i in range(group.num_columns)]
    (statistics,) = (c.statistics for c in columns if c.path_in_schema == "cop_y_m")
    assert statistics is None or not statistics.has_min_max
    rows = list(csv.DictReader(session.data(format="csv").text.splitlines()))
    assert any(row["cop_x_m"] for row in rows)
    assert {row["cop_y_m"] for row in rows} == {""}
    bins = session.running.http.get(f"{session.url}/timeseries").json()["columns"]
    assert any(value is not None for value in bins["cop_x_m_max"])
    for name in ("cop_y_m_min", "cop_y_m_max", "cop_y_low_m_min", "cop_y_high_m_max"):
        assert set(bins[name]) == {None}


def test_an_exact_server_does_not_round(serve_with: ServeWith, node_of: NodeOf) -> None:
    node = node_of(serve_with(unquantized=True))
    node.connect()
    node.tared()
    node.acknowledged(69)
    session = node.record_sealed(200, [20.0, 60.0], noise=1)
    schema = pq.read_schema(session.folder / "frames.parquet")
    assert not any(b"rounded_to" in (field.metadata or {}) for field in schema)
    with session.reader() as file:
        assert file.notes["rounded_to"] == {}


def test_clock_samples_are_stored_with_a_session(running: Running, tared: FakeNode) -> None:
    session = tared.record()
    begin_ns = time.monotonic_ns()
    written = (session.folder / "session.json").read_bytes()
    for number in (1000, 1001, 1002):
        tared.say_clock(number, t_mono_ns=begin_ns + number)
    tared.deliver(20)
    # A sample does not rewrite the description.
    assert (session.folder / "session.json").read_bytes() == written
    running.restart()
    tared.connect()
    tared.finish(session)
    rows = pq.read_table(session.folder / "clock.parquet").to_pylist()
    # The first and the last are those of the two connections.
    assert [row["server_minus_node_ns"] for row in rows] == [0, 1000, 1001, 1002, 0]
    assert rows[1] == {
        "stream_id": tared.stream_id,
        "t_mono_ns": begin_ns + 1000,
        "server_minus_node_ns": 1000,
        "uncertainty_ns": 7,
    }


def test_a_pre_roll_has_the_clock_samples_of_its_time(tared: FakeNode) -> None:
    begin_ns = int(tared.sent[0].t_mono_ns[0])
    for number, t_mono_ns in enumerate((-2000, -1000, 10_000_000, 20_000_000)):
        tared.say_clock(number, t_mono_ns=begin_ns + t_mono_ns)
    tared.deliver(20)
    session = tared.record(pre_roll_s=600)
    found = json.loads((session.folder / "session.json").read_bytes())
    assert [row["server_minus_node_ns"] for row in found["clock"]] == [1, 2, 3]


def test_a_session_without_calibration_is_sealed_raw(running: Running, node_of: NodeOf) -> None:
    node = node_of(running, calibration=None)
    node.connect()
    node.deliver(10)
    session = running.record()
    node.deliver(50)
    sealed = node.finish(session)
    assert sealed["complete"] is True
    assert (sealed["calibration_id"], sealed["absolute_scale"]) == (None, None)
    assert "no estimates" in sealed["problem"]
    assert_same_bits(session.frames(), node.all_sent().slice_rows(10, 60))
    names = pq.read_schema(session.folder / "frames.parquet").names
    assert not any(name.startswith("force_n") for name in names)
    with session.reader() as file:
        assert "no estimates" in file.notes["estimates"]
    session = running.record()
    node.deliver(50)
    node.restart()
    node.tiles += 1
    node.connect()
    problem = session.sealed()["problem"]
    assert "other tiles" in problem
    assert "no estimates" in problem


def test_a_session_without_tare_is_sealed_raw(node: FakeNode) -> None:
    node.connect()
    node.deliver(10, 50.0)
    session = node.record()
    node.deliver(50, 50.0)
    sealed = node.finish(session)
    assert "no estimates" in sealed["problem"]
    assert sealed["frames"] == 50


def test_a_session_without_frames_is_complete(tared: FakeNode) -> None:
    sealed = tared.finish(tared.record())
    assert sealed["problem"] == "no frame was recorded"
    assert (sealed["frames"], sealed["complete"]) == (0, True)


def test_a_session_is_sealed_when_the_disk_has_space(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    fail_once = failing_once(write_sealed_files, StorageError, "No space left on device")
    monkeypatch.setattr(service.server.recorder, "write_sealed_files", fail_once)
    monkeypatch.setattr(service.server.recorder, "_RETRY_S", 0.2)
    session = tared.record()
    tared.deliver(20)
    session.stop()
    tared.send(10, now=True)
    until(lambda: "No space left" in (session.now()["problem"] or ""))
    sealed = session.sealed()
    assert (sealed["frames"], sealed["problem"]) == (20, None)


def test_a_wrong_date_of_the_node_changes_no_tare(node: FakeNode) -> None:
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
    node.reboot()  # the offset of the new stream's clock is unknown at the seal
    node.connect()
    assert session.sealed()["problem"] is None
    np.testing.assert_allclose(session.column("force_n_0"), 10.0, atol=0.1)


def test_a_recording_keeps_its_first_calibration(tared: FakeNode) -> None:
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
    assert session.sealed()["calibration_id"] != tared.calibration.id
    np.testing.assert_allclose(session.column("force_n_0"), 10.0, atol=0.1)
