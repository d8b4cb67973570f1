"""Clocks of sessions over REST: the server's time beside the node's, and one axis of all parts."""

from __future__ import annotations

import csv
import io
import json
import time
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import devices.clock
import foottile
from service.pull import pull_export, pull_session
from storage.clock.log import ClockLog
from storage.formats.load_trace import read_load_to_emulate
from storage.formats.slice import Slice
from storage.formats.writers.registry import get_format
from storage.parquet_hash import write_hashed_table
from tests.builders.arrays import PERIOD_NS
from tests.service.command import command
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording, read_table, whole_parts_of
from tests.service.running import Running, assert_refused, content_of
from tests.storage.faulty_disk import refusing
from tests.waiting import until

HOUR_NS = 3_600_000_000_000
HALF_NS = 400_000


def send_sample(node: FakeNode, offset_ns: int) -> None:
    """Send a clock sample of the newest frame."""
    node.say_clock(offset_ns, uncertainty_ns=HALF_NS)
    shown = {
        "t_mono_ns": node.next_t_mono_ns,
        "server_minus_node_ns": offset_ns,
        "uncertainty_ns": HALF_NS,
    }
    until(lambda: node.running.node(node.name)["clock"] == shown)


def record(node: FakeNode, offset_ns: int | None, **changes: Any) -> Recording:
    """Record 200 frames of a node whose clock is behind by an offset; None: without a sample."""
    node.utc_offset_ns -= offset_ns or 0
    node.greet(**changes)
    if offset_ns is not None:
        send_sample(node, offset_ns)
    node.tared()
    node.taken_in()
    session = node.record()
    for later_ns in (0, 1):
        node.send(100, [20.0, 60.0])
        if offset_ns is not None:
            send_sample(node, offset_ns + later_ns)
    node.taken_in()
    return session


def set_servers_date(monkeypatch: pytest.MonkeyPatch, step_ns: int) -> None:
    """Have the server's date set, as it sees it from its next start on."""
    monkeypatch.setattr(devices.clock, "_UTC_OFFSET_NS", devices.clock._UTC_OFFSET_NS + step_ns)


@pytest.fixture(scope="module")
def session(shared: Running) -> Iterator[Recording]:
    """A sealed session of 200 frames of a node whose clock is an hour behind."""
    node = FakeNode(shared)
    session = record(node, HOUR_NS)
    node.finish(session)
    yield session
    node.close()


@pytest.fixture
def clock_path(session: Recording) -> Iterator[Path]:
    """The table of the session's clock, which a test may change."""
    path = session.folder / "clock.parquet"
    content = path.read_bytes()
    yield path
    path.write_bytes(content)


def test_every_table_has_the_servers_time_on_request(session: Recording) -> None:
    plain = read_table(session.data(), "parquet")
    assert "t_server_ns" not in plain.column_names
    whole = read_table(session.data(clock="server"), "parquet")
    for to in ("parquet", "arrow", "csv"):
        table = read_table(session.data(clock="server", format=to), to)
        assert table["t_ns"].to_pylist() == plain["t_ns"].to_pylist()
        off_ns = table["t_server_ns"].to_numpy() - plain["t_ns"].to_numpy()
        bound_ns = table["t_server_uncertainty_ns"].to_numpy()
        assert (np.abs(off_ns - HOUR_NS) <= bound_ns).all()
        assert (bound_ns < 2 * HALF_NS).all()
        assert table["t_server_ns"].to_pylist() == whole["t_server_ns"].to_pylist()
    notes = json.loads(whole.schema.metadata[b"foottile.notes"])
    assert (notes["clock"], notes["session"]["id"]) == (session.clock(), session.id)
    query = {"format": "csv", "clock": "server", "columns": "t_server_ns,t_ns"}
    part = read_table(session.data(**query, start_s=0.1, end_s=0.2), "csv")
    assert part.column_names == ["t_server_ns", "t_ns"]
    assert part.to_pylist() == whole.select(part.column_names).to_pylist()[50:100]


