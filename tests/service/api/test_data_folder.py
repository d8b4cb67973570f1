"""A data folder that goes away under a running server: nothing outside it is acknowledged."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from operator import eq
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from devices.errors import FolderGoneError, StorageError
from devices.frames import FrameBatch
from service.server.data_folder import DataFolder
from storage.durable_files import LOCK_NAME
from storage.intervals import Intervals
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, assert_refused, closed
from tests.storage.faulty_disk import failing_if, failing_once, refusing
from tests.waiting import until


def list_files(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def list_open_files(folder: Path) -> set[str]:
    """Return the names of files below a folder that this process has open."""
    found = set()
    for each in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if (path := Path(os.readlink(each))).is_relative_to(folder):
                found.add(path.name)
    return found


def delete(folder: Path) -> None:
    """Delete a folder at once, before a new file is written into it."""
    shutil.rmtree(folder.rename(folder.with_name("doomed")))


def move_away(running: Running) -> Path:
    return running.data.rename(running.data.with_name("away"))


def reconnect(node: FakeNode, *unstored: FrameBatch) -> None:
    """Connect again after the server's close, and send frames that are not stored."""
    assert closed(node.socket)[0] == 1012
    until(lambda: not node.running.node()["connected"])
    lacks = node.connect()
    assert lacks[0][0] == (int(unstored[0].seq[0]) if unstored else node.seq)
    assert lacks[-1][1] is None  # a message that came after the failure may be stored
    for batch in unstored:
        node.send_again(batch)
    node.deliver(10, 20.0)
    node.acknowledged(node.seq - 1)
    assert_same_bits(node.running.held(node.stream_id), node.all_sent())


def put_nothing(data: Path) -> None:
    """Leave the place empty."""


def put_empty_folder(data: Path) -> None:
    data.mkdir()


def put_foreign_folder(data: Path) -> None:
    data.mkdir()
    (data / "thesis.tex").touch()


def put_folder_of_another_server(data: Path) -> None:
    other = data.with_name("other")
    DataFolder(other).release_lock()
    other.rename(data)


@pytest.mark.parametrize(
    ("put", "reason"),
    [
        (put_nothing, "there is nothing in its place"),
        (put_empty_folder, "an empty mount point"),
        (put_foreign_folder, "another folder"),
        (put_folder_of_another_server, "another server"),
    ],
)
def test_another_folder_in_its_place_stores_no_frame(
    running: Running, tared: FakeNode, put: Callable[[Path], None], reason: str
) -> None:
    node, data = tared, running.data
    recording = node.record()
    away = move_away(running)
    put(data)
    found = list_files(data) if data.exists() else None
    sent = node.send(30, 20.0)
    until(lambda: reason in (running.node()["storage_problem"] or ""))
    assert_refused(running.http.get("/ready"), 503, reason)
    assert_refused(running.http.post("/sessions", json={"node": "bench", "name": "x"}), 503)
    node.socket.send('{"type":"probe","id":1}')
    node.receive("probe")
    assert node.acked == Intervals([(0, 69)])
    assert running.node()["last_seq"] >= 90  # the live picture goes on
    assert (list_files(data) if data.exists() else None) == found
    if data.exists():
        shutil.rmtree(data)
    away.rename(data)
    reconnect(node, sent)
    assert running.node()["storage_problem"] is None
    assert running.http.get("/ready").status_code == 200
    sealed = node.finish(recording)
    assert (sealed["complete"], sealed["lost"]) == (True, {})
    running.restart()
    assert running.session(recording.id).now()["complete"] is True


def test_frames_of_a_deleted_journal_are_not_acknowledged(
    running: Running, tared: FakeNode
) -> None:
    delete(running.data / "journal" / "bench")
    tared.send(30, 20.0)
    until(lambda: running.node()["storage_problem"])
    with suppress(ConnectionClosed):  # it can write again, and asks for them
        tared.socket.send('{"type":"probe","id":1}')
        tared.receive("probe")
    assert tared.acked == Intervals([(0, 69)])


