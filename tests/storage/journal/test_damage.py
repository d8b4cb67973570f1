"""A journal that was cut off or damaged: every whole batch is kept, and never another frame."""

from __future__ import annotations

import errno
import os
import shutil
import zlib
from itertools import pairwise
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DamagedFramesError, FileFormatError, StorageError
from storage.intervals import Intervals
from storage.journal.segment import RECORD_DTYPE
from storage.schema import wire_schema
from storage.verify.journal import verify_segment
from storage.wire import encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import assert_same_bits
from tests.storage.journal.journals import (
    HEADER,
    SCHEMA,
    assert_holds,
    begun,
    filled,
    members,
    part,
    reopened,
    segments,
    stream,
)


@pytest.mark.slow
@pytest.mark.parametrize("every_bytes", [7, pytest.param(1, marks=pytest.mark.soak)])
def test_a_cut_keeps_every_whole_message_before_it(tmp_path: Path, every_bytes: int) -> None:
    whole = tmp_path / "whole"
    filled(whole, (0, 9), (10, 10), (11, 12)).close()
    (path,) = segments(whole)
    content = path.read_bytes()
    header = len(SCHEMA.serialize().to_pybytes())
    edges, stored = [header], [0, 10, 11, 13]
    for first, last in ((0, 9), (10, 10), (11, 12)):
        edges.append(edges[-1] + len(encode_frames(part(first, last), SCHEMA)))
    assert edges[-1] == len(content)
    # At every byte near an edge, at fewer within later messages, and fewer still of the header.
    near = {cut for edge in edges[1:] for cut in range(edge - 40, edge + 41)}
    at_first = range(edges[1]) if every_bytes == 1 else range(0, header, 97)
    cuts = near.union(at_first, range(edges[1], len(content), every_bytes))
    for cut in sorted(cut for cut in cuts if cut <= len(content)):
        folder = tmp_path / f"cut-{cut}"
        folder.mkdir()
        (folder / path.name).write_bytes(content[:cut])
        journal = begun(folder)
        kept = set(range(stored[sum(cut >= edge for edge in edges[1:])]))
        assert members(journal.stored) == kept, cut
        if cut % 13 == 0 or cut in edges:  # it can be appended to, and read again
            assert_holds(journal, kept)
            journal.append_new_frames(part(5, 19))
            assert_holds(journal, kept | set(range(5, 20)))
            journal.close()
            assert_holds(reopened(folder), kept | set(range(5, 20)))


def test_a_segment_that_was_cut_is_a_stream_for_arrow_again(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19)).close()
    (path,) = segments(tmp_path)
    path.write_bytes(path.read_bytes()[:-3])
    assert_holds(begun(tmp_path), set(range(10)))
    assert pa.ipc.open_stream(path.read_bytes()).read_all().num_rows == 10


@settings(max_examples=80)
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
    journal.append_new_frames(part(10, 19))
    assert_holds(journal, set(range(20)))


def test_a_tail_of_another_array_is_cut_off(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9)).close()
    (path,) = segments(tmp_path)
    with path.open("ab") as file:
        file.write(encode_frames(stream(5, 3), wire_schema(make_array(3))))
    assert_holds(reopened(tmp_path), set(range(10)))


def test_a_file_that_is_no_segment_does_not_hide_others(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9)).close()
    for name, content in (("00.arrows", b""), ("01.arrows", b"\0" * 500), ("99.arrows", b"PAR1")):
        (tmp_path / name).write_bytes(content)
    assert_holds(reopened(tmp_path), set(range(10)))
    assert len(segments(tmp_path)) == 1


def test_a_batch_damaged_since_is_refused_when_it_is_read(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9), (10, 19))
    journal.sync()
    (path,) = segments(tmp_path)
    content = bytearray(path.read_bytes())
    second = len(content) - len(encode_frames(part(10, 19), SCHEMA))
    content[second : second + 8] = bytes(8)
    path.write_bytes(content)
    reading = journal.read_frames(0, 19)
    assert_same_bits(next(reading), part(0, 9))
    with pytest.raises(FileFormatError):
        next(reading)


def index_of(path: Path) -> Path:
    return path.with_suffix(".idx")


def crashed(folder: Path, *parts: tuple[int, int]) -> Path:
    """The only segment of a journal that was never closed."""
    journal = begun(folder)
    for first, last in parts:
        journal.append_new_frames(part(first, last))
    copy = folder.with_name(folder.name + "-crashed")
    shutil.copytree(folder, copy)
    (path,) = segments(copy)
    return path


