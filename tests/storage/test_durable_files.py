"""Files that are whole or not there, and errors that name the file."""

from __future__ import annotations

import errno
import fcntl
import os
import re
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError, StorageError
from storage import durable_files
from storage.clock.log import ClockLog, ClockOffset
from storage.durable_files import (
    lock_folder,
    make_synced_folder,
    make_temporary_path,
    remove_dead_process_temporaries,
    set_aside_damaged,
    sync_folder,
    translate_storage_errors,
    write_atomically,
)
from storage.journal.journal import Journal
from storage.permissions import set_umask_and_create_private_folder
from storage.sessions.folder import Part, Session, SessionsFolder
from tests.builders.arrays import make_array
from tests.storage.faulty_disk import IO_ERROR, disk_with_room_for, refusing

STREAM_ID = "a" * 32
OFFSET = ClockOffset(
    stream_id=STREAM_ID, t_mono_ns=0, server_minus_node_ns=0, uncertainty_ns=1_000_000
)
SESSION = Session(
    id="20200131T235959Z-0a1b2c",
    name="first walk",
    node="bench",
    state="recording",
    started_t_ns=10**18,
    parts=(Part(stream_id=STREAM_ID, seq_first=0),),
    scene="mud",
)


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@settings(max_examples=20)
@given(st.lists(st.binary(max_size=5000), min_size=1, max_size=4))
def test_a_file_is_replaced_and_nothing_lies_beside_it(
    tmp_path_factory: pytest.TempPathFactory, contents: list[bytes]
) -> None:
    folder = tmp_path_factory.mktemp("whole")
    for content in contents:
        write_atomically(folder / "file.json", content)
        assert files_in(folder) == {"file.json": content}


def test_a_secret_is_closed_to_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    modes, fsync = set[int](), os.fsync

    def watched(descriptor: int) -> None:
        modes.update(p.stat().st_mode & 0o077 for p in tmp_path.iterdir())
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write_atomically(tmp_path / "token", b"secret", mode=0o600)
    assert modes == {0}
    assert (tmp_path / "token").stat().st_mode & 0o777 == 0o600


def test_content_is_synced_before_its_name_and_its_name_at_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, events, fsync = tmp_path / "file", [], os.fsync

    def watched(descriptor: int) -> None:
        target = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        size = target.stat().st_size if target.is_file() else None
        events.append(("folder" if target == tmp_path else "file", size, path.exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write_atomically(path, b"12345")
    assert events == [("file", 5, False), ("folder", None, True)]


@pytest.mark.parametrize("room", [0, 1, 4095])
@pytest.mark.parametrize("before", [None, b"what was there"])
def test_a_full_disk_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, room: int, before: bytes | None
) -> None:
    path = tmp_path / "file"
    if before is not None:
        path.write_bytes(before)
    with (
        pytest.raises(StorageError, match=r"[Ff]ile too large") as caught,
        disk_with_room_for(room),
    ):
        write_atomically(path, b"x" * 4096)
    assert caught.value.where == str(path)
    assert caught.value.remedy
    assert files_in(tmp_path) == ({} if before is None else {"file": before})


@pytest.mark.parametrize(
    ("error", "raised"), [(IO_ERROR, StorageError), ((KeyboardInterrupt,), KeyboardInterrupt)]
)
def test_a_failed_or_interrupted_sync_leaves_the_old_file(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: tuple[Any, ...],
    raised: type[BaseException],
) -> None:
    write_atomically(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "fsync", refusing(*error))
    with pytest.raises(raised):
        write_atomically(tmp_path / "file", b"new")
    assert files_in(tmp_path) == {"file": b"old"}


def test_a_file_that_cannot_be_made_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "taken").mkdir()
    names = ("missing/x", "file/x", "taken", "n" * 300)
    for path in (tmp_path / name for name in names):
        with pytest.raises(StorageError) as caught:
            write_atomically(path, b"content")
        assert caught.value.where == str(path)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "taken"}


