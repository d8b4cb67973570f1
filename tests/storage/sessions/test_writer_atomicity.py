"""When the file of a sealed session appears, and what stays if it fails."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from devices.errors import FileFormatError
from devices.frames import (
    FrameBatch,
)
from storage.durable_files import remove_dead_process_temporaries
from storage.sessions.writer import SealedFileWriter
from tests.builders.arrays import make_array
from tests.storage.faulty_disk import disk_with_room_for
from tests.storage.sessions.session_files import frames, read, write


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_the_file_appears_only_when_it_is_sealed_and_nothing_stays_beside_it(
    tmp_path: Path,
) -> None:
    path, batch = tmp_path / "s.parquet", frames(3000, period_ns=50_000_000)
    with SealedFileWriter(path, make_array(), {}) as writer:
        for begin in range(0, 3000, 300):
            writer.append_frames(batch.slice_rows(begin, begin + 300), {})
            assert not path.exists()
        assert names_in(tmp_path)  # the first minute is on disk already, under another name
    assert names_in(tmp_path) == ["s.parquet"]


def fail(path: Path, batch: FrameBatch | None, error: type[BaseException]) -> None:
    """Write the batch, if there is one, and then fail within the block."""
    with SealedFileWriter(path, make_array(), {}) as writer:
        if batch is not None:
            writer.append_frames(batch, {})
        raise error


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("rows", [0, 3, 3000])
def test_an_exception_in_the_block_leaves_nothing_behind(
    tmp_path: Path, error: type[BaseException], rows: int
) -> None:
    batch = frames(rows, period_ns=50_000_000) if rows else None
    with pytest.raises(error):
        fail(tmp_path / "s.parquet", batch, error)
    assert names_in(tmp_path) == []


def test_a_file_that_is_there_stays_until_the_new_one_is_sealed(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet", frames(5))
    old = path.read_bytes()
    with SealedFileWriter(path, make_array(), {}) as writer:
        writer.append_frames(frames(1300, period_ns=50_000_000), {})
        assert path.read_bytes() == old
    assert len(read(path)) == 1300


def test_a_file_that_is_there_survives_a_failure(tmp_path: Path) -> None:
    path = write(tmp_path / "s.parquet", frames(5))
    old = path.read_bytes()
    with pytest.raises(RuntimeError):
        fail(path, frames(1300, period_ns=50_000_000), RuntimeError)
    assert path.read_bytes() == old
    assert names_in(tmp_path) == ["s.parquet"]


def test_a_session_without_frames_is_refused_and_leaves_nothing_behind(tmp_path: Path) -> None:
    path = tmp_path / "s.parquet"
    with (
        pytest.raises(FileFormatError, match="no frames"),
        SealedFileWriter(path, make_array(), {}),
    ):
        pass
    assert names_in(tmp_path) == []


def test_it_is_synced_before_it_gets_its_name_and_the_folder_after(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, events = tmp_path / "s.parquet", []
    fsync = os.fsync

    def watched(descriptor: int) -> None:
        target = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        events.append(("folder" if target == tmp_path else "file", path.exists()))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    write(path, frames(5))
    assert events == [("file", False), ("folder", True)]


def test_while_it_is_written_its_name_says_whose_it_is(tmp_path: Path) -> None:
    with SealedFileWriter(tmp_path / "s.parquet", make_array(), {}) as writer:
        writer.append_frames(frames(3000, period_ns=50_000_000), {})
        (name,) = names_in(tmp_path)
        assert name.startswith(f".s.parquet.{os.getpid()}.")
        assert remove_dead_process_temporaries(tmp_path) == []
    assert names_in(tmp_path) == ["s.parquet"]


@pytest.mark.parametrize("room", [0, 1, 100, 4000, 9000])
def test_a_full_disk_is_an_os_error_and_leaves_nothing_behind(tmp_path: Path, room: int) -> None:
    path, batch = tmp_path / "s.parquet", frames(2000)
    assert write(tmp_path / "whole.parquet", batch).stat().st_size > 10_000
    (tmp_path / "whole.parquet").unlink()
    with pytest.raises(OSError, match=r"[Ff]ile too large|EFBIG"), disk_with_room_for(room):
        write(path, batch)
    assert names_in(tmp_path) == []


def test_a_folder_that_is_not_there_is_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="missing"):
        write(tmp_path / "missing" / "s.parquet", frames(5))
