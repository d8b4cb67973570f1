"""Sessions on the server's time axis: over REST, from the files alone, and two nodes on one."""

from __future__ import annotations

import io
import json
import time
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pyarrow as pa
import pyarrow.csv as pacsv
import pyarrow.parquet as pq
import pytest

import foottile
from service import server_clock
from service.pull import pull_session
from storage.clock.log import ClockLog
from storage.parquet_hash import write_hashed_table
from tests.service.command import command
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused
from tests.storage.faulty_disk import refusing
from tests.waiting import until

HOUR_NS = 3_600_000_000_000
HALF_NS = 400_000


def measured(node: FakeNode, offset_ns: int) -> None:
    """Tell the clock as it was at the newest frame."""
    node.say_clock(offset_ns, uncertainty_ns=HALF_NS)
    shown = {"server_minus_node_ns": offset_ns, "uncertainty_ns": HALF_NS}
    until(lambda: node.running.node(node.name)["clock"] == shown)


def recorded(node: FakeNode, offset_ns: int | None) -> Recording:
    """A sealed session of 200 frames, its clock measured in the middle and at its end."""
    session = node.record()
    for later_ns in (0, 1):
        node.send(100, [20.0, 60.0])
        if offset_ns is not None:
            measured(node, offset_ns + later_ns)
    node.taken_in()
    node.finish(session)
    return session


def begun(node: FakeNode, offset_ns: int | None, **changes: Any) -> None:
    """Connect a node whose clock is `offset_ns` behind, and tare it."""
    node.utc_offset_ns -= offset_ns or 0
    node.greet(**changes)
    if offset_ns is not None:
        measured(node, offset_ns)
    node.tared()
    node.taken_in()


def parquet_of(answer: httpx.Response) -> pa.Table:
    return pq.read_table(io.BytesIO(answer.content))


def arrow_of(answer: httpx.Response) -> pa.Table:
    return pa.ipc.open_file(answer.content).read_all()


def csv_of(answer: httpx.Response) -> pa.Table:
    return pacsv.read_csv(io.BytesIO(answer.content))


def test_every_format_can_have_the_servers_time_beside_the_nodes(
    running: Running, node: FakeNode
) -> None:
    begun(node, HOUR_NS)
    session = recorded(node, HOUR_NS)
    tables = {
        "parquet": parquet_of(session.data(clock="server", format="parquet")),
        "arrow": arrow_of(session.data(clock="server", format="arrow")),
        "csv": csv_of(session.data(clock="server", format="csv")),
    }
    raw = parquet_of(session.data())
    assert "t_server_ns" not in raw.column_names
    for table in tables.values():
        assert table["t_ns"].to_pylist() == raw["t_ns"].to_pylist()
        off_ns = table["t_server_ns"].to_numpy() - raw["t_ns"].to_numpy()
        bound_ns = table["t_server_uncertainty_ns"].to_numpy()
        assert (np.abs(off_ns - HOUR_NS) <= bound_ns).all()
        assert (bound_ns < 2 * HALF_NS).all()
        assert table["t_server_ns"].to_pylist() == tables["arrow"]["t_server_ns"].to_pylist()
    notes = json.loads(tables["parquet"].schema.metadata[b"foottile.notes"])
    assert notes["clock"] == session.clock()
    assert notes["session"]["id"] == session.id


def test_the_tag_of_a_download_depends_on_the_clock(running: Running, node: FakeNode) -> None:
    begun(node, HOUR_NS)
    session = recorded(node, HOUR_NS)
    query = {"format": "csv", "clock": "server"}
    tags = [
        session.data(**q).headers["etag"]
        for q in ({"format": "csv"}, query, {"clock": "server"}, {})
    ]
    assert len(set(tags)) == 4
    assert session.data(format="csv", clock="node").headers["etag"] == tags[0]
    url = f"{session.url}/data"
    seen = {"If-None-Match": tags[1]}
    assert running.http.get(url, params=query, headers=seen).status_code == 304
    path = session.folder / "clock.parquet"
    table = pq.read_table(path)
    write_hashed_table(path, table.slice(0, 1))
    assert running.http.get(url, params=query, headers=seen).status_code == 200
    pq.write_table(table, path)  # by another program: its hash is gone
    refused = running.http.get(url, params=query, headers=seen)
    assert (refused.status_code, "its hash is gone" in refused.json()["detail"]) == (500, True)
    answer = running.http.get(url, params={"clock": "mine"})
    assert answer.status_code == 422


def test_a_slice_has_the_servers_time_of_its_own_rows(running: Running, node: FakeNode) -> None:
    begun(node, HOUR_NS)
    session = recorded(node, HOUR_NS)
    query = {"format": "csv", "clock": "server", "columns": "t_server_ns,t_ns"}
    whole = csv_of(session.data(**query))
    part = csv_of(session.data(**query, start_s=0.1, end_s=0.2))
    assert part.column_names == ["t_server_ns", "t_ns"]
    assert part.to_pylist() == whole.to_pylist()[50:100]


