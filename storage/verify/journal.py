"""Verification of a stream's journal: its segments, their order, and its notes."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from devices.errors import FileFormatError, StorageError
from devices.frames import ArrayInfo
from storage.clock.log import NAME as CLOCK_LOG
from storage.clock.log import ClockLog
from storage.frame_rules import runs_back
from storage.intervals import CORRUPT, Intervals, Losses
from storage.journal.segment import SUFFIX, UNREAD_SUFFIX
from storage.journal.segment_format import INDEX_SUFFIX, RECORD
from storage.journal.stream_notes import NOTES_FILE, StreamNotes
from storage.sessions.claims import bytes_of
from storage.sessions.ledger import StreamState
from storage.verify.segment import SegmentReport, verify_segment


@dataclass
class StreamReport:
    """Result of the verification of one stream's journal.

    Attributes:
        node: its node, by the folder's name.
        boot_id: its id, by the folder's name.
        held: numbers of undamaged frames.
        lost: lost numbers by reason; damaged ones among them.
        unsynced: see `SegmentReport`.
        notes: its `stream.json`; None if there is none.
        info: the array.
        segments: number of segments.
        problems: messages of damage.
        remarks: other messages for people.
        unproven: facts that these files cannot prove.
    """

    node: str
    boot_id: str
    held: Intervals = field(default_factory=Intervals)
    lost: Losses = field(default_factory=Losses)
    unsynced: Intervals = field(default_factory=Intervals)
    notes: StreamNotes | None = None
    info: ArrayInfo | None = None
    segments: int = 0
    problems: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    unproven: list[str] = field(default_factory=list)

    def state(self, may_come: Intervals) -> StreamState:
        """Return the stream's state for ledgers.

        Args:
            may_come: numbers that its node may still send, unless they are lost.
        """
        notes = self.notes
        recorded_losses = Losses(notes.lost if notes is not None else None)
        return StreamState(
            held=self.held,
            lost=recorded_losses,
            damaged=self.lost.all - recorded_losses.all,
            may_come=may_come - recorded_losses.all,
            next_seq=notes.next_seq if notes is not None else None,
            unsynced_tail_max=notes.unsynced_tail_max if notes is not None else 0,
            missed_slots=notes.missed_slots if notes is not None else 0,
        )

    @property
    def missing(self) -> Intervals:
        """Numbers up to the stream's end that are neither stored nor lost.

        They were deleted when no session needed them any more, or are still to come.
        """
        last = self.held.last
        if self.notes is not None and self.notes.next_seq is not None:
            last = max(self.notes.next_seq - 1, -1 if last is None else last)
        first = self.held.first or 0
        if last is None or last < first:
            return Intervals()
        return self.held.missing(first, last) - self.lost.all

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON (docs/formats.md)."""
        lost = self.lost.by_reason.items()
        return {
            "node": self.node,
            "boot_id": self.boot_id,
            "segments": self.segments,
            "frames": self.held.count,
            "held": list(self.held),
            "lost": {reason: numbers.count for reason, numbers in lost if numbers},
            "missing": self.missing.count,
            "unsynced": self.unsynced.count,
            "next_seq": self.notes.next_seq if self.notes is not None else None,
            "unsynced_tail_max": self.notes.unsynced_tail_max if self.notes is not None else 0,
            "problems": self.problems,
            "unproven": self.unproven,
        }


