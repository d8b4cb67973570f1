"""Trash, abandoned frames, damage before the seal, and starts of the server."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
from typing import Any

import pytest

import service.api.routes.recordings.sessions
import service.server
import service.server.recorder
from devices.errors import StorageError
from service.sessions.sealing import write_sealed_files
from storage.sessions.folder import DELETED_PREFIX, SessionsFolder
from tests.service.fake_node import FakeNode
from tests.service.recording import Recording
from tests.service.running import Running, assert_refused, closed, receive_live
from tests.storage.faulty_disk import flip_bits, refusing
from tests.waiting import until


def leave_pending(node: FakeNode) -> Recording:
    """Stop a session whose node has left with its last thirty frames."""
    session = node.record()
    node.deliver(50)
    node.leave()
    node.frames(30)
    session.stop()
    return session


def list_ids(running: Running, path: str) -> list[str]:
    return [each["id"] for each in running.http.get(path).json()["items"]]


# --- the trash ------------------------------------------------------------------------------------


def test_pages_are_told_of_a_deleted_session_and_it_is_restored_unchanged(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record_sealed(20)
    before = session.now()
    with running.socket("/api/v1/live") as live:
        receive_live(live, lambda each: each["type"] == "hello")
        answer = running.http.delete(session.url)
        assert (answer.status_code, answer.content) == (204, b"")
        notice = receive_live(live, lambda each: each["type"] == "deleted")
    assert notice["session_id"] == session.id
    assert list_ids(running, "/sessions") == []
    running.restart()
    assert running.http.get("/trash").json()["items"] == [before]
    assert_refused(running.http.get(session.url), 404, "trash")
    assert running.http.get(f"{session.url}/data").status_code == 404
    answer = running.http.post(f"/trash/{session.id}/restore")
    assert answer.status_code == 200
    assert answer.json() == before
    assert list_ids(running, "/trash") == []
    assert running.http.get(f"{session.url}/data").status_code == 200


def test_emptying_the_trash_deletes_and_counts(running: Running, tared: FakeNode) -> None:
    kept = tared.record_sealed(20)
    size = 0
    for _ in range(2):
        session = tared.record_sealed(20)
        folder = session.folder
        size += sum(path.stat().st_size for path in folder.iterdir())
        running.http.delete(session.url)
    assert running.http.delete("/trash").json() == {"sessions": 2, "bytes": size}
    assert running.http.delete("/trash").json() == {"sessions": 0, "bytes": 0}
    assert list_ids(running, "/trash") == []
    assert list((running.data / "trash").iterdir()) == []
    assert list_ids(running, "/sessions") == [kept.id]


def test_a_session_is_not_deleted_during_its_seal(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_seal = threading.Event()

    def wait_and_seal(*arguments: Any) -> Any:
        assert may_seal.wait(20.0)
        return write_sealed_files(*arguments)

    monkeypatch.setattr(service.server.recorder, "write_sealed_files", wait_and_seal)
    try:
        session = tared.record()
        tared.deliver(20)
        session.stop()
        tared.send(10, now=True)
        until(lambda: session.now()["state"] == "sealing")
        assert_refused(running.http.delete(session.url), 409, "sealed")
    finally:
        may_seal.set()
    session.sealed()


def test_a_pending_session_needs_its_frames_until_the_trash_is_emptied(
    running: Running, tared: FakeNode
) -> None:
    session = leave_pending(tared)
    running.http.delete(session.url)
    running.restart()
    tared.connect()
    [wanted] = tared.wanted.streams
    assert (wanted.stream_id, [*wanted.numbers]) == (
        tared.stream_id,
        [(0, None)],
    )  # and those before it
    tared.send_again(tared.sent[-1])
    tared.send(10, now=True)
    tared.acknowledged(tared.seq - 1, first=120)
    assert running.http.get("/trash").json()["items"][0]["state"] == "pending"
    running.http.post(f"/trash/{session.id}/restore")
    assert session.sealed()["complete"] is True
    again = leave_pending(tared)
    running.http.delete(again.url)
    tared.connect()
    assert tared.wanted.streams
    running.http.delete("/trash")
    tared.receive("retain")
    assert tared.wanted.streams == ()


def test_an_interrupted_delete_leaves_a_session_in_one_place(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = tared.record_sealed(20)
    cut_off = refusing(StorageError, "No space left")
    move = SessionsFolder.move_to
    monkeypatch.setattr(SessionsFolder, "move_to", cut_off)
    assert running.http.delete(session.url).status_code == 507
    assert list_ids(running, "/sessions") == [session.id]
    assert list_ids(running, "/trash") == []
    monkeypatch.setattr(SessionsFolder, "move_to", move)

    def move_and_die(folder: SessionsFolder, session_id: str, to: SessionsFolder) -> None:
        move(folder, session_id, to)
        cut_off()  # after the folder was renamed

    monkeypatch.setattr(SessionsFolder, "move_to", move_and_die)
    assert running.http.delete(session.url).status_code == 507
    monkeypatch.setattr(SessionsFolder, "move_to", move)
    running.restart()
    assert list_ids(running, "/sessions") == []
    assert list_ids(running, "/trash") == [session.id]


def test_a_half_deleted_session_is_removed_at_the_next_start(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    session = tared.record_sealed(20)
    running.http.delete(session.url)
    monkeypatch.setattr(
        service.server.server, "delete_and_count_bytes", lambda folders: 0
    )  # killed before
    running.http.delete("/trash")
    assert [path.name for path in (running.data / "trash").iterdir()] == [
        DELETED_PREFIX + session.id
    ]
    running.restart()
    assert list_ids(running, "/trash") == []
    assert list((running.data / "trash").iterdir()) == []


# --- abandoned ------------------------------------------------------------------------------------


def test_a_session_is_sealed_without_its_node(running: Running, tared: FakeNode) -> None:
    session = leave_pending(tared)
    answer = running.http.post(f"{session.url}/abandon-missing")
    assert answer.status_code == 200, answer.text
    done = session.sealed()
    assert (done["complete"], done["frames"]) == ("lossy", 50)
    assert done["parts"] == [{"stream_id": tared.stream_id, "seq_first": 70, "seq_last": 119}]
    # At most as many frames as fit between the last one and the stop.
    assert done["max_lost_tail_frames"] >= 30
    assert done["pending_frames"] == 0


# --- damage ---------------------------------------------------------------------------------------


def damage(running: Running, node: FakeNode) -> None:
    """Flip a bit in the middle of the node's journal."""
    [path] = (running.data / "journal" / "bench" / node.stream_id).glob("*.arrows")
    flip_bits(path, bits=0x10)