def test_a_recording_session_has_the_clock_as_it_is_so_far(
    running: Running, node: FakeNode
) -> None:
    begun(node, HOUR_NS)
    session = node.record()
    node.send(50)
    until(lambda: session.now()["frames"] == 50)
    query = {"format": "arrow", "clock": "server"}
    before = session.data(**query)
    table = arrow_of(before)
    off_ns = table["t_server_ns"].to_numpy() - table["t_ns"].to_numpy()
    assert (np.abs(off_ns - HOUR_NS) <= table["t_server_uncertainty_ns"].to_numpy()).all()
    (stream,) = session.clock()["streams"]
    assert (stream["state"], stream["rows"]) == ("measured", 1)
    assert stream["stretches"][0]["drift_ppm"] is None
    answer = running.http.get(f"{session.url}/clock?format=parquet")
    assert answer.status_code == 409
    measured(node, HOUR_NS + 5)
    after = session.data(**query)
    assert after.headers["etag"] != before.headers["etag"]


def test_a_node_that_was_switched_on_anew_has_a_clock_for_each_start(
    running: Running, node: FakeNode
) -> None:
    begun(node, 0)
    session = node.record()
    node.send(50)
    node.taken_in()
    first = node.stream_id
    node.restart()
    begun(node, HOUR_NS)
    node.send(50)
    node.taken_in()
    node.finish(session)
    streams = session.clock()["streams"]
    assert [stream["stream_id"] for stream in streams] == [first, node.stream_id]
    assert [stream["stretches"][0]["offset_ns"] for stream in streams] == [0, HOUR_NS]
    begins = [stream["stretches"][0]["begin_t_ns"] for stream in streams]
    assert begins[0] - begins[1] > HOUR_NS / 2
    table = parquet_of(session.data(clock="server"))
    off_ns = table["t_server_ns"].to_numpy() - table["t_ns"].to_numpy()
    part = table["part"].to_numpy()
    assert np.abs(off_ns[part == 0]).max() < 2 * HALF_NS
    assert np.abs(off_ns[part == 1] - HOUR_NS).max() < 2 * HALF_NS


@pytest.mark.parametrize(("clock_set", "state"), [(True, "unmeasured"), (False, "unsynchronised")])
def test_a_node_nobody_measured_has_no_servers_time(
    running: Running, node: FakeNode, clock_set: bool, state: str
) -> None:
    begun(node, None, array_info=node.info.model_copy(update={"clock_set": clock_set}))
    session = recorded(node, None)
    (stream,) = session.clock()["streams"]
    assert stream == {
        "stream_id": node.stream_id,
        "state": state,
        "rows": 0,
        "stretches": [],
        "steps": [],
    }
    table = parquet_of(session.data(clock="server"))
    assert table["t_server_ns"].null_count == len(table) == 200
    assert table["t_server_uncertainty_ns"].null_count == 200
    assert table["t_ns"].null_count == 0


