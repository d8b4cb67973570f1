"""A data folder that goes away under a running server: nothing is promised that is not in it."""

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

import storage.sessions.folder
from devices.errors import FolderGoneError, StorageError
from service.server.data_folder import DataFolder
from storage.durable_files import LOCK_NAME
from storage.intervals import Intervals
from tests.builders.frames import assert_same_bits
from tests.service.fake_node import FakeNode, NodeOf, Play
from tests.service.running import Running, assert_refused, closed
from tests.storage.faulty_disk import failing_if, failing_once, refusing
from tests.waiting import until


def files_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def open_below(folder: Path) -> set[str]:
    """Names of files below it that this process has open."""
    found = set()
    for each in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            if (path := Path(os.readlink(each))).is_relative_to(folder):
                found.add(path.name)
    return found


def delete(folder: Path) -> None:
    """All at once, before something new is written into it."""
    doomed = folder.with_name("doomed")
    folder.rename(doomed)
    shutil.rmtree(doomed)


def nothing(data: Path) -> None:
    """In the place of the folder."""


def an_empty_folder(data: Path) -> None:
    data.mkdir()


def a_foreign_folder(data: Path) -> None:
    data.mkdir()
    (data / "thesis.tex").touch()


def another_servers(data: Path) -> None:
    other = data.with_name("other")
    DataFolder(other).release_lock()
    other.rename(data)


