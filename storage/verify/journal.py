"""Verification of a stream's journal: its segments, their order, and its notes.

Nothing is repaired. A writer may be appending, or a power cut may have stopped it: then an unclosed
segment may end with half a batch, and its index may have records of batches that never came to the
disk. Those were never promised. Everything else has to match its checksum.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from devices.errors import DamagedFileError, FileFormatError, StorageError
from devices.frames import ArrayInfo
from storage.clock.log import CLOCK_LOG_NAME as CLOCK_LOG
from storage.clock.log import ClockLog
from storage.frame_rules import describe_first_broken_rule, find_time_reversals
from storage.intervals import CORRUPT, Intervals, Losses
from storage.journal.segment import (
    INDEX_SUFFIX,
    RECORD_DTYPE,
    SUFFIX,
    UNREAD_SUFFIX,
    Records,
    find_end_offset,
    is_index_closed,
    is_record_intact,
    make_message_batch,
    mask_intact_records,
    read_existing_index,
    read_messages_until_damage,
    read_schema_and_first_offset,
    read_verified_payload,
    select_batch_records_by_checksum,
    seq_range_of,
)
from storage.journal.stream_notes import NOTES_FILE, StreamNotes
from storage.schema import read_array_info, wire_schema
from storage.sessions.ledger import StreamState
from storage.sessions.metadata import read_bytes_or_none
from storage.wire import MessageBatchDecoder, decode_message

_BATCHES_PER_CHECK = 256
"""Batches that are checked together: some thousand frames."""


@dataclass
class SegmentReport:
    """Result of the verification of a segment.

    Attributes:
        path: the segment.
        stored: numbers of frames whose bytes match their checksum.
        damaged: numbers of frames whose bytes do not.
        unsynced: numbers in the index at the end of an unclosed segment that are not on the disk:
            they were never promised.
        is_closed: True: it was closed in order.
        info: its array; None if that cannot be read.
        index: records of the undamaged batches.
        problems: messages of damage.
        remarks: other messages for people.
    """

    path: Path
    stored: Intervals = field(default_factory=Intervals)
    damaged: Intervals = field(default_factory=Intervals)
    unsynced: Intervals = field(default_factory=Intervals)
    is_closed: bool = False
    info: ArrayInfo | None = None
    index: Records = field(default_factory=lambda: np.zeros(0, RECORD_DTYPE))
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def to_json_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        return {
            "node": self.info.node if self.info is not None else None,
            "stream_id": self.info.stream_id if self.info is not None else None,
            "frames": self.stored.number_count,
            "held": list(self.stored),
            "damaged": list(self.damaged),
            "unsynced": self.unsynced.number_count,
            "closed": self.is_closed,
            "problems": self.problems,
        }


def verify_segment(path: Path) -> SegmentReport:
    """Verify every batch of a segment.

    Raises:
        FileFormatError: there is no such file.
    """
    report = SegmentReport(path)
    for each in (path, path.with_suffix(INDEX_SUFFIX)):
        if os.path.lexists(each) and (each.is_symlink() or not each.is_file()):
            report.problems.append(f"{each.name} is not a file")
            return report
    try:
        _verify_bytes(path, report)
    except FileNotFoundError as error:  # or deleted meanwhile
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(path)) from error
    except Exception as error:  # damaged bytes may cause any error
        report.problems.append(f"it cannot be read: {error}")
    return report


def _verify_bytes(path: Path, report: SegmentReport) -> None:
    try:
        # In this order, since a writer appends to the segment first: at most one batch of this
        # size has no record in the index that is read after it.
        size = path.stat().st_size
        index: Records | None = read_existing_index(path)
    except FileNotFoundError:
        if not path.exists():
            raise
        index = None
    report.is_closed = index is not None and is_index_closed(index)
    schema, header_bytes = _read_schema(path, report)
    if schema is None:
        # A segment that was created just before a power cut may be empty; one with frames may not.
        if report.is_closed or (index is not None and _has_any_batch(path, index)):
            report.problems.append("it does not begin with the description of an array")
        return
    if index is None:
        if size > header_bytes:
            report.problems.append(
                f"its index {path.with_suffix(INDEX_SUFFIX).name} is missing: nothing proves its "
                "frames; it is rebuilt when the journal is next opened"
            )
        return
    _BatchVerifier(report, schema, header_bytes).verify(index)
    end = max(header_bytes, find_end_offset(select_batch_records_by_checksum(index)))
    behind, at = 0, end
    for message in read_messages_until_damage(path, end, schema):
        at += len(message.payload)
        if at > size:
            break
        behind += 1
    if report.is_closed and size > end:
        report.problems.append(f"{size - end} bytes behind its last batch are in no index")
    elif behind > 1:
        report.problems.append(f"{behind} batches behind its last one are in no index: it was cut")
    elif behind:
        report.remarks.append("a batch behind its last one is in no index")


class _BatchVerifier:
    """Verifier of the batches of one segment, in the order of its index.

    Args:
        report: findings are added here.
        schema: schema of the segment.
        header_bytes: offset of its first batch.
    """

    def __init__(self, report: SegmentReport, schema: pa.Schema, header_bytes: int) -> None:
        self._report = report
        self._runs = MessageBatchDecoder(schema)
        self._info = read_array_info(schema, where="")
        self._end = header_bytes
        self._doubtful = Intervals()
        self._pending_problems: list[str] = []
        """Messages since the last undamaged batch."""

    def verify(self, index: Records) -> None:
        """Verify all batches of the index."""
        report, undamaged = self._report, [np.zeros(0, RECORD_DTYPE)]
        if report.is_closed:
            index = index[:-1]
        with report.path.open("rb") as file:
            for begin in range(0, len(index), _BATCHES_PER_CHECK):
                records = index[begin : begin + _BATCHES_PER_CHECK]
                if self._verify_group(file.fileno(), records):
                    undamaged.append(records)
                    continue
                for at, record in enumerate(records):
                    if self._verify_batch(file.fileno(), record, begin + at):
                        undamaged.append(records[at : at + 1])
        report.index = np.concatenate(undamaged)
        if report.is_closed:
            report.damaged = report.damaged | self._doubtful
            report.problems += self._pending_problems
        elif self._pending_problems:
            report.unsynced = self._doubtful
            report.remarks.append(
                f"{len(self._pending_problems)} batches at its end were not yet on the disk: they "
                "were never promised"
            )

    def _verify_group(self, descriptor: int, records: Records) -> bool:
        """Return whether a group of batches is undamaged; otherwise nothing is recorded."""
        offset, length = records["offset"], records["length"].astype(np.uint64)
        is_joined = bool((offset[1:] == (offset + length)[:-1]).all())
        first, last = seq_range_of(records[0])[0], seq_range_of(records[-1])[1]
        if not is_joined or offset[0] < self._end or not mask_intact_records(records).all():
            return False
        content = os.pread(descriptor, int(length.sum()), int(offset[0]))
        frames = self._runs.decode_or_none_if_damaged(make_message_batch(records, content))
        if frames is None or self._report.stored.restricted_to(first, last):
            return False
        ends = np.cumsum(records["count"], dtype=np.int64)
        t_ns_first, t_ns_last = frames.t_ns[ends - records["count"]], frames.t_ns[ends - 1]
        if (t_ns_first != records["t_ns_first"]).any() or (t_ns_last != records["t_ns_last"]).any():
            return False
        if describe_first_broken_rule(frames, self._info):
            return False
        self._report.stored.add_ranges(records["seq_first"], records["count"])
        self._report_pending()
        self._end = int(offset[-1] + length[-1])
        return True

    def _verify_batch(self, descriptor: int, record: np.void, at: int) -> bool:
        """Verify one batch; return whether it is undamaged and its frames belong there."""
        report = self._report
        if not is_record_intact(record):
            self._pending_problems.append(f"record {at} of its index is damaged")
            return False
        if not record["count"]:
            return False
        first, last = seq_range_of(record)
        payload = read_verified_payload(descriptor, record)
        if payload is None:
            self._pending_problems.append(
                f"frames {first} to {last} do not agree with their checksum"
            )
            self._doubtful.add(first, last)
            return False
        self._report_pending()
        wrong = _find_batch_problem(payload, record, self._runs.schema, self._info)
        if int(record["offset"]) < self._end:
            wrong = "they overlap other frames"
        self._end = int(record["offset"]) + int(record["length"])
        if not wrong and report.stored.restricted_to(first, last):
            wrong = "they are in it twice"
        if wrong:
            report.problems.append(f"frames {first} to {last}: {wrong}")
            return False
        report.stored.add(first, last)
        return True

    def _report_pending(self) -> None:
        """Report pending damage: a good batch behind it shows that it happened after writing."""
        self._report.damaged = self._report.damaged | self._doubtful
        self._report.problems += self._pending_problems
        self._doubtful, self._pending_problems = Intervals(), []


def _find_batch_problem(payload: bytes, record: np.void, schema: pa.Schema, info: ArrayInfo) -> str:
    """Return a message where the bytes contradict the index; empty if they do not."""
    try:
        batch = decode_message(payload, schema)
    except FileFormatError as error:
        return error.what
    if (int(batch.seq[0]), len(batch)) != (int(record["seq_first"]), int(record["count"])):
        return f"the batch holds {len(batch)} frames from {int(batch.seq[0])} on"
    if (int(batch.t_ns[0]), int(batch.t_ns[-1])) != (record["t_ns_first"], record["t_ns_last"]):
        return "the index has other instants than the batch"
    return describe_first_broken_rule(batch, info)


def _has_any_batch(path: Path, index: Records) -> bool:
    """Return whether any batch in the segment matches the index."""
    with path.open("rb") as file:
        batches = select_batch_records_by_checksum(index)
        return any(read_verified_payload(file.fileno(), record) is not None for record in batches)


def _read_schema(path: Path, report: SegmentReport) -> tuple[pa.Schema | None, int]:
    """Return a segment's expected schema and the length of its header; None: it has none."""
    schema, length = read_schema_and_first_offset(path)
    if schema is None:
        return None, 0
    try:
        report.info = read_array_info(schema, where=str(path))
    except FileFormatError as error:
        if isinstance(error, DamagedFileError):
            report.problems.append(error.what)
        return None, 0
    expected = wire_schema(report.info)
    if not schema.equals(expected, check_metadata=True):
        report.problems.append("its columns are not those of a stream of frames")
    return expected, length


