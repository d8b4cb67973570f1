"""A server whose disk is full or failing acknowledges nothing that is not on it, and asks again."""

from __future__ import annotations

import json
import threading

import pytest

import service.api.routes.sockets.ingest
import service.server
import service.server.node
import service.server.streams
import storage.journal.segment_writer
from devices.errors import StorageError
from service.server.node import ServerNode
from storage.intervals import Intervals
from storage.journal.journal import Journal
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode
from tests.service.running import Running, closed
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


def gated_sync(monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Have the first sync wait: an event that says that it was asked for, and one that lets it."""
    asked, may_sync = threading.Event(), threading.Event()
    sync = Journal.sync

    def gated(journal: Journal) -> None:
        asked.set()
        assert may_sync.wait(20.0)
        sync(journal)

    monkeypatch.setattr(Journal, "sync", gated)
    return asked, may_sync


def test_nothing_is_acknowledged_before_it_is_synced(
    node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked, may_sync = gated_sync(monkeypatch)
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
    asked, may_sync = gated_sync(monkeypatch)
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


def test_frames_that_a_full_disk_does_not_take_are_asked_for_when_it_does(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = threading.Event()
    segment, is_full = storage.journal.segment_writer, lambda *_: full.is_set()
    writes = failing_if(is_full, segment.write_all_or_none, *NO_SPACE)
    check = failing_if(is_full, running.server.check_writable, *STORAGE_FULL)
    monkeypatch.setattr(segment, "write_all_or_none", writes)
    monkeypatch.setattr(running.server, "check_writable", check)
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
            message = json.loads(live.recv(timeout=PATIENCE_S))
            shown = message["seq"] if message["type"] == "frame" else shown
        assert message["force_n"] == pytest.approx([20.0, 20.0], abs=0.5)
        node.socket.send('{"type":"probe","id":1}')
        node.receive("probe")
        assert node.acked == Intervals([(0, 69)])
        assert running.journal(node.stream_id).stored == Intervals([(0, 69)])
    full.clear()
    assert closed(node.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    assert node.connect() == [(70, None)]
    node.send_again(lost)
    node.deliver(10, 20.0)
    assert running.node()["storage_problem"] is None
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_a_disk_that_is_full_between_two_syncs_has_refused_nothing(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Who takes messages in never writes: they wait in memory for the next sync.
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
    until(lambda: running.node()["last_seq"] == 39)
    full.clear()
    node.acknowledged(39)
    assert running.node()["storage_problem"] is None


def test_what_a_node_says_is_written_down_in_another_thread_before_its_frames_are_promised(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, may_go_on, keep = threading.Event(), threading.Event(), ServerNode.save_hello

    def slow(self: ServerNode) -> None:
        begun.set()
        assert may_go_on.wait(PATIENCE_S)
        keep(self)

    monkeypatch.setattr(ServerNode, "save_hello", slow)
    try:
        node.connect()
        node.send(10)
        assert begun.wait(PATIENCE_S)
        until(lambda: running.node()["last_seq"] == 9)  # the picture goes on meanwhile
        assert not node.acked
        assert not (running.data / "nodes" / "bench" / "hello.json").exists()
    finally:
        may_go_on.set()
    node.acknowledged(9)
    assert (running.data / "nodes" / "bench" / "hello.json").exists()


def test_a_disk_that_refuses_to_sync_acknowledges_nothing(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    broken = failing_once(Journal.sync, StorageError, "Input/output error")
    monkeypatch.setattr(Journal, "sync", broken)
    node.send(20)
    assert closed(node.socket)[0] == 1012
    assert not node.acked
    # Whatever it is asked for now, in the end everything has to be acknowledged.
    for first, last in node.connect():
        if last is None:
            node.send_again(node.all_sent().slice_rows(first, 20)) if first < 20 else None
    node.deliver(10)
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_what_a_node_says_is_followed_although_it_cannot_be_written_down(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    node.restart()
    node.tiles += 1
    with monkeypatch.context() as patch:
        patch.setattr(service.server.node.ServerNode, "save_hello", refusing(*STORAGE_FULL))
        node.connect()
    shown = running.node()
    assert len(shown["tiles"]) == node.tiles
    calibration = node.hello().calibration
    assert calibration is not None
    assert shown["calibration"]["id"] == calibration.id


def test_what_could_not_be_synced_is_sent_again(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    before_each_sync_of_frames(monkeypatch, failing_once(lambda: None, *IO_ERROR))
    lost = node.send(10)
    assert closed(node.socket)[0] == 1012
    assert node.connect() == [(10, None)]
    node.send_again(lost)
    node.acknowledged(19)
    running.restart()
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_a_disk_that_was_full_from_the_first_frame_on_is_tried_again(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    refuse = refusing(*STORAGE_FULL)
    monkeypatch.setattr(service.server.streams, "Journal", refuse)  # not even a folder
    monkeypatch.setattr(running.server, "check_writable", refuse)
    node.connect()
    node.send(10)
    until(lambda: running.node()["storage_problem"] is not None)
    monkeypatch.setattr(service.server.streams, "Journal", Journal)
    monkeypatch.setattr(running.server, "check_writable", lambda: None)
    assert closed(node.socket)[0] == 1012
    assert node.connect() == [(0, None)]