def test_the_servers_clock_set_by_an_hour_is_a_step_of_the_session(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun(node, 0)
    session = node.record()
    node.send(50)
    measured(node, 0)
    node.send(50)
    node.taken_in()
    node.leave()  # a server whose date is set has been started anew
    monkeypatch.setattr(server_clock, "_OFFSET_NS", server_clock._OFFSET_NS + HOUR_NS)
    node.greet()
    measured(node, HOUR_NS)
    node.send(50)
    until(lambda: session.now()["frames"] == 150)
    (stream,) = session.clock()["streams"]
    assert [stretch["rows"] for stretch in stream["stretches"]] == [2, 1]
    (step,) = stream["steps"]
    assert abs(step["jump_ns"] - HOUR_NS) <= step["jump_uncertainty_ns"] < 4 * HALF_NS
    assert step["before_t_ns"] - step["after_t_ns"] == 50 * 2_000_000
    query = {"format": "arrow", "clock": "server"}
    table = arrow_of(session.data(**query))
    bound_ns = table["t_server_uncertainty_ns"].to_numpy()
    assert (bound_ns[:51] < 2 * HALF_NS).all()
    assert (bound_ns[51:100] > HOUR_NS // 2).all()
    assert (bound_ns[100:] < 2 * HALF_NS).all()


def test_a_pulled_session_is_exported_with_the_servers_time_and_a_lone_file_is_not(
    running: Running,
    node: FakeNode,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    begun(node, HOUR_NS)
    session = recorded(node, HOUR_NS)
    with foottile.connect(running.url) as server:
        pull_session(server, session.id, tmp_path)
    folder = tmp_path / session.id
    out = tmp_path / "out.parquet"
    options = ("--format", "parquet", "--clock", "server", "--out", out)
    assert command(monkeypatch, "export", folder, *options) == 0
    served = session.data(clock="server", markers="true").content
    assert pq.read_table(out).equals(pq.read_table(io.BytesIO(served)))
    out.unlink()
    lone = tmp_path / "lone.parquet"
    (folder / "frames.parquet").rename(lone)
    capsys.readouterr()
    assert command(monkeypatch, "export", lone, *options) == 2
    said = capsys.readouterr().err
    assert "clock.parquet" in said
    assert not out.exists()
    assert (
        command(monkeypatch, "export", lone, "--clock", "mine", "--format", "csv", "--out", out)
        == 2
    )
    assert "node or server" in capsys.readouterr().err


def test_a_table_that_was_taken_away_is_said_to_be(
    running: Running, node: FakeNode, tmp_path: Path
) -> None:
    begun(node, HOUR_NS)
    session = recorded(node, HOUR_NS)
    (session.folder / "clock.parquet").unlink()
    for url in ("clock", "clock?format=parquet"):
        answer = running.http.get(f"{session.url}/{url}")
        assert_refused(answer, 404, "clock.parquet")
    answer = running.http.get(f"{session.url}/data?clock=server")
    assert_refused(answer, 422, "clock.parquet")
    with foottile.connect(running.url) as server:
        pull_session(server, session.id, tmp_path)
    assert not (tmp_path / session.id / "clock.parquet").exists()
    assert running.http.get("/sessions/20200101T000000Z-000000/clock").status_code == 404


def test_numbers_that_no_clock_has_are_refused_and_the_raw_data_stays(
    running: Running, node: FakeNode
) -> None:
    begun(node, 0)
    session = recorded(node, 0)
    path = session.folder / "clock.parquet"
    table = pq.read_table(path)
    offsets = pa.array([2**63 - 1] * len(table), pa.int64())
    write_hashed_table(path, table.set_column(2, table.schema.field(2), offsets))
    assert session.data(format="csv").status_code == 200
    answer = running.http.get(f"{session.url}/data?clock=server")
    assert_refused(answer, 500, "server_minus_node_ns")


def test_two_nodes_that_saw_the_same_event_are_put_on_one_axis(
    running: Running, node_of: NodeOf
) -> None:
    """One is an hour behind, the other was never set; both saw the same hop."""
    offsets = {"left": HOUR_NS, "right": time.time_ns() - 40_000_000_000}
    event_t_ns = None
    seen = {}
    for name, offset_ns in offsets.items():
        node = node_of(running, name)
        begun(node, offset_ns)
        measured(node, offset_ns - 300_000)  # as lopsided as its round trip allows
        session = node.record()
        node.send(100, [20.0, 60.0])
        if event_t_ns is None:
            node.next_t_mono_ns += 10_000_000_000  # later than what the other takes before it
            event_t_ns = node.next_t_mono_ns + node.utc_offset_ns + offset_ns
        else:
            node.next_t_mono_ns = event_t_ns - node.utc_offset_ns - offset_ns
        node.send(1, [90.0, 90.0])
        measured(node, offset_ns + 300_000)
        node.send(99, [20.0, 60.0])
        node.taken_in()
        node.finish(session)
        table = parquet_of(session.data(clock="server"))
        hop = int(np.argmin(table["pressure_raw_0"].to_numpy()))
        seen[name] = [
            table[column][hop].as_py() for column in ("t_server_ns", "t_server_uncertainty_ns")
        ]
    for t_server_ns, bound_ns in seen.values():
        assert abs(t_server_ns - event_t_ns) <= bound_ns < 2 * HALF_NS
    (left_ns, left_bound_ns), (right_ns, right_bound_ns) = seen.values()
    assert abs(left_ns - right_ns) <= left_bound_ns + right_bound_ns


def test_a_measurement_that_has_the_servers_clock_elsewhere_is_not_kept(
    running: Running, node: FakeNode
) -> None:
    """The server knows what its clock showed; a row that is absurd would move whole sessions."""
    begun(node, 0)
    now_ns = time.monotonic_ns()
    for offset_ns in (-HOUR_NS, 90_000_000_000, 10**18, -(10**18)):
        node.say_clock(offset_ns, t_mono_ns=now_ns)
    node.say_clock(0, t_mono_ns=now_ns - HOUR_NS)
    measured(node, 5)
    assert running.node()["clock"]["server_minus_node_ns"] == 5
    rows = running.call(
        lambda: list(running.server.nodes.get("bench").present_stream.clock_offsets)
    )
    assert [row.server_minus_node_ns for row in rows] == [0, 5]


def test_a_node_that_connects_again_costs_no_reading_of_what_its_sessions_have(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tared.record()
    for _ in range(3):
        tared.deliver(10)
        tared.say_clock(0)
    tared.deliver(10)
    with monkeypatch.context() as patched:
        patched.setattr(
            ClockLog, "read_undamaged_rows", refusing(AssertionError, "the log is read")
        )
        tared.leave()
        tared.connect()
    assert tared.finish(recording)["complete"] is True
