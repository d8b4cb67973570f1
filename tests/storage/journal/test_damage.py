"""A journal that was cut off or damaged: every whole batch is kept, and never another frame."""

from __future__ import annotations

import os
import shutil
import zlib
from collections.abc import Callable
from itertools import accumulate
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import DamagedFramesError, StorageError
from storage.intervals import Intervals
from storage.journal.segment import RECORD_DTYPE
from storage.schema import wire_schema
from storage.verify.journal import verify_segment
from storage.wire import encode_frames
from tests.builders.arrays import make_array
from tests.builders.frames import assert_same_bits
from tests.storage.faulty_disk import IO_ERROR, failing_if
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

THREE = ((0, 9), (10, 19), (20, 29))
LENGTH = len(encode_frames(part(0, 9), SCHEMA))
"""Bytes of a message of ten frames."""


def index_of(path: Path) -> Path:
    return path.with_suffix(".idx")


def closed(folder: Path, *parts: tuple[int, int]) -> Path:
    """The only segment of a journal that was closed."""
    filled(folder, *parts).close()
    (path,) = segments(folder)
    return path


def crashed(folder: Path, *parts: tuple[int, int]) -> Path:
    """The only segment of a journal that was never closed."""
    filled(folder, *parts)
    (path,) = segments(shutil.copytree(folder, folder.with_name(folder.name + "-crashed")))
    return path


def edit(path: Path, change: Callable[[bytearray], object]) -> None:
    content = bytearray(path.read_bytes())
    change(content)
    path.write_bytes(content)


def flip(path: Path, at: int, bit: int = 0) -> None:
    edit(path, lambda content: content.__setitem__(at, content[at] ^ 1 << bit))


def with_record(path: Path, at: int, **columns: int) -> None:
    """A record of the index says something else, and its checksum is right."""
    records = np.frombuffer(index_of(path).read_bytes(), RECORD_DTYPE).copy()
    for name, value in columns.items():
        records[name][at] = value
    records["check"][at] = zlib.crc32(records[at].tobytes()[:-4])
    index_of(path).write_bytes(records.tobytes())


def add_other_files(path: Path) -> None:
    for name, content in (("00.arrows", b""), ("01.arrows", bytes(500)), ("99.arrows", b"PAR1")):
        path.with_name(name).write_bytes(content)


def cut_index(size: int) -> Callable[[Path], None]:
    return lambda path: os.truncate(index_of(path), size)


def empty_pages(size: int) -> Callable[[Path], None]:
    """The length of a file may be on the disk before its bytes are: zeros that Arrow reads well."""
    return lambda path: edit(path, lambda c: c.__setitem__(slice(-size, None), bytes(size)))


def cut(size: int) -> Callable[[Path], None]:
    return lambda path: os.truncate(path, HEADER + size)


def record(**columns: int) -> Callable[[Path], None]:
    return lambda path: with_record(path, 1, **columns)


def add_other_batch(path: Path) -> None:
    message = encode_frames(stream(5, 3), wire_schema(make_array(3)))
    edit(path, lambda content: content.extend(message))