@pytest.mark.parametrize(
    ("put", "said"),
    [
        (nothing, "there is nothing in its place"),
        (an_empty_folder, "an empty mount point"),
        (a_foreign_folder, "another folder"),
        (another_servers, "another server"),
    ],
)
def test_while_the_folder_is_away_nothing_is_promised_or_written_in_its_place(
    running: Running, tared: FakeNode, put: Callable[[Path], None], said: str
) -> None:
    node, data = tared, running.data
    away = data.with_name("away")
    data.rename(away)
    put(data)
    found = files_in(data) if data.exists() else None
    sent = node.send(30, 20.0)
    until(lambda: said in (running.node()["storage_problem"] or ""))
    assert_refused(running.http.get("/ready"), 503, said)
    assert_refused(running.http.post("/sessions", json={"node": "bench", "name": "x"}), 503)
    node.socket.send('{"type":"probe","id":1}')
    node.receive("probe")
    assert node.acked == Intervals([(0, 69)])
    assert running.node()["last_seq"] >= 90  # the picture goes on
    assert (files_in(data) if data.exists() else None) == found
    if data.exists():
        shutil.rmtree(data)
    away.rename(data)
    assert closed(node.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    node.connect()
    node.send_again(sent)
    node.send(10, 20.0)
    node.acknowledged(node.seq - 1)
    assert running.node()["storage_problem"] is None
    assert running.http.get("/ready").status_code == 200
    assert_same_bits(running.held(node.stream_id), node.all_sent())


def test_a_recording_is_complete_although_the_folder_was_away_in_the_middle(
    running: Running, tared: FakeNode
) -> None:
    node = tared
    recording = node.record()
    node.deliver(50, 20.0)
    away = running.data.with_name("away")
    running.data.rename(away)
    sent = node.send(50, 20.0)
    until(lambda: running.node()["storage_problem"])
    away.rename(running.data)
    assert closed(node.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    node.connect()
    node.send_again(sent)
    node.acknowledged(int(sent.seq[-1]))
    sealed = node.finish(recording)
    assert sealed["complete"] is True
    assert sealed["lost"] == {}
    running.restart()
    assert running.session(recording.id).now()["complete"] is True


def test_frames_whose_own_file_was_deleted_are_not_acknowledged(
    running: Running, tared: FakeNode
) -> None:
    delete(running.data / "journal" / "bench")
    tared.send(30, 20.0)
    until(lambda: running.node()["storage_problem"])
    tared.socket.send('{"type":"probe","id":1}')
    tared.receive("probe")
    assert tared.acked == Intervals([(0, 69)])


def test_a_folder_that_was_deleted_is_not_made_again(running: Running, tared: FakeNode) -> None:
    delete(running.data)
    with Play(tared, 20.0):
        until(lambda: running.node()["storage_problem"])
        assert_refused(running.http.get("/ready"), 503, "nothing in its place")
    assert not running.data.exists()
    assert tared.acked == Intervals([(0, 69)])


def test_a_copy_with_the_same_id_is_the_folder(running: Running, tared: FakeNode) -> None:
    # As it is when a disk is mounted anew: other inodes, the same content.
    away = running.data.with_name("away")
    running.data.rename(away)
    until(lambda: running.node()["storage_problem"])
    shutil.copytree(away, running.data)
    until(lambda: running.http.get("/ready").status_code == 200)
    assert closed(tared.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    tared.connect()
    tared.send(30, 20.0)
    tared.acknowledged(int(tared.sent[-1].seq[-1]))
    assert files_in(running.data) > files_in(away) - {".writable"}
    assert_same_bits(running.held(tared.stream_id), tared.all_sent())


def test_a_copy_that_took_its_place_between_sync_and_acknowledgement_is_promised_nothing(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Frames are on the disk in the old folder, and not in the copy, which was made before.
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
    sent = tared.send(30, 20.0)
    assert closed(tared.socket)[0] == 1012
    assert away.exists()
    until(lambda: not running.node()["connected"])
    assert tared.connect() == [(70, None)]
    tared.send_again(sent)
    tared.acknowledged(99)
    assert_same_bits(running.held(tared.stream_id), tared.all_sent())
    assert open_below(away) == set()


def test_nothing_stays_open_in_a_folder_whose_copy_is_used(
    running: Running, tared: FakeNode, node_of: NodeOf, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A stream that has ended, and a node of which was said before that nothing of it is kept.
    node, other = tared, node_of(running, "other")
    node.leave()
    node.reboot()
    node.connect(earlier=(node.before[0].said(),))
    node.deliver(10)
    other.connect()
    other.deliver(10)
    with monkeypatch.context() as patched:
        full = refusing(StorageError, "No space left on device")
        patched.setattr(running.server.nodes.get("other").present_stream, "sync", full)
        patched.setattr(running.server, "check_writable", full)
        other.send(10)
        until(lambda: running.node("other")["storage_problem"])
    away = running.data.with_name("away")
    running.data.rename(away)
    until(lambda: open_below(away) == {LOCK_NAME})
    shutil.copytree(away, running.data)
    assert closed(node.socket)[0] == closed(other.socket)[0] == 1012
    assert open_below(away) == set()


def test_a_folder_is_not_used_before_what_is_open_in_the_one_before_is_closed(
    tmp_path: Path,
) -> None:
    data, away = tmp_path / "data", tmp_path / "away"
    folder = DataFolder(data)
    data.rename(away)
    shutil.copytree(away, data)
    for _ in range(2):
        with pytest.raises(FolderGoneError, match="not used yet"):
            folder.check_still_in_place()
    folder.relock_same_folder()
    folder.check_still_in_place()
    folder.release_lock()


def test_a_copy_that_another_server_has_is_not_taken_from_it(tmp_path: Path) -> None:
    data, away = tmp_path / "data", tmp_path / "away"
    folder = DataFolder(data)
    data.rename(away)
    shutil.copytree(away, data)
    # The lock is the kernel's: another descriptor of this process is as good as another process.
    with (data / LOCK_NAME).open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(StorageError, match="another foottile server"):
            folder.relock_same_folder()
    folder.relock_same_folder()
    folder.release_lock()


def test_a_place_that_cannot_be_seen_is_a_folder_that_is_gone(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    away, denied = running.data.with_name("away"), (PermissionError, errno.EACCES, "not for you")
    running.data.rename(away)
    with monkeypatch.context() as patched:
        is_it = partial(eq, running.data)
        patched.setattr(Path, "is_dir", failing_if(is_it, Path.is_dir, *denied))
        sent = tared.send(30, 20.0)
        until(lambda: "not for you" in (running.node()["storage_problem"] or ""))
    away.rename(running.data)
    assert closed(tared.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    assert tared.connect() == [(70, None)]
    tared.send_again(sent)
    tared.acknowledged(99)


def test_a_bug_on_the_way_to_the_disk_costs_no_frame(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = running.server.nodes.get("bench").present_stream
    monkeypatch.setattr(stream, "sync", failing_once(stream.sync, ZeroDivisionError, "a bug"))
    sent = tared.send(30, 20.0)
    assert closed(tared.socket)[0] == 1012
    until(lambda: not running.node()["connected"])
    assert tared.connect() == [(70, None)]
    tared.send_again(sent)
    tared.acknowledged(99)
    assert_same_bits(running.held(tared.stream_id), tared.all_sent())


def test_the_log_says_it_once(
    running: Running, tared: FakeNode, caplog: pytest.LogCaptureFixture
) -> None:
    running.data.rename(running.data.with_name("away"))
    with Play(tared, 20.0):
        until(lambda: running.node()["storage_problem"])
        time.sleep(0.5)  # some twenty ticks
    said = [record for record in caplog.records if "moved, deleted" in record.getMessage()]
    assert 1 <= len(said) <= 3
    assert not [record for record in caplog.records if record.exc_info]
    running.data.with_name("away").rename(running.data)


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


def test_a_disk_that_is_unmounted_takes_nothing_and_its_mount_point_neither(mounted: Path) -> None:
    data = mounted / "data"
    folder = DataFolder(data)
    assert subprocess.run(["umount", "-l", str(mounted)]).returncode == 0
    with pytest.raises(FolderGoneError, match="nothing in its place"):
        folder.check_writable()
    assert list(mounted.iterdir()) == []
    folder.release_lock()


def test_a_start_that_a_full_disk_refuses_leaves_nothing(
    running: Running, tared: FakeNode, monkeypatch: pytest.MonkeyPatch
) -> None:
    full = refusing(StorageError, "No space left on device")
    with monkeypatch.context() as patched:
        patched.setattr(storage.sessions.folder, "write_checksummed_json", full)
        assert_refused(running.http.post("/sessions", json={"node": "bench", "name": "x"}), 507)
    assert list((running.data / "sessions").iterdir()) == []
    assert running.sessions() == []
    assert tared.finish(tared.record())["complete"] is True
