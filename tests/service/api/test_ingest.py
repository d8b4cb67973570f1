"""A node's connection: what is acknowledged is on disk, and what is lacking is asked for."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import threading
import time
from contextlib import suppress
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

import service.api.routes.sockets.ingest
import service.server
import service.server.streams
from devices.frames import FrameBatch
from storage.intervals import Intervals
from storage.journal.journal import Journal
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.process import Start
from tests.service.running import Running, closed
from tests.waiting import until


def test_a_new_node_is_asked_for_everything(node: FakeNode) -> None:
    assert node.connect() == [(0, None)]


def test_a_new_node_is_not_asked_for_what_it_has_forgotten(node: FakeNode) -> None:
    assert node.connect(stored=((500, 899),), next_seq=900) == [(500, None)]


def test_what_is_acknowledged_is_readable_from_disk(running: Running, node: FakeNode) -> None:
    node.connect()
    sent = node.deliver(300)
    assert node.acked == Intervals([(0, 299)])
    assert_same_bits(running.held(node.stream_id), sent)


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
    assert_same_bits(running.held(node.stream_id), node.all_sent())
    assert running.node()["lost_frames"] == 0


def test_frames_that_are_sent_twice_are_held_once_and_acknowledged_again(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    sent = node.deliver(100)
    node.acked = Intervals()
    node.send_again(sent.slice_rows(55, 100))
    node.acknowledged(99, first=55)
    assert_same_bits(running.held(node.stream_id), sent)


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
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_after_a_restart_the_server_lacks_exactly_the_rest(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(200)
    running.restart()
    assert_same_bits(running.held(node.stream_id), node.all_sent())
    assert node.connect() == [(200, None)]
    node.deliver(50)
    assert_same_bits(running.held(node.stream_id), node.all_sent())


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
    running: Running, node_of: NodeOf, foottile: Start, tmp_path: Path
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
        while node.acked.number_count < 400:
            node.receive("ack")
        os.kill(process.pid, signal.SIGKILL)
        with suppress(ConnectionClosed):
            while node.receive("ack", timeout_s=5.0):
                pass
    assert process.ended(5.0) == -signal.SIGKILL
    copy = tmp_path / "copy"
    shutil.copytree(data / "journal" / "bench" / node.stream_id, copy)
    journal = Journal.open_and_recover(copy)
    assert not (node.acked - journal.stored)
    held = journal.stored.last
    assert held is not None
    found = FrameBatch.concatenate(list(journal.read_frames(0, held)))
    assert_same_bits(found, node.all_sent().slice_rows(0, held + 1))
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


def test_the_same_stream_again_takes_the_place_of_its_older_connection(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    older = node.socket
    assert node.connect() == [(10, None)]
    assert closed(older)[0] == 4010
    node.deliver(10)
    assert running.node()["connected"]


def test_a_node_that_has_left_may_come_back_with_another_boot(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    node.restart()
    assert node.connect() == [(0, None)]
    assert running.node()["stream_id"] == node.stream_id
    node.deliver(10)


@pytest.mark.parametrize("greeted", [False, True])
def test_a_node_that_says_nothing_is_let_go(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch, greeted: bool
) -> None:
    monkeypatch.setattr(service.api.routes.sockets.ingest, "LINK_TIMEOUT_S", 0.3)
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
    assert not node.acked.restricted_to(20, 29)
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
        node.send_again(node.sent[-1].slice_rows(first, 20))
    node.deliver(10)


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
    node.open_with_hello()
    until(gone.is_set)
    until(lambda: not running.node()["connected"])
    node.reboot()
    assert node.connect() == [(0, None)]


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
    assert_same_bits(running.held(node.stream_id), node.all_sent())
    # No session needs them: their journal is deleted as soon as they are acknowledged.
    while (0, 19) not in node.acked_of.get(before.stream_id, ()):
        node.receive("ack")
    assert running.node()["last_seq"] == 19
    node.socket.send(json.dumps({"type": "stream", "stream_id": before.stream_id}))
    node.socket.send(node.payload(node.frames(10)))  # of three tiles
    assert closed(node.socket)[0] == 4001
