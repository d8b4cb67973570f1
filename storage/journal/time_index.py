"""Batches of a journal by its segments' indexes: their times, and their frames.

Searches the frame of an instant, and the instant of a frame. Incoming frames have to fit between
the stored ones, which may be far away in the files, since the newest frames and the backlog arrive
alternately. Only the ends of stored intervals matter, and their times are cached.

Frames are returned in pieces of thousands, independent of the batches: a piece is read and decoded
at once, and batch by batch only if a check fails.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from devices.arrays import Ints
from devices.errors import DamagedFramesError, StorageError
from devices.frames import FrameBatch
from storage.durable_files import translate_storage_errors
from storage.intervals import Intervals
from storage.journal.segment import (
    RECORD_DTYPE,
    Records,
    Segment,
    make_message_batch,
    read_verified_payload,
    seq_range_of,
)
from storage.wire import EncodedBatch, MessageBatchDecoder, decode_message


class TimeIndex:
    """Time index of one journal: cached times of the ends of its stored intervals.

    Args:
        find_t_ns: returns the node's UTC of a stored number that ends an interval; True: its upper
            end.
    """

    def __init__(self, find_t_ns: Callable[[int, bool], int | None]) -> None:
        self._look_up = find_t_ns
        self._t_ns_by_end: dict[tuple[int, bool], int | None] = {}
        """Times by number and whether it is an upper end: a batch of one frame is both."""

    def register_message(self, message: EncodedBatch, stored: Intervals) -> None:
        """Update the cache with a written message that is among the stored ones."""
        t_ns_by_end, first, last = self._t_ns_by_end, message.seq_first, message.seq_last
        t_ns_by_end[first, False], t_ns_by_end[last, True] = message.t_ns_first, message.t_ns_last
        before, after = stored.nearest_outside(first, last)
        if before == first - 1:  # joined to it: the two numbers are no ends any more
            t_ns_by_end.pop((first - 1, True), None)
            t_ns_by_end.pop((first, False), None)
        if after == last + 1:
            t_ns_by_end.pop((last + 1, False), None)
            t_ns_by_end.pop((last, True), None)

    def forget_cached_times(self) -> None:
        """Clear the cache: numbers are no longer stored."""
        self._t_ns_by_end.clear()

    def describe_reversal_against_stored(self, frames: FrameBatch, stored: Intervals) -> str:
        """Return a message if time would run back between `frames` and stored ones; else empty.

        Args:
            frames: frames of one message; stored frames are ignored.
            stored: numbers in the journal.
        """
        first, last = int(frames.seq[0]), int(frames.seq[-1])
        for a, b in stored.missing_in(first, last):
            before, after = stored.nearest_outside(a, b)
            begin_ns, end_ns = int(frames.t_ns[a - first]), int(frames.t_ns[b - first])
            before_ns = None if before is None else self._get_t_ns(before, is_upper=True)
            after_ns = None if after is None else self._get_t_ns(after, is_upper=False)
            spans = [
                *([] if before_ns is None else [(before_ns, before_ns, before)]),
                (begin_ns, end_ns, a),
                *([] if after_ns is None else [(after_ns, after_ns, after)]),
            ]
            # The rule of `frame_rules.find_time_reversals`, without arrays for two or three spans.
            for (_, before_end_ns, _), (next_begin_ns, _, seq) in pairwise(spans):
                if next_begin_ns < before_end_ns:
                    return f"time runs back before frame {seq}"
        return ""

    def _get_t_ns(self, seq: int, *, is_upper: bool) -> int | None:
        end = seq, is_upper
        if end not in self._t_ns_by_end:
            self._t_ns_by_end[end] = self._look_up(*end)
        return self._t_ns_by_end[end]


def find_first_batch_seq_since(segments: Iterable[Segment], t_ns: int) -> int | None:
    """Return the first number of the oldest batch with a frame at `t_ns` or later, if any.

    Raises:
        StorageError: an index cannot be read; so for all searches here.
    """
    young = []
    for segment in segments:
        if segment.t_ns_first >= t_ns:
            young.append(segment.seq_range[0])
        elif segment.t_ns_last >= t_ns:
            records = segment.read_stored_batch_records()
            young += records["seq_first"][records["t_ns_last"] >= t_ns].tolist()
    return min(young, default=None)


def find_batch_t_ns_near(
    segments: Sequence[Segment], seq: int, *, at_or_before: bool
) -> int | None:
    """Return the node's UTC of the end (upper) or beginning of the batch with `seq`.

    If the batch's record is damaged, the nearest valid one before or after it counts; None if there
    is none.
    """
    holding = [segment for segment in segments if segment.stored.restricted_to(seq, seq)]
    found = _find_nearest_batches(holding, seq, at_or_before=at_or_before) or _find_nearest_batches(
        segments, seq, at_or_before=at_or_before
    )
    return (max(found) if at_or_before else min(found))[1] if found else None


def _find_nearest_batches(
    segments: Iterable[Segment], seq: int, *, at_or_before: bool
) -> list[tuple[int, int]]:
    """Return number and time of each segment's last batch up to `seq`, or first from it on."""
    found: list[tuple[int, int]] = []
    for segment in segments:
        records = segment.read_stored_batch_records()
        if at_or_before:
            records = records[records["seq_first"] <= seq][-1:]
        else:
            records = records[records["seq_first"] + records["count"] > seq][:1]
        name = "t_ns_last" if at_or_before else "t_ns_first"
        found += [(int(record["seq_first"]), int(record[name])) for record in records]
    return found


