"""The journal: every frame once, whatever comes twice and in whatever order."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

import pyarrow as pa
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError, StorageError
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.segment_writer import SEGMENT_DURATION_NS
from storage.schema import frames_from_record_batch
from storage.wire import encode_frames
from tests.builders.arrays import UTC_NS, make_array
from tests.builders.frames import assert_same_bits
from tests.storage.journal.journals import (
    HEADER,
    LONG,
    SCHEMA,
    TOP,
    assert_holds,
    begun,
    filled,
    members,
    part,
    reopened,
    segments,
)

ends = st.tuples(st.integers(0, TOP - 1), st.integers(0, TOP - 1)).map(
    lambda pair: (min(pair), max(pair))
)


@settings(max_examples=60)
@given(parts=st.lists(ends, max_size=8), asked=ends, reopen=st.integers(0, 8), sent=st.booleans())
def test_each_frame_is_stored_once_in_whatever_order_they_come(
    tmp_path_factory: pytest.TempPathFactory,
    parts: list[tuple[int, int]],
    asked: tuple[int, int],
    reopen: int,
    sent: bool,
) -> None:
    folder = tmp_path_factory.mktemp("journal")
    journal, stored = begun(folder), set[int]()
    for number, (first, last) in enumerate(parts):
        if number == reopen:
            journal.close()
            journal = begun(folder)
        batch = part(first, last)
        new = journal.append_new_frames(batch, encode_frames(batch, SCHEMA) if sent else None)
        assert members(new) == set(range(first, last + 1)) - stored
        stored |= set(range(first, last + 1))
    assert_holds(journal, stored)
    assert_holds(journal, stored, *asked)
    journal.close()
    assert_holds(begun(folder), stored, *asked)
    if parts:
        journal = reopened(folder)
        assert journal.info == make_array()
        assert_holds(journal, stored, *asked)


def test_frames_are_read_before_and_after_a_sync(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9))
    assert_holds(journal, set(range(10)))
    journal.sync()
    journal.append_new_frames(part(10, 19))
    journal.sync()
    journal.close()
    journal.sync()
    assert_holds(journal, set(range(20)))


def test_reading_goes_on_while_frames_come(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9), (10, 19))
    reading = journal.read_frames(0, 100)
    first = next(reading)
    journal.append_new_frames(part(20, 29))
    read = [first, *reading]
    assert [int(seq) for batch in read for seq in batch.seq] == list(range(20))


def test_bytes_that_came_are_the_bytes_on_disk(tmp_path: Path) -> None:
    journal, batch = begun(tmp_path), part(0, 9)
    payload = encode_frames(batch, SCHEMA)
    journal.append_new_frames(batch, payload)
    (path,) = segments(tmp_path)
    assert path.read_bytes() == SCHEMA.serialize().to_pybytes() + payload


def test_arrow_alone_reads_a_segment(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (15, 19), (0, 16)).close()
    found = []
    for path in segments(tmp_path):
        with pa.ipc.open_stream(path.read_bytes()) as reader:
            assert reader.schema.equals(SCHEMA, check_metadata=True)
            found.append([frames_from_record_batch(record) for record in reader])
    numbers = [[n for batch in rows for n in batch.seq.tolist()] for rows in found]
    assert numbers == [[*range(10), *range(15, 20)], [*range(10, 15)]]
    assert_same_bits(found[0][0], part(0, 9))


def test_time_never_runs_back_within_a_segment(tmp_path: Path) -> None:
    """Newest first and the missed ones behind, in turns, as over a link that was slow."""
    journal = begun(tmp_path)
    for turn in range(3):
        for first in (30 + 10 * turn, 10 * turn):
            journal.append_new_frames(part(first, first + 9))
    assert_holds(journal, set(range(60)))
    journal.close()
    assert len(segments(tmp_path)) == 2
    for path in segments(tmp_path):
        rows = [frames_from_record_batch(r) for r in pa.ipc.open_stream(path.read_bytes())]
        seq = [n for batch in rows for n in batch.seq.tolist()]
        assert seq == sorted(seq)
    assert_holds(reopened(tmp_path), set(range(60)))


def test_a_journal_of_nothing_holds_nothing(tmp_path: Path) -> None:
    journal = begun(tmp_path / "a" / "b")
    assert_holds(journal, set())
    journal.sync()
    journal.close()
    assert segments(tmp_path / "a" / "b") == []
    with pytest.raises(FileFormatError, match="no readable journal segment"):
        reopened(tmp_path / "a" / "b")


def without_a_segment(folder: Path) -> Path:
    """The segment of frames 10 to 19 that is gone; its index and two other segments are there."""
    journal = filled(folder, (0, 9), (20, 29))
    journal.close()
    journal.append_new_frames(part(10, 19))
    journal.close()
    path = folder / f"{10:020d}.arrows"
    path.unlink()
    return path


def test_an_index_without_a_segment_is_set_aside(tmp_path: Path) -> None:
    path = without_a_segment(tmp_path)
    index = path.with_suffix(".idx").read_bytes()
    assert_holds(reopened(tmp_path), {*range(10), *range(20, 30)})
    assert not path.with_suffix(".idx").exists()
    assert path.with_suffix(".unread").read_bytes() == index


def test_what_was_set_aside_before_is_not_replaced(tmp_path: Path) -> None:
    path = without_a_segment(tmp_path)
    aside = path.with_suffix(".unread")
    aside.write_bytes(b"what followed the last whole batch")
    assert_holds(reopened(tmp_path), {*range(10), *range(20, 30)})
    assert aside.read_bytes() == b"what followed the last whole batch"
    assert not path.with_suffix(".idx").exists()
    assert path.with_suffix(".2.unread").exists()
    path.write_bytes(b"no segment")
    reopened(tmp_path).close()
    assert aside.read_bytes() == b"what followed the last whole batch"
    assert path.with_suffix(".3.unread").read_bytes() == b"no segment"


def test_a_deleted_journal_is_gone(tmp_path: Path) -> None:
    journal = filled(tmp_path / "journal", (0, 9))
    journal.close_and_delete()
    assert not (tmp_path / "journal").exists()
    assert_holds(journal, set())


def long_journal(folder: Path, rows: int = 10) -> Journal:
    journal = begun(folder)
    for first in range(0, 200, rows):
        journal.append_new_frames(LONG.slice_rows(first, first + rows))
    return journal


@pytest.mark.parametrize("rows", [1, 5, 7])
def test_a_segment_is_closed_after_a_minute_of_frames(tmp_path: Path, rows: int) -> None:
    journal = long_journal(tmp_path, rows)
    starts = [0]
    for first in range(0, 200, rows):
        if LONG.t_ns[first] - LONG.t_ns[starts[-1]] >= SEGMENT_DURATION_NS:
            starts.append(first)
    assert len(starts) >= 9
    assert [path.name for path in segments(tmp_path)] == [f"{n:020d}.arrows" for n in starts]
    assert_holds(journal, set(range(200)), 0, 199, of=LONG)
    journal.close()
    assert_holds(reopened(tmp_path), set(range(200)), 0, 199, of=LONG)


@settings(max_examples=40)
@given(before=st.integers(-1, 210), keep=st.lists(st.integers(0, 199), max_size=3))
def test_only_old_segments_that_are_not_kept_are_deleted(
    tmp_path_factory: pytest.TempPathFactory, before: int, keep: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("prune")
    journal = long_journal(folder, 20)
    before_t_ns = UTC_NS + before * (SEGMENT_DURATION_NS // 20)
    kept = set[int]()
    for first in range(0, 200, 20):
        numbers = set(range(first, first + 20))
        old = LONG.t_ns[first + 19] < before_t_ns
        if not old or numbers & set(keep) or first == 180:
            kept |= numbers
    journal.sync()
    gone = journal.delete_old_segments(before_t_ns, Intervals((n, n) for n in keep))
    assert members(gone) == set(range(200)) - kept
    assert_holds(journal, kept, 0, 199, of=LONG)
    assert {int(path.stem) for path in segments(folder)} == {n for n in kept if n % 20 == 0}
    journal.close()
    assert_holds(reopened(folder), kept, 0, 199, of=LONG)


def test_frames_come_after_pruning_and_pruned_ones_can_come_again(tmp_path: Path) -> None:
    journal = long_journal(tmp_path, 20)
    journal.sync()
    assert members(journal.delete_old_segments(2**62, Intervals())) == set(range(180))
    journal.append_new_frames(LONG.slice_rows(0, 200))
    assert_holds(journal, set(range(200)), 0, 199, of=LONG)


times = st.integers(-30, 230).map(lambda n: UTC_NS + n * (SEGMENT_DURATION_NS // 40))
subsets = st.lists(st.integers(0, 19), unique=True, max_size=20)


@settings(max_examples=60)
@given(order=subsets, t_ns=times)
def test_the_first_number_since_a_time_is_that_of_its_batch(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], t_ns: int
) -> None:
    journal = begun(tmp_path_factory.mktemp("since"))
    for n in order:
        journal.append_new_frames(LONG.slice_rows(n * 5, n * 5 + 5))
    young = sorted(n for n in members(journal.stored) if LONG.t_ns[n] >= t_ns)
    expected = young[0] // 5 * 5 if young else None
    assert journal.find_first_batch_seq_since(t_ns) == expected


@example(order=[*range(20)], t_ns=UTC_NS + 39 * (SEGMENT_DURATION_NS // 40), at_least=0)
@settings(max_examples=60)
@given(order=subsets, t_ns=times, at_least=st.integers(0, 110))
def test_the_last_number_before_a_time_is_known_once_it_is_passed(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], t_ns: int, at_least: int
) -> None:
    journal = begun(tmp_path_factory.mktemp("until"))
    for n in order:
        journal.append_new_frames(LONG.slice_rows(n * 5, n * 5 + 5))
    stored = {n for n in members(journal.stored) if n >= at_least}
    found = journal.find_part_last_seq_once_passed(t_ns, part_seq_first=at_least)
    if not any(LONG.t_ns[n] > t_ns for n in stored):
        assert found is None
    else:
        assert found == max([at_least - 1, *(n for n in stored if LONG.t_ns[n] <= t_ns)])


def test_open_files_do_not_grow_with_segments(tmp_path: Path) -> None:
    def open_here() -> Sequence[Path]:
        targets = [Path("/proc/self/fd", name.name) for name in Path("/proc/self/fd").iterdir()]
        return [t for t in targets if str(tmp_path) in str(t.resolve())]

    journal = long_journal(tmp_path, 20)
    journal.sync()
    assert len(open_here()) == 2
    while_read = [len(open_here()) for _ in journal.read_frames(0, 199)]
    while_read += [len(open_here()) for _ in journal.read_overlapping_messages(0, 199)]
    assert max(while_read) <= 2 + 8
    assert sum(len(batch) for batch in journal.read_frames(0, 199)) == 200
    assert len(open_here()) == 2
    journal.close()
    assert len(open_here()) == 0
    reopened(tmp_path)
    assert len(open_here()) == 0


def test_batches_of_a_replaced_file_are_invalidated_as_well(tmp_path: Path) -> None:
    journal = filled(tmp_path / "data", (0, 9))
    journal.sync()
    shutil.copytree(tmp_path / "data", tmp_path / "copy")
    journal.append_new_frames(part(10, 19))
    (tmp_path / "data").rename(tmp_path / "away")
    (tmp_path / "copy").rename(tmp_path / "data")
    journal.invalidate_batches_wholly_within(Intervals([(10, 19)]))
    assert journal.stored == Intervals([(0, 9)])
    journal.append_new_frames(part(10, 19))
    assert_holds(journal, set(range(20)))
    with pytest.raises(StorageError, match="another file is in its place"):
        journal.close()


def test_an_invalidated_copy_is_cut_off_when_its_segment_is_closed(tmp_path: Path) -> None:
    """The disk refused once and then said nothing more; what it kept of the first copy may be bad.

    After a restart the copy that was written later has to be the one that counts.
    """
    journal = filled(tmp_path, (0, 9), (10, 19))
    (path,) = segments(tmp_path)
    journal.invalidate_batches_wholly_within(Intervals([(10, 19)]))
    journal.append_new_frames(part(10, 19))
    journal.close()
    assert path.stat().st_size == HEADER + len(encode_frames(part(0, 9), SCHEMA))
    again = reopened(tmp_path)
    assert_holds(again, set(range(20)))
    assert not again.lost
    assert not list(tmp_path.glob("*.unread"))
