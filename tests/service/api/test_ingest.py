"""Connections of nodes: what is acknowledged and requested, and a bug that costs one node only."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
from starlette.websockets import WebSocket

import service.api.routes.sockets.ingest
import service.server.server
from devices.errors import StorageError
from devices.frames import FrameBatch
from service.server.estimates.live_estimator import LiveEstimator
from service.server.node import ServerNode
from storage.intervals import Intervals
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed, receive_live
from tests.storage.faulty_disk import failing_if, refusing
from tests.waiting import PATIENCE_S, until


def assert_all_stored(node: FakeNode) -> None:
    """The journal has every frame of the node's stream."""
    assert_same_bits(node.running.held(node.stream_id), node.all_sent())


def test_a_new_node_is_asked_for_every_frame_that_it_has(running: Running, node: FakeNode) -> None:
    assert node.connect() == [(0, None)]
    node.deliver(300)
    assert node.acked == Intervals([(0, 299)])
    assert_all_stored(node)
    node.restart()
    assert node.connect(stored=((500, 899),), next_seq=900) == [(500, None)]
    assert running.node()["stream_id"] == node.stream_id


def test_a_node_that_returns_continues_where_the_server_is(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(100)
    node.leave()
    node.frames(50)  # taken while it was away
    assert node.connect() == [(100, None)]
    node.send_again(node.sent[1])
    node.deliver(30)
    assert_all_stored(node)
    node.acked = Intervals()  # a node whose acknowledgement was lost waits for another one
    node.send_again(node.sent[0].slice_rows(55, 100))
    node.acknowledged(99, first=55)
    assert running.node()["lost_frames"] == 0
    running.restart()
    assert_all_stored(node)
    assert node.connect() == [(180, None)]
    node.deliver(50)
    assert_all_stored(node)


def test_a_server_that_stops_closes_connections_and_journals(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.send(20)
    running.stop()  # perhaps before the tick that acknowledges the frames
    assert closed(node.socket)[0] in (1001, 1012)
    assert running.open_journals == []
    running.start()
    [(first, _)] = node.connect()
    if first < 20:
        node.send_again(node.sent[-1].slice_rows(first, 20))
    node.deliver(10)


def test_a_probe_has_the_servers_clock_and_the_api_the_nodes_counts(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    before_ns = time.time_ns()
    node.socket.send('{"type":"probe","id":3}')
    answer = node.receive("probe")
    assert answer.id == 3
    assert before_ns <= answer.server_t_ns <= time.time_ns()
    node.send(10)
    node.say_clock(-77, uncertainty_ns=12)
    node.socket.send('{"type":"status","missed_slots":4}')
    until(lambda: running.node()["missed_slots"] == 4)
    clock = {"server_minus_node_ns": -77, "uncertainty_ns": 12}
    assert running.node()["clock"] == clock | {"t_mono_ns": node.next_t_mono_ns}


def test_a_second_connection_of_a_stream_replaces_the_first(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(10)
    first = node.socket
    assert node.connect() == [(10, None)]
    assert closed(first)[0] == 4010
    node.deliver(10)
    assert running.node()["connected"]


@pytest.mark.parametrize("is_greeted", [False, True])
def test_a_silent_node_is_disconnected(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch, is_greeted: bool
) -> None:
    monkeypatch.setattr(service.api.routes.sockets.ingest, "LINK_TIMEOUT_S", 0.3)
    if is_greeted:
        node.connect()
    else:
        node.open()
    code, reason = closed(node.socket)
    assert (code, "0.3 s" in reason) == (4005, True)
    if is_greeted:
        until(lambda: not running.node()["connected"])
    assert running.http.get("/health").status_code == 200


def test_frames_received_before_a_cut_are_acknowledged_or_requested(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A node keeps every frame until it is acknowledged.
    node.connect()
    node.deliver(10)
    monkeypatch.setattr(service.server.server, "TICK_S", 0.5)
    node.send(10)
    node.acknowledged(19)  # the next tick is half a second away
    node.send(10)
    node.taken_in()
    node.socket.socket.shutdown(2)
    until(lambda: not running.node()["connected"])
    assert not node.acked.restricted_to(20, 29)
    for first, _ in node.connect():
        if first == 20:
            node.send_again(node.sent[-1])
    node.deliver(10)


def test_a_node_that_leaves_before_its_welcome_leaves_its_name_free(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    send_text, is_gone = WebSocket.send_text, threading.Event()

    async def send_or_fail(socket: WebSocket, data: str) -> None:
        if '"welcome"' in data and not is_gone.is_set():
            is_gone.set()
            raise RuntimeError("the peer has gone")
        await send_text(socket, data)

    monkeypatch.setattr(WebSocket, "send_text", send_or_fail)
    node.open_with_hello()
    until(is_gone.is_set)
    # Long before its silence would disconnect it.
    until(lambda: not running.node()["connected"], PATIENCE_S / 4)
    node.reboot()
    assert node.connect() == [(0, None)]


def test_frames_of_an_earlier_stream_fit_its_own_description(
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
    assert_all_stored(node)
    # No session needs them: their journal is deleted as soon as they are acknowledged.
    while (0, 19) not in node.acked_of.get(before.stream_id, ()):
        node.receive("ack")
    assert running.node()["last_seq"] == 19
    node.socket.send(json.dumps({"type": "stream", "stream_id": before.stream_id}))
    node.socket.send(node.payload(node.frames(10)))  # of three tiles
    assert closed(node.socket)[0] == 4001


# --- bugs and busy nodes --------------------------------------------------------------------------


LIVE = "/api/v1/live"


@pytest.fixture
def other(running: Running, node_of: NodeOf) -> FakeNode:
    node = node_of(running, "other")
    node.connect()
    node.tared()
    return node


@pytest.fixture
def live(running: Running, other: FakeNode) -> Iterator[Any]:
    with running.socket(f"{LIVE}?rate_hz=60") as socket:
        yield socket


def assert_goes_on(live: Any, other: FakeNode) -> None:
    """The other node's frames are acknowledged and shown."""
    other.deliver(40, now=True)
    receive_live(live, lambda each: each["type"] == "frame" and each["node"] == "other")


def count_bugs(caplog: pytest.LogCaptureFixture) -> int:
    return sum("this is a bug" in record.getMessage() for record in caplog.records)


# A RuntimeError is also the error of a closed socket.
@pytest.mark.parametrize("kind", [ArithmeticError, RuntimeError])
def test_a_bug_in_a_hello_leaves_the_name_free(
    running: Running,
    live: Any,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    kind: type[Exception],
) -> None:
    for step in ("apply_checked_hello", "needed_and_present_frames_to_request"):
        with monkeypatch.context() as patch:
            patch.setattr(ServerNode, step, refusing(kind, "a bug"))
            node.open_with_hello()
            assert closed(node.socket)[0] == 1011
        if step == "apply_checked_hello":
            assert running.http.get("/nodes/bench").status_code == 404
    until(lambda: not running.node()["connected"])
    assert_goes_on(live, other)
    node.reboot()
    assert node.connect() == [(0, None)]


def test_a_bug_in_a_nodes_estimates_costs_only_its_estimates(
    running: Running,
    live: Any,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def is_of_bench(estimator: LiveEstimator, _: FrameBatch) -> bool:
        return estimator.info.node == "bench" and estimator.calibration is not None

    estimate = LiveEstimator.estimate_or_pass_frames
    fail = failing_if(is_of_bench, estimate, ZeroDivisionError, "a bug")
    node.connect()
    node.deliver(20)
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(LiveEstimator, "estimate_or_pass_frames", fail)
        node.deliver(100)
        assert_goes_on(live, other)
    assert count_bugs(caplog) == 1
    assert "the estimator failed" in running.node()["calibration_problem"]
    assert running.node("other")["calibration_problem"] is None
    node.leave()
    node.connect()
    assert running.node()["calibration_problem"] is None


def test_a_bug_in_a_nodes_summary_hides_only_this_node(
    running: Running,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    node.connect()
    facts = (running.server.make_node_view, ArithmeticError, "a bug")
    fail = failing_if(lambda known: known.name == "bench", *facts)
    monkeypatch.setattr(running.server, "make_node_view", fail)
    with caplog.at_level(logging.ERROR), running.socket(LIVE) as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert [shown["node"] for shown in hello["nodes"]] == ["other"]
        node.deliver(30)
        assert_goes_on(live, other)
    assert count_bugs(caplog) == 1


def test_a_problem_that_is_not_utf_8_ends_no_socket(
    running: Running, other: FakeNode, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    server = running.server
    fail = failing_if(lambda: True, server.check_writable, StorageError, "still")
    monkeypatch.setattr(server, "check_writable", fail)
    server.nodes.get("bench").storage_problem = "\udcff"
    with running.socket(LIVE) as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert {shown["node"]: shown["storage_problem"] for shown in hello["nodes"]} == {
            "bench": r"\udcff",
            "other": None,
        }
        running.call(lambda: server.notify_node_changed(server.nodes.get("bench")))
        receive_live(live, lambda message: message["type"] == "node")
        assert_goes_on(live, other)
    assert running.node()["storage_problem"] == r"\udcff"
    assert "bench" in server.links


def test_a_notice_that_cannot_be_encoded_ends_no_socket(
    running: Running,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    def fail(_: object) -> None:
        raise ArithmeticError("a bug")

    node.connect()
    node.deliver(30)
    session = node.record()
    with running.socket(LIVE) as live, caplog.at_level(logging.ERROR):
        receive_live(live, lambda message: message["type"] == "hello")
        with monkeypatch.context() as patch:
            patch.setattr(running.server.broadcaster, "queue_notice", fail)
            bench = running.server.nodes.get("bench")
            running.call(lambda: running.server.notify_node_changed(bench))
            session.stop()
        assert_goes_on(live, other)
    assert "bench" in running.server.links
    for of in ("node bench", f"session {session.id}"):
        assert f"{of}, its view: this is a bug" in caplog.text


def test_the_loop_runs_between_two_messages_of_a_backlog(
    running: Running, node: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    node.connect()
    node.deliver(10)
    turns, messages, receive = 0, 60, ServerNode.receive_frames
    received_at: list[int] = []

    async def count_turns() -> None:
        nonlocal turns
        while len(received_at) < messages:
            turns += 1
            await asyncio.sleep(0)

    def receive_and_note(self: ServerNode, *arguments: Any) -> Any:
        received_at.append(turns)
        return receive(self, *arguments)

    monkeypatch.setattr(ServerNode, "receive_frames", receive_and_note)
    counting = running.call(lambda: asyncio.ensure_future(count_turns()))
    sent = node.frames(10 * messages)
    for payload in [node.payload(sent.slice_rows(i, i + 10)) for i in range(0, len(sent), 10)]:
        node.socket.send(payload)  # all in one piece, so that the server reads them at once
    until(lambda: len(received_at) == messages)
    until(counting.done)
    assert len(set(received_at)) == messages