def verify_stream(folder: Path) -> StreamReport:
    """Verify a stream's journal: every segment, and its notes.

    Args:
        folder: `DIR/journal/<node>/<stream_id>`.

    Raises:
        FileFormatError: the folder cannot be read.
    """
    report = StreamReport(folder.parent.name, folder.name)
    try:
        report.notes, is_proven = StreamNotes.load_checked(folder)
        if not is_proven:
            report.unproven.append(f"{NOTES_FILE}: it has no hash")
    except (FileFormatError, StorageError) as error:
        report.problems.append(f"{NOTES_FILE}: {error.what}")
    if report.notes is not None:
        report.info, report.lost = report.notes.array_info, Losses(report.notes.lost)
    else:
        report.remarks.append(f"no {NOTES_FILE}: nothing says where the stream ended")
    _check_clock(report, folder)
    segments = _segments(folder)
    for path in _names(folder, INDEX_SUFFIX):
        # An empty one is what a power cut leaves.
        if not path.with_suffix(SUFFIX).exists() and bytes_of(path) != b"":
            report.problems.append(f"{path.name}: the segment of this index is missing")
    for path in _names(folder, UNREAD_SUFFIX):
        report.remarks.append(f"{path.name}: bytes that were no whole batch after a crash")
    report.segments = len(segments)
    for segment in segments:
        name = segment.path.name
        report.problems += [f"{name}: {problem}" for problem in segment.problems]
        report.remarks += [f"{name}: {remark}" for remark in segment.remarks]
        if segment.info is not None:
            report.info = report.info or segment.info
            if segment.info != report.info:
                report.problems.append(f"{name}: it is of another stream or array")
                continue
        report.held = report.held | segment.held
        report.unsynced = report.unsynced | segment.unsynced
    report.unsynced = report.unsynced - report.held
    if report.notes is not None:
        report.lost.add(Intervals(report.notes.damaged) - report.held, CORRUPT)
    for segment in segments:
        report.lost.add(segment.damaged - report.held, CORRUPT)
    _check_stream(report, segments, is_servers=(folder.parents[2] / "nodes").is_dir())
    return report


def _check_stream(report: StreamReport, segments: list[SegmentReport], *, is_servers: bool) -> None:
    info, notes = report.info, report.notes
    if info is not None and (info.node, info.boot_id) != (report.node, report.boot_id):
        report.problems.append(
            f"its frames are of node {info.node}, stream {info.boot_id}: wrongly placed"
        )
    index = np.concatenate([np.zeros(0, RECORD), *(segment.index for segment in segments)])
    index = index[np.argsort(index["seq_first"], kind="stable")]
    # A batch that a disk refused was written again: a second copy is neither damage nor disorder.
    ends = np.maximum.accumulate(index["seq_first"] + index["count"])
    index = index[np.concatenate([[True] * min(1, len(index)), ends[1:] > ends[:-1]]).astype(bool)]
    back = runs_back(index["t_ns_first"], index["t_ns_last"])
    if len(back):
        report.problems.append(f"time runs back before frame {index['seq_first'][back[0]]}")
    if notes is None or notes.next_seq is None:
        return
    last = report.held.last
    if last is not None and last >= notes.next_seq:
        report.problems.append(
            f"it has frame {last}, and by {NOTES_FILE} it ended with {notes.next_seq - 1}"
        )
    open_ones = [segment for segment in segments if not segment.is_closed]
    if not is_servers and open_ones:
        # A node closes a stream's segments before it records where the stream ended.
        report.problems += [
            f"{segment.path.name}: it was cut behind frame {segment.held.last}: the stream has "
            "ended, and it was not closed"
            for segment in open_ones
        ]


def _check_clock(report: StreamReport, folder: Path) -> None:
    try:
        lines = ClockLog(folder).lines()
    except StorageError as error:
        report.problems.append(f"{CLOCK_LOG}: {error.what}")
        return
    if lines.damaged:
        report.problems.append(
            f"{CLOCK_LOG}: {lines.damaged} lines are damaged: they are skipped, and the bounds of "
            "the server's time are wider"
        )
    if lines.is_torn:
        report.remarks.append(f"{CLOCK_LOG}: its last line is incomplete, as after a power cut")


def _segments(folder: Path) -> list[SegmentReport]:
    """Verify every segment; damaged ones twice, since the file may just have been deleted."""
    first_look = [_if_there(path) for path in _names(folder, SUFFIX)]
    second_look = [
        _if_there(report.path) if report is not None and report.problems else report
        for report in first_look
    ]
    return [report for report in second_look if report is not None]


def _if_there(path: Path) -> SegmentReport | None:
    """Verify a segment; None if it was deleted meanwhile because no session needs it."""
    try:
        report = verify_segment(path)
    except FileFormatError:
        if path.exists():
            raise
        return None
    return report if not report.problems or path.exists() else None


def _names(folder: Path, suffix: str) -> list[Path]:
    try:
        return sorted(folder.glob("*" + suffix))
    except OSError as error:
        raise FileFormatError(f"cannot be read: {error.strerror}", where=str(folder)) from error