@settings(max_examples=60)
@given(data=st.data())
def test_a_flipped_bit_costs_its_own_batch_only(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = crashed(tmp_path_factory.mktemp("flip") / "j", (0, 9), (10, 19), (20, 29))
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(HEADER, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    path.write_bytes(content)
    length = len(encode_frames(part(0, 9), SCHEMA))
    hit = (at - HEADER) // length
    journal = reopened(path.parent)
    gone = set(range(10 * hit, 10 * hit + 10))
    assert_holds(journal, set(range(30)) - gone)
    # What stood at the end of a file that was not closed may never have been on the disk.
    named = members(journal.lost.by_reason.get("corrupt", Intervals()))
    assert named == (gone if hit < 2 else set())
    journal.append_new_frames(part(0, 29))
    assert_holds(journal, set(range(30)))
    assert not journal.lost


@settings(max_examples=60)
@given(data=st.data())
def test_a_flipped_bit_in_the_index_costs_at_most_one_batch(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = crashed(tmp_path_factory.mktemp("flip") / "j", (0, 9), (10, 19), (20, 29))
    index = bytearray(index_of(path).read_bytes())
    at = data.draw(st.integers(0, len(index) - 1))
    index[at] ^= 1 << data.draw(st.integers(0, 7))
    index_of(path).write_bytes(index)
    journal = reopened(path.parent)
    stored = members(journal.stored)
    assert len(stored) >= 20
    assert_holds(journal, stored)


def test_frames_of_a_closed_segment_are_checked_when_they_are_read(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19), (20, 29)).close()
    (path,) = segments(tmp_path)
    content = bytearray(path.read_bytes())
    content[HEADER + len(encode_frames(part(0, 9), SCHEMA)) + 200] ^= 8
    path.write_bytes(content)
    journal = reopened(tmp_path)
    assert members(journal.stored) == set(range(30))
    with pytest.raises(DamagedFramesError, match="frames 10 to 19") as caught:
        list(journal.read_frames(0, 29))
    assert (caught.value.seq_first, caught.value.seq_last) == (10, 19)
    journal.invalidate_batches_wholly_within(Intervals([(10, 19)]))
    assert_holds(journal, {*range(10), *range(20, 30)})
    # A copy that comes later is the one that counts, after a restart, too.
    journal.append_new_frames(part(10, 19))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


def test_a_damaged_batch_among_thousands_of_frames_costs_its_own(tmp_path: Path) -> None:
    whole = stream(9000)
    cuts = [*range(0, 9000, 25), 9000]
    journal = begun(tmp_path)
    for a, b in pairwise(cuts):
        journal.append_new_frames(whole.slice_rows(a, b))
    journal.close()
    (path,) = segments(tmp_path)
    content = bytearray(path.read_bytes())
    records = np.frombuffer(index_of(path).read_bytes(), RECORD_DTYPE)
    record = records[records["seq_first"] == 5000][0]
    content[int(record["offset"]) + int(record["length"]) // 2] ^= 1
    path.write_bytes(content)
    journal = reopened(tmp_path)
    before: list[int] = []
    with pytest.raises(DamagedFramesError, match="frames 5000 to 5024") as caught:
        before += (int(seq) for batch in journal.read_frames(3, 9000) for seq in batch.seq)
    assert (caught.value.seq_first, caught.value.seq_last) == (5000, 5024)
    assert before == list(range(3, 5000))
    journal.invalidate_batches_wholly_within(Intervals([(5000, 5024)]))
    stored = {*range(5000), *range(5025, 9000)}
    assert_holds(journal, stored, 3, 8990, of=whole)
    assert max(len(batch) for batch in journal.read_frames(0, 9000)) > 1000


def with_record(path: Path, at: int, **columns: int) -> None:
    """A record of the index says something else, and its checksum is right."""
    records = np.frombuffer(index_of(path).read_bytes(), RECORD_DTYPE).copy()
    for name, value in columns.items():
        records[name][at] = value
    records["check"][at] = zlib.crc32(records[at].tobytes()[:-4])
    index_of(path).write_bytes(records.tobytes())


@pytest.mark.parametrize(
    "columns", [{"seq_first": 2**63}, {"seq_first": 2**64 - 1}, {"offset": 2**63}]
)
def test_impossible_index_numbers_cost_nothing(tmp_path: Path, columns: dict[str, int]) -> None:
    filled(tmp_path, (0, 9), (10, 19), (20, 29)).close()
    (path,) = segments(tmp_path)
    with_record(path, 1, **columns)
    report = verify_segment(path)
    assert "record 1 of its index is damaged" in report.problems
    assert_holds(reopened(tmp_path), set(range(30)))


def test_a_batch_of_other_frames_than_in_its_index_is_refused(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19), (20, 29)).close()
    (path,) = segments(tmp_path)
    with_record(path, 1, seq_first=40)
    journal, read = reopened(tmp_path), list[int]()
    with pytest.raises(
        DamagedFramesError, match=r"frames 40 to 49.*the frames that its index says"
    ):
        read += (int(seq) for batch in journal.read_frames(0, 59) for seq in batch.seq)
    assert read == [*range(10), *range(20, 30)]


def test_a_bad_sector_costs_no_frame_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = filled(tmp_path, *((a, a + 9) for a in range(0, 60, 10)))
    journal.sync()
    bad = HEADER + 3 * len(encode_frames(part(0, 9), SCHEMA)) + 100
    real = os.pread

    def pread(descriptor: int, length: int, offset: int) -> bytes:
        if offset <= bad < offset + length:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return real(descriptor, length, offset)

    monkeypatch.setattr("os.pread", pread)
    read: list[int] = []
    with pytest.raises(StorageError, match="Input/output error"):
        read += (int(seq) for batch in journal.read_frames(0, 59) for seq in batch.seq)
    assert read == list(range(30))


def test_a_truncation_exactly_at_a_batch_is_seen_by_the_index(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19), (20, 29)).close()
    (path,) = segments(tmp_path)
    os.truncate(path, HEADER + 2 * len(encode_frames(part(0, 9), SCHEMA)))
    journal = reopened(tmp_path)
    assert_holds(journal, set(range(20)))
    assert members(journal.lost.by_reason["corrupt"]) == set(range(20, 30))


@pytest.mark.parametrize("kept", [0, 1, 47, 48, 95, 96, 100])
def test_batches_that_are_in_no_index_are_set_aside(tmp_path: Path, kept: int) -> None:
    path = crashed(tmp_path / "j", (0, 9), (10, 19), (20, 29))
    os.truncate(index_of(path), kept)
    journal = reopened(path.parent) if kept >= 48 else begun(path.parent)
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
    journal = begun(path.parent)
    kept = {16: 20, 400: 20, 4096: 0}[empty]
    assert_holds(journal, set(range(kept)))


def test_a_segment_that_is_gone_is_an_error_that_names_it(tmp_path: Path) -> None:
    journal = filled(tmp_path, (0, 9))
    (path,) = segments(tmp_path)
    path.unlink()
    with pytest.raises(StorageError, match=path.name):
        list(journal.read_frames(0, 9))
    with pytest.raises(StorageError, match=path.name):
        journal.close()  # what was written to it is nowhere


@pytest.mark.parametrize("record", [0, 1, 2])
def test_a_damaged_index_record_gives_its_neighbours_time(tmp_path: Path, record: int) -> None:
    journal = filled(tmp_path, (0, 9), (10, 19), (20, 29), (30, 39))
    (path,) = segments(tmp_path)
    index = path.with_suffix(".idx")
    content = bytearray(index.read_bytes())
    content[record * RECORD_DTYPE.itemsize + 9] ^= 1
    index.write_bytes(content)
    asked = 10 * record + 2
    oldest, newest = (
        journal.find_batch_t_ns_near(asked, at_or_before=newest) for newest in (False, True)
    )
    assert oldest == part(10 * record + 10, 10 * record + 10).t_ns[0]
    assert newest == (part(10 * record - 1, 10 * record - 1).t_ns[0] if record else None)
    index.write_bytes(b"")
    assert journal.find_batch_t_ns_near(asked, at_or_before=False) is None


def test_an_index_that_was_emptied_is_said(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9), (10, 19)).close()
    (path,) = segments(tmp_path)
    index_of(path).write_bytes(b"")
    journal = reopened(tmp_path)
    assert_holds(journal, set())
    (problem,) = journal.problems
    assert path.name in problem
    assert path.with_suffix(".unread").exists()


def test_a_segment_begun_before_a_kill_is_no_problem(tmp_path: Path) -> None:
    filled(tmp_path, (0, 9)).close()
    (path,) = segments(tmp_path)
    index_of(path).write_bytes(b"")
    assert reopened(tmp_path).problems == []
