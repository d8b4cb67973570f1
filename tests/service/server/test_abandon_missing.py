"""Sessions whose stream the server or the node has lost."""

from __future__ import annotations

import shutil

import pytest

from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running

pytestmark = pytest.mark.real_time


@pytest.fixture
def session(tared: FakeNode) -> Recording:
    """A recording of fifty stored frames, and of thirty that the node has not sent."""
    recording = tared.record()
    tared.deliver(50)
    tared.frames(30)
    return recording


def lose_node(running: Running, tared: FakeNode) -> None:
    """Delete all files of the node on the server but its sessions."""
    running.stop()
    for folder in ("nodes", "journal"):
        shutil.rmtree(running.data / folder / tared.name)
    running.start()


def test_abandoned_frames_of_a_stream_with_a_known_end_are_counted(
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
    counts = (sealed["frames"], sealed["max_lost_tail_frames"], sealed["complete"])
    assert counts == (50, 0, "lossy")


def test_a_session_waits_for_a_stream_that_is_not_announced(
    running: Running, tared: FakeNode, session: Recording
) -> None:
    tared.leave()
    lose_node(running, tared)
    (listed,) = running.sessions()
    assert (listed["state"], listed["frames"], listed["complete"]) == ("recording", 0, False)
    assert session.stop()["pending_reason"] == "end"
    tared.reboot()
    tared.come_back()
    sealed = session.sealed()
    assert (sealed["frames"], sealed["complete"]) == (80, True)


def test_a_stream_lost_on_both_sides_seals_its_session(
    running: Running, tared: FakeNode, session: Recording
) -> None:
    tared.leave()
    lose_node(running, tared)
    session.stop()
    tared.reboot()
    tared.connect()
    sealed = session.sealed()
    assert (sealed["frames"], sealed["complete"]) == (0, "lossy")
    assert sealed["max_lost_tail_frames"] > 0
