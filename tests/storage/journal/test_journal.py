"""The journal: every frame once, whatever comes twice, and nothing lost by a cut but the tail."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import fields
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DamagedFramesError, FileFormatError, StorageError
from devices.frames import FrameBatch
from storage.intervals import Intervals
from storage.journal import segment as segment_module
from storage.journal.journal import Journal
from storage.journal.open_segments import SEGMENT_NS
from storage.schema import from_record_batch, wire_schema
from storage.wire import encode
from tests.builders.arrays import PERIOD_NS, UTC_NS, make_array
from tests.builders.frames import any_frames, assert_same_bits
from tests.storage.faulty_disk import disk_with_room_for

TOP = 60


def stream(rows: int = TOP, tiles: int = 2, *, period_ns: int = PERIOD_NS) -> FrameBatch:
    """A stream from its first frame on, with any bits in columns without a law."""
    seq = np.arange(rows)
    t_mono_ns = period_ns * seq
    times = {"t_mono_ns": t_mono_ns, "t_ns": t_mono_ns + UTC_NS}
    return any_frames(rows, tiles, rows, seq=seq, **times)


ALL = stream()
SCHEMA = wire_schema(make_array())


def part(first: int, last: int) -> FrameBatch:
    """Frames `first` to `last`, both included, of the one stream that all tests take them from."""
    return ALL.rows(first, last + 1)


def members(intervals: Intervals) -> set[int]:
    return {n for first, last in intervals for n in range(first, last + 1)}


def assert_holds(
    journal: Journal, numbers: set[int], first: int = 0, last: int = TOP, of: FrameBatch = ALL
) -> None:
    """Reading from `first` to `last` gives these frames of the stream, in order, each once."""
    assert members(journal.held) == numbers
    expected = sorted(n for n in numbers if first <= n <= last)
    batches = list(journal.read(first, last))
    assert all(len(batch) for batch in batches)
    read = [int(n) for batch in batches for n in batch.seq]
    assert read == expected
    if read:
        whole = FrameBatch.concatenate(batches)
        rows = {f.name: getattr(of, f.name)[expected] for f in fields(of)}
        assert_same_bits(whole, FrameBatch(**rows))


_OPENED: list[Journal] = []


@pytest.fixture(autouse=True)
def _closed() -> Iterator[None]:
    yield
    while _OPENED:
        _OPENED.pop().close()


def begun(folder: Path) -> Journal:
    """A journal for this array; it is closed when the test ends."""
    _OPENED.append(Journal(folder, make_array()))
    return _OPENED[-1]


def reopened(folder: Path) -> Journal:
    """The journal as somebody finds it who knows its folder only."""
    _OPENED.append(Journal.open(folder))
    return _OPENED[-1]


def filled(folder: Path, *parts: tuple[int, int]) -> Journal:
    journal = begun(folder)
    for first, last in parts:
        journal.append(part(first, last))
    return journal


def segments(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.arrows"))


ends = st.tuples(st.integers(0, TOP - 1), st.integers(0, TOP - 1)).map(
    lambda pair: (min(pair), max(pair))
)


# --- what is held ---------------------------------------------------------------------------------


@settings(max_examples=60, deadline=None)
@given(parts=st.lists(ends, max_size=8), asked=ends, reopen=st.integers(0, 8), sent=st.booleans())
def test_every_frame_is_held_once_whatever_comes_twice_and_in_whatever_order(
    tmp_path_factory: pytest.TempPathFactory,
    parts: list[tuple[int, int]],
    asked: tuple[int, int],
    reopen: int,
    sent: bool,
) -> None:
    folder = tmp_path_factory.mktemp("journal")
    journal, held = begun(folder), set[int]()
    for number, (first, last) in enumerate(parts):
        if number == reopen:
            journal.close()
            journal = begun(folder)
        batch = part(first, last)
        new = journal.append(batch, encode(batch, SCHEMA) if sent else None)
        assert members(new) == set(range(first, last + 1)) - held
        held |= set(range(first, last + 1))
    assert_holds(journal, held)
    assert_holds(journal, held, *asked)
    journal.close()
    assert_holds(begun(folder), held, *asked)


def test_a_reopened_journal_knows_its_array_and_holds_the_same(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (20, 29), (10, 14)).close()
    journal = reopened(tmp_path)
    assert journal.info == make_array()
    assert_holds(journal, {*range(15), *range(20, 30)})


def test_what_is_held_can_be_read_before_it_is_synced_and_after(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9))
    assert_holds(journal, set(range(10)))
    journal.sync()
    journal.append(part(10, 19))
    journal.sync()
    journal.close()
    journal.sync()
    assert_holds(journal, set(range(20)))


def test_reading_goes_on_while_frames_come(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9), (10, 19))
    reading = journal.read(0, 100)
    first = next(reading)
    journal.append(part(20, 29))
    rest = list(reading)
    assert int(first.seq[0]) == 0
    assert [int(batch.seq[0]) for batch in rest] == [10]


def test_bytes_that_came_are_the_bytes_on_disk(tmp_path: Path) -> None:
    journal, batch = begun(tmp_path), part(0, 9)
    payload = encode(batch, SCHEMA)
    journal.append(batch, payload)
    (path,) = segments(tmp_path)
    assert path.read_bytes() == SCHEMA.serialize().to_pybytes() + payload


def test_arrow_alone_reads_a_segment(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (15, 19), (0, 16)).close()
    found = []
    for path in segments(tmp_path):
        with pa.ipc.open_stream(path.read_bytes()) as reader:
            assert reader.schema.equals(SCHEMA, check_metadata=True)
            found.append([from_record_batch(record) for record in reader])
    numbers = [[n for batch in rows for n in batch.seq.tolist()] for rows in found]
    assert numbers == [[*range(10), *range(15, 20)], [*range(10, 15)]]
    assert_same_bits(found[0][0], part(0, 9))


def test_within_a_segment_time_never_runs_back_in_whatever_order_frames_come(
    tmp_path: Path,
) -> None:
    """Newest first and the missed ones behind, in turns, as over a link that was slow."""
    journal = begun(tmp_path)
    for turn in range(3):
        for first in (30 + 10 * turn, 10 * turn):
            journal.append(part(first, first + 9))
    assert_holds(journal, set(range(60)))
    journal.close()
    assert len(segments(tmp_path)) == 2
    for path in segments(tmp_path):
        rows = [from_record_batch(r) for r in pa.ipc.open_stream(path.read_bytes())]
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


def test_a_deleted_journal_is_gone(tmp_path: Path) -> None:
    journal = filled(tmp_path / "journal", (0, 9))
    journal.delete()
    assert not (tmp_path / "journal").exists()
    assert_holds(journal, set())


# --- cut off --------------------------------------------------------------------------------------


def test_a_cut_anywhere_keeps_every_whole_message_before_it(tmp_path: Path) -> None:
    whole = tmp_path / "whole"
    filled(whole, (0, 9), (10, 10), (11, 12)).close()
    (path,) = segments(whole)
    content = path.read_bytes()
    header = len(SCHEMA.serialize().to_pybytes())
    edges, held = [header], [0, 10, 11, 13]
    for first, last in ((0, 9), (10, 10), (11, 12)):
        edges.append(edges[-1] + len(encode(part(first, last), SCHEMA)))
    assert edges[-1] == len(content)
    cuts = [*range(0, header, 97), *range(edges[1] - 9, len(content) + 1)]
    for cut in cuts:
        folder = tmp_path / f"cut-{cut}"
        folder.mkdir()
        (folder / path.name).write_bytes(content[:cut])
        journal = begun(folder)
        kept = set(range(held[sum(cut >= edge for edge in edges[1:])]))
        assert members(journal.held) == kept, cut
        if cut % 13 == 0 or cut in edges:  # it can be appended to, and read again
            assert_holds(journal, kept)
            journal.append(part(5, 19))
            assert_holds(journal, kept | set(range(5, 20)))
            journal.close()
            assert_holds(reopened(folder), kept | set(range(5, 20)))


def test_a_cut_in_the_first_message_leaves_an_empty_journal_that_can_be_appended_to(
    tmp_path: Path,
) -> None:
    filled(tmp_path, (0, 9)).close()
    (path,) = segments(tmp_path)
    content = path.read_bytes()
    for cut in (0, 1, 7, 8, 100, len(SCHEMA.serialize().to_pybytes()), len(content) - 1):
        path.write_bytes(content[:cut])
        journal = begun(tmp_path)
        assert_holds(journal, set())
        journal.append(part(0, 9))
        journal.close()
        assert segments(tmp_path) == [path]
        assert path.read_bytes() == content


def test_a_segment_that_was_cut_is_a_stream_for_arrow_again(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19)).close()
    (path,) = segments(tmp_path)
    path.write_bytes(path.read_bytes()[:-3])
    assert_holds(begun(tmp_path), set(range(10)))
    assert pa.ipc.open_stream(path.read_bytes()).read_all().num_rows == 10


@settings(max_examples=80, deadline=None)
@given(tail=st.binary(min_size=1, max_size=300), framed=st.booleans())
def test_garbage_behind_whole_messages_is_cut_off(
    tmp_path_factory: pytest.TempPathFactory, tail: bytes, framed: bool
) -> None:
    folder = tmp_path_factory.mktemp("garbage")
    filled(folder, (0, 9)).close()
    (path,) = segments(folder)
    content = path.read_bytes()
    # Framed: it begins as messages do, and the length of its metadata is garbage too.
    path.write_bytes(content + (b"\xff\xff\xff\xff" if framed else b"") + tail)
    journal = reopened(folder)
    assert_holds(journal, set(range(10)))
    assert path.read_bytes() == content
    journal.append(part(10, 19))
    assert_holds(journal, set(range(20)))


def test_a_tail_of_another_array_is_cut_off(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9)).close()
    (path,) = segments(tmp_path)
    with path.open("ab") as file:
        file.write(encode(stream(5, 3), wire_schema(make_array(3))))
    assert_holds(reopened(tmp_path), set(range(10)))


def test_a_file_that_is_no_segment_at_all_does_not_hide_the_others(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9)).close()
    for name, content in (("00.arrows", b""), ("01.arrows", b"\0" * 500), ("99.arrows", b"PAR1")):
        (tmp_path / name).write_bytes(content)
    assert_holds(reopened(tmp_path), set(range(10)))
    assert len(segments(tmp_path)) == 1


def test_a_batch_that_was_damaged_since_is_refused_when_it_is_read(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9), (10, 19))
    journal.sync()
    (path,) = segments(tmp_path)
    content = bytearray(path.read_bytes())
    second = len(content) - len(encode(part(10, 19), SCHEMA))
    content[second : second + 8] = bytes(8)
    path.write_bytes(content)
    reading = journal.read(0, 19)
    assert_same_bits(next(reading), part(0, 9))
    with pytest.raises(FileFormatError):
        next(reading)


# --- bits that flip, pages that never came --------------------------------------------------------


def index_of(path: Path) -> Path:
    return path.with_suffix(".idx")


def crashed(folder: Path, *parts: tuple[int, int]) -> Path:
    """The only segment of a journal that was never closed."""
    journal = begun(folder)
    for first, last in parts:
        journal.append(part(first, last))
    copy = folder.with_name(folder.name + "-crashed")
    shutil.copytree(folder, copy)
    (path,) = segments(copy)
    return path


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_flipped_bit_is_found_wherever_it_is_and_costs_its_own_batch_only(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = crashed(tmp_path_factory.mktemp("flip") / "j", (0, 9), (10, 19), (20, 29))
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(HEADER, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    length = len(encode(part(0, 9), SCHEMA))
    hit = (at - HEADER) // length
    journal = reopened(path.parent)
    gone = set(range(10 * hit, 10 * hit + 10))
    assert_holds(journal, set(range(30)) - gone)
    # What stood at the end of a file that was not closed may never have been on the disk.
    named = members(journal.lost.by_reason.get("corrupt", Intervals()))
    assert named == (gone if hit < 2 else set())
    journal.append(part(0, 29))
    assert_holds(journal, set(range(30)))
    assert not journal.lost


@settings(max_examples=60, deadline=None)
@given(data=st.data())
def test_a_flipped_bit_in_the_index_costs_nothing_or_one_batch_and_never_gives_wrong_frames(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = crashed(tmp_path_factory.mktemp("flip") / "j", (0, 9), (10, 19), (20, 29))
    index = bytearray(index_of(path).read_bytes())
    at = data.draw(st.integers(0, len(index) - 1))
    index[at] ^= 1 << data.draw(st.integers(0, 7))
    index_of(path).write_bytes(index)
    journal = reopened(path.parent)
    held = members(journal.held)
    assert len(held) >= 20
    assert_holds(journal, held)


def test_a_segment_that_was_closed_is_not_read_through_but_its_frames_are_checked_when_read(
    tmp_path: Path,
) -> None:
    filled(tmp_path, (0, 9), (10, 19), (20, 29)).close()
    (path,) = segments(tmp_path)
    content = bytearray(path.read_bytes())
    content[HEADER + len(encode(part(0, 9), SCHEMA)) + 200] ^= 8
    path.write_bytes(content)
    journal = reopened(tmp_path)
    assert members(journal.held) == set(range(30))
    with pytest.raises(DamagedFramesError, match="frames 10 to 19") as caught:
        list(journal.read(0, 29))
    assert (caught.value.seq_first, caught.value.seq_last) == (10, 19)
    journal.disown(Intervals([(10, 19)]))
    assert_holds(journal, {*range(10), *range(20, 30)})
    # A copy that comes later is the one that counts, after a restart, too.
    journal.append(part(10, 19))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


def test_a_truncation_exactly_at_a_batch_is_seen_by_the_index(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19), (20, 29)).close()
    (path,) = segments(tmp_path)
    os.truncate(path, HEADER + 2 * len(encode(part(0, 9), SCHEMA)))
    journal = reopened(tmp_path)
    assert_holds(journal, set(range(20)))
    assert members(journal.lost.by_reason["corrupt"]) == set(range(20, 30))


@pytest.mark.parametrize("kept", [0, 1, 47, 48, 95, 96, 100])
def test_what_is_not_in_the_index_was_never_promised_and_is_set_aside(
    tmp_path: Path, kept: int
) -> None:
    path = crashed(tmp_path / "j", (0, 9), (10, 19), (20, 29))
    os.truncate(index_of(path), kept)
    journal = reopened(path.parent) if kept >= 48 else None
    if journal is None:
        journal = Journal(path.parent, make_array())
        _OPENED.append(journal)
    assert_holds(journal, set(range(10 * (kept // 48))))
    assert path.with_suffix(".unread").exists()


def test_an_index_that_is_missing_is_made_anew(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19)).close()
    (path,) = segments(tmp_path)
    before = index_of(path).read_bytes()
    index_of(path).unlink()
    assert_holds(reopened(tmp_path), set(range(20)))
    assert index_of(path).read_bytes() == before


@pytest.mark.parametrize("empty", [16, 400, 4096])
def test_pages_that_a_power_cut_left_empty_are_no_frames(tmp_path: Path, empty: int) -> None:
    """The length of a file may be on the disk before its bytes are: zeros that Arrow reads well."""
    path = crashed(tmp_path / "j", (0, 9), (10, 19), (20, 29))
    content = path.read_bytes()
    path.write_bytes(content[:-empty] + bytes(empty))
    journal = Journal(path.parent, make_array())
    _OPENED.append(journal)
    kept = {16: 20, 400: 20, 4096: 0}[empty]
    assert_holds(journal, set(range(kept)))


def test_names_and_files_are_on_the_disk_before_anything_is_promised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[str] = []
    real = os.fsync

    def note(descriptor: int) -> None:
        synced.append(Path(f"/proc/self/fd/{descriptor}").readlink().name)
        real(descriptor)

    monkeypatch.setattr("os.fsync", note)
    journal = filled(tmp_path / "stream", (0, 9))
    assert synced == [tmp_path.name]  # the stream's own folder has its name
    journal.sync()
    assert synced[1:] == [f"{0:020d}.arrows", f"{0:020d}.idx", "stream"]


def test_a_segment_that_is_gone_is_an_error_that_names_it(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9))
    (path,) = segments(tmp_path)
    path.unlink()
    with pytest.raises(StorageError, match=path.name):
        list(journal.read(0, 9))


# --- segments and time ----------------------------------------------------------------------------

LONG = stream(200, period_ns=SEGMENT_NS // 20)
"""Ten minutes of frames, twenty a segment."""


def long_journal(folder: Path, rows: int = 10) -> Journal:
    journal = begun(folder)
    for first in range(0, 200, rows):
        journal.append(LONG.rows(first, first + rows))
    return journal


@pytest.mark.parametrize("rows", [1, 5, 7])
def test_a_segment_is_closed_after_a_minute_of_frames(tmp_path: Path, rows: int) -> None:
    journal = long_journal(tmp_path, rows)
    begins = [int(path.stem) for path in segments(tmp_path)]
    starts = [0]
    for first in range(0, 200, rows):
        if LONG.t_ns[first] - LONG.t_ns[starts[-1]] >= SEGMENT_NS:
            starts.append(first)
    assert begins == starts
    assert len(begins) >= 9
    assert_holds(journal, set(range(200)), 0, 199, of=LONG)
    journal.close()
    assert_holds(reopened(tmp_path), set(range(200)), 0, 199, of=LONG)


@settings(max_examples=40, deadline=None)
@given(before=st.integers(-1, 210), keep=st.lists(st.integers(0, 199), max_size=3))
def test_only_what_is_older_and_not_kept_is_deleted_and_never_what_is_written(
    tmp_path_factory: pytest.TempPathFactory, before: int, keep: list[int]
) -> None:
    folder = tmp_path_factory.mktemp("prune")
    journal = long_journal(folder, 20)
    before_t_ns = UTC_NS + before * (SEGMENT_NS // 20)
    kept = set[int]()
    for first in range(0, 200, 20):
        numbers = set(range(first, first + 20))
        old = LONG.t_ns[first + 19] < before_t_ns
        if not old or numbers & set(keep) or first == 180:
            kept |= numbers
    journal.sync()
    gone = journal.prune(before_t_ns, Intervals((n, n) for n in keep))
    assert members(gone) == set(range(200)) - kept
    assert_holds(journal, kept, 0, 199, of=LONG)
    assert {int(path.stem) for path in segments(folder)} == {n for n in kept if n % 20 == 0}
    journal.close()
    assert_holds(reopened(folder), kept, 0, 199, of=LONG)


def test_frames_come_after_pruning_and_pruned_ones_can_come_again(tmp_path: Path) -> None:
    journal = long_journal(tmp_path, 20)
    journal.sync()
    assert members(journal.prune(2**62, Intervals())) == set(range(180))
    journal.append(LONG.rows(0, 200))
    assert_holds(journal, set(range(200)), 0, 199, of=LONG)


times = st.integers(-30, 230).map(lambda n: UTC_NS + n * (SEGMENT_NS // 40))
subsets = st.lists(st.integers(0, 19), unique=True, max_size=20)


@settings(max_examples=60, deadline=None)
@given(order=subsets, t_ns=times)
def test_the_first_number_since_an_instant_is_at_most_a_batch_early_and_never_late(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], t_ns: int
) -> None:
    journal = begun(tmp_path_factory.mktemp("since"))
    for n in order:
        journal.append(LONG.rows(n * 5, n * 5 + 5))
    young = sorted(n for n in members(journal.held) if LONG.t_ns[n] >= t_ns)
    expected = young[0] // 5 * 5 if young else None
    assert journal.first_seq_since(t_ns) == expected


@settings(max_examples=60, deadline=None)
@given(order=subsets, t_ns=times, at_least=st.integers(0, 110))
def test_the_last_number_until_an_instant_is_known_once_the_stream_has_passed_it(
    tmp_path_factory: pytest.TempPathFactory, order: list[int], t_ns: int, at_least: int
) -> None:
    journal = begun(tmp_path_factory.mktemp("until"))
    for n in order:
        journal.append(LONG.rows(n * 5, n * 5 + 5))
    held = {n for n in members(journal.held) if n >= at_least}
    found = journal.last_seq_until(t_ns, at_least=at_least)
    if not any(LONG.t_ns[n] > t_ns for n in held):
        assert found is None
    else:
        assert found == max([at_least - 1, *(n for n in held if LONG.t_ns[n] <= t_ns)])


# --- a disk that is full --------------------------------------------------------------------------


HEADER = len(SCHEMA.serialize().to_pybytes())


@pytest.mark.parametrize("short", [1, 500, 2000])
def test_a_full_disk_holds_nothing_of_the_batch_and_goes_on_when_there_is_room(
    tmp_path: Path, short: int
) -> None:
    journal = filled(tmp_path, (0, 9))
    (path,) = segments(tmp_path)
    needed = len(encode(part(10, 39), SCHEMA))
    # In the segment that is written, then in the new ones that are tried.
    for begin in (path.stat().st_size, HEADER, HEADER):
        with pytest.raises(StorageError) as caught, disk_with_room_for(begin + needed - short):
            journal.append(part(10, 39))
        assert str(tmp_path) in str(caught.value)
        assert_holds(journal, set(range(10)))
    journal.append(part(10, 39))
    journal.append(part(40, 49))
    assert_holds(journal, set(range(50)))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(50)))
    for segment in segments(tmp_path):
        assert pa.ipc.open_stream(segment.read_bytes()).read_all().num_rows > 0


@pytest.mark.parametrize("room", [0, 100, HEADER - 1, HEADER, HEADER + 500])
def test_a_disk_that_is_full_from_the_beginning_leaves_nothing_that_is_in_the_way(
    tmp_path: Path, room: int
) -> None:
    journal = begun(tmp_path)
    for _ in range(2):
        with pytest.raises(StorageError), disk_with_room_for(room):
            journal.append(part(0, 59))
        assert_holds(journal, set())
    journal.append(part(0, 59))
    assert_holds(journal, set(range(60)))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(60)))


def test_a_disk_that_neither_takes_nor_gives_back_leaves_all_whole_messages(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A write that stops halfway and cannot be taken back: the next begins another segment."""
    journal = filled(tmp_path, (0, 9))
    whole = segment_module.write_all

    def halfway(file: Any, data: bytes) -> None:
        whole(file, data[: len(data) // 2])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(segment_module, "write_all", halfway)
        with pytest.raises(StorageError, match="No space left"):
            journal.append(part(10, 19))
    assert_holds(journal, set(range(10)))
    journal.append(part(10, 19))
    journal.append(part(20, 29))
    assert_holds(journal, set(range(30)))
    assert len(segments(tmp_path)) == 2
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


@pytest.mark.parametrize("written", [0, 1, 2])
def test_a_disk_that_fills_between_the_gaps_of_a_batch_holds_what_was_written_and_no_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """A batch that fills three gaps is three writes."""
    journal, held = filled(tmp_path, (5, 9), (15, 19)), {*range(5, 10), *range(15, 20)}
    whole, writes = segment_module.write_all, 0

    def full(file: Any, data: bytes) -> None:
        nonlocal writes
        writes += 1
        if writes > 3 * written:  # of each gap a header, a batch and a record
            raise OSError(28, "No space left on device")
        whole(file, data)

    with monkeypatch.context() as patch:
        patch.setattr(segment_module, "write_all", full)
        with pytest.raises(StorageError):
            journal.append(part(0, 29))
    assert_holds(journal, held | set(range(10 * written)))
    assert members(journal.append(part(0, 29))) == set(range(30)) - held - set(range(10 * written))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


def test_appending_never_waits_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    real = os.fsync

    def count(descriptor: int) -> None:
        synced.append(descriptor)
        real(descriptor)

    journal = begun(tmp_path / "stream")
    monkeypatch.setattr("os.fsync", count)
    for first in range(0, 200, 20):
        journal.append(LONG.rows(first, first + 20))
    assert synced == []
    assert len(segments(tmp_path / "stream")) == 10
    journal.sync()
    assert len(synced) == 3 * 9 + 2 + 1  # each segment and its index, closed but one; the folder
    journal.sync()
    assert len(synced) == 3 * 9 + 2 + 1


def test_a_disk_that_does_not_sync_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(descriptor: int) -> None:
        raise OSError(5, "Input/output error")

    journal = filled(tmp_path, (0, 9))
    with monkeypatch.context() as patch:
        patch.setattr("os.fsync", refuse)
        with pytest.raises(StorageError, match="Input/output error"):
            journal.sync()
        with pytest.raises(StorageError, match="Input/output error"):
            journal.close()
    journal.append(part(10, 19))
    assert_holds(journal, set(range(20)))


def test_a_folder_that_cannot_be_made_is_a_storage_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(StorageError):
        begun(tmp_path / "file" / "journal")


def test_open_files_do_not_grow_with_segments(tmp_path: Path) -> None:
    def open_here() -> Sequence[Path]:
        targets = [Path("/proc/self/fd", name.name) for name in Path("/proc/self/fd").iterdir()]
        return [t for t in targets if str(tmp_path) in str(t.resolve())]

    journal = long_journal(tmp_path, 20)
    journal.sync()
    assert len(open_here()) == 2
    assert sum(len(batch) for batch in journal.read(0, 199)) == 200
    assert len(open_here()) == 2
    journal.close()
    assert len(open_here()) == 0
    reopened(tmp_path)
    assert len(open_here()) == 0


def test_names_of_segments_sort_as_their_frames(tmp_path: Path) -> None:
    long_journal(tmp_path, 20)
    names = [path.name for path in segments(tmp_path)]
    assert all(int(one.split(".")[0]) < int(other.split(".")[0]) for one, other in pairwise(names))
    assert {len(name) for name in names} == {20 + len(".arrows")}


def test_what_was_disowned_is_asked_for_again_and_held_once(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9), (10, 19))
    journal.disown(Intervals([(10, 19)]))
    assert journal.held == Intervals([(0, 9)])
    journal.append(part(10, 19))
    assert_holds(journal, set(range(20)))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(20)))


def test_a_doubtful_copy_is_forgotten_when_its_segment_is_closed(tmp_path: Path) -> None:
    """The disk refused once and then said nothing more; what it kept of the first copy may be bad.

    After a restart the copy that was written later has to be the one that counts.
    """
    journal = filled(tmp_path, (0, 9), (10, 19))
    (path,) = segments(tmp_path)
    journal.disown(Intervals([(10, 19)]))
    journal.append(part(10, 19))
    journal.close()
    assert path.stat().st_size == HEADER + len(encode(part(0, 9), SCHEMA))
    again = reopened(tmp_path)
    assert_holds(again, set(range(20)))
    assert not again.lost
    assert not list(tmp_path.glob("*.unread"))