def find_part_last_seq_once_passed(
    segments: Iterable[Segment],
    t_ns: int,
    *,
    part_seq_first: int,
    read_frames: Callable[[int, int], Iterable[FrameBatch]],
) -> int | None:
    """Return the last number at `t_ns` or before, as `Journal.find_part_last_seq_once_passed`.

    Args:
        segments: segments of the journal.
        t_ns: node's UTC.
        part_seq_first: batches before this number are skipped.
        read_frames: returns the frames of a batch by its first and last number.
    """
    segments = [segment for segment in segments if segment.seq_range[1] >= part_seq_first]
    if all(segment.t_ns_last <= t_ns for segment in segments):
        return None
    # Among segments that end before `t_ns` only the last one counts.
    before = max((s.seq_range[1] for s in segments if s.t_ns_last <= t_ns), default=None)
    records = np.concatenate(
        [np.zeros(0, RECORD_DTYPE)]
        + [
            segment.read_stored_batch_records()
            for segment in segments
            if segment.seq_range[1] == before or segment.t_ns_first <= t_ns < segment.t_ns_last
        ]
    )
    records = records[records["seq_first"] + records["count"] > part_seq_first]
    is_later_known = any(segment.t_ns_first > t_ns for segment in segments)
    if not is_later_known and not (records["t_ns_last"] > t_ns).any():
        return None
    early = records[records["t_ns_first"] <= t_ns]
    if not len(early):
        return part_seq_first - 1
    newest = seq_range_of(early[early["seq_first"].argmax()])
    rows = sum(
        int(np.searchsorted(batch.t_ns, t_ns, side="right")) for batch in read_frames(*newest)
    )
    return max(part_seq_first - 1, newest[0] + rows - 1)


PIECE_FRAMES = 4096
"""Frames in a piece, unless one message has more: as many as the estimator handles at a time."""
_MAX_OPEN_FILES = 8
"""Upper limit of open segments; out-of-order frames alternate between two or three."""


@dataclass(frozen=True)
class BatchIndex:
    """Index records of batches in order of their frames.

    Attributes:
        records: index records.
        paths: segments.
        segment_number: int64, index of each batch's segment in `paths`.
    """

    records: Records
    paths: Sequence[Path]
    segment_number: Ints

    @classmethod
    def from_segments(cls, records_by_path: Sequence[tuple[Path, Records]]) -> BatchIndex:
        """Merge the records of several segments, in order of their frames."""
        records = np.concatenate(
            [np.zeros(0, RECORD_DTYPE), *(records for _, records in records_by_path)]
        )
        segment = np.repeat(
            np.arange(len(records_by_path)), [len(records) for _, records in records_by_path]
        )
        order = np.lexsort((records["count"], records["seq_first"]))
        return cls(records[order], [path for path, _ in records_by_path], segment[order])

    def __len__(self) -> int:
        return len(self.records)

    def skip_before(self, seq: int) -> BatchIndex:
        """Return the batches that do not end before this number."""
        keep = self.records["seq_first"] + self.records["count"] > seq
        return BatchIndex(self.records[keep], self.paths, self.segment_number[keep])

    def split_by_frame_count(self) -> Iterator[BatchIndex]:
        """Split the batches into groups of up to `PIECE_FRAMES` frames."""
        frames = np.cumsum(self.records["count"], dtype=np.int64)
        begin = before = 0
        while begin < len(self):
            end = int(np.searchsorted(frames, before + PIECE_FRAMES, side="right"))
            end = max(end, begin + 1)
            yield BatchIndex(self.records[begin:end], self.paths, self.segment_number[begin:end])
            begin, before = end, int(frames[end - 1])


