"""A journal proves itself: what is damaged is told from what was not yet written."""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices.errors import FileFormatError
from devices.frames import ArrayInfo, FrameBatch
from storage.clock.log import ClockLog, ClockOffset
from storage.intervals import Intervals
from storage.journal.journal import Journal
from storage.journal.segment import INDEX_SUFFIX, RECORD_DTYPE, read_schema_and_first_offset
from storage.journal.segment_writer import SegmentWriter
from storage.journal.stream_notes import NOTES_FILE, StreamNotes
from storage.schema import read_array_info, wire_schema
from storage.verify.journal import verify_journal, verify_segment
from storage.wire import EncodedBatch, encode_frames
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames

STREAM_ID = "a" * 32
RECORD_BYTES = RECORD_DTYPE.itemsize


def array(**changes: Any) -> ArrayInfo:
    return make_array(1, **{"stream_id": STREAM_ID} | changes)


def frames(first: int, last: int, *, at_ns: int = 0) -> FrameBatch:
    seq = np.arange(first, last + 1)
    return make_frames(seq, 1, t_mono_ns=PERIOD_NS * seq + at_ns)


def stream(root: Path, *, next_seq: int | None = None) -> Path:
    """The journal of a stream of 40 frames in batches of 5, closed in order."""
    folder = root / "journal" / "bench" / STREAM_ID
    journal = Journal(folder, array())
    for first in range(0, 40, 5):
        journal.append_new_frames(frames(first, first + 4))
    journal.close()
    StreamNotes(array_info=array(), next_seq=next_seq).save(folder)
    return folder


def segment_of(folder: Path) -> Path:
    (path,) = folder.glob("*.arrows")
    return path


def index_of(folder: Path) -> Path:
    return segment_of(folder).with_suffix(INDEX_SUFFIX)


def ends(folder: Path) -> list[int]:
    records = np.frombuffer(index_of(folder).read_bytes(), RECORD_DTYPE)
    return [int(r["offset"] + r["length"]) for r in records if r["count"]]


def problems(folder: Path) -> str:
    return "; ".join(verify_journal(folder).problems)


def opened(folder: Path) -> Path:
    """As it is while it is written: the marker of the end is not there yet."""
    path = index_of(folder)
    path.write_bytes(path.read_bytes()[: -RECORD_DTYPE.itemsize])
    return folder


def test_a_whole_journal_is_counted_and_nothing_is_touched(tmp_path: Path) -> None:
    folder = stream(tmp_path, next_seq=40)
    before = {path: (path.read_bytes(), path.stat().st_mtime_ns) for path in folder.iterdir()}
    report = verify_journal(folder)
    assert report.problems == report.remarks == []
    assert report.stored == Intervals([(0, 39)])
    assert not report.absent_not_lost
    assert not report.unsynced
    assert before == {p: (p.read_bytes(), p.stat().st_mtime_ns) for p in folder.iterdir()}


def test_a_journal_that_is_being_written_is_whole(tmp_path: Path) -> None:
    folder = tmp_path / "journal" / "bench" / STREAM_ID
    journal = Journal(folder, array())
    StreamNotes(array_info=array()).save(folder)
    assert problems(folder) == ""
    for first in range(0, 20, 5):
        journal.append_new_frames(frames(first, first + 4))
        report = verify_journal(folder)
        assert (report.problems, report.stored.last) == ([], first + 4)
    journal.close()


@pytest.mark.parametrize("closed", [True, False])
def test_a_cut_segment_is_damaged_if_it_was_closed(tmp_path: Path, closed: bool) -> None:
    folder = stream(tmp_path)
    path = segment_of(folder)
    if not closed:
        opened(folder)
    whole, boundaries = path.read_bytes(), ends(folder)
    for size in sorted({*range(0, len(whole), 397), *boundaries[:-1], len(whole) - 1}):
        path.write_bytes(whole[:size])
        report = verify_journal(folder)
        gone = 40 - 5 * sum(end <= size for end in boundaries)
        if closed:
            assert report.problems, size
        else:  # nobody was promised what is gone, and the index still says how much it is
            assert report.problems == [], size
            assert report.unsynced.number_count == gone or size < boundaries[0]
            assert report.stored.number_count == 40 - gone


def cut_index(records: int) -> Callable[[Path], object]:
    def cut(folder: Path) -> None:
        index_of(folder).write_bytes(index_of(folder).read_bytes()[: records * RECORD_BYTES])

    return cut