@pytest.mark.parametrize(
    ("is_deleted", "expected"),
    [(False, (True, 200, {})), (True, ("lossy", 190, {"corrupt": 10}))],
    ids=["sent again", "deleted by the node"],
)
def test_damaged_frames_are_requested_again_and_lost_if_the_node_has_deleted_them(
    running: Running, tared: FakeNode, *, is_deleted: bool, expected: tuple[Any, ...]
) -> None:
    session = tared.record()
    tared.deliver(200)
    damage(running, tared)
    session.stop()
    tared.send(10, now=True)
    code, reason = closed(tared.socket)
    assert (code, "damaged" in reason) == (1012, True)
    if is_deleted:
        tared.connect(stored=((270, 279),))
    else:
        first, last = tared.connect()[0]
        assert last is not None
        assert 70 <= first <= last <= 269
        tared.send_again(tared.all_sent().slice_rows(first, last + 1))
    done = session.sealed()
    assert (done["complete"], done["frames"], done["lost"]) == expected


# --- starting -------------------------------------------------------------------------------------


@pytest.mark.parametrize("state", ["sealing", "pending"])
def test_a_restarted_server_seals_unsealed_sessions(
    running: Running, tared: FakeNode, state: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        service.server.recorder, "write_sealed_files", refusing(StorageError, "No space left")
    )
    session = tared.record()
    tared.deliver(20)
    session.stop()
    if state == "sealing":
        tared.send(10, now=True)
        until(lambda: "No space" in (session.now()["problem"] or ""))
    assert session.now()["state"] == state
    monkeypatch.setattr(service.server.recorder, "write_sealed_files", write_sealed_files)
    running.restart()
    if state == "pending":
        tared.connect()
        tared.send(10, now=True)
    assert session.sealed()["frames"] == 20


