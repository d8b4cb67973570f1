"""Bugs and busy nodes: what fails for one node changes nothing for another."""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Iterator
from typing import Any

import pytest

from devices.frames import FrameBatch
from service.protocol.live import NodeView
from service.server.estimates.live_estimator import LiveEstimator
from service.server.node import ServerNode
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed, receive_live
from tests.waiting import PATIENCE_S, until

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
    def fail(*_: Any) -> None:
        raise kind("a bug")

    for step in ("apply_checked_hello", "needed_and_present_frames_to_request"):
        with monkeypatch.context() as patch:
            patch.setattr(ServerNode, step, fail)
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
    feed = LiveEstimator.estimate_or_pass_frames

    def feed_or_fail(self: LiveEstimator, frames: FrameBatch) -> Any:
        if self._info.node == "bench" and self._calibration is not None:
            raise ZeroDivisionError("a bug")
        return feed(self, frames)

    node.connect()
    node.deliver(20)
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(LiveEstimator, "estimate_or_pass_frames", feed_or_fail)
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
    make_node_view = running.server.make_node_view

    def view_or_fail(known: ServerNode) -> NodeView:
        if known.name == "bench":
            raise ArithmeticError("a bug")
        return make_node_view(known)

    node.connect()
    monkeypatch.setattr(running.server, "make_node_view", view_or_fail)
    with caplog.at_level(logging.ERROR), running.socket(LIVE) as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert [shown["node"] for shown in hello["nodes"]] == ["other"]
        node.deliver(30)
        assert_goes_on(live, other)
    assert count_bugs(caplog) == 1


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