@dataclass
class StreamReport:
    """Result of the verification of one stream's journal.

    Attributes:
        node: its node, by the folder's name.
        stream_id: its id, by the folder's name.
        stored: numbers of undamaged frames.
        lost: lost numbers by reason; damaged ones among them.
        unsynced: see `SegmentReport`.
        notes: its `stream.json`; None if there is none.
        info: the array.
        segment_count: number of segments.
        problems: messages of damage.
        remarks: other messages for people.
    """

    node: str
    stream_id: str
    stored: Intervals = field(default_factory=Intervals)
    lost: Losses = field(default_factory=Losses)
    unsynced: Intervals = field(default_factory=Intervals)
    notes: StreamNotes | None = None
    info: ArrayInfo | None = None
    segment_count: int = 0
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)

    def to_stream_state(self, obtainable: Intervals) -> StreamState:
        """Return the stream's state for ledgers.

        Args:
            obtainable: numbers that its node may still send, unless they are lost.
        """
        notes = self.notes
        recorded_losses = Losses(notes.lost if notes is not None else None)
        return StreamState(
            stored=self.stored,
            lost=recorded_losses,
            damaged=self.lost.numbers - recorded_losses.numbers,
            obtainable=obtainable - recorded_losses.numbers,
            next_seq=notes.next_seq if notes is not None else None,
            max_lost_tail_frames=notes.max_lost_tail_frames if notes is not None else 0,
            missed_slots=notes.missed_slots if notes is not None else 0,
        )

    @property
    def absent_not_lost(self) -> Intervals:
        """Numbers up to the stream's end that are neither stored nor lost.

        They were deleted when no session needed them any more, or are still to come.
        """
        last = self.stored.last
        if self.notes is not None and self.notes.next_seq is not None:
            last = max(self.notes.next_seq - 1, -1 if last is None else last)
        first = self.stored.first or 0
        if last is None or last < first:
            return Intervals()
        return self.stored.missing_in(first, last) - self.lost.numbers

    def to_json_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        lost = self.lost.by_reason.items()
        return {
            "node": self.node,
            "stream_id": self.stream_id,
            "segments": self.segment_count,
            "frames": self.stored.number_count,
            "held": list(self.stored),
            "lost": {reason: numbers.number_count for reason, numbers in lost if numbers},
            "missing": self.absent_not_lost.number_count,
            "unsynced": self.unsynced.number_count,
            "next_seq": self.notes.next_seq if self.notes is not None else None,
            "max_lost_tail_frames": self.notes.max_lost_tail_frames
            if self.notes is not None
            else 0,
            "problems": self.problems,
        }


