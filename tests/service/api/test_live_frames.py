"""The live websocket for programs: every frame once, as Arrow; what is missing is said."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

import service.api.routes.sockets.live
import service.server.live_feed.buffer
from tests.service.api.test_calibrations import assign, stiffer
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed
from tests.waiting import PATIENCE_S, until

LIVE = "/api/v1/live?format=arrow"


@dataclass
class Taken:
    """What came on a live socket, in order."""

    socket: ClientConnection
    said: list[dict[str, Any]] = field(default_factory=list)
    batches: list[tuple[str, Any]] = field(default_factory=list)
    """With the stream each is of."""
    stream_id: str = ""
    schema: Any = None

    def next(self) -> Any:
        message = self.socket.recv(timeout=PATIENCE_S)
        if isinstance(message, str):
            self.said.append(json.loads(message))
            if self.said[-1]["type"] == "stream":
                self.stream_id, self.schema = self.said[-1]["stream_id"], None
            return self.said[-1]
        if self.schema is None:
            self.schema = pa.ipc.read_schema(pa.py_buffer(message))
            return self.next()
        batch = pa.ipc.read_record_batch(pa.py_buffer(message), self.schema)
        self.batches.append((self.stream_id, batch))
        return batch

    def until(self, seq: int, stream_id: str | None = None) -> Taken:
        """Take until this frame has come."""
        while not (
            self.batches
            and stream_id in (None, self.batches[-1][0])
            and self.batches[-1][1]["seq"][-1].as_py() >= seq
        ):
            self.next()
        return self

    def until_said(self, kind: str) -> dict[str, Any]:
        while True:
            message = self.next()
            if isinstance(message, dict) and message["type"] == kind:
                return message

    def table(self, stream_id: str | None = None) -> Any:
        return pa.Table.from_batches([b for of, b in self.batches if stream_id in (None, of)])

    @property
    def seqs(self) -> list[int]:
        return [seq for _, batch in self.batches for seq in batch["seq"].to_pylist()]


def take(running: Running, query: str = "") -> Taken:
    return Taken(running.socket(LIVE + query))


def differing(a: Any, b: Any) -> dict[str, list[int]]:
    """Columns whose bits differ, nulls included, and in which frames; empty if there are none."""
    assert a["seq"].to_pylist() == b["seq"].to_pylist()
    found = {}
    for name in a.column_names:
        pairs = zip(a[name].to_pylist(), b[name].to_pylist(), strict=True)
        rows = [seq for seq, (x, y) in zip(a["seq"].to_pylist(), pairs, strict=True) if x != y]
        if rows and name != "recomputed":
            found[name] = rows
    return found


def test_every_frame_comes_once_with_its_estimates(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE) as socket:
        taken = Taken(socket)
        hello = taken.until_said("hello")
        sent = tared.send(100, [20.0, 60.0], alive=True)
        taken.until(tared.seq - 10)
    assert (hello["node"], hello["policy"], hello["protocol"]) == ("bench", "lossless", 1)
    table = taken.table()
    assert taken.seqs == list(range(taken.seqs[0], taken.seqs[-1] + 1))
    assert 60 <= taken.seqs[0] <= 70  # frames that waited for their look-ahead come, too
    assert not any(table["recomputed"].to_pylist())
    rows = table.slice(int(sent.seq[20]) - taken.seqs[0])
    assert np.median(rows["force_n_1"].to_numpy()) == pytest.approx(60.0, abs=0.05)
    assert np.median(rows["grf_n"].to_numpy()) == pytest.approx(80.0, abs=0.1)
    at = np.asarray(rows["seq"]) - int(sent.seq[0])
    assert rows["pressure_raw_0"].to_pylist() == sent.pressure_raw[at.astype(int), 0].tolist()
    assert rows.schema.field("grf_n").metadata[b"unit"] == b"N"
    info = json.loads(rows.schema.metadata[b"foottile.array_info"])
    assert info["stream_id"] == tared.stream_id


def test_only_columns_that_were_asked_for_come(running: Running, tared: FakeNode) -> None:
    with running.socket(LIVE + "&columns=cop_x_m,force_n_1,gauge_kpa&node=bench") as socket:
        taken = Taken(socket)
        taken.until_said("hello")
        tared.send(60, 20.0)
        taken.until(tared.seq - 10)
    assert taken.table().column_names == [
        *("seq", "t_ns", "cop_x_m", "force_n_1", "gauge_kpa_0", "gauge_kpa_1", "recomputed")
    ]


def test_messages_of_a_stream_behind_each_other_are_an_arrow_stream(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE + "&columns=grf_n") as socket:
        assert isinstance(socket.recv(timeout=PATIENCE_S), str)  # hello
        tared.send(100, 20.0)
        assert json.loads(socket.recv(timeout=PATIENCE_S))["type"] == "stream"
        content = b""
        while len(content) < 4000:
            message = socket.recv(timeout=PATIENCE_S)
            assert isinstance(message, bytes)
            content += message
    table = pa.ipc.open_stream(content).read_all()
    assert len(table) >= 10


@pytest.mark.parametrize(
    ("query", "said"),
    [
        ("&columns=grf_n,colour", "'colour'"),
        ("&columns=force_n_2", "'force_n_2'"),
        ("&policy=all", "policy='all'"),
        ("&policy=", "policy=''"),
        ("&stream_id=x", "32 hex digits"),
        ("&stream_id=" + "0" * 32, "no stream"),
        ("&from_seq=-1", "from_seq='-1'"),
        ("&from_seq=1e3", "from_seq='1e3'"),
        ("&from_seq=" + "9" * 400, "from_seq="),
        ("&node=nobody", "'nobody'"),
        ("&rate_hz=30", "'rate_hz'"),
        ("&colour=red", "'colour'"),
    ],
)
def test_a_query_that_is_none_closes_with_the_reason(
    running: Running, tared: FakeNode, query: str, said: str
) -> None:
    with running.socket(LIVE + query) as live:
        code, reason = closed(live)
    assert code == (4011 if "stream_id=0" in query else 1008)
    assert said in reason


def test_of_several_nodes_one_has_to_be_named(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    node_of(running, "other").connect()
    with running.socket(LIVE) as live:
        code, reason = closed(live)
    assert code == 1008
    assert "bench" in reason
    assert "other" in reason


def test_a_cut_and_a_resume_anywhere_give_the_same_bits_as_no_cut(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE) as socket, running.socket(LIVE) as other:
        whole, cut = Taken(socket), Taken(other)
        whole.until_said("hello")
        cut.until_said("hello")
        tared.send(40, [20.0, 60.0], alive=True)
        cut.until(tared.seq - 25)
        tared.send(160, [30.0, 50.0], alive=True)
        whole.until(tared.seq - 10)
    first, last = whole.seqs[0], whole.seqs[-1]
    parts = [cut.table()]
    at = cut.seqs[-1] + 1
    for n in (1, 7, 30, 33):  # in the middle of a piece, and at its edge
        with running.socket(f"{LIVE}&stream_id={tared.stream_id}&from_seq={at}") as socket:
            taken = Taken(socket).until(at + n - 1)
        parts.append(taken.table().slice(0, n))
        at += n
    with running.socket(f"{LIVE}&stream_id={tared.stream_id}&from_seq={at}") as socket:
        parts.append(Taken(socket).until(last).table())
    table = pa.concat_tables(parts)
    assert table["seq"].to_pylist()[: last - first + 1] == whole.seqs
    assert differing(table.slice(0, len(whole.seqs)), whole.table()) == {}


def test_what_memory_has_not_any_more_is_recomputed_to_the_same_bits(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running.socket(LIVE) as socket:
        whole = Taken(socket)
        whole.until_said("hello")
        memory = running.server.live_feeds.get_or_create("bench")
        tared.send(300, [20.0, 60.0], alive=True)
        whole.until(tared.seq - 10)
        monkeypatch.setattr(memory, "_bytes_max", 20_000)
        tared.send(300, [50.0, 10.0], alive=True)
        whole.until(tared.seq - 10)
    first = whole.seqs[0]
    with running.socket(f"{LIVE}&stream_id={tared.stream_id}&from_seq={first}") as socket:
        again = Taken(socket).until(whole.seqs[-1])
    assert again.seqs[: len(whole.seqs)] == whole.seqs
    table = again.table().slice(0, len(whole.seqs))
    assert sum(table["recomputed"].to_pylist()) > 300
    assert not table["recomputed"][-1].as_py()
    assert differing(table, whole.table()) == {}


def test_tare_and_calibration_are_in_force_from_the_frame_on_from_which_they_were_live(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running.socket(LIVE) as socket:
        whole = Taken(socket)
        whole.until_said("hello")
        tared.send(200, alive=True)
        tared.taken_in()
        assert running.http.post("/nodes/bench/tare").status_code == 201
        tared.send(100, 20.0, alive=True)
        tared.taken_in()
        assert assign(running, stiffer(*tared.info.serials)).status_code == 200
        tared.send(100, 20.0, alive=True)
        whole.until(tared.seq - 10)
    monkeypatch.setattr(running.server.live_feeds.get_or_create("bench"), "_bytes_max", 1)
    tared.send(10)
    tared.taken_in()
    first, last = whole.seqs[0], whole.seqs[-1]
    with running.socket(f"{LIVE}&stream_id={tared.stream_id}&from_seq={first}") as socket:
        again = Taken(socket).until(last)
    table = again.table().slice(0, len(whole.seqs))
    assert all(table["recomputed"].to_pylist())
    assert differing(table, whole.table()) == {}


def test_over_a_restart_of_the_server_no_frame_is_missing_and_none_comes_twice(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE) as socket:
        before = Taken(socket)
        before.until_said("hello")
        tared.deliver(100, 20.0)
        before.until(tared.seq - 30)
    running.restart()
    tared.connect()
    tared.send(50, 20.0)
    at = before.seqs[-1] + 1
    with running.socket(f"{LIVE}&stream_id={tared.stream_id}&from_seq={at}") as socket:
        after = Taken(socket).until(tared.seq - 10)
    seqs = before.seqs + after.seqs
    assert seqs == list(range(seqs[0], seqs[-1] + 1))
    assert [s["type"] for s in after.said] == ["hello", "stream"]
    assert after.table()["recomputed"][0].as_py()


def test_frames_that_come_late_over_a_broken_link_are_waited_for(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE) as socket:
        taken = Taken(socket)
        taken.until_said("hello")
        tared.send(30, 20.0)
        taken.until(tared.seq - 10)
        missed = tared.frames(50, 20.0)
        tared.send(50, 20.0)
        tared.taken_in()
        tared.send_again(missed)
        tared.send(10)
        taken.until(tared.seq - 15)
    assert taken.seqs == list(range(taken.seqs[0], taken.seqs[-1] + 1))
    assert {s["type"] for s in taken.said} == {"hello", "stream"}


def test_frames_that_will_not_come_are_said_to_be_lost_with_the_reason(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE) as socket:
        taken = Taken(socket)
        taken.until_said("hello")
        tared.send(30, 20.0)
        first = tared.seq
        tared.frames(50)
        tared.say_lost(disk_full=[[first, tared.seq - 1]])
        tared.send(50, 20.0)
        lost = taken.until_said("lost")
        taken.until(tared.seq - 10)
    assert lost == {
        "type": "lost",
        "stream_id": tared.stream_id,
        "from_seq": first,
        "to_seq": first + 49,
        "reason": "disk_full",
    }
    assert set(taken.seqs).isdisjoint(range(first, first + 50))


def test_a_node_that_is_switched_on_again_goes_on_with_its_new_stream(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE + "&columns=grf_n") as socket:
        taken = Taken(socket)
        taken.until_said("hello")
        tared.deliver(45, 20.0)
        before, last = tared.stream_id, tared.seq - 1
        tared.restart()
        tared.come_back()
        tared.send(60, 20.0)
        taken.until(tared.seq - 10, tared.stream_id)
    assert [s["stream_id"] for s in taken.said if s["type"] == "stream"] == [
        before,
        tared.stream_id,
    ]
    assert taken.table(before)["seq"][-1].as_py() == last  # its last 10 ms as well
    assert taken.table(tared.stream_id)["seq"][0].as_py() == 0
    assert not [s for s in taken.said if s["type"] == "lost"]


def test_a_lossless_client_that_does_not_read_is_told_from_where_to_resume(
    running: Running, node_of: NodeOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.api.routes.sockets.live, "TOO_SLOW_S", 0.05)
    wide = node_of(running, tiles=24)  # what kernels take in on the way is a few seconds of these
    wide.connect()
    wide.tared()
    with running.socket(LIVE, small=True, max_queue=1) as stalled:
        until(lambda: running.server.live_feeds.get_or_create("bench").reader_count)
        for _ in range(8):
            wide.send(500)
        wide.taken_in()
        with running.socket(LIVE + "&columns=grf_n") as other:
            wide.send(60)
            Taken(other).until(wide.seq - 10)
        taken = Taken(stalled)
        code, reason = _taken_until_closed(taken)
    assert code == 4008
    assert taken.seqs == list(range(taken.seqs[0], taken.seqs[-1] + 1))
    assert f"resume with stream_id={wide.stream_id}&from_seq={taken.seqs[-1] + 1}" in reason


def _taken_until_closed(taken: Taken) -> tuple[int, str]:
    with pytest.raises(ConnectionClosed) as end:
        taken.until(2**53)
    assert end.value.rcvd is not None
    return int(end.value.rcvd.code), end.value.rcvd.reason


def test_latest_and_drop_oldest_say_what_they_left_out(running: Running, tared: FakeNode) -> None:
    for policy in ("latest", "drop_oldest"):
        first = tared.seq
        tared.send(10)
        tared.frames(20)  # these are late
        tared.send(100, alive=True)
        tared.taken_in()
        query = f"&policy={policy}&from_seq={max(0, first - 20)}&columns=grf_n"
        with running.socket(LIVE + query) as socket:
            taken = Taken(socket)
            taken.until_said("hello")
            tared.send(30)
            taken.until(tared.seq - 10)
        left_out = [
            seq
            for said in taken.said
            if said["type"] == "dropped"
            for seq in range(said["from_seq"], said["to_seq"] + 1)
        ]
        everything = sorted([*taken.seqs, *left_out])
        assert everything == list(range(everything[0], everything[-1] + 1))
        assert len(taken.seqs) == len(set(taken.seqs))
