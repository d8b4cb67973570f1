"""Live websocket for programs: every frame once, as Arrow, and every loss."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pydantic import TypeAdapter
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection

import service.api.routes.sockets.live
from service.protocol.live import FeedMessage
from tests.service.api.sealed import Sealed
from tests.service.api.test_calibrations import assign, stiffer
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed
from tests.waiting import PATIENCE_S, until

LIVE = "/api/v1/live?format=arrow"

FEED_MESSAGES: TypeAdapter[FeedMessage] = TypeAdapter(FeedMessage)


@dataclass
class Received:
    """Messages of a live socket, in order."""

    socket: ClientConnection
    texts: list[dict[str, Any]] = field(default_factory=list)
    batches: list[tuple[str, Any]] = field(default_factory=list)
    """Each with its stream."""
    stream_id: str = ""
    schema: Any = None

    def next(self) -> Any:
        message = self.socket.recv(timeout=PATIENCE_S)
        if isinstance(message, str):
            self.texts.append(json.loads(message))
            FEED_MESSAGES.validate_json(message, strict=True)
            if self.texts[-1]["type"] == "stream":
                self.stream_id, self.schema = self.texts[-1]["stream_id"], None
            return self.texts[-1]
        if self.schema is None:
            self.schema = pa.ipc.read_schema(pa.py_buffer(message))
            return self.next()
        batch = pa.ipc.read_record_batch(pa.py_buffer(message), self.schema)
        self.batches.append((self.stream_id, batch))
        return batch

    def until(self, seq: int, stream_id: str | None = None) -> Received:
        """Receive until this frame."""
        while not (
            self.batches
            and stream_id in (None, self.batches[-1][0])
            and self.batches[-1][1]["seq"][-1].as_py() >= seq
        ):
            self.next()
        return self

    def until_text(self, kind: str) -> dict[str, Any]:
        while True:
            message = self.next()
            if isinstance(message, dict) and message["type"] == kind:
                return message

    def list_texts(self, kind: str) -> list[dict[str, Any]]:
        return [text for text in self.texts if text["type"] == kind]

    def table(self, stream_id: str | None = None) -> Any:
        return pa.Table.from_batches([b for of, b in self.batches if stream_id in (None, of)])

    @property
    def seqs(self) -> list[int]:
        return [seq for _, batch in self.batches for seq in batch["seq"].to_pylist()]

    def assert_no_gap(self) -> None:
        assert self.seqs == list(range(self.seqs[0], self.seqs[-1] + 1))


@contextmanager
def subscribe(running: Running, query: str = "") -> Iterator[Received]:
    """Subscribe, and wait for the first message."""
    with running.socket(LIVE + query) as socket:
        received = Received(socket)
        received.until_text("hello")
        yield received


def resume(node: FakeNode, seq: int, last: int) -> Received:
    """Receive the frames of a node's stream from a number on."""
    query = f"&stream_id={node.stream_id}&from_seq={seq}"
    with node.running.socket(LIVE + query) as socket:
        return Received(socket).until(last)


def find_differences(a: Any, b: Any) -> dict[str, list[int]]:
    """Return columns whose bits differ, nulls included, and the frames."""
    assert a["seq"].to_pylist() == b["seq"].to_pylist()
    found = {}
    for name in set(a.column_names) - {"recomputed"}:
        pairs = zip(a[name].to_pylist(), b[name].to_pylist(), strict=True)
        rows = [seq for seq, (x, y) in zip(a["seq"].to_pylist(), pairs, strict=True) if x != y]
        if rows:
            found[name] = rows
    return found