def test_the_tag_of_a_download_depends_on_the_clock(session: Recording, clock_path: Path) -> None:
    query = {"format": "csv", "clock": "server"}
    tags = [
        session.data(**q).headers["etag"]
        for q in ({"format": "csv"}, query, {"clock": "server"}, {})
    ]
    assert len(set(tags)) == 4
    assert session.data(format="csv", clock="node").headers["etag"] == tags[0]
    http, url, known = session.running.http, f"{session.url}/data", {"If-None-Match": tags[1]}
    assert http.get(url, params=query, headers=known).status_code == 304
    table = pq.read_table(clock_path)
    write_hashed_table(clock_path, table.slice(0, 1))
    assert http.get(url, params=query, headers=known).status_code == 200
    pq.write_table(table, clock_path)  # by another program, without a hash
    assert_refused(http.get(url, params=query, headers=known), 500, "its hash is gone")
    assert http.get(url, params={"clock": "mine"}).status_code == 422


def test_impossible_offsets_are_refused_and_the_nodes_time_stays(
    session: Recording, clock_path: Path
) -> None:
    table = pq.read_table(clock_path)
    offsets = pa.array([2**63 - 1] * len(table), pa.int64())
    write_hashed_table(clock_path, table.set_column(2, table.schema.field(2), offsets))
    assert session.data(format="csv").status_code == 200
    answer = session.running.http.get(f"{session.url}/data?clock=server")
    assert_refused(answer, 500, "server_minus_node_ns")


def test_a_missing_clock_is_named(session: Recording, clock_path: Path, tmp_path: Path) -> None:
    clock_path.unlink()
    http = session.running.http
    for rest in ("clock", "clock?format=parquet"):
        assert_refused(http.get(f"{session.url}/{rest}"), 404, "clock.parquet")
    assert_refused(http.get(f"{session.url}/data?clock=server"), 422, "clock.parquet")
    with foottile.connect(session.running.url) as server:
        pull_session(server, session.id, tmp_path)
    assert not (tmp_path / session.id / "clock.parquet").exists()
    assert http.get("/sessions/20200101T000000Z-000000/clock").status_code == 404