def remove(find: Callable[[Path], Path]) -> Callable[[Path], object]:
    return lambda folder: find(folder).unlink()


def notes_of(folder: Path) -> Path:
    return folder / NOTES_FILE


def spoil_notes(folder: Path) -> None:
    notes_of(folder).write_bytes(b"{")


def flip_fourth_batch(folder: Path) -> None:
    content = bytearray(segment_of(opened(folder)).read_bytes())
    content[ends(folder)[3] - 9] ^= 1
    segment_of(folder).write_bytes(content)


def spoil_a_name(folder: Path) -> None:
    content = segment_of(opened(folder)).read_bytes()
    segment_of(folder).write_bytes(content.replace(b"frame_flags", b"\xf2rame_flags", 1))


def add_segment(folder: Path, batch: FrameBatch, info: ArrayInfo) -> None:
    payload = encode_frames(batch, wire_schema(info))
    header = wire_schema(info).serialize().to_pybytes()
    writer = SegmentWriter(folder / f"{batch.seq[0]:020d}.arrows", header)
    writer.append(EncodedBatch.from_frames_and_payload(batch, payload))
    writer.close()


def take_back(folder: Path) -> None:
    add_segment(folder, frames(40, 44, at_ns=-(10**9)), array())


def add_other_stream(folder: Path) -> None:
    add_segment(folder, frames(40, 49), array(stream_id="b" * 32))


ALL, FOURTH, NONE = Intervals([(0, 39)]), Intervals([(15, 19)]), Intervals()


@pytest.mark.parametrize(
    ("damage", "said", "remarked", "stored", "corrupt"),
    [
        pytest.param(
            cut_index(4),
            "4 batches behind its last one are in no index",
            "",
            None,
            NONE,
            id="index",
        ),
        # The newest may be on its way.
        pytest.param(cut_index(7), "", "in no index", None, NONE, id="newest record"),
        pytest.param(remove(index_of), "is missing", "", None, NONE, id="no index"),
        pytest.param(
            remove(segment_of), "segment of this index is missing", "", None, NONE, id="no segment"
        ),
        pytest.param(
            spoil_a_name,
            "its columns are not those of a stream of frames",
            "",
            ALL,
            NONE,
            id="a name",
        ),
        pytest.param(
            flip_fourth_batch,
            "frames 15 to 19 do not agree with their checksum",
            "",
            ALL - FOURTH,
            FOURTH,
            id="a bit",
        ),
        pytest.param(add_other_stream, "another stream or array", "", None, NONE, id="stream"),
        pytest.param(take_back, "time runs back before frame 40", "", None, NONE, id="time"),
        pytest.param(spoil_notes, NOTES_FILE, "", ALL, NONE, id="notes"),
        pytest.param(
            remove(notes_of), "", "nothing says where the stream ended", ALL, NONE, id="no notes"
        ),
    ],
)
def test_damage_is_a_problem_and_an_unfinished_write_a_remark(
    tmp_path: Path,
    damage: Callable[[Path], object],
    said: str,
    remarked: str,
    stored: Intervals | None,
    corrupt: Intervals,
) -> None:
    folder = stream(tmp_path)
    damage(folder)
    report = verify_journal(folder)
    assert said in "; ".join(report.problems)
    assert bool(report.problems) == bool(said)
    assert remarked in "; ".join(report.remarks)
    assert stored in (None, report.stored)
    assert report.lost.by_reason.get("corrupt", NONE) == corrupt


def test_a_wrong_place_or_end_is_named(tmp_path: Path) -> None:
    folder = stream(tmp_path / "place")
    assert "wrongly placed" in problems(folder.rename(folder.with_name("b" * 32)))
    assert "it ended with 29" in problems(stream(tmp_path / "end", next_seq=30))


def test_a_cut_of_segment_and_index_is_seen_by_the_streams_end(tmp_path: Path) -> None:
    folder = stream(tmp_path, next_seq=40)
    os.truncate(segment_of(folder), ends(folder)[4])
    cut_index(5)(folder)
    report = verify_journal(folder)
    assert report.absent_not_lost == Intervals([(25, 39)])
    assert "cut behind frame 24" in "; ".join(report.problems)
    (tmp_path / "nodes").mkdir()  # a server may still get the rest
    report = verify_journal(folder)
    assert (report.problems, report.absent_not_lost.number_count) == ([], 15)


