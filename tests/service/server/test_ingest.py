"""A node's connection: what is acknowledged is on disk, and who says nonsense is let go alone."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import struct
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed

import service.server
import service.server.ingest
import service.server.nodes
import service.server.streams
import storage.journal.segment
from devices.frames import FrameBatch
from service.link import INGEST_PATH, MESSAGE_BYTES_MAX
from storage.intervals import Intervals
from storage.journal.journal import Journal
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.process import Start
from tests.service.running import Running, closed
from tests.waiting import until


def read_all(journal: Journal) -> FrameBatch:
    return FrameBatch.concatenate(list(journal.read(0, 2**61)))


def assert_goes_on(running: Running, healthy: FakeNode) -> None:
    """The server answers, and a node that was there all the time is taken in as before."""
    assert running.http.get("/health").json() == {"status": "ok"}
    healthy.send(20)
    healthy.acknowledged(healthy.seq - 1)


@pytest.fixture
def healthy(running: Running, node_of: NodeOf) -> FakeNode:
    """Another node, which does everything right."""
    node = node_of(running, "healthy")
    assert node.connect() == [(0, None)]
    node.deliver(20)
    return node


def test_a_new_node_is_asked_for_everything(node: FakeNode) -> None:
    assert node.connect() == [(0, None)]


def test_a_new_node_is_not_asked_for_what_it_has_forgotten(node: FakeNode) -> None:
    assert node.connect(held=((500, 899),), next_seq=900) == [(500, None)]


def test_what_is_acknowledged_is_readable_from_disk(running: Running, node: FakeNode) -> None:
    node.connect()
    sent = node.deliver(300)
    assert node.acked == Intervals([(0, 299)])
    assert_same_bits(read_all(running.journal(node.boot_id)), sent)


def test_nothing_is_acknowledged_before_it_is_synced(
    node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, may_sync = threading.Event(), threading.Event()
    sync = Journal.sync

    def gated(journal: Journal) -> None:
        asked.set()
        assert may_sync.wait(20.0)
        sync(journal)

    monkeypatch.setattr(Journal, "sync", gated)
    try:
        node.connect()
        node.send(100)
        assert asked.wait(5.0)
        node.socket.send('{"type":"probe","id":7}')
        assert node.receive("probe").id == 7
        assert not node.acked
    finally:
        may_sync.set()
    node.acknowledged(99)


def test_frames_that_come_during_a_sync_wait_for_the_next_one(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, may_sync = threading.Event(), threading.Event()
    sync = Journal.sync

    def gated(journal: Journal) -> None:
        if not asked.is_set():
            asked.set()
            assert may_sync.wait(20.0)
        sync(journal)

    monkeypatch.setattr(Journal, "sync", gated)
    try:
        node.connect()
        node.send(10)
        assert asked.wait(5.0)
        node.send(10)
        until(lambda: running.node()["last_seq"] == 19)
    finally:
        may_sync.set()
    first = node.receive("ack")
    assert (first.seq_first, first.seq_last) == (0, 9)
    node.acknowledged(19)


def test_a_node_that_comes_back_goes_on_where_the_server_is(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(100)
    node.leave()
    node.frames(50)  # taken while it was away
    assert node.connect() == [(100, None)]
    node.send_again(node.sent[1])
    node.deliver(30)
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())
    assert running.node()["lost_frames"] == 0


def test_frames_that_are_sent_twice_are_held_once_and_acknowledged_again(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    sent = node.deliver(100)
    node.acked = Intervals()
    node.send_again(sent.rows(55, 100))
    node.acknowledged(99, first=55)
    assert_same_bits(read_all(running.journal(node.boot_id)), sent)


def test_a_gap_is_asked_for_at_the_next_connection(running: Running, node: FakeNode) -> None:
    node.connect()
    node.send(40)
    gap = node.frames(25)
    node.send(35)
    node.acknowledged(99, first=65)
    node.leave()
    assert node.connect() == [(40, 64), (100, None)]
    node.send_again(gap)
    node.acknowledged(99)
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())


def test_after_a_restart_the_server_lacks_exactly_the_rest(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(200)
    running.restart()
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())
    assert node.connect() == [(200, None)]
    node.deliver(50)
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())


def test_a_server_that_goes_down_says_so_to_its_nodes(running: Running, node: FakeNode) -> None:
    node.connect()
    node.send(10)
    running.stop()
    code, _ = closed(node.socket)
    assert code in (1001, 1012)


def test_a_server_that_ends_closes_its_journals(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(10)
    running.stop()
    assert running.open_journals == []


def test_a_killed_server_has_every_frame_that_it_acknowledged(
    running: Running,
    node_of: NodeOf,
    foottile: Start,
    tmp_path: Path,
) -> None:
    data = tmp_path / "killed"
    process = foottile("serve", "--port", 0, "--data", data)
    line = process.said("FootTile is at ")
    port = re.search(r"127\.0\.0\.1:(\d+)/", line)
    assert port is not None, line
    running.stop()
    running.port = int(port[1])
    node = node_of(running)
    node.connect()
    with Play(node):
        while node.acked.count < 400:
            node.receive("ack")
        os.kill(process.pid, signal.SIGKILL)
        with suppress(ConnectionClosed):
            while node.receive("ack", timeout_s=5.0):
                pass
    assert process.ended(5.0) == -signal.SIGKILL
    copy = tmp_path / "copy"
    shutil.copytree(data / "journal" / "bench" / node.boot_id, copy)
    journal = Journal.open(copy)
    assert not (node.acked - journal.held)
    held = journal.held.last
    assert held is not None
    found, sent = read_all(journal), node.all_sent()
    assert_same_bits(found, sent.rows(0, held + 1))
    # What it held is what it does not ask for when it runs again.
    running.port = 0
    running.data = data
    running.start()
    assert node.connect() == [(held + 1, None)]


def test_a_probe_is_answered_with_the_servers_clock(node: FakeNode) -> None:
    node.connect()
    before_ns = time.time_ns()
    node.socket.send('{"type":"probe","id":3}')
    answer = node.receive("probe")
    assert answer.id == 3
    assert before_ns <= answer.server_t_ns <= time.time_ns()


def test_a_clock_row_and_counts_of_a_node_are_shown(running: Running, node: FakeNode) -> None:
    node.connect()
    node.send(10)
    node.say_clock(-77, uncertainty_ns=12)
    node.socket.send('{"type":"status","missed_slots":4}')
    until(lambda: running.node()["missed_slots"] == 4)
    assert running.node()["clock"] == {"server_minus_node_ns": -77, "uncertainty_ns": 12}


@pytest.mark.parametrize("offered", [None, ["foottile.v2"], ["chat", "foottile.v0"]])
def test_another_subprotocol_is_refused(
    running: Running, healthy: FakeNode, offered: list[str] | None
) -> None:
    with running.socket(INGEST_PATH, subprotocols=offered) as socket:
        assert socket.subprotocol is None
        code, reason = closed(socket)
    assert code == 4002
    assert "foottile.v1" in reason
    assert_goes_on(running, healthy)


def test_another_protocol_number_is_refused(
    running: Running, healthy: FakeNode, node: FakeNode
) -> None:
    node.open().send('{"type":"hello","protocol":1,"first_seq":0}')  # with fields of its own
    code, reason = closed(node.socket)
    assert (code, reason) == (4002, "protocol 1; this server speaks 2: update the node")
    assert running.http.get("/nodes/bench").status_code == 404
    assert_goes_on(running, healthy)


@pytest.mark.parametrize(
    "first",
    [
        b"\0\1\2",
        "",
        "hello",
        "null",
        "[]",
        "[" * 100_000,
        '{"type":"hello"}',
        '{"type":"goodbye"}',
        '{"type":"probe","id":1}',
        '{"type":"hello","protocol":2,"array_info":null}',
        '{"type":"hello","😀":1}',
    ],
    ids=lambda first: repr(first[:30]),
)
def test_whoever_does_not_say_hello_first_is_let_go(
    running: Running, healthy: FakeNode, node: FakeNode, first: str | bytes
) -> None:
    node.open().send(first)
    code, reason = closed(node.socket)
    assert code == 4001
    assert reason
    assert_goes_on(running, healthy)


@pytest.mark.parametrize(
    "change",
    [
        {"held": [[-1, 5]]},
        {"held": [[0, 2**62]]},
        {"held": [[0]]},
        {"lost": {"Evicted!": [[0, 1]]}},
        {"earlier": [{}]},
        {"next_seq": 1.5},
        {"protocol": "one"},
        {"surprise": 1},
        {"calibration": {"version": 1}},
        {"scene": []},
    ],
    ids=str,
)
def test_a_malformed_hello_is_refused_with_the_place(
    running: Running, healthy: FakeNode, node: FakeNode, change: dict[str, Any]
) -> None:
    hello = json.loads(node.hello().model_dump_json()) | change
    node.open().send(json.dumps(hello))
    code, reason = closed(node.socket)
    assert code == 4001
    assert next(iter(change)) in reason
    assert_goes_on(running, healthy)


@pytest.mark.parametrize(
    "name", ["../outside", "..", ".", "", "a/b", "a\\b", "a\0b", ".hidden", "x" * 65, "naïve"]
)
def test_a_name_that_is_no_folders_name_is_refused(
    running: Running, node: FakeNode, name: str
) -> None:
    info = node.info.model_copy(update={"node": name})
    node.open().send(node.hello(array_info=info).model_dump_json())
    code, _ = closed(node.socket)
    assert code == 4001
    assert running.http.get("/nodes").json()["items"] == []
    assert not (running.data / "outside").exists()
    assert not (running.data / "nodes").exists()


@pytest.mark.parametrize("boot_id", ["../x", "", "0" * 31, "G" * 32, "0" * 32 + "/.."])
def test_a_boot_id_that_is_no_folders_name_is_refused(
    running: Running, node: FakeNode, boot_id: str
) -> None:
    info = node.info.model_copy(update={"boot_id": boot_id})
    node.open().send(node.hello(array_info=info).model_dump_json())
    code, _ = closed(node.socket)
    assert code == 4001
    assert running.http.get("/nodes").json()["items"] == []


def test_a_node_without_tiles_is_refused(running: Running, node: FakeNode) -> None:
    info = node.info.model_copy(update={"tiles": ()})
    node.open().send(node.hello(array_info=info).model_dump_json())
    code, reason = closed(node.socket)
    assert code == 4001
    assert "no tiles" in reason
    assert running.http.get("/nodes").json()["items"] == []


def _backwards(node: FakeNode, payload: bytes) -> bytes:
    batch = node.sent[-1]
    return bytes(node.payload(FrameBatch.concatenate([batch.rows(5, 10), batch.rows(0, 5)])))


def _endless(_: FakeNode, payload: bytes) -> bytes:
    # The message's length says 2 GiB.
    return payload[:4] + struct.pack("<i", 2**31 - 1) + payload[8:]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda _, payload: b"",
        lambda _, payload: b"\0",
        lambda _, payload: payload[: len(payload) // 2],
        lambda _, payload: payload[:-1],
        lambda _, payload: payload[8:],
        lambda _, payload: np.random.default_rng(3).bytes(len(payload)),
        lambda _, payload: b"\xff" * 4 + np.random.default_rng(4).bytes(len(payload)),
        _backwards,
        _endless,
    ],
    ids=["empty", "one", "half", "all-but-one", "headless", "random", "marked", "order", "endless"],
)
def test_a_binary_message_that_is_no_frames_is_refused(
    running: Running,
    healthy: FakeNode,
    node: FakeNode,
    spoil: Callable[[FakeNode, bytes], bytes],
) -> None:
    node.connect()
    node.send(10)
    payload = node.payload(node.frames(10))
    node.socket.send(spoil(node, payload))
    code, reason = closed(node.socket)
    assert code == 4004
    assert "bench" in reason
    assert_goes_on(running, healthy)
    assert node.connect() == [(10, None)]
    node.send_again(node.sent[-1])
    node.acknowledged(19, first=10)


def test_a_binary_message_with_flipped_bits_harms_nobody(
    running: Running, healthy: FakeNode, node: FakeNode
) -> None:
    random = np.random.default_rng(7)
    for _ in range(40):
        node.reboot()
        node.connect()
        spoilt = bytearray(node.payload(node.frames(10)))
        spoilt[random.integers(0, 400)] ^= 1 << int(random.integers(8))  # in its description
        node.socket.send(bytes(spoilt))
        with suppress(ConnectionClosed):
            node.socket.send("no JSON")  # it is hung up on in any case
        code, _ = closed(node.socket)
        assert code == 4004
    assert_goes_on(running, healthy)


@pytest.mark.parametrize("message", ["x" * (MESSAGE_BYTES_MAX + 1), b"x" * (MESSAGE_BYTES_MAX + 1)])
def test_a_message_of_more_than_a_mebibyte_is_refused(
    running: Running, healthy: FakeNode, node: FakeNode, message: str | bytes
) -> None:
    node.connect()
    node.socket.send(message)
    code, _ = closed(node.socket)
    assert code == 1009
    assert_goes_on(running, healthy)


@pytest.mark.parametrize("message", ["{", '{"type":"ack"}', '{"type":"probe","id":-1}', "\0"])
def test_a_text_message_that_is_none_is_refused(
    running: Running, healthy: FakeNode, node: FakeNode, message: str
) -> None:
    node.connect()
    node.socket.send(message)
    code, _ = closed(node.socket)
    assert code == 4004
    assert_goes_on(running, healthy)


def test_a_second_hello_is_refused(running: Running, healthy: FakeNode, node: FakeNode) -> None:
    node.connect()
    node.socket.send(node.hello().model_dump_json())
    code, reason = closed(node.socket)
    assert (code, reason) == (4004, "hello was said before")
    assert_goes_on(running, healthy)


def test_a_name_that_is_in_use_is_refused_by_name(
    running: Running, node: FakeNode, node_of: NodeOf
) -> None:
    node.connect()
    node.send(10)
    other = node_of(running)  # the same name, another boot
    other.open().send(other.hello().model_dump_json())
    code, reason = closed(other.socket)
    assert code == 4009
    assert "'bench'" in reason
    assert "--name" in reason
    assert running.node()["boot_id"] == node.boot_id
    assert_goes_on(running, node)


def test_the_same_stream_again_takes_the_place_of_its_older_connection(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    older = node.socket
    assert node.connect() == [(10, None)]
    code, _ = closed(older)
    assert code == 4010
    node.deliver(10)
    assert running.node()["connected"]


def test_a_node_that_has_left_may_come_back_with_another_boot(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    node.leave()
    node.reboot()
    assert node.connect() == [(0, None)]
    assert running.node()["boot_id"] == node.boot_id
    node.deliver(10)


@pytest.mark.parametrize("greeted", [False, True])
def test_a_node_that_says_nothing_is_let_go(
    running: Running,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    greeted: bool,
) -> None:
    monkeypatch.setattr(service.server.ingest, "SILENCE_S", 0.3)
    if greeted:
        node.connect()
    else:
        node.open()
    code, reason = closed(node.socket)
    assert code == 4005
    assert "0.3 s" in reason
    if greeted:
        until(lambda: not running.node()["connected"])
    assert running.http.get("/health").status_code == 200


def test_a_node_that_is_cut_off_is_away(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(10)
    node.socket.socket.shutdown(2)
    until(lambda: not running.node()["connected"])
    assert node.connect() == [(10, None)]


def test_frames_that_a_full_disk_does_not_take_are_asked_for_when_it_does(
    running: Running,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    write_all = storage.journal.segment.write_all
    check_storage = running.server.check_storage
    full = threading.Event()

    def refusing(file: Any, data: bytes) -> None:
        if full.is_set():
            raise OSError(28, "No space left on device")
        write_all(file, data)

    def check() -> None:
        if full.is_set():
            from devices.errors import StorageError

            raise StorageError("No space left on device")
        check_storage()

    monkeypatch.setattr(storage.journal.segment, "write_all", refusing)
    monkeypatch.setattr(running.server, "check_storage", check)
    node.connect()
    node.tared()
    node.acknowledged(69)
    with running.socket("/api/v1/live?rate_hz=60") as live:
        full.set()
        lost = node.send(30, 20.0)
        until(lambda: running.node()["storage_problem"])
        assert "No space left" in running.node()["storage_problem"]
        shown = -1
        while shown < 90:  # all but those that wait for their look-ahead
            message = json.loads(live.recv(timeout=5.0))
            shown = message["seq"] if message["type"] == "frame" else shown
        assert message["force_n"] == pytest.approx([20.0, 20.0], abs=0.5)
        node.socket.send('{"type":"probe","id":1}')
        node.receive("probe")
        assert node.acked == Intervals([(0, 69)])
        assert running.journal(node.boot_id).held == Intervals([(0, 69)])
    full.clear()
    code, _ = closed(node.socket)
    assert code == 1012
    until(lambda: not running.node()["connected"])
    assert node.connect() == [(70, None)]
    node.send_again(lost)
    node.deliver(10, 20.0)
    assert running.node()["storage_problem"] is None
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())


def test_one_message_that_a_full_disk_did_not_take_is_asked_for_again(
    running: Running,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # Space is there again before the server's next tick has seen that there was none.
    write_all = storage.journal.segment.write_all
    node.connect()
    node.deliver(10)
    lost = node.frames(10)
    refused = node.payload(lost)

    def refusing(file: Any, data: bytes) -> None:
        if data == refused:
            raise OSError(28, "No space left on device")
        write_all(file, data)

    monkeypatch.setattr(service.server.server, "TICK_S", 0.5)
    node.send(10)
    node.acknowledged(29, first=20)  # the next tick is half a second away
    monkeypatch.setattr(storage.journal.segment, "write_all", refusing)
    node.send_again(lost)
    node.send(10)
    until(lambda: running.node()["last_seq"] == 39)
    monkeypatch.setattr(storage.journal.segment, "write_all", write_all)
    code, _ = closed(node.socket)
    assert code == 1012
    assert node.connect() == [(10, 19), (40, None)]


def test_a_disk_that_refuses_to_sync_acknowledges_nothing(
    running: Running,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from devices.errors import StorageError

    sync = Journal.sync
    broken = threading.Event()

    def refusing(journal: Journal) -> None:
        if broken.is_set():
            broken.clear()
            raise StorageError("Input/output error")
        sync(journal)

    monkeypatch.setattr(Journal, "sync", refusing)
    node.connect()
    broken.set()
    node.send(20)
    code, _ = closed(node.socket)
    assert code == 1012
    assert not node.acked
    # Whatever it is asked for now, in the end everything has to be acknowledged.
    for first, last in node.connect():
        if last is None:
            node.send_again(node.all_sent().rows(first, 20)) if first < 20 else None
    node.deliver(10)
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())


def test_what_was_held_and_not_acknowledged_is_so_at_the_next_connection(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A node forgets nothing that is not acknowledged, so it must not wait for it for ever.
    node.connect()
    node.deliver(10)
    monkeypatch.setattr(service.server.server, "TICK_S", 0.5)
    node.send(10)
    node.acknowledged(19)  # the next tick is half a second away
    node.send(10)
    until(lambda: running.node()["last_seq"] == 29)
    node.socket.socket.shutdown(2)
    until(lambda: not running.node()["connected"])
    assert not node.acked.within(20, 29)
    for first, _ in node.connect():
        if first == 20:
            node.send_again(node.sent[-1])
    node.deliver(10)


def test_what_was_held_at_a_restart_is_acknowledged_at_the_next_connection(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.send(20)
    running.stop()  # perhaps before the tick that would have acknowledged it
    node.acked = Intervals()
    running.start()
    [(first, _)] = node.connect()
    if first < 20:
        node.send_again(node.sent[-1].rows(first, 20))
    node.deliver(10)


# What a hostile tester found


def test_a_node_that_goes_before_it_is_welcomed_leaves_its_name_free(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    from starlette.websockets import WebSocket

    send_text = WebSocket.send_text
    gone = threading.Event()

    async def failing(socket: WebSocket, data: str) -> None:
        if '"welcome"' in data and not gone.is_set():
            gone.set()
            raise RuntimeError("the peer has gone")
        await send_text(socket, data)

    monkeypatch.setattr(WebSocket, "send_text", failing)
    node.open()
    node.socket.send(node.hello().model_dump_json())
    until(gone.is_set)
    until(lambda: not running.node()["connected"])
    node.reboot()
    assert node.connect() == [(0, None)]


def test_what_a_node_says_is_followed_although_it_cannot_be_written_down(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    from devices.errors import StorageError

    node.connect()
    node.deliver(10)
    node.leave()
    node.reboot()
    node.tiles += 1
    full = threading.Event()
    full.set()
    keep = service.server.nodes.Node.keep

    def refusing(kept: service.server.nodes.Node) -> None:
        if full.is_set():
            raise StorageError("No space left on device")
        keep(kept)

    monkeypatch.setattr(service.server.nodes.Node, "keep", refusing)
    node.connect()
    shown = running.node()
    assert len(shown["tiles"]) == node.tiles
    calibration = node.hello().calibration
    assert calibration is not None
    assert shown["calibration"]["id"] == calibration.id
    full.clear()


def test_what_could_not_be_synced_is_sent_again(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    broken = threading.Event()
    broken.set()
    fsync = os.fsync

    def failing(descriptor: int) -> None:
        if broken.is_set() and "arrows" in os.readlink(f"/proc/self/fd/{descriptor}"):
            broken.clear()
            raise OSError(5, "Input/output error")
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", failing)
    lost = node.send(10)
    assert closed(node.socket)[0] == 1012
    assert node.connect() == [(10, None)]
    node.send_again(lost)
    node.acknowledged(19)
    running.restart()
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())


def test_a_disk_that_was_full_from_the_first_frame_on_is_tried_again(
    running: Running,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from devices.errors import StorageError

    def refuse(*_: object) -> None:
        raise StorageError("No space left on device")

    monkeypatch.setattr(service.server.streams, "Journal", refuse)  # not even a folder
    monkeypatch.setattr(running.server, "check_storage", refuse)
    node.connect()
    node.send(10)
    until(lambda: running.node()["storage_problem"] is not None)
    monkeypatch.setattr(service.server.streams, "Journal", Journal)
    monkeypatch.setattr(running.server, "check_storage", lambda: None)
    assert closed(node.socket)[0] == 1012
    assert node.connect() == [(0, None)]


def test_what_another_version_wrote_of_a_node_does_not_keep_the_server_from_starting(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    running.stop()
    path = running.data / "nodes" / "bench" / "hello.json"
    path.write_text('{"type":"hello","protocol":1,"first_seq":0}')
    running.start()
    assert running.http.get("/nodes").json()["items"] == []
    assert node.connect() == [(10, None)]


@pytest.mark.parametrize(
    "message",
    [
        {"type": "stream", "boot_id": "f" * 32},
        {"type": "stream", "boot_id": "../x"},
        {"type": "lost", "boot_id": "f" * 32, "lost": {}},
        {"type": "lost", "boot_id": None, "lost": {"evicted": [[5, 4]]}},
    ],
    ids=str,
)
def test_a_stream_that_was_not_announced_is_refused(
    running: Running,
    healthy: FakeNode,
    node: FakeNode,
    message: dict[str, Any],
) -> None:
    node.connect()
    boot_id = message["boot_id"] or node.boot_id
    node.socket.send(json.dumps(message | {"boot_id": boot_id}))
    code, _ = closed(node.socket)
    assert code == 4004
    assert_goes_on(running, healthy)


@pytest.mark.parametrize("what", ["name", "tiles", "twice", "held"])
def test_earlier_streams_that_cannot_be_are_refused(
    running: Running, healthy: FakeNode, node: FakeNode, what: str
) -> None:
    node.reboot()
    [before] = node.before
    changes: dict[str, dict[str, Any]] = {
        "name": {"node": "other"},
        "tiles": {"tiles": ()},
        "twice": {"boot_id": node.boot_id},
        "held": {},
    }
    held = ((5, 4),) if what == "held" else ()
    said = before.said(array_info=before.info.model_copy(update=changes[what]), held=held)
    node.open().send(node.hello(earlier=(said,)).model_dump_json())
    assert closed(node.socket)[0] == 4001
    assert_goes_on(running, healthy)


def test_frames_of_an_earlier_stream_are_held_to_its_own_description(
    running: Running, node: FakeNode
) -> None:
    node.frames(20)
    node.reboot()
    node.tiles = 3
    [before] = node.before
    node.connect(earlier=(before.said(),))
    node.send(10)
    node.send_earlier(before, 0, 19)
    node.deliver(10)
    assert_same_bits(read_all(running.journal(node.boot_id)), node.all_sent())
    assert_same_bits(read_all(running.journal(before.boot_id)), before.sent[0])
    assert running.node()["last_seq"] == 19
    node.socket.send(json.dumps({"type": "stream", "boot_id": before.boot_id}))
    node.socket.send(node.payload(node.frames(10)))  # of three tiles
    assert closed(node.socket)[0] == 4004