def test_an_export_of_a_pulled_session_has_the_servers_time(
    session: Recording,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with foottile.connect(session.running.url) as server:
        pull_session(server, session.id, tmp_path)
    folder, out = tmp_path / session.id, tmp_path / "out.parquet"
    options = ("--format", "parquet", "--clock", "server", "--out", out)
    assert command(monkeypatch, "export", folder, *options) == 0
    served = read_table(session.data(clock="server", markers="true"), "parquet")
    assert pq.read_table(out).equals(served)
    out.unlink()
    lone = (folder / "frames.parquet").rename(tmp_path / "lone.parquet")
    capsys.readouterr()
    assert command(monkeypatch, "export", lone, *options) == 2
    assert "clock.parquet" in capsys.readouterr().err
    assert not out.exists()
    wrong = ("--clock", "mine", "--format", "csv", "--out", out)
    assert command(monkeypatch, "export", lone, *wrong) == 2
    assert "node or server" in capsys.readouterr().err


def test_a_recording_session_has_its_present_clock(running: Running, node: FakeNode) -> None:
    session = record(node, HOUR_NS)
    query = {"format": "arrow", "clock": "server"}
    before = session.data(**query)
    table = read_table(before, "arrow")
    off_ns = table["t_server_ns"].to_numpy() - table["t_ns"].to_numpy()
    assert (np.abs(off_ns - HOUR_NS) <= table["t_server_uncertainty_ns"].to_numpy()).all()
    (stream,) = session.clock()["streams"]
    assert (stream["state"], stream["rows"]) == ("measured", 3)
    assert running.http.get(f"{session.url}/clock?format=parquet").status_code == 409
    send_sample(node, HOUR_NS + 5)
    assert session.data(**query).headers["etag"] != before.headers["etag"]


@pytest.mark.parametrize(("clock_set", "state"), [(True, "unmeasured"), (False, "unsynchronised")])
def test_a_node_without_samples_has_no_servers_time(
    node: FakeNode, clock_set: bool, state: str
) -> None:
    session = record(node, None, array_info=node.info.model_copy(update={"clock_set": clock_set}))
    node.finish(session)
    (stream,) = session.clock()["streams"]
    expected = {"stream_id": node.stream_id, "state": state, "rows": 0}
    assert stream == expected | {"stretches": [], "steps": []}
    table = read_table(session.data(clock="server"), "parquet")
    nulls = {name: table[name].null_count for name in ("t_server_ns", "t_ns")}
    assert nulls == {"t_server_ns": 200, "t_ns": 0}
    assert table["t_server_uncertainty_ns"].null_count == 200


def test_a_date_set_on_the_server_is_a_step_of_the_session(
    node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = record(node, 0)
    node.send(50)
    node.taken_in()
    node.leave()
    set_servers_date(monkeypatch, HOUR_NS)
    node.greet()
    send_sample(node, HOUR_NS)
    (stream,) = session.clock()["streams"]
    (step,) = stream["steps"]
    assert abs(step["jump_ns"] - HOUR_NS) <= step["jump_uncertainty_ns"] < 4 * HALF_NS


@pytest.mark.parametrize("step_ns", [-HOUR_NS, 0, HOUR_NS])
@pytest.mark.parametrize("order", [*permutations(("restart", "stop", "return"))][:4])
def test_a_date_set_before_a_servers_restart_moves_no_end(
    running: Running,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    step_ns: int,
    order: tuple[str, ...],
) -> None:
    node.connect()
    node.deliver(20, now=True)
    session = node.record()
    node.deliver(50, now=True)
    node.leave()
    unsent = node.frames(10, now=True)
    for event in order:
        if event == "restart":
            running.stop()
            set_servers_date(monkeypatch, step_ns)
            running.start()
        elif event == "stop":
            until(lambda: time.monotonic_ns() > node.next_t_mono_ns)
            session.stop()
        elif event == "return":
            node.greet()
            node.send_again(unsent)
            node.acknowledged(79)
    if order[-1] == "restart":
        node.leave()
        node.greet()
    node.say_clock(step_ns, t_mono_ns=time.monotonic_ns())
    node.send(20, now=True)
    assert whole_parts_of(session.sealed()) == [(node.stream_id, 20, 79)]


def test_a_measurement_of_a_former_date_is_not_the_present_one(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(20, now=True)
    node.leave()
    running.stop()
    set_servers_date(monkeypatch, -HOUR_NS)
    running.start()
    node.greet()
    node.deliver(10, now=True)
    session = node.record()
    node.deliver(30, now=True)
    session.stop()
    session.sealed()
    assert running.node(node.name)["clock"] is None
    (stream,) = session.clock()["streams"]
    assert (stream["state"], stream["rows"]) == ("unmeasured", 0)


def test_an_impossible_sample_is_dropped(
    running: Running, node: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    """The server knows its own clock; one absurd row would move whole sessions."""
    node.connect()
    now_ns = time.monotonic_ns()
    for offset_ns in (-HOUR_NS, 90_000_000_000, 10**18, -(10**18)):
        node.say_clock(offset_ns, t_mono_ns=now_ns)
    for ahead_ns in (HOUR_NS, -HOUR_NS):
        for offset_ns in (0, -ahead_ns):
            node.say_clock(offset_ns, t_mono_ns=now_ns + ahead_ns)
    send_sample(node, 5)
    rows = running.call(
        lambda: list(running.server.nodes.get("bench").present_stream.clock_offsets)
    )
    assert [row.server_minus_node_ns for row in rows] == [0, 5]
    assert caplog.text.count("a measurement of its clock is not kept") == 8
    node.deliver(10)


def test_a_node_connects_again_without_a_reading_of_the_log(
    tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = tared.record()
    for _ in range(3):
        tared.deliver(10)
        tared.say_clock(0)
    tared.deliver(10)
    with monkeypatch.context() as patch:
        fail = refusing(AssertionError, "the log is read")
        patch.setattr(ClockLog, "read_undamaged_rows", fail)
        tared.leave()
        tared.connect()
    assert tared.finish(recording)["complete"] is True


# --- a node whose date is set between two parts ---------------------------------------------------

WRONG_NS = 56 * 365 * 86_400 * 1_000_000_000
"""A node without a clock is in 1970."""
GAP_NS = 3_000_000_000
FIRST, SECOND = 200, 150
BEGIN_S = (FIRST * PERIOD_NS + GAP_NS) * 1e-9
"""Of the second part, on the axis."""
END_S = BEGIN_S + (SECOND - 1) * PERIOD_NS * 1e-9
SOON_S = 0.005
"""Two anchors of the fake node's date differ by at most this."""
LAG_S = 0.011
"""The newest frames of a recording are in the look-ahead."""


def record_parts(node: FakeNode, *, is_measured: bool = True) -> Recording:
    """Record one part in 1970 and another one, 3 s later, in the present."""
    node.utc_offset_ns -= WRONG_NS
    node.greet()
    node.say_clock(WRONG_NS, uncertainty_ns=9, t_mono_ns=time.monotonic_ns())
    node.tared()
    node.acknowledged(69)
    session = node.record()
    node.deliver(FIRST, [20.0, 10.0])
    end_ns = node.next_t_mono_ns
    node.restart()
    node.greet()
    if is_measured:
        node.say_clock(0, uncertainty_ns=9, t_mono_ns=time.monotonic_ns())
        node.next_t_mono_ns = end_ns + GAP_NS
    node.deliver(SECOND, [10.0, 20.0])
    return session


@pytest.fixture(scope="module")
def dated(shared: Running) -> Iterator[Recording]:
    """A sealed session of two such parts."""
    node = FakeNode(shared, "dated")
    session = record_parts(node)
    assert_one_axis(session)  # while it is recorded, too
    node.finish(session)
    yield session
    node.close()


def read_rows(session: Recording, **query: Any) -> dict[str, list[str]]:
    rows = list(csv.DictReader(io.StringIO(session.data(format="csv", **query).text)))
    return {name: [row[name] for row in rows] for name in rows[0]}


def get_overview(session: Recording, **query: Any) -> dict[str, Any]:
    return dict(content_of(session.running.http.get(f"{session.url}/timeseries", params=query)))


def assert_one_axis(session: Recording) -> None:
    until(lambda: get_overview(session)["duration_s"] >= END_S - SOON_S - LAG_S)
    whole = get_overview(session)
    assert whole["duration_s"] == pytest.approx(END_S, abs=SOON_S + LAG_S)
    assert [part["by"] for part in whole["time_axis"]] == ["node", "server"]
    assert (np.diff(whole["columns"]["t_first_s"]) > 0).all()
    for points in (1, 1000):
        later = get_overview(session, start_s=BEGIN_S - 1, end_s=BEGIN_S + 0.1, points=points)
        assert set(later["columns"]["part"]) == {1}
        assert min(later["columns"]["t_first_s"]) == pytest.approx(BEGIN_S, abs=SOON_S)
    names = "part,time_s,t_ns,seq"
    rows = read_rows(session, columns=names)
    assert np.diff(np.array(rows["time_s"], float)).min() > 0
    later = read_rows(session, columns=names, start_s=BEGIN_S - 1)
    assert later["seq"] == [str(i) for i in range(SECOND)]
    assert read_rows(session, columns=names, end_s=BEGIN_S - 1)["part"] == ["0"] * FIRST
    # The node's own time stays as it was.
    assert np.diff(np.array(rows["t_ns"], dtype=np.int64)).max() > WRONG_NS


def test_a_sealed_session_has_one_time_axis(dated: Recording) -> None:
    assert_one_axis(dated)
    streams = dated.clock()["streams"]
    assert [stream["stretches"][0]["offset_ns"] for stream in streams] == [WRONG_NS, 0]
    t_server_ns = np.array(read_rows(dated, clock="server")["t_server_ns"], np.int64)
    gap_s = np.diff(t_server_ns).max() * 1e-9
    assert gap_s == pytest.approx((GAP_NS + PERIOD_NS) * 1e-9, abs=SOON_S)
    url = f"{dated.url}/data?format=csv&start_s={END_S + 10}"
    answer = dated.running.http.get(url)
    assert_refused(answer, 422, f"ends at {END_S:.3f}"[:-1])
    load = read_load_to_emulate(dated.folder / "frames.parquet")
    assert np.diff(load.time_s).max() == pytest.approx((GAP_NS + PERIOD_NS) * 1e-9, abs=SOON_S)


@pytest.mark.parametrize("at_s", [0.1, BEGIN_S + 0.1])
def test_a_marker_is_at_a_frame_of_its_own_part(dated: Recording, at_s: float) -> None:
    rows = read_rows(dated, clock="server", columns="part,time_s,t_server_ns")
    row = int(np.argmin(np.abs(np.array(rows["time_s"], float) - at_s)))
    marker = {"label": "here", "t_ns": int(rows["t_server_ns"][row])}
    answer = dated.running.http.post(f"{dated.url}/markers", json=marker)
    assert answer.status_code == 201
    part = {"start_s": max(0.0, at_s - 0.05), "end_s": at_s + 0.05}
    marked = read_rows(dated, columns="part,time_s,marker", **part)
    (at,) = [i for i, label in enumerate(marked["marker"]) if label]
    assert marked["part"][at] == rows["part"][row]
    assert float(marked["time_s"][at]) == pytest.approx(float(rows["time_s"][row]), abs=1e-6)


@pytest.mark.parametrize("to", ["c3d", "opensim", "mcap", "xdf", "mat"])
def test_no_format_fills_the_years_between(dated: Recording, to: str) -> None:
    frames = GAP_NS // PERIOD_NS + FIRST + SECOND
    options = {"long_gap": "end"} if to == "opensim" else {}
    for clock in ("node", "server"):
        assert len(dated.data(format=to, clock=clock, **options).content) < 400 * frames + 100_000


def test_clients_have_both_clocks(dated: Recording, tmp_path: Path) -> None:
    with foottile.connect(dated.running.url) as server:
        later = server.session(dated.id).open("part", start_s=BEGIN_S - 1, clock="server")
        assert set(later["part"]) == {1}
        part = Slice(BEGIN_S - 1, None, ("time_s", "t_server_ns"))
        pulled = pull_export(server, dated.id, tmp_path, part, get_format("csv"), clock="server")
    rows = list(csv.DictReader(io.StringIO(Path(pulled["path"]).read_text())))
    assert len(rows) == SECOND
    steps = np.diff([int(row["t_server_ns"]) for row in rows])
    assert (np.abs(steps - PERIOD_NS) < 10_000).all()


def test_parts_without_samples_are_joined(node: FakeNode) -> None:
    session = record_parts(node, is_measured=False)
    length_s = (FIRST + SECOND - 1) * PERIOD_NS * 1e-9
    until(lambda: get_overview(session)["duration_s"] >= length_s - LAG_S)
    whole = get_overview(session)
    assert [part["by"] for part in whole["time_axis"]] == ["node", "joined"]
    assert whole["duration_s"] == pytest.approx(length_s, abs=LAG_S)
