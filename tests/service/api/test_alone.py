"""What goes wrong on one connection, or with one node, ends nothing beside it."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from devices.frames import FrameBatch
from service.server.broadcast.views import NodeView
from service.server.estimates.live_estimator import LiveEstimator
from service.server.node import ServerNode
from storage.verify.journal import verify_journal
from tests.builders.frames import with_columns
from tests.builders.odd_values import with_value
from tests.service.fake_node import FakeNode, NodeOf
from tests.service.running import Running, closed
from tests.waiting import PATIENCE_S, until

LIVE = "/api/v1/live"


@pytest.fixture
def other(running: Running, node_of: NodeOf) -> FakeNode:
    """A node that was there before."""
    node = node_of(running, "other")
    node.connect()
    node.tared()
    return node


@pytest.fixture
def screen(running: Running, other: FakeNode) -> Iterator[Any]:
    """A screen that was there before."""
    with running.socket(f"{LIVE}?rate_hz=60") as live:
        yield live


def assert_goes_on(screen: Any, other: FakeNode) -> None:
    """The screen is shown what the other node sends, and that is acknowledged."""
    other.deliver(40, now=True)
    while True:
        message = json.loads(screen.recv(timeout=PATIENCE_S))
        if message["type"] == "frame" and message["node"] == "other":
            return


@pytest.mark.parametrize(
    ("place", "value"),
    [
        (("array_info", "tiles", 0, "conversion_ms"), math.nan),
        (("array_info", "tiles", 0, "x_m"), math.inf),
        (("array_info", "tiles", 0, "coefficient_words", 0), 70_000),
        (("array_info", "nominal_rate_hz"), math.nan),
        (("lost",), {"x": [[0, 2**62 - 1]]}),
        (("scene", "name"), math.nan),
    ],
    ids=str,
)
def test_a_hello_that_cannot_be_leaves_no_trace(
    running: Running, screen: Any, other: FakeNode, node: FakeNode, place: Any, value: Any
) -> None:
    hello = with_value(json.loads(node.hello().model_dump_json()), place, value)
    node.open().send(json.dumps(hello))
    code, reason = closed(node.socket)
    assert code == 4001
    assert str(place[0]) in reason
    assert_goes_on(screen, other)
    assert running.http.get("/nodes/bench").status_code == 404
    running.restart()
    assert [n["node"] for n in running.http.get("/nodes").json()["items"]] == ["other"]
    assert node.connect() == [(0, None)]


@pytest.mark.parametrize("kind", [ArithmeticError, RuntimeError])
def test_a_node_that_could_not_be_taken_in_is_not_known_and_its_name_is_free(
    running: Running,
    screen: Any,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    kind: type[Exception],
) -> None:
    """A RuntimeError is also what a socket says that has gone: it is told apart."""

    def failing(*_: Any) -> None:
        raise kind("as a bug would")

    with monkeypatch.context() as patch:
        patch.setattr(ServerNode, "apply_checked_hello", failing)
        node.open_with_hello()
        assert closed(node.socket)[0] == 1011
    assert running.http.get("/nodes/bench").status_code == 404
    with monkeypatch.context() as patch:
        patch.setattr(ServerNode, "needed_and_present_frames_to_request", failing)
        node.open_with_hello()
        assert closed(node.socket)[0] == 1011
    until(lambda: not running.node()["connected"])
    assert_goes_on(screen, other)
    node.reboot()
    assert node.connect() == [(0, None)]


def test_a_bug_in_one_nodes_estimates_costs_it_its_estimates_and_no_more(
    running: Running,
    screen: Any,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    feed = LiveEstimator.estimate_or_pass_frames

    def failing(self: LiveEstimator, frames: FrameBatch) -> Any:
        if self._info.node == "bench" and self._calibration is not None:
            raise ZeroDivisionError("as a bug would")
        return feed(self, frames)

    node.connect()
    node.deliver(20)
    with monkeypatch.context() as patch, caplog.at_level(logging.ERROR):
        patch.setattr(LiveEstimator, "estimate_or_pass_frames", failing)
        node.deliver(100)
        assert_goes_on(screen, other)
    assert len([r for r in caplog.records if "this is a bug" in r.getMessage()]) == 1
    assert "the estimator failed" in running.node()["calibration_problem"]
    assert running.node("other")["calibration_problem"] is None
    node.leave()
    node.connect()
    assert running.node()["calibration_problem"] is None


def test_a_node_that_cannot_be_shown_is_left_out_of_the_screens_and_said_once(
    running: Running,
    other: FakeNode,
    node: FakeNode,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    of = NodeView.from_node

    def failing(known: ServerNode, *rest: Any) -> NodeView:
        if known.name == "bench":
            raise ArithmeticError("as a bug would")
        return of(known, *rest)

    node.connect()
    monkeypatch.setattr(NodeView, "from_node", failing)
    with caplog.at_level(logging.ERROR), running.socket(LIVE) as live:
        hello = json.loads(live.recv(timeout=PATIENCE_S))
        assert [shown["node"] for shown in hello["nodes"]] == ["other"]
        node.deliver(30)
        assert_goes_on(live, other)
    assert len([r for r in caplog.records if "this is a bug" in r.getMessage()]) == 1


def test_frames_whose_time_runs_back_are_refused_lost_and_not_asked_for_again(
    running: Running, screen: Any, other: FakeNode, node: FakeNode
) -> None:
    node.connect()
    node.deliver(20)
    late = node.frames(10)
    node.socket.send(node.payload(with_columns(late, t_mono_ns=late.t_mono_ns - 25_000_000)))
    code, reason = closed(node.socket)
    assert code == 4001
    assert "frames 20 to 29" in reason
    assert_goes_on(screen, other)
    assert node.connect() == [(30, None)]
    node.deliver(20)
    assert running.node()["lost"] == {"refused": 10}
    assert not node.acked.restricted_to(20, 29)
    running.restart()
    assert node.connect() == [(50, None)]
    running.stop()
    report = verify_journal(running.data / "journal" / "bench" / node.stream_id)
    assert report.problems == []
    assert report.lost.to_pairs() == {"refused": ((20, 29),)}


def test_what_comes_from_behind_has_to_fit_what_is_there(running: Running, node: FakeNode) -> None:
    node.connect()
    node.frames(50)
    node.deliver(20)
    first = node.sent[0]
    shifted = with_columns(first, t_mono_ns=first.t_mono_ns + 60_000_000)
    node.socket.send(node.payload(shifted.slice_rows(40, 50)))
    code, reason = closed(node.socket)
    assert (code, "40 to 49" in reason) == (4001, True)
    node.connect()
    node.send_again(first.slice_rows(0, 40))
    node.acknowledged(39)


@pytest.mark.parametrize("t_mono_ns", [2**60, 2**62, 2**63 - 100, -(2**63)])
def test_instants_that_no_clock_says_are_refused(node: FakeNode, t_mono_ns: int) -> None:
    node.connect()
    frames = node.frames(10)
    with np.errstate(over="ignore"):
        t_ns = np.full(10, t_mono_ns) + np.int64(node.utc_offset_ns)
    odd = FrameBatch(**{**vars(frames), "t_mono_ns": np.full(10, t_mono_ns), "t_ns": t_ns})
    node.socket.send(node.payload(odd))
    assert closed(node.socket)[0] == 4001


def test_no_frame_comes_behind_the_end_of_a_stream(running: Running, node: FakeNode) -> None:
    node.connect()
    node.deliver(20)
    more = node.frames(10)
    node.restart()
    [before] = node.before
    before.next_seq = 20
    node.connect(earlier=(before.said(),))
    before.sent[-1] = more
    node.send_earlier(before, 20, 29)
    code, reason = closed(node.socket)
    assert code == 4001
    assert "frames 20 to 29" in reason