@pytest.mark.parametrize(
    "write",
    [
        pytest.param(lambda folder: Journal(folder, make_array()), id="journal"),
        pytest.param(lambda folder: ClockLog(folder).append(OFFSET), id="clock log"),
        pytest.param(
            lambda folder: SessionsFolder(folder).save_session_json(SESSION), id="session"
        ),
    ],
)
def test_a_folder_that_cannot_be_made_is_a_storage_error(
    tmp_path: Path, write: Callable[[Path], object]
) -> None:
    (tmp_path / "file").write_bytes(b"")
    for folder in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(StorageError, match=re.escape(str(tmp_path / "file"))):
            write(folder)


def test_only_a_folder_can_be_synced_as_one(tmp_path: Path) -> None:
    sync_folder(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NotADirectoryError):
        sync_folder(tmp_path / "file")
    descriptors = len(os.listdir("/proc/self/fd"))
    sync_folder(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == descriptors


def folders_answer(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """Have every fsync of a folder fail with this error, as on a file system without it."""
    fsync = os.fsync

    def answer(descriptor: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(number, os.strerror(number))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", answer)
    monkeypatch.setattr(durable_files, "_warned_devices", set())


@pytest.mark.parametrize(
    "number", [errno.EINVAL, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOSYS, errno.EBADF]
)
def test_a_file_system_that_cannot_sync_folders_is_warned_of_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, number: int
) -> None:
    folders_answer(monkeypatch, number)
    with lock_folder(tmp_path):
        [warning] = caplog.messages  # at the start, before anything is written
        make_synced_folder(tmp_path / "a" / "b")
        write_atomically(tmp_path / "a" / "b" / "file", b"content")
        set_aside_damaged(tmp_path / "a" / "b" / "file")
    assert str(tmp_path) in warning
    assert "power" in warning
    assert caplog.messages == [warning]
    assert files_in(tmp_path / "a" / "b") == {"file.damaged-1": b"content"}


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC])
def test_a_disk_that_fails_to_sync_a_folder_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    folders_answer(monkeypatch, number)
    with pytest.raises(StorageError) as caught:
        write_atomically(tmp_path / "file", b"new")
    assert caught.value.errno == number
    assert caught.value.where == str(tmp_path / "file")


@pytest.mark.parametrize(
    "number", [errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EINVAL, errno.EIO]
)
def test_a_folder_without_locks_is_refused_by_name_and_with_a_way_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    monkeypatch.setattr(fcntl, "flock", refusing(OSError, number, os.strerror(number)))
    descriptors = len(os.listdir("/proc/self/fd"))
    with pytest.raises(StorageError, match="no lock") as caught, lock_folder(tmp_path):
        pass
    assert caught.value.where == str(tmp_path)
    assert caught.value.errno == number
    assert "local disk" in caught.value.remedy
    assert len(os.listdir("/proc/self/fd")) == descriptors


@pytest.mark.parametrize("number", [errno.EPERM, errno.EINVAL, errno.ENOTSUP, errno.ENOSYS])
def test_a_file_system_without_permissions_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    (tmp_path / "data").mkdir(mode=0o755)
    monkeypatch.setattr(os, "chmod", refusing(OSError, number, os.strerror(number)))
    umask = os.umask(0o022)
    try:
        set_umask_and_create_private_folder(tmp_path / "data")
        assert os.umask(0o022) == 0o077
    finally:
        os.umask(umask)


def test_a_failed_chmod_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "chmod", refusing(*IO_ERROR))
    umask = os.umask(0o022)
    try:
        (tmp_path / "data").mkdir(mode=0o755)
        with pytest.raises(StorageError, match="closed to other users") as caught:
            set_umask_and_create_private_folder(tmp_path / "data")
    finally:
        os.umask(umask)
    assert caught.value.where == str(tmp_path / "data")


