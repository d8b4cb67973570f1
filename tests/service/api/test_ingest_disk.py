"""Full and failing disks of a server: no frame is acknowledged that is not stored."""

from __future__ import annotations

import threading
import time

import pytest

import service.server.server
import service.server.streams
import storage.journal.segment_writer
from devices.errors import StorageError
from service.server.node import ServerNode
from storage.intervals import Intervals
from storage.journal.journal import Journal
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode
from tests.service.running import Running, closed, receive_live
from tests.storage.faulty_disk import (
    IO_ERROR,
    NO_SPACE,
    before_each_sync_of_frames,
    failing_if,
    failing_once,
    refusing,
)
from tests.waiting import PATIENCE_S, until

STORAGE_FULL = (StorageError, "No space left on device")


class Gate:
    """A method that waits until the gate opens."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, owner: type, name: str) -> None:
        self.reached, self.opened = threading.Event(), threading.Event()
        method = getattr(owner, name)

        def wait(it: object) -> None:
            self.reached.set()
            assert self.opened.wait(PATIENCE_S)
            method(it)

        monkeypatch.setattr(owner, name, wait)

    def __enter__(self) -> Gate:
        return self

    def __exit__(self, *_: object) -> None:
        self.opened.set()


def probe(node: FakeNode) -> None:
    """Wait until the server has answered the messages so far."""
    node.socket.send('{"type":"probe","id":7}')
    assert node.receive("probe").id == 7


def test_frames_are_acknowledged_after_their_sync(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Gate(monkeypatch, Journal, "sync") as gate:
        node.connect()
        node.send(10)
        assert gate.reached.wait(PATIENCE_S)
        node.send(10)
        node.taken_in()
        probe(node)
        assert not node.acked
    first = node.receive("ack")
    assert (first.seq_first, first.seq_last) == (0, 9)
    node.acknowledged(19)


def test_a_hello_is_stored_in_a_thread_before_its_frames_are_acknowledged(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = running.data / "nodes" / "bench" / "hello.json"
    with Gate(monkeypatch, ServerNode, "save_hello") as gate:
        node.connect()
        node.send(10)
        assert gate.reached.wait(PATIENCE_S)
        node.taken_in()
        assert not node.acked
        assert not path.exists()
    node.acknowledged(9)
    assert path.exists()


def test_a_full_disk_refuses_no_node_whose_stopped_session_becomes_ready(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    recording = node.record()
    node.deliver(20)
    first = node.seq
    node.frames(10)  # not sent, and lost on the node's disk later
    node.send(10)
    until(lambda: time.monotonic_ns() > node.next_t_mono_ns)
    recording.stop()
    node.send(10, now=True)
    until(lambda: recording.now()["parts"][-1]["seq_last"] is not None)
    node.leave()
    save = failing_if(lambda *_: True, running.server.sessions.save, *STORAGE_FULL)
    with monkeypatch.context() as full:
        full.setattr(running.server.sessions, "save", save)
        stored = ((0, first - 1), (first + 10, node.seq - 1))
        node.connect(stored=stored, lost={"disk_full": ((first, first + 9),)})
        node.send(10)
        node.taken_in()
        assert recording.now()["state"] == "pending"
    assert recording.sealed()["complete"] == "lossy"


def test_frames_that_a_full_disk_refuses_are_requested_again(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    full, segment = threading.Event(), storage.journal.segment_writer
    writes = failing_if(lambda *_: full.is_set(), segment.write_all_or_none, *NO_SPACE)
    check = failing_if(lambda *_: full.is_set(), running.server.check_writable, *STORAGE_FULL)
    monkeypatch.setattr(segment, "write_all_or_none", writes)
    monkeypatch.setattr(running.server, "check_writable", check)
    node.connect()
    node.tared()
    node.acknowledged(69)
    with running.socket("/api/v1/live?rate_hz=60") as live:
        full.set()
        refused = node.send(30, 20.0)
        until(lambda: running.node()["storage_problem"])
        assert "No space left" in running.node()["storage_problem"]
        message = receive_live(  # all but the look-ahead
            live, lambda message: message["type"] == "frame" and message["seq"] >= 90
        )
        assert message["force_n"] == pytest.approx([20.0, 20.0], abs=0.5)
        probe(node)
        assert node.acked == Intervals([(0, 69)])
        assert running.journal(node.stream_id).stored == Intervals([(0, 69)])
    full.clear()
    assert closed(node.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    assert node.connect() == [(70, None)]
    node.send_again(refused)
    node.deliver(10, 20.0)
    assert running.node()["storage_problem"] is None
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_a_disk_that_is_full_between_two_syncs_refuses_no_frame(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Received messages wait in memory for the next sync.
    full, segment = threading.Event(), storage.journal.segment_writer
    writes = failing_if(lambda *_: full.is_set(), segment.write_all_or_none, *NO_SPACE)
    node.connect()
    node.deliver(10)
    monkeypatch.setattr(service.server.server, "TICK_S", 0.5)
    node.send(10)
    node.acknowledged(19)  # the next tick is half a second away
    monkeypatch.setattr(segment, "write_all_or_none", writes)
    full.set()
    node.send(20)
    node.taken_in()
    full.clear()
    node.acknowledged(39)
    assert running.node()["storage_problem"] is None


def test_a_failed_sync_acknowledges_no_frame(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    with monkeypatch.context() as patch:
        before_each_sync_of_frames(patch, failing_once(lambda: None, *IO_ERROR))
        refused = node.send(10)
        assert closed(node.socket)[0] == 1012
    assert not node.acked.restricted_to(10, 19)
    assert node.connect() == [(10, None)]
    node.send_again(refused)
    node.acknowledged(19)
    fail_once = failing_once(Journal.sync, StorageError, "Input/output error")
    monkeypatch.setattr(Journal, "sync", fail_once)
    node.send(10)
    assert closed(node.socket)[0] == 1012
    assert not node.acked.restricted_to(20, 29)
    # Whatever the server requests, in the end it acknowledges every frame.
    for first, _ in node.connect():
        if first < 30:
            node.send_again(node.all_sent().slice_rows(first, 30))
    node.deliver(10)
    node.acknowledged(node.seq - 1)
    running.restart()
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_a_hello_counts_although_it_cannot_be_stored(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    node.restart()
    node.tiles += 1
    with monkeypatch.context() as patch:
        patch.setattr(ServerNode, "save_hello", refusing(*STORAGE_FULL))
        node.connect()
    shown, calibration = running.node(), node.hello().calibration
    assert len(shown["tiles"]) == node.tiles
    assert calibration is not None
    assert shown["calibration"]["id"] == calibration.id


def test_a_disk_that_is_full_from_the_first_frame_on_is_tried_again(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        # Not even a folder can be created.
        patch.setattr(service.server.streams, "Journal", refusing(*STORAGE_FULL))
        patch.setattr(running.server, "check_writable", refusing(*STORAGE_FULL))
        node.connect()
        node.send(10)
        until(lambda: running.node()["storage_problem"] is not None)
    assert closed(node.socket)[0] == 1012
    assert node.connect() == [(0, None)]
