"""A journal whose disk is slow, full or failing; one that writes later makes no append wait."""

from __future__ import annotations

import itertools
import os
import threading
from pathlib import Path
from typing import Any

import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import StorageError
from storage.intervals import Intervals
from storage.journal import segment_writer
from storage.journal.journal import Journal
from storage.journal.segment_writer import SegmentWriter
from storage.wire import encode_frames
from tests.builders.arrays import make_array
from tests.storage.faulty_disk import IO_ERROR, NO_SPACE, disk_with_room_for, failing_if, refusing
from tests.storage.journal.journals import (
    HEADER,
    LONG,
    OPENED,
    SCHEMA,
    assert_holds,
    begun,
    filled,
    members,
    part,
    reopened,
    segments,
)


def later(folder: Path) -> Journal:
    OPENED.append(Journal(folder, make_array(), is_write_deferred=True))
    return OPENED[-1]


def test_appended_frames_are_in_the_file_after_a_sync(tmp_path: Path) -> None:
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 29))
    (path,) = segments(tmp_path)
    assert path.stat().st_size == HEADER
    assert list(journal.stored) == [(0, 29)]
    journal.sync()
    assert path.stat().st_size > HEADER
    assert_holds(reopened(tmp_path), set(range(30)))


def test_what_waits_is_written_before_anything_is_read(tmp_path: Path) -> None:
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 29))
    assert_holds(journal, set(range(30)))
    journal.append_new_frames(part(30, 39))
    assert journal.find_batch_t_ns_near(35, at_or_before=False) == int(part(30, 30).t_ns[0])
    journal.append_new_frames(part(40, 49))
    assert journal.find_first_batch_seq_since(int(part(45, 45).t_ns[0])) == 40
    journal.append_new_frames(part(50, 59))
    assert journal.find_part_last_seq_once_passed(int(part(54, 54).t_ns[0]), part_seq_first=0) == 54
    assert [m.seq_first for m in journal.read_overlapping_messages(0, 59)] == [0, 30, 40, 50]


@settings(max_examples=40)
@given(
    st.lists(st.tuples(st.integers(0, 199), st.integers(1, 30)), max_size=12),
    st.lists(st.booleans(), min_size=12, max_size=12),
)
def test_files_are_the_same_whenever_they_are_written(
    tmp_path_factory: pytest.TempPathFactory, parts: list[tuple[int, int]], synced: list[bool]
) -> None:
    at_once, afterwards = tmp_path_factory.mktemp("at_once"), tmp_path_factory.mktemp("afterwards")
    first = Journal(at_once, make_array())
    second = Journal(afterwards, make_array(), is_write_deferred=True)
    for (begin, count), is_synced in zip(parts, synced, strict=False):
        for journal in (first, second):
            journal.append_new_frames(LONG.slice_rows(begin, min(200, begin + count)))
            if is_synced:
                journal.sync()
    first.close()
    second.close()
    contents = [
        {path.name: path.read_bytes() for path in folder.iterdir()}
        for folder in (at_once, afterwards)
    ]
    assert contents[0] == contents[1]


@pytest.mark.parametrize("room", [0, 100, 1000])
def test_what_the_disk_refuses_goes_on_waiting(tmp_path: Path, room: int) -> None:
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 9))
    journal.sync()
    (path,) = segments(tmp_path)
    size = path.stat().st_size
    journal.append_new_frames(part(10, 29))
    journal.append_new_frames(part(30, 39))
    with disk_with_room_for(size + room), pytest.raises(StorageError):
        journal.sync()
    assert path.stat().st_size == size
    journal.append_new_frames(part(40, 49))
    journal.sync()
    assert_holds(reopened(tmp_path), set(range(50)))


def test_refused_and_invalidated_frames_can_come_again(tmp_path: Path) -> None:
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 9))
    journal.sync()
    journal.append_new_frames(part(10, 39))
    (path,) = segments(tmp_path)
    with disk_with_room_for(path.stat().st_size + 100), pytest.raises(StorageError):
        journal.sync()
    journal.invalidate_batches_wholly_within(Intervals([(10, 39)]))
    assert_holds(journal, set(range(10)))
    journal.append_new_frames(part(10, 19))
    journal.close()
    assert_holds(journal, set(range(20)))
    assert_holds(reopened(tmp_path), set(range(20)))


def test_a_busy_disk_blocks_no_append(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 9))
    begun, may_go_on = threading.Event(), threading.Event()
    write_all = segment_writer.write_all_or_none

    def slow(*arguments: object) -> None:
        begun.set()
        assert may_go_on.wait(30.0)
        write_all(*arguments)  # type: ignore[arg-type]  # handed through

    monkeypatch.setattr(segment_writer, "write_all_or_none", slow)
    syncing = threading.Thread(target=journal.sync)
    syncing.start()
    assert begun.wait(30.0)
    journal.append_new_frames(part(10, 19))  # while the other thread is in the middle of its write
    may_go_on.set()
    syncing.join()
    journal.sync()
    assert_holds(reopened(tmp_path), set(range(20)))


def test_waiting_bytes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_writer, "_MAX_WAITING_BYTES", 1)
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 9))
    (path,) = segments(tmp_path)
    assert path.stat().st_size == HEADER
    journal.append_new_frames(part(10, 19))
    at_once = filled(tmp_path / "at_once", (0, 9), (10, 19))
    assert path.stat().st_size == segments(tmp_path / "at_once")[0].stat().st_size
    at_once.close()


def test_a_closed_segment_stops_no_reader(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    journal = later(tmp_path)
    journal.append_new_frames(part(0, 29))
    write = SegmentWriter.write_waiting

    def closed_just_before(writer: SegmentWriter) -> None:
        writer.close_without_sync()  # as after a close that the disk has refused
        write(writer)

    monkeypatch.setattr(SegmentWriter, "write_waiting", closed_just_before)
    assert (
        journal.find_batch_t_ns_near(5, at_or_before=False) is None
    )  # not acknowledged, and asked for again
    OPENED.remove(journal)  # nothing is left to be closed


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


def test_a_sync_covers_segment_index_and_folder_and_appending_syncs_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    real = os.fsync

    def note(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        real(descriptor)

    monkeypatch.setattr("os.fsync", note)
    journal = begun(tmp_path / "stream")
    for first in range(0, 200, 20):
        journal.append_new_frames(LONG.slice_rows(first, first + 20))
    assert synced == [tmp_path.name]  # the stream's own folder has its name
    synced.clear()
    assert len(segments(tmp_path / "stream")) == 10
    for _ in range(2):
        journal.sync()
        assert len(synced) == 3 * 9 + 2 + 1  # each segment and its index, closed but one; folders
        assert synced[-3:] == [f"{180:020d}.arrows", f"{180:020d}.idx", "stream"]


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