class BatchReader:
    """Reader of batches; it keeps the last segments open until it is closed.

    Args:
        decoder: decoder of the stream.
    """

    def __init__(self, decoder: MessageBatchDecoder) -> None:
        self._runs = decoder
        self._opened: dict[Path, int] = {}

    def __enter__(self) -> BatchReader:
        return self

    def __exit__(self, *_: object) -> None:
        with ExitStack() as stack:
            for descriptor in self._opened.values():
                stack.callback(os.close, descriptor)

    def read_messages(self, batches: BatchIndex) -> Iterator[EncodedBatch]:
        """Yield each batch as the bytes in which it came.

        Raises:
            DamagedFramesError: a batch on disk is damaged; the error has its numbers.
            StorageError: a segment cannot be read.
        """
        for record, at in zip(batches.records, batches.segment_number.tolist(), strict=True):
            path = batches.paths[at]
            first, last = seq_range_of(record)
            with translate_storage_errors(path):
                payload = read_verified_payload(self._open_segment(path), record)
            if payload is None:
                raise _damage_error(path, record, "the bytes that were written, by their CRC-32")
            t_ns = int(record["t_ns_first"]), int(record["t_ns_last"])
            yield EncodedBatch(first, last, *t_ns, payload)

    def read_frames(self, batches: BatchIndex) -> Iterator[FrameBatch]:
        """Yield the frames in pieces; those before an unreadable batch come before its error.

        Raises:
            DamagedFramesError: as for `read_messages`.
            FileFormatError: a batch is undamaged but holds no frames of this stream.
            StorageError: as for `read_messages`.
        """
        for piece in batches.split_by_frame_count():
            try:
                content = self._read_bytes(piece)
            except StorageError:  # a bad sector is in one batch: read those before it
                content = b""
            frames = self._runs.decode_or_none_if_damaged(
                make_message_batch(piece.records, content)
            )
            if frames is not None:
                yield frames
                continue
            for at, message in enumerate(self.read_messages(piece)):
                frames = decode_message(message.payload, self._runs.schema)
                if (
                    EncodedBatch.from_frames_and_payload(frames, message.payload).numbers
                    != message.numbers
                ):
                    path = piece.paths[piece.segment_number[at]]
                    raise _damage_error(path, piece.records[at], "the frames that its index says")
                yield frames

    def _read_bytes(self, batches: BatchIndex) -> bytes:
        """Read the bytes of adjacent batches; fewer if a segment was cut."""
        records, segment = batches.records, batches.segment_number
        ends = records["offset"] + records["length"]
        breaks = (segment[1:] != segment[:-1]) | (records["offset"][1:] != ends[:-1])
        stretches = []
        for begin, end in pairwise([0, *(np.flatnonzero(breaks) + 1).tolist(), len(records)]):
            path = batches.paths[segment[begin]]
            offset = int(records["offset"][begin])
            with translate_storage_errors(path):
                length = int(ends[end - 1]) - offset
                stretches.append(os.pread(self._open_segment(path), length, offset))
        return b"".join(stretches)

    def _open_segment(self, path: Path) -> int:
        if path not in self._opened:
            if len(self._opened) >= _MAX_OPEN_FILES:  # a session of hours has hundreds
                os.close(self._opened.pop(next(iter(self._opened))))
            self._opened[path] = os.open(path, os.O_RDONLY)
        return self._opened[path]


def _damage_error(path: Path, record: np.void, expected: str) -> DamagedFramesError:
    first, last = seq_range_of(record)
    return DamagedFramesError(
        f"the batch at byte {int(record['offset'])} (frames {first} to {last}) is damaged",
        where=str(path),
        expected=expected,
        seq_first=first,
        seq_last=last,
    )