def test_every_frame_comes_once_with_its_estimates(running: Running, tared: FakeNode) -> None:
    with subscribe(running) as received:
        sent = tared.send(100, [20.0, 60.0], alive=True)
        received.until(tared.seq - 10)
    (hello,) = received.list_texts("hello")
    assert (hello["node"], hello["policy"], hello["protocol"]) == ("bench", "lossless", 1)
    table = received.table()
    received.assert_no_gap()
    assert 60 <= received.seqs[0] <= 70  # frames in the look-ahead come, too
    assert not any(table["recomputed"].to_pylist())
    rows = table.slice(int(sent.seq[20]) - received.seqs[0])
    assert np.median(rows["force_n_1"].to_numpy()) == pytest.approx(60.0, abs=0.05)
    assert np.median(rows["grf_n"].to_numpy()) == pytest.approx(80.0, abs=0.1)
    at = np.asarray(rows["seq"]) - int(sent.seq[0])
    assert rows["pressure_raw_0"].to_pylist() == sent.pressure_raw[at.astype(int), 0].tolist()
    assert rows.schema.field("grf_n").metadata[b"unit"] == b"N"
    info = json.loads(rows.schema.metadata[b"foottile.array_info"])
    assert info["stream_id"] == tared.stream_id


def test_a_stream_has_the_requested_columns_and_is_an_arrow_stream(
    running: Running, tared: FakeNode
) -> None:
    with running.socket(LIVE + "&columns=cop_x_m,force_n_1,gauge_kpa&node=bench") as socket:
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
    assert table.column_names == [
        *("seq", "t_ns", "cop_x_m", "force_n_1", "gauge_kpa_0", "gauge_kpa_1", "recomputed")
    ]


@pytest.mark.parametrize(
    ("query", "word"),
    [
        ("columns=grf_n,colour", "'colour'"),
        ("columns=force_n_2", "'force_n_2'"),
        ("policy=all", "policy='all': expected lossless, drop_oldest, latest"),
        ("policy=", "policy=''"),
        ("stream_id=x", "stream_id='x': expected 32 hex digits"),
        ("stream_id=" + "0" * 32, "no stream"),
        ("from_seq=-1", "from_seq='-1': expected a frame's number, from 0"),
        *((f"from_seq={n}", "from_seq=") for n in ("1e3", "9" * 400, "1.0", "1_000", "%2B1", "-0")),
        ("node=nobody", "'nobody'"),
        ("rate_hz=30", "unknown parameter 'rate_hz'; known: format, policy, node, columns, "),
        ("colour=red", "'colour'"),
    ],
)
def test_a_wrong_query_closes_with_a_reason(sealed: Sealed, query: str, word: str) -> None:
    with sealed.running.socket(f"{LIVE}&{query}") as live:
        code, reason = closed(live)
    assert code == (4011 if word == "no stream" else 1008)
    assert word in reason


def test_one_of_several_nodes_has_to_be_named(
    running: Running, tared: FakeNode, node_of: NodeOf
) -> None:
    node_of(running, "other").connect()
    with running.socket(LIVE) as live:
        code, reason = closed(live)
    assert (code, "bench" in reason, "other" in reason) == (1008, True, True)


def test_a_stream_resumed_in_the_middle_of_a_piece_has_the_same_bits(
    running: Running, tared: FakeNode
) -> None:
    with subscribe(running) as whole:
        tared.send(40, [20.0, 60.0], alive=True)
        tared.send(160, [30.0, 50.0], alive=True)
        whole.until(tared.seq - 10)
    n = len(whole.seqs)
    for at in (1, 8, 45, n - 15):
        resumed = resume(tared, whole.seqs[at], whole.seqs[-1])
        table = resumed.table().slice(0, n - at)
        assert find_differences(table, whole.table().slice(at)) == {}, at


