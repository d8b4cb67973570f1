"""Verification of a stream's journal: its segments, their order, and its notes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import FileFormatError, StorageError
from devices.frames import ArrayInfo
from storage.clock.log import CLOCK_LOG_NAME as CLOCK_LOG
from storage.clock.log import ClockLog
from storage.frame_rules import find_time_reversals
from storage.intervals import CORRUPT, Intervals, Losses
from storage.journal.segment import INDEX_SUFFIX, RECORD_DTYPE, SUFFIX, UNREAD_SUFFIX
from storage.journal.stream_notes import NOTES_FILE, StreamNotes
from storage.sessions.ledger import StreamState
from storage.sessions.metadata import read_bytes_or_none
from storage.verify.segment import SegmentReport, verify_segment


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
    if report.notes is not None:
        report.info, report.lost = report.notes.array_info, Losses(report.notes.lost)
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
    if report.notes is not None:
        report.lost.add_if_new(Intervals(report.notes.damaged) - report.stored, CORRUPT)
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