def test_a_system_error_names_the_path_and_a_remedy() -> None:
    with pytest.raises(StorageError, match="No space left") as caught:  # noqa: SIM117  # it is the inner one's error
        with translate_storage_errors(Path("/data/x")):
            raise OSError(28, "No space left on device")
    assert caught.value.where == "/data/x"
    assert "Free space" in caught.value.remedy
    assert isinstance(caught.value.__cause__, OSError)
    with (
        pytest.raises(StorageError, match="Plug it in"),
        translate_storage_errors(Path("x"), "Plug it in"),
    ):
        raise OSError(5, "Input/output error")


@pytest.mark.parametrize(
    "error", [StorageError("the inner one", where="inner"), FileFormatError("no"), KeyError("k")]
)
def test_errors_that_say_enough_pass_as_they_are(error: Exception) -> None:
    with pytest.raises(type(error)) as caught, translate_storage_errors(Path("outer")):
        raise error
    assert caught.value is error


def test_parents_of_new_folders_are_synced(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr(durable_files, "sync_folder", lambda folder: synced.append(folder.name))
    make_synced_folder(tmp_path / "sessions" / "one" / "two")
    assert synced == [tmp_path.name, "sessions", "one"]
    assert (tmp_path / "sessions" / "one" / "two").is_dir()
    synced.clear()
    make_synced_folder(tmp_path / "sessions" / "one")
    assert synced == ["sessions"]


# --- what dead processes leave --------------------------------------------------------------------

_NAME = (
    "from pathlib import Path; from storage.durable_files import make_temporary_path; "
    "print(make_temporary_path(Path({!r})))"
)


def temporary_of_another(path: Path, then: str = "") -> subprocess.Popen[str]:
    """A process that prints the name it would write under."""
    code = _NAME.format(str(path)) + then
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def first_line(process: subprocess.Popen[str]) -> Path:
    assert process.stdout is not None
    return Path(process.stdout.readline().strip())


@pytest.mark.process
def test_files_of_a_dead_process_are_removed_and_no_others(tmp_path: Path) -> None:
    with temporary_of_another(tmp_path / "frames.parquet") as process:
        stale = first_line(process)
    mine = make_temporary_path(tmp_path / "session.json")
    others = [".lock", "session.json", ".tmp", "a.1.2.0123abcd.tmp", ".frames.parquet.part"]
    for path in (stale, mine, *(tmp_path / name for name in others)):
        path.write_bytes(b"x")
    (tmp_path / f".folder.{process.pid}.tmp").mkdir()
    assert remove_dead_process_temporaries(tmp_path) == [stale]
    assert {p.name for p in tmp_path.iterdir() if p.is_file()} == {mine.name, *others}
    assert remove_dead_process_temporaries(tmp_path) == []


@pytest.mark.process
def test_what_a_living_process_is_writing_stays(tmp_path: Path) -> None:
    with temporary_of_another(
        tmp_path / "frames.parquet", "; import sys, time; sys.stdout.flush(); time.sleep(60)"
    ) as process:
        writing = first_line(process)
        writing.write_bytes(b"x")
        assert remove_dead_process_temporaries(tmp_path) == []
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        # It is dead, although nobody has asked for its end.
        assert remove_dead_process_temporaries(tmp_path) == [writing]


def test_a_reused_process_number_is_no_sign_of_life(tmp_path: Path) -> None:
    mine = make_temporary_path(tmp_path / "x")
    parts = mine.name.split(".")
    stale = mine.with_name(".".join([*parts[:3], str(int(parts[3]) - 1), *parts[4:]]))
    stale.write_bytes(b"")
    assert remove_dead_process_temporaries(tmp_path) == [stale]


def test_a_folder_that_is_not_there_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(StorageError) as caught:
        remove_dead_process_temporaries(tmp_path / "none")
    assert caught.value.where == str(tmp_path / "none")