def verify_journal(folder: Path) -> StreamReport:
    """Verify a stream's journal: every segment, and its notes.

    Args:
        folder: `DIR/journal/<node>/<stream_id>`.

    Raises:
        FileFormatError: the folder cannot be read.
    """
    report = StreamReport(folder.parent.name, folder.name)
    try:
        report.notes = StreamNotes.load(folder)
    except (FileFormatError, StorageError) as error:
        report.problems.append(f"{NOTES_FILE}: {error.what}")
    if (notes := report.notes) is not None:
        report.info, report.lost = notes.array_info, Losses(notes.lost)
    else:
        report.remarks.append(f"no {NOTES_FILE}: nothing says where the stream ended")
    _check_clock(report, folder)
    segments = _verify_segments(folder)
    for path in _list_files(folder, INDEX_SUFFIX):
        # An empty one is what a power cut leaves.
        if not path.with_suffix(SUFFIX).exists() and read_bytes_or_none(path) != b"":
            report.problems.append(f"{path.name}: the segment of this index is missing")
    for path in _list_files(folder, UNREAD_SUFFIX):
        report.remarks.append(f"{path.name}: bytes that were no whole batch after a crash")
    report.segment_count = len(segments)
    for segment in segments:
        name = segment.path.name
        report.problems += [f"{name}: {problem}" for problem in segment.problems]
        report.remarks += [f"{name}: {remark}" for remark in segment.remarks]
        if segment.info is not None:
            report.info = report.info or segment.info
            if segment.info != report.info:
                report.problems.append(f"{name}: it is of another stream or array")
                continue
        report.stored = report.stored | segment.stored
        report.unsynced = report.unsynced | segment.unsynced
    report.unsynced = report.unsynced - report.stored
    if notes is not None:
        report.lost.add_if_new(Intervals(notes.damaged) - report.stored, CORRUPT)
    for segment in segments:
        report.lost.add_if_new(segment.damaged - report.stored, CORRUPT)
    _check_order_and_end(report, segments, is_servers=(folder.parents[2] / "nodes").is_dir())
    return report