def test_recomputed_frames_have_the_bits_tares_and_calibrations_of_live_ones(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = running.server.live_feeds.get_or_create("bench")
    with subscribe(running) as whole:
        tared.send(200, alive=True)
        tared.taken_in()
        assert running.http.post("/nodes/bench/tare").status_code == 201
        tared.send(100, 20.0, alive=True)
        tared.taken_in()
        assert assign(running, stiffer(*tared.info.serials)).status_code == 200
        tared.send(100, [20.0, 60.0], alive=True)
        whole.until(tared.seq - 10)
        monkeypatch.setattr(feed, "_bytes_max", 20_000)
        tared.send(300, [50.0, 10.0], alive=True)
        whole.until(tared.seq - 10)
    again = resume(tared, whole.seqs[0], whole.seqs[-1])
    assert [text["type"] for text in again.texts] == ["hello", "stream"]
    table = again.table().slice(0, len(whole.seqs))
    assert sum(table["recomputed"].to_pylist()) > 410  # beyond tare and calibration
    assert not table["recomputed"][-1].as_py()
    assert find_differences(table, whole.table()) == {}


def test_lost_frames_are_reported(running: Running, tared: FakeNode) -> None:
    with subscribe(running) as received:
        tared.send(30, 20.0)
        first = tared.seq
        tared.frames(50)
        tared.say_lost(disk_full=[[first, tared.seq - 1]])
        tared.send(50, 20.0)
        lost = received.until_text("lost")
        received.until(tared.seq - 10)
    assert lost == {
        "type": "lost",
        "stream_id": tared.stream_id,
        "from_seq": first,
        "to_seq": first + 49,
        "reason": "disk_full",
    }
    assert set(received.seqs).isdisjoint(range(first, first + 50))


def test_a_restarted_node_continues_with_its_new_stream(running: Running, tared: FakeNode) -> None:
    with subscribe(running, "&columns=grf_n") as received:
        tared.deliver(45, 20.0)
        before, last = tared.stream_id, tared.seq - 1
        tared.restart()
        tared.come_back()
        tared.send(60, 20.0)
        received.until(tared.seq - 10, tared.stream_id)
    streams = [text["stream_id"] for text in received.list_texts("stream")]
    assert streams == [before, tared.stream_id]
    assert received.table(before)["seq"][-1].as_py() == last  # without a look-ahead
    assert received.table(tared.stream_id)["seq"][0].as_py() == 0
    assert not received.list_texts("lost")


def test_a_lossless_client_that_does_not_read_is_closed_with_its_position(
    running: Running, node_of: NodeOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(service.api.routes.sockets.live, "TOO_SLOW_S", 0.05)
    wide = node_of(running, tiles=64)  # its frames fill the buffers of any kernel
    wide.connect()
    wide.tared()
    with running.socket(LIVE, small=True, max_queue=1) as stalled:
        until(lambda: running.server.live_feeds.get_or_create("bench")._waiting)
        for _ in range(8):
            wide.send(500)
        wide.taken_in()
        with running.socket(LIVE + "&columns=grf_n") as other:
            wide.send(60)
            Received(other).until(wide.seq - 10)
        received = Received(stalled)
        with pytest.raises(ConnectionClosed) as end:
            received.until(2**53)
    assert end.value.rcvd is not None
    assert end.value.rcvd.code == 4008
    received.assert_no_gap()
    position = f"stream_id={wide.stream_id}&from_seq={received.seqs[-1] + 1}"
    assert f"resume with {position}" in end.value.rcvd.reason


@pytest.mark.parametrize("policy", ["latest", "drop_oldest"])
def test_a_lossy_policy_reports_dropped_frames(
    running: Running, tared: FakeNode, policy: str
) -> None:
    tared.send(10)
    tared.frames(20)  # these are late
    tared.send(100, alive=True)
    tared.taken_in()
    with subscribe(running, f"&policy={policy}&from_seq=50&columns=grf_n") as received:
        tared.send(30)
        received.until(tared.seq - 10)
    dropped = [
        seq
        for text in received.list_texts("dropped")
        for seq in range(text["from_seq"], text["to_seq"] + 1)
    ]
    every = sorted([*received.seqs, *dropped])
    assert every == list(range(every[0], every[-1] + 1))
    assert len(received.seqs) == len(set(received.seqs))