@settings(max_examples=60)
@given(st.data())
def test_a_flipped_bit_in_a_closed_segment_or_its_index_is_found(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    base = tmp_path_factory.getbasetemp() / "flipped_journal"
    if not base.exists():
        stream(base, next_seq=40)
    folder = base / "journal" / "bench" / STREAM_ID
    path = data.draw(st.sampled_from([segment_of(folder), index_of(folder)]))
    whole = path.read_bytes()
    content = bytearray(whole)
    at = data.draw(st.integers(0, len(content) - 1))
    content[at] ^= 1 << data.draw(st.integers(0, 7))
    try:
        path.write_bytes(content)
        report = verify_journal(folder)
    finally:
        path.write_bytes(whole)
    # A header has padding, and bytes that nobody reads.
    harmless = (
        path.suffix == ".arrows" and at < ends(folder)[0] and report.stored.number_count == 40
    )
    assert report.problems or harmless


def test_a_segment_proves_itself_alone(tmp_path: Path) -> None:
    path = segment_of(stream(tmp_path))
    report = verify_segment(path)
    assert (report.stored.number_count, report.is_closed, report.problems) == (40, True, [])
    with pytest.raises(FileFormatError, match=r"none\.arrows"):
        verify_segment(path.with_name("none.arrows"))


def test_bytes_set_aside_after_a_crash_are_remarked(tmp_path: Path) -> None:
    folder = opened(stream(tmp_path))
    path = segment_of(folder)
    path.write_bytes(path.read_bytes() + b"half a batch")
    assert verify_journal(folder).problems == []
    Journal.open_existing_and_recover(folder).close()
    report = verify_journal(folder)
    assert (report.problems, report.stored.number_count) == ([], 40)
    assert "no whole batch" in "; ".join(report.remarks)


def test_batches_written_again_are_no_disorder(tmp_path: Path) -> None:
    folder = tmp_path / "journal" / "bench" / array().stream_id
    journal = Journal(folder, array())
    for first in range(0, 40, 10):
        journal.append_new_frames(frames(first, first + 9))
    journal.invalidate_batches_wholly_within(Intervals([(20, 39)]))
    for first in range(20, 60, 10):
        journal.append_new_frames(frames(first, first + 9))
    StreamNotes(array_info=array(), next_seq=60).save(folder)
    journal.close()
    report = verify_journal(folder)
    assert report.problems == []
    assert list(report.stored) == [(0, 59)]


# --- beside the segments --------------------------------------------------------------------------


def with_clock(folder: Path) -> Path:
    log = ClockLog(folder)
    for second in range(4):
        times = {"t_mono_ns": second * 10**9, "server_minus_node_ns": second}
        log.append(ClockOffset(stream_id=STREAM_ID, uncertainty_ns=500, **times))
    return log.path


def test_a_damaged_clock_row_is_named_and_a_torn_last_one_is_none(tmp_path: Path) -> None:
    path = with_clock(stream(tmp_path))
    whole = path.read_bytes()
    assert problems(path.parent) == ""
    last = whole.rindex(b"\n", 0, -1)
    for at in range(0, len(whole) - 1, 11):
        damaged = bytearray(whole)
        damaged[at] ^= 4
        path.write_bytes(damaged)
        report = verify_journal(path.parent)  # a power cut may leave anything of the last line
        assert "clock.jsonl" in " ".join(report.problems if at < last else report.remarks)
    path.write_bytes(whole[:-20])
    report = verify_journal(path.parent)
    assert (report.problems, "clock.jsonl" in report.remarks[-1]) == ([], True)
    ClockLog(path.parent).append(
        ClockLog(path.parent).read_undamaged_rows()[0]
    )  # which cuts the torn one off
    assert verify_journal(path.parent).remarks == []


def test_no_flip_in_a_segments_header_gives_another_array(tmp_path: Path) -> None:
    folder = stream(tmp_path)
    (folder / NOTES_FILE).unlink()  # so that only the segment says which array it is of
    path = segment_of(folder)
    whole = path.read_bytes()
    _, header_bytes = read_schema_and_first_offset(path)
    for at in range(0, header_bytes, 11):
        damaged = bytearray(whole)
        damaged[at] ^= 1 << at % 8
        path.write_bytes(damaged)
        schema, _ = read_schema_and_first_offset(path)
        with suppress(FileFormatError):
            same = schema is None or read_array_info(schema, where="") == array()
            assert same, f"flipped at {at}"
            continue
        assert problems(folder) != ""