def test_half_written_files_of_dead_processes_are_removed_at_the_start(
    running: Running, tared: FakeNode
) -> None:
    session = tared.record_sealed(20)
    folder = session.folder
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait(20)
    stale = running.data / "nodes" / "bench" / f".hello.json.{ended.pid}.7.0a1b2c3d.tmp"
    foreign = [folder / ".mine.tmp", folder / f"frames.{ended.pid}.tmp"]
    for path in (stale, *foreign):
        path.write_bytes(b"half")
    running.restart()
    assert not stale.exists()
    assert all(path.exists() for path in foreign)


def test_unneeded_journals_are_deleted_one_at_a_time(running: Running, tared: FakeNode) -> None:
    # A node with a thousand streams does not block the others meanwhile.
    streams = [tared.stream_id]
    for _ in range(2):
        tared.close()
        tared.reboot()
        until(lambda: not running.node()["connected"])
        tared.connect()
        tared.deliver(10)
        streams.append(tared.stream_id)
    node = running.server.nodes.get("bench")
    folder = running.data / "journal" / "bench"
    left = []
    while running.call(
        lambda: node.delete_old_frames_and_up_to_one_ended_journal(
            running.server.recorder.collect_needed_frames("bench")
        )
    ):
        left.append(sorted(path.name for path in folder.iterdir()))
    assert left == [sorted(streams[1:]), streams[2:]]
    assert node.present_stream.stored


# --- abandoned: a stream that server or node has lost ---------------------------------------------


@pytest.fixture
def unsent(tared: FakeNode) -> Recording:
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


@pytest.mark.real_time
def test_abandoned_frames_of_a_stream_with_a_known_end_are_counted(
    tared: FakeNode, unsent: Recording
) -> None:
    tared.restart()
    unsent.stop()
    tared.connect(earlier=tuple(each.said() for each in tared.before))
    assert unsent.now()["pending_reason"] == "end"
    answer = unsent.running.http.post(f"{unsent.url}/abandon-missing")
    assert answer.status_code == 200, answer.text
    sealed = unsent.sealed()
    assert sealed["lost"] == {"abandoned": 30}
    counts = (sealed["frames"], sealed["max_lost_tail_frames"], sealed["complete"])
    assert counts == (50, 0, "lossy")


@pytest.mark.real_time
def test_a_session_waits_for_a_stream_that_is_not_announced(
    running: Running, tared: FakeNode, unsent: Recording
) -> None:
    tared.leave()
    lose_node(running, tared)
    (listed,) = running.sessions()
    assert (listed["state"], listed["frames"], listed["complete"]) == ("recording", 0, False)
    assert unsent.stop()["pending_reason"] == "end"
    tared.reboot()
    tared.come_back()
    sealed = unsent.sealed()
    assert (sealed["frames"], sealed["complete"]) == (80, True)


@pytest.mark.real_time
def test_a_stream_lost_on_both_sides_seals_its_session(
    running: Running, tared: FakeNode, unsent: Recording
) -> None:
    tared.leave()
    lose_node(running, tared)
    unsent.stop()
    tared.reboot()
    tared.connect()
    sealed = unsent.sealed()
    assert (sealed["frames"], sealed["complete"]) == (0, "lossy")
    assert sealed["max_lost_tail_frames"] > 0
