"""Files that are whole or not there, and errors that name the file."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError, StorageError
from storage import durable
from storage.durable import (
    make_folder,
    remove_stale_temporaries,
    storage_errors,
    sync_folder,
    temporary_of,
    write_whole,
)
from tests.storage.faulty_disk import IO_ERROR, disk_with_room_for, refusing


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@settings(max_examples=20, deadline=None)
@given(st.lists(st.binary(max_size=5000), min_size=1, max_size=4))
def test_a_file_holds_what_was_written_last_and_nothing_lies_beside_it(
    tmp_path_factory: pytest.TempPathFactory, contents: list[bytes]
) -> None:
    folder = tmp_path_factory.mktemp("whole")
    for content in contents:
        write_whole(folder / "file.json", content)
        assert files_in(folder) == {"file.json": content}


def test_what_is_secret_is_never_readable_by_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    modes, fsync = set[int](), os.fsync

    def watched(descriptor: int) -> None:
        modes.update(p.stat().st_mode & 0o077 for p in tmp_path.iterdir())
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write_whole(tmp_path / "token", b"secret", mode=0o600)
    assert modes == {0}
    assert (tmp_path / "token").stat().st_mode & 0o777 == 0o600


def test_the_content_is_on_the_disk_before_the_name_and_the_name_before_it_returns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, events, fsync = tmp_path / "file", [], os.fsync

    def watched(descriptor: int) -> None:
        target = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        size = target.stat().st_size if target.is_file() else None
        events.append(("folder" if target == tmp_path else "file", size, path.exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write_whole(path, b"12345")
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
        write_whole(path, b"x" * 4096)
    assert caught.value.where == str(path)
    assert caught.value.remedy
    assert files_in(tmp_path) == ({} if before is None else {"file": before})


def test_a_disk_that_does_not_sync_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_whole(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "fsync", refusing(*IO_ERROR))
    with pytest.raises(StorageError, match="Input/output error"):
        write_whole(tmp_path / "file", b"new")
    assert files_in(tmp_path) == {"file": b"old"}


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(descriptor: int) -> None:
        raise KeyboardInterrupt

    write_whole(tmp_path / "file", b"old")
    monkeypatch.setattr(os, "fsync", interrupt)
    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "file", b"new")
    assert files_in(tmp_path) == {"file": b"old"}


def test_a_folder_that_is_not_there_or_is_no_folder_is_an_error_that_names_the_file(
    tmp_path: Path,
) -> None:
    (tmp_path / "file").write_bytes(b"")
    for path in (tmp_path / "missing" / "x", tmp_path / "file" / "x", tmp_path / ("n" * 300)):
        with pytest.raises(StorageError) as caught:
            write_whole(path, b"content")
        assert caught.value.where == str(path)
    assert files_in(tmp_path) == {"file": b""}


def test_a_folder_in_place_of_the_file_is_an_error_and_stays(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(StorageError):
        write_whole(tmp_path / "taken", b"content")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_only_a_folder_can_be_synced_as_one(tmp_path: Path) -> None:
    sync_folder(tmp_path)
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(NotADirectoryError):
        sync_folder(tmp_path / "file")
    descriptors = len(os.listdir("/proc/self/fd"))
    sync_folder(tmp_path)
    assert len(os.listdir("/proc/self/fd")) == descriptors


def test_an_error_of_the_system_becomes_one_that_names_the_path() -> None:
    with pytest.raises(StorageError, match="No space left") as caught:  # noqa: SIM117  # it is the inner one's error
        with storage_errors(Path("/data/x")):
            raise OSError(28, "No space left on device")
    assert caught.value.where == "/data/x"
    assert "Free space" in caught.value.remedy
    assert isinstance(caught.value.__cause__, OSError)


def test_a_remedy_may_be_given() -> None:
    with pytest.raises(StorageError, match="Plug it in"), storage_errors(Path("x"), "Plug it in"):
        raise OSError(5, "Input/output error")


@pytest.mark.parametrize(
    "error", [StorageError("the inner one", where="inner"), FileFormatError("no"), KeyError("k")]
)
def test_errors_that_say_enough_pass_as_they_are(error: Exception) -> None:
    with pytest.raises(type(error)) as caught, storage_errors(Path("outer")):
        raise error
    assert caught.value is error


def test_the_names_of_new_folders_are_on_the_disk_all_the_way_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    monkeypatch.setattr(durable, "sync_folder", lambda folder: synced.append(folder.name))
    make_folder(tmp_path / "sessions" / "one" / "two")
    assert synced == [tmp_path.name, "sessions", "one"]
    assert (tmp_path / "sessions" / "one" / "two").is_dir()
    synced.clear()
    make_folder(tmp_path / "sessions" / "one")
    assert synced == ["sessions"]


# --- what dead processes leave --------------------------------------------------------------------

_NAME = (
    "from pathlib import Path; from storage.durable import temporary_of; "
    "print(temporary_of(Path({!r})))"
)


def temporary_of_another(path: Path, then: str = "") -> subprocess.Popen[str]:
    """A process that prints the name it would write under."""
    code = _NAME.format(str(path)) + then
    return subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)


def first_line(process: subprocess.Popen[str]) -> Path:
    assert process.stdout is not None
    return Path(process.stdout.readline().strip())


@pytest.mark.process
def test_what_a_dead_process_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    with temporary_of_another(tmp_path / "frames.parquet") as process:
        stale = first_line(process)
    older = tmp_path / f".frames.parquet.{process.pid}.tmp"
    even_older = tmp_path / f".session.json.{process.pid}-0123abcd.tmp"
    mine = temporary_of(tmp_path / "session.json")
    others = [".lock", "session.json", ".tmp", "a.1.2.0123abcd.tmp", ".frames.parquet.part"]
    for path in (stale, older, even_older, mine, *(tmp_path / name for name in others)):
        path.write_bytes(b"x")
    (tmp_path / f".folder.{process.pid}.tmp").mkdir()
    assert sorted(remove_stale_temporaries(tmp_path)) == sorted([stale, older, even_older])
    assert {p.name for p in tmp_path.iterdir() if p.is_file()} == {mine.name, *others}
    assert remove_stale_temporaries(tmp_path) == []


@pytest.mark.process
def test_what_a_living_process_is_writing_stays(tmp_path: Path) -> None:
    with temporary_of_another(
        tmp_path / "frames.parquet", "; import sys, time; sys.stdout.flush(); time.sleep(60)"
    ) as process:
        writing = first_line(process)
        writing.write_bytes(b"x")
        assert remove_stale_temporaries(tmp_path) == []
        process.kill()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
        # It is dead, although nobody has asked for its end.
        assert remove_stale_temporaries(tmp_path) == [writing]


def test_a_number_that_was_given_to_another_process_is_no_sign_of_life(tmp_path: Path) -> None:
    mine = temporary_of(tmp_path / "x")
    parts = mine.name.split(".")
    stale = mine.with_name(".".join([*parts[:3], str(int(parts[3]) - 1), *parts[4:]]))
    stale.write_bytes(b"")
    assert remove_stale_temporaries(tmp_path) == [stale]


def test_a_folder_that_is_not_there_is_an_error_that_names_it(tmp_path: Path) -> None:
    with pytest.raises(StorageError) as caught:
        remove_stale_temporaries(tmp_path / "none")
    assert caught.value.where == str(tmp_path / "none")
