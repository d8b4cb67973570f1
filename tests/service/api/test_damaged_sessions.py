"""A server that finds the description of a session damaged names it, or makes it again."""

from __future__ import annotations

from storage.intervals import NO_END, Intervals
from tests.service.fake_node import FakeNode
from tests.service.running import Running, assert_refused
from tests.waiting import until


def damage(running: Running, session_id: str) -> None:
    path = running.data / "sessions" / session_id / "session.json"
    content = path.read_bytes()
    path.write_bytes(content.replace(b'"node"', b'"nude"', 1))


def test_of_an_open_one_it_is_named_and_all_frames_are_kept(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(20)
    session = node.record()
    node.send(50)
    until(lambda: session.now()["frames"] == 50)
    running.stop()
    damage(running, session.id)
    running.start()
    listed = running.http.get("/sessions").json()
    assert listed["items"] == []
    assert list(listed["unreadable"]) == [session.id]
    assert_refused(running.http.get(session.url), 409, "cannot be read", "foottile verify")
    needed = running.call(lambda: running.server.recorder.needed_frames("bench"))
    assert needed == {node.stream_id: Intervals([(0, NO_END)])}
    assert (running.data / "sessions" / session.id / "session.json").is_file()


def test_of_a_sealed_one_it_is_made_again_and_can_be_downloaded(
    running: Running, node: FakeNode
) -> None:
    node.connect()
    node.deliver(20)
    session = node.record()
    node.send(50)
    until(lambda: session.now()["frames"] == 50)
    node.finish(session)
    content = session.data().content
    running.stop()
    damage(running, session.id)
    running.start()
    listed = running.http.get("/sessions").json()
    assert (listed["unreadable"], [one["id"] for one in listed["items"]]) == ({}, [session.id])
    assert "was rebuilt from frames.parquet" in listed["items"][0]["problem"]
    assert session.data().content == content