DAMAGES: dict[str, tuple[Callable[..., Path], Callable[[Path], object], int, int, bool]] = {
    "a tail of another array": (closed, add_other_batch, 30, 0, True),
    "files that are no segments": (closed, add_other_files, 30, 0, False),
    "cut exactly at a batch": (closed, cut(2 * LENGTH), 20, 10, False),
    "cut within a batch": (closed, cut(3 * LENGTH - 3), 20, 10, True),
    "no index": (closed, lambda path: index_of(path).unlink(), 30, 0, False),
    "an emptied index": (closed, cut_index(0), 0, 0, True),
    **{
        f"{size} bytes of an index": (crashed, cut_index(size), 10 * (size // 48), 0, True)
        for size in (0, 1, 47, 48, 95, 96, 100)
    },
    "16 empty bytes": (crashed, empty_pages(16), 20, 0, True),
    "400 empty bytes": (crashed, empty_pages(400), 20, 0, True),
    "4096 empty bytes": (crashed, empty_pages(4096), 0, 0, True),
    "an impossible number": (closed, record(seq_first=2**63), 30, 0, False),
    "an impossible last number": (closed, record(seq_first=2**64 - 1), 30, 0, False),
    "an impossible place": (closed, record(offset=2**63), 30, 0, False),
}
"""How a segment is left, its damage, frames kept and named corrupt, and are bytes set aside?"""


@pytest.mark.parametrize("what", DAMAGES)
def test_damage_costs_the_batches_that_it_hits(tmp_path: Path, what: str) -> None:
    leave, damage, kept, corrupt, is_set_aside = DAMAGES[what]
    path = leave(tmp_path / "j", *THREE)
    index = index_of(path).read_bytes()
    damage(path)
    if "impossible" in what:
        assert "record 1 of its index is damaged" in verify_segment(path).problems
    # Of a folder in which nothing is left the array has to be known.
    journal = (reopened if kept else begun)(path.parent)
    assert_holds(journal, set(range(kept)))
    lost = members(journal.lost.by_reason.get("corrupt", Intervals()))
    assert lost == set(range(kept, kept + corrupt))
    assert path.with_suffix(".unread").exists() == is_set_aside
    assert segments(path.parent) == ([path] if kept else [])
    if what == "no index":
        assert index_of(path).read_bytes() == index
    if what == "an emptied index":
        (problem,) = journal.problems
        assert path.name in problem
    if kept:  # it is a stream for Arrow again
        assert pa.ipc.open_stream(path.read_bytes()).read_all().num_rows == kept


def test_a_segment_begun_before_a_kill_is_no_problem(tmp_path: Path) -> None:
    path = closed(tmp_path, (0, 9))
    index_of(path).write_bytes(b"")
    assert reopened(tmp_path).problems == []


@pytest.mark.slow
@pytest.mark.parametrize("every_bytes", [7, pytest.param(1, marks=pytest.mark.soak)])
def test_a_cut_keeps_every_whole_message_before_it(tmp_path: Path, every_bytes: int) -> None:
    parts = ((0, 9), (10, 10), (11, 12))
    path = closed(tmp_path / "whole", *parts)
    content = path.read_bytes()
    sizes = [len(encode_frames(part(first, last), SCHEMA)) for first, last in parts]
    edges, stored = list(accumulate(sizes, initial=HEADER)), [0, 10, 11, 13]
    assert edges[-1] == len(content)
    # At every byte near an edge, at fewer within later messages, and fewer still of the header.
    near = {cut for edge in edges[1:] for cut in range(edge - 40, edge + 41)}
    at_first = range(edges[1]) if every_bytes == 1 else range(0, HEADER, 97)
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


@settings(max_examples=80)
@given(tail=st.binary(min_size=1, max_size=300), framed=st.booleans())
def test_garbage_behind_whole_messages_is_cut_off(
    tmp_path_factory: pytest.TempPathFactory, tail: bytes, framed: bool
) -> None:
    folder = tmp_path_factory.mktemp("garbage")
    path = closed(folder, (0, 9))
    content = path.read_bytes()
    # Framed: it begins as messages do, and the length of its metadata is garbage too.
    path.write_bytes(content + (b"\xff\xff\xff\xff" if framed else b"") + tail)
    journal = reopened(folder)
    assert_holds(journal, set(range(10)))
    assert path.read_bytes() == content
    journal.append_new_frames(part(10, 19))
    assert_holds(journal, set(range(20)))


@settings(max_examples=60)
@given(data=st.data())
def test_a_flipped_bit_costs_its_own_batch_only(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    path = crashed(tmp_path_factory.mktemp("flip") / "j", *THREE)
    at = data.draw(st.integers(HEADER, path.stat().st_size - 1))
    flip(path, at, data.draw(st.integers(0, 7)))
    hit = (at - HEADER) // LENGTH
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
    path = crashed(tmp_path_factory.mktemp("flip") / "j", *THREE)
    index = index_of(path)
    flip(index, data.draw(st.integers(0, index.stat().st_size - 1)), data.draw(st.integers(0, 7)))
    journal = reopened(path.parent)
    stored = members(journal.stored)
    assert len(stored) >= 20
    assert_holds(journal, stored)


@pytest.mark.parametrize("is_closed", [True, False])
def test_frames_are_checked_when_they_are_read(tmp_path: Path, is_closed: bool) -> None:
    journal = filled(tmp_path, *THREE)
    journal.sync()
    if is_closed:
        journal.close()
    (path,) = segments(tmp_path)
    begin = HEADER + LENGTH
    edit(path, lambda content: content.__setitem__(slice(begin, begin + 8), bytes(8)))
    if is_closed:
        flip(path, begin + 200, 3)
        journal = reopened(tmp_path)
    assert members(journal.stored) == set(range(30))
    reading = journal.read_frames(0, 29)
    assert_same_bits(next(reading), part(0, 9))
    with pytest.raises(DamagedFramesError, match="frames 10 to 19") as caught:
        next(reading)
    assert (caught.value.seq_first, caught.value.seq_last) == (10, 19)
    journal.invalidate_batches_wholly_within(Intervals([(10, 19)]))
    assert_holds(journal, {*range(10), *range(20, 30)})
    # A copy that comes later is the one that counts, after a restart, too.
    journal.append_new_frames(part(10, 19))
    journal.close()
    assert_holds(reopened(tmp_path), set(range(30)))


def test_a_damaged_batch_among_thousands_of_frames_costs_its_own(tmp_path: Path) -> None:
    whole = stream(9000)
    journal = begun(tmp_path)
    for first in range(0, 9000, 25):
        journal.append_new_frames(whole.slice_rows(first, first + 25))
    journal.close()
    (path,) = segments(tmp_path)
    records = np.frombuffer(index_of(path).read_bytes(), RECORD_DTYPE)
    record = records[records["seq_first"] == 5000][0]
    flip(path, int(record["offset"]) + int(record["length"]) // 2)
    journal, before = reopened(tmp_path), list[int]()
    with pytest.raises(DamagedFramesError, match="frames 5000 to 5024"):
        before += (int(seq) for batch in journal.read_frames(3, 9000) for seq in batch.seq)
    assert before == list(range(3, 5000))
    journal.invalidate_batches_wholly_within(Intervals([(5000, 5024)]))
    assert_holds(journal, {*range(5000), *range(5025, 9000)}, 3, 8990, of=whole)
    assert max(len(batch) for batch in journal.read_frames(0, 9000)) > 1000


def test_a_batch_of_other_frames_than_in_its_index_is_refused(tmp_path: Path) -> None:
    with_record(closed(tmp_path, *THREE), 1, seq_first=40)
    journal, read = reopened(tmp_path), list[int]()
    says = r"frames 40 to 49.*the frames that its index says"
    with pytest.raises(DamagedFramesError, match=says):
        read += (int(seq) for batch in journal.read_frames(0, 59) for seq in batch.seq)
    assert read == [*range(10), *range(20, 30)]


def test_a_bad_sector_costs_no_frame_before_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    journal = filled(tmp_path, *((a, a + 9) for a in range(0, 60, 10)))
    journal.sync()
    bad = HEADER + 3 * LENGTH + 100
    pread = failing_if(lambda _, length, at: at <= bad < at + length, os.pread, *IO_ERROR)
    monkeypatch.setattr("os.pread", pread)
    read: list[int] = []
    with pytest.raises(StorageError, match="Input/output error"):
        read += (int(seq) for batch in journal.read_frames(0, 59) for seq in batch.seq)
    assert read == list(range(30))


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
    journal = filled(tmp_path, *THREE, (30, 39))
    (path,) = segments(tmp_path)
    flip(index_of(path), record * RECORD_DTYPE.itemsize + 9)
    asked = 10 * record + 2
    oldest, newest = (
        journal.find_batch_t_ns_near(asked, at_or_before=newest) for newest in (False, True)
    )
    assert oldest == part(10 * record + 10, 10 * record + 10).t_ns[0]
    assert newest == (part(10 * record - 1, 10 * record - 1).t_ns[0] if record else None)
    index_of(path).write_bytes(b"")
    assert journal.find_batch_t_ns_near(asked, at_or_before=False) is None
