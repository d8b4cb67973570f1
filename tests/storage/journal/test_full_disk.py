"""A journal whose disk is full, slow or failing."""

from __future__ import annotations

import itertools
import os
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest

from devices.errors import StorageError
from storage.journal import segment_writer
from storage.wire import encode_frames
from tests.storage.faulty_disk import IO_ERROR, NO_SPACE, disk_with_room_for, failing_if, refusing
from tests.storage.journal.journals import (
    HEADER,
    LONG,
    SCHEMA,
    assert_holds,
    begun,
    filled,
    members,
    part,
    reopened,
    segments,
)


@pytest.mark.parametrize("short", [1, 500, 2000])
def test_a_full_disk_stores_nothing_of_the_batch(tmp_path: Path, short: int) -> None:
    journal = filled(tmp_path, (0, 9))
    (path,) = segments(tmp_path)
    needed = len(encode_frames(part(10, 39), SCHEMA))
    # In the segment that is written, then in the new ones that are tried.
    for begin in (path.stat().st_size, HEADER, HEADER):
        with pytest.raises(StorageError) as caught, disk_with_room_for(begin + needed - short):
            journal.append_new_frames(part(10, 39))
        assert str(tmp_path) in str(caught.value)
        assert_holds(journal, set(range(10)))
    journal.append_new_frames(part(10, 39))
    journal.append_new_frames(part(40, 49))
    assert_holds(journal, set(range(50)))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(50)))
    for segment in segments(tmp_path):
        assert pa.ipc.open_stream(segment.read_bytes()).read_all().num_rows > 0


@pytest.mark.parametrize("room", [0, 100, HEADER - 1, HEADER, HEADER + 500])
def test_a_disk_full_from_the_beginning_leaves_nothing(tmp_path: Path, room: int) -> None:
    journal = begun(tmp_path)
    for _ in range(2):
        with pytest.raises(StorageError), disk_with_room_for(room):
            journal.append_new_frames(part(0, 59))
        assert_holds(journal, set())
    journal.append_new_frames(part(0, 59))
    assert_holds(journal, set(range(60)))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(60)))


def test_a_half_batch_is_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A write that stops halfway and cannot be taken back: the next begins another segment."""
    journal = filled(tmp_path, (0, 9))
    whole = segment_writer.write_all_or_none

    def halfway(file: Any, data: bytes) -> None:
        whole(file, data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(segment_writer, "write_all_or_none", halfway)
        with pytest.raises(StorageError, match="No space left"):
            journal.append_new_frames(part(10, 19))
    assert_holds(journal, set(range(10)))
    journal.append_new_frames(part(10, 19))
    journal.append_new_frames(part(20, 29))
    assert_holds(journal, set(range(30)))
    assert len(segments(tmp_path)) == 2
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


@pytest.mark.parametrize("written", [0, 1, 2])
def test_a_disk_that_fills_within_a_batch_stores_what_was_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """A batch that fills three gaps is three writes."""
    journal, stored = filled(tmp_path, (5, 9), (15, 19)), {*range(5, 10), *range(15, 20)}
    writes = itertools.count(1)  # of each gap a header, a batch and a record
    full = failing_if(
        lambda *_: next(writes) > 3 * written, segment_writer.write_all_or_none, *NO_SPACE
    )
    with monkeypatch.context() as patch:
        patch.setattr(segment_writer, "write_all_or_none", full)
        with pytest.raises(StorageError):
            journal.append_new_frames(part(0, 29))
    assert_holds(journal, stored | set(range(10 * written)))
    assert members(journal.append_new_frames(part(0, 29))) == set(range(30)) - stored - set(
        range(10 * written)
    )
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


def test_appending_does_not_sync(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[int] = []
    real = os.fsync

    def count(descriptor: int) -> None:
        synced.append(descriptor)
        real(descriptor)

    journal = begun(tmp_path / "stream")
    monkeypatch.setattr("os.fsync", count)
    for first in range(0, 200, 20):
        journal.append_new_frames(LONG.slice_rows(first, first + 20))
    assert synced == []
    assert len(segments(tmp_path / "stream")) == 10
    journal.sync()
    assert len(synced) == 3 * 9 + 2 + 1  # each segment and its index, closed but one; the folder
    journal.sync()
    assert len(synced) == 3 * 9 + 2 + 1


def test_a_failed_sync_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = filled(tmp_path, (0, 9))
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", refusing(*IO_ERROR))
        with pytest.raises(StorageError, match="Input/output error"):
            journal.sync()
        with pytest.raises(StorageError, match="Input/output error"):
            journal.close()
    journal.append_new_frames(part(10, 19))
    assert_holds(journal, set(range(20)))


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StorageError):
        begun(tmp_path / "file" / "journal")


def test_recovery_on_a_full_disk_leaves_nothing(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9)).close()
    (path,) = segments(tmp_path)
    path.write_bytes(path.read_bytes() + bytes(5000))
    before = sorted(tmp_path.iterdir())
    for _ in range(3):
        with pytest.raises(StorageError), disk_with_room_for(1000):
            reopened(tmp_path)
        assert sorted(tmp_path.iterdir()) == before
    assert_holds(reopened(tmp_path), set(range(10)))
