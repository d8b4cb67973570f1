"""Sessions whose streams the server or the node knows little of, or nothing any more."""

from __future__ import annotations

import shutil

import pytest

from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running

pytestmark = pytest.mark.real_time


@pytest.fixture
def session(tared: FakeNode) -> Recording:
    """A recording of which fifty frames are here, and thirty were taken and not sent."""
    recording = tared.record()
    tared.deliver(50)
    tared.frames(30)
    return recording


def forgotten(running: Running, tared: FakeNode) -> None:
    """The server has lost all that it knew of the node but its sessions."""
    running.stop()
    for what in ("nodes", "journal"):
        shutil.rmtree(running.data / what / tared.name)
    running.start()


def test_what_is_given_up_of_a_stream_whose_end_is_known_is_counted_frame_by_frame(
    tared: FakeNode, session: Recording
) -> None:
    tared.restart()
    session.stop()
    tared.connect(earlier=tuple(each.said() for each in tared.before))
    assert session.now()["pending_reason"] == "end"
    answer = session.running.http.post(f"{session.url}/abandon-missing")
    assert answer.status_code == 200, answer.text
    sealed = session.sealed()
    assert sealed["lost"] == {"abandoned": 30}
    assert (sealed["frames"], sealed["max_lost_tail_frames"], sealed["complete"]) == (
        50,
        0,
        "lossy",
    )


def test_a_stream_that_is_not_announced_yet_is_waited_for_and_comes_whole(
    running: Running, tared: FakeNode, session: Recording
) -> None:
    tared.leave()
    forgotten(running, tared)
    (listed,) = running.sessions()
    assert (listed["state"], listed["frames"], listed["complete"]) == ("recording", 0, False)
    assert session.stop()["pending_reason"] == "end"
    tared.reboot()
    tared.come_back()
    sealed = session.sealed()
    assert (sealed["frames"], sealed["complete"]) == (80, True)


def test_a_stream_that_has_vanished_on_both_sides_leaves_no_session_open_for_ever(
    running: Running, tared: FakeNode, session: Recording
) -> None:
    tared.leave()
    forgotten(running, tared)
    session.stop()
    tared.reboot()
    tared.connect()
    sealed = session.sealed()
    assert (sealed["frames"], sealed["complete"]) == (0, "lossy")
    assert sealed["max_lost_tail_frames"] > 0, "nobody knows how many there were"
