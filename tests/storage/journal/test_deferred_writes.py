"""A journal that writes later: who appends never waits for the disk."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import StorageError
from storage.intervals import Intervals
from storage.journal import segment_writer
from storage.journal.journal import Journal
from storage.journal.segment_writer import SegmentWriter
from tests.builders.arrays import make_array
from tests.storage.faulty_disk import disk_with_room_for
from tests.storage.journal.journals import (
    HEADER,
    LONG,
    OPENED,
    assert_holds,
    filled,
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
