"""Sessions over several streams of a node: which frames of each stream belong to them."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from devices.frames import FrameBatch
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording, parts_of, whole_parts_of
from tests.service.running import Running
from tests.waiting import until


@pytest.fixture
def session(tared: FakeNode) -> Recording:
    """A session of fifty frames, 70 to 119; its node has left."""
    session = tared.record()
    tared.deliver(50)
    tared.leave()
    return session


def restart_now(node: FakeNode) -> None:
    """Begin a new stream whose first frame is taken now."""
    node.reboot()
    node.next_t_mono_ns = time.monotonic_ns()


def test_streams_taken_without_a_link_are_parts_of_a_session(
    running: Running, tared: FakeNode, session: Recording
) -> None:
    tared.frames(30)
    tared.reboot()
    tared.frames(40)
    tared.reboot()
    first, second = tared.before
    tared.connect(earlier=(first.said(), second.said()))
    assert tared.lacks[first.stream_id] == [(120, 149)]
    assert tared.lacks[second.stream_id] == [(0, 39)]
    third = tared.deliver(20)
    assert session.ledger()["parts"][0]["pending"] == 30
    tared.send_lacking()
    sealed = tared.finish(session)
    assert whole_parts_of(sealed) == [
        (first.stream_id, 70, 149),
        (second.stream_id, 0, 39),
        (tared.stream_id, 0, 19),
    ]
    old = FrameBatch.concatenate(first.sent)
    assert_same_bits(
        session.frames(), FrameBatch.concatenate([old.slice_rows(70, 150), *second.sent, third])
    )
    path = session.folder / "frames.parquet"
    column = pq.read_table(path, columns=["part"])["part"].to_numpy()
    np.testing.assert_array_equal(column, [0] * 80 + [1] * 40 + [2] * 20)
    assert running.node()["lost_frames"] == 0


@pytest.mark.parametrize(("announced", "open_tail"), [(250, 200), (30, 0), (50, 0)])
def test_the_servers_frames_shorten_the_tail_of_a_power_cut(
    tared: FakeNode, session: Recording, announced: int, open_tail: int
) -> None:
    tared.reboot()
    [first] = tared.before
    # The server has the last fifty frames, which the node lost when its power failed.
    tared.connect(
        earlier=(first.said(stored=((0, 69),), next_seq=70, max_lost_tail_frames=announced),)
    )
    sealed = tared.finish(session)
    assert parts_of(sealed)[0] == (first.stream_id, 70, 119)
    part = session.ledger()["parts"][0]
    assert (part["recorded"], part["lost"], part["max_lost_tail_frames"]) == (50, {}, open_tail)
    assert sealed["complete"] == ("lossy" if open_tail else True)
    assert sealed["max_lost_tail_frames"] == open_tail


def test_frames_slower_than_the_nominal_rate_belong_to_the_session(
    tared: FakeNode, session: Recording
) -> None:
    tared.reboot()
    tared.nominal_rate_hz = 1e5  # by which its frames would be of the last millisecond
    tared.frames(40)
    session.stop()
    time.sleep(1.1)  # in its last second a node may have taken more frames
    tared.frames(10, now=True)
    [first] = tared.before
    tared.connect(earlier=(first.said(),))
    for frames in tared.sent:
        tared.send_again(frames)
    sealed = session.sealed()
    assert whole_parts_of(sealed) == [(first.stream_id, 70, 119), (tared.stream_id, 0, 39)]


def test_a_forgotten_stream_has_a_tail_bounded_by_its_silence(
    tared: FakeNode,
) -> None:
    session = tared.record()
    tared.deliver(50, now=True)
    tared.leave()
    restart_now(tared)
    tared.connect()
    tail = session.ledger()["parts"][0]["max_lost_tail_frames"]
    # Five hundred a second since its newest frame; a slow test takes some seconds.
    assert 1 <= tail <= 500 * 20
    assert session.now()["complete"] == "lossy"


def test_overlapping_sessions_have_their_own_frames(running: Running, tared: FakeNode) -> None:
    first = tared.record(name="first")
    tared.deliver(50)
    second = tared.record(name="second")
    tared.deliver(50)
    assert set(running.node()["recording"]) == {first.id, second.id}
    # The stop has to lie behind these frames on the node's clock, too.
    first.stop()
    tared.send(10, now=True)
    until(lambda: first.now()["state"] == "sealed")
    assert running.node()["recording"] == [second.id]
    tared.taken_in()
    until(lambda: time.monotonic_ns() > tared.next_t_mono_ns)
    second.stop()
    tared.send(10, now=True)
    assert parts_of(first.sealed()) == [(tared.stream_id, 70, 169)]
    assert parts_of(second.sealed()) == [(tared.stream_id, 120, 179)]
    assert first.sealed()["complete"] is True
    assert second.sealed()["complete"] is True
    assert_same_bits(second.frames(), tared.all_sent().slice_rows(120, 180))


def test_the_node_gets_each_change_of_the_retention_request(tared: FakeNode) -> None:
    def request() -> tuple[list[tuple[str, list[Any]]], bool]:
        wanted = tared.wanted
        return [(each.stream_id, [*each.numbers]) for each in wanted.streams], wanted.recording

    assert request() == ([], False)
    first = tared.record()
    tared.receive("retain")
    assert request() == ([(tared.stream_id, [(0, None)])], True)  # with the frames before it
    tared.deliver(50)
    second = tared.record(pre_roll_s=0.02)
    tared.finish(first)
    tared.finish(second)
    until(lambda: request() == ([], False) or (tared.receive("retain") and False))
    third = tared.record()
    until(lambda: request()[1] or (tared.receive("retain") and False))
    tared.restart()
    [before] = tared.before
    tared.connect(earlier=(before.said(),))
    assert third["parts"][0]["stream_id"] == before.stream_id
    assert request() == (
        sorted([(before.stream_id, [(0, 139)]), (tared.stream_id, [(0, None)])]),
        True,
    )


def test_the_node_keeps_every_stream_that_may_have_the_stop(
    tared: FakeNode, session: Recording
) -> None:
    tared.frames(30)
    tared.reboot()
    tared.frames(40)
    session.stop()
    tared.frames(10, now=True)
    [first] = tared.before
    tared.connect(earlier=(first.said(),))
    wanted = {each.stream_id: [*each.numbers] for each in tared.wanted.streams}
    assert wanted == {first.stream_id: [(0, None)], tared.stream_id: [(0, None)]}
    assert tared.wanted.recording is False


def test_a_pre_roll_reaches_into_the_backlog(tared: FakeNode) -> None:
    tared.leave()
    backlog = tared.frames(400)
    tared.connect()
    tared.deliver(20)
    session = tared.record(pre_roll_s=0.44)  # 220 frames; the server has 20
    first = session["parts"][0]["seq_first"]
    assert 490 - 220 - 15 <= first <= 490 - 220 + 15
    tared.send_again(backlog)
    tared.deliver(30)
    sealed = tared.finish(session)
    assert whole_parts_of(sealed) == [(tared.stream_id, first, 519)]