def _check_order_and_end(
    report: StreamReport, segments: list[SegmentReport], *, is_servers: bool
) -> None:
    info, notes = report.info, report.notes
    if info is not None and (info.node, info.stream_id) != (report.node, report.stream_id):
        report.problems.append(
            f"its frames are of node {info.node}, stream {info.stream_id}: wrongly placed"
        )
    index = np.concatenate([np.zeros(0, RECORD_DTYPE), *(segment.index for segment in segments)])
    index = index[np.argsort(index["seq_first"], kind="stable")]
    # A batch that a disk refused was written again: a second copy is neither damage nor disorder.
    ends = np.maximum.accumulate(index["seq_first"] + index["count"])
    index = index[np.concatenate([[True] * min(1, len(index)), ends[1:] > ends[:-1]]).astype(bool)]
    back = find_time_reversals(index["t_ns_first"], index["t_ns_last"])
    if len(back):
        report.problems.append(f"time runs back before frame {index['seq_first'][back[0]]}")
    if notes is None or notes.next_seq is None:
        return
    last = report.stored.last
    if last is not None and last >= notes.next_seq:
        report.problems.append(
            f"it has frame {last}, and by {NOTES_FILE} it ended with {notes.next_seq - 1}"
        )
    open_ones = [segment for segment in segments if not segment.is_closed]
    if not is_servers and open_ones:
        # A node closes a stream's segments before it records where the stream ended.
        report.problems += [
            f"{segment.path.name}: it was cut behind frame {segment.stored.last}: the stream has "
            "ended, and it was not closed"
            for segment in open_ones
        ]


def _check_clock(report: StreamReport, folder: Path) -> None:
    try:
        lines = ClockLog(folder).read_rows_and_damage()
    except StorageError as error:
        report.problems.append(f"{CLOCK_LOG}: {error.what}")
        return
    if lines.damaged_lines:
        report.problems.append(
            f"{CLOCK_LOG}: {lines.damaged_lines} lines are damaged: they are skipped, and the "
            "bounds of the server's time are wider"
        )
    if lines.is_torn:
        report.remarks.append(f"{CLOCK_LOG}: its last line is incomplete, as after a power cut")


def _verify_segments(folder: Path) -> list[SegmentReport]:
    """Verify every segment; damaged ones twice, since the file may just have been deleted."""
    first_look = [_verify_segment_if_present(path) for path in _list_files(folder, SUFFIX)]
    second_look = [
        _verify_segment_if_present(report.path)
        if report is not None and report.problems
        else report
        for report in first_look
    ]
    return [report for report in second_look if report is not None]


def _verify_segment_if_present(path: Path) -> SegmentReport | None:
    """Verify a segment; None if it was deleted meanwhile because no session needs it."""
    try:
        report = verify_segment(path)
    except FileFormatError:
        if path.exists():
            raise
        return None
    return report if not report.problems or path.exists() else None


def _list_files(folder: Path, suffix: str) -> list[Path]:
    try:
        return sorted(folder.glob("*" + suffix))
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(folder)) from error