def test_a_deleted_folder_is_not_created_again_and_logged_once(
    running: Running, tared: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    delete(running.data)
    with Play(tared, 20.0):
        until(lambda: running.node()["storage_problem"])
        assert_refused(running.http.get("/ready"), 503, "nothing in its place")
        time.sleep(0.5)  # some twenty ticks
    assert not running.data.exists()
    assert tared.acked == Intervals([(0, 69)])
    messages = [r.getMessage() for r in caplog.records if "moved, deleted" in r.getMessage()]
    assert 1 <= len(messages) <= 3
    assert not [record for record in caplog.records if record.exc_info]


def test_a_copy_with_the_same_id_is_the_folder(running: Running, tared: FakeNode) -> None:
    # A disk that is mounted again has other inodes.
    away = move_away(running)
    until(lambda: running.node()["storage_problem"])
    shutil.copytree(away, running.data)
    until(lambda: running.http.get("/ready").status_code == 200)
    reconnect(tared)
    assert list_files(running.data) > list_files(away) - {".writable"}


def test_a_copy_in_its_place_between_sync_and_acknowledgement_is_noticed(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The frames are in the old folder, and not in the older copy.
    data, folder = running.data, running.server.data_folder
    copy, away = data.with_name("copy"), data.with_name("away")
    shutil.copytree(data, copy)
    node, check = running.server.nodes.get("bench"), folder.check_still_in_place

    def swap_and_check() -> None:
        if node.last_seq == 99 and copy.exists():
            data.rename(away)
            copy.rename(data)
        check()

    monkeypatch.setattr(folder, "check_still_in_place", swap_and_check)
    reconnect(tared, tared.send(30, 20.0))
    assert away.exists()
    assert list_open_files(away) == set()


def test_no_file_stays_open_in_a_folder_whose_copy_is_used(
    running: Running, tared: FakeNode, node_of: NodeOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A stream that has ended, and a node whose frames a full disk has refused.
    node, other = tared, node_of(running, "other")
    node.leave()
    node.reboot()
    node.connect(earlier=(node.before[0].said(),))
    node.deliver(10)
    other.connect()
    other.deliver(10)
    with monkeypatch.context() as patch:
        full = refusing(StorageError, "No space left on device")
        patch.setattr(running.server.nodes.get("other").present_stream, "sync", full)
        patch.setattr(running.server, "check_writable", full)
        other.send(10)
        until(lambda: running.node("other")["storage_problem"])
    away = move_away(running)
    until(lambda: list_open_files(away) == {LOCK_NAME})
    shutil.copytree(away, running.data)
    assert closed(node.socket)[0] == closed(other.socket)[0] == 1012
    assert list_open_files(away) == set()


def test_a_copy_is_used_once_the_old_folder_is_closed_and_no_other_server_has_it(
    tmp_path: Path,
) -> None:
    data, away = tmp_path / "data", tmp_path / "away"
    folder = DataFolder(data)
    data.rename(away)
    shutil.copytree(away, data)
    for _ in range(2):
        with pytest.raises(FolderGoneError, match="not used yet"):
            folder.check_still_in_place()
    # For the kernel's lock another descriptor is like another process.
    with (data / LOCK_NAME).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="another foottile server"):
            folder.relock_same_folder()
    folder.relock_same_folder()
    folder.check_still_in_place()
    folder.release_lock()


def test_an_unreadable_place_is_a_folder_that_is_gone(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    away = move_away(running)
    with monkeypatch.context() as patch:
        denied = (PermissionError, errno.EACCES, "not for you")
        patch.setattr(Path, "is_dir", failing_if(partial(eq, running.data), Path.is_dir, *denied))
        sent = tared.send(30, 20.0)
        until(lambda: "not for you" in (running.node()["storage_problem"] or ""))
    away.rename(running.data)
    reconnect(tared, sent)


def test_a_bug_in_a_sync_costs_no_frame(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = running.server.nodes.get("bench").present_stream
    monkeypatch.setattr(stream, "sync", failing_once(stream.sync, ZeroDivisionError, "a bug"))
    reconnect(tared, tared.send(30, 20.0))


@pytest.fixture
def mounted(tmp_path: Path) -> Iterator[Path]:
    """A folder with a disk of its own."""
    point = tmp_path / "mount"
    point.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "foottile-test", str(point)]
    if os.geteuid() != 0 or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("only root may mount, and not in every container")
    yield point
    subprocess.run(["umount", "-l", str(point)], capture_output=True)


def test_the_mount_point_of_an_unmounted_disk_stays_empty(mounted: Path) -> None:
    folder = DataFolder(mounted / "data")
    assert subprocess.run(["umount", "-l", str(mounted)]).returncode == 0
    with pytest.raises(FolderGoneError, match="nothing in its place"):
        folder.check_writable()
    assert list(mounted.iterdir()) == []
    folder.release_lock()
