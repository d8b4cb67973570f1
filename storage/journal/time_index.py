"""Times of the frames in a journal, by the records of its segments.

Searches the frame of an instant, and the instant of a frame. Incoming frames have to fit between
the stored ones, which may be far away in the files, since the newest frames and the backlog arrive
alternately. Only the ends of stored intervals matter, and their times are cached.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise

import numpy as np

from devices.frames import FrameBatch
from storage.intervals import Intervals
from storage.journal.segment import Segment
from storage.journal.segment_format import RECORD_DTYPE, seq_range_of
from storage.wire import EncodedBatch


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

    def clear(self) -> None:
        """Clear the cache: numbers are no longer stored."""
        self._t_ns_by_end.clear()

    def describe_time_conflict(self, frames: FrameBatch, stored: Intervals) -> str:
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


def find_last_seq_once_passed(
    segments: Iterable[Segment],
    t_ns: int,
    *,
    min_seq: int,
    read_frames: Callable[[int, int], Iterable[FrameBatch]],
) -> int | None:
    """Return the last number at `t_ns` or before, as `Journal.find_last_seq_once_passed`.

    Args:
        segments: segments of the journal.
        t_ns: node's UTC.
        min_seq: batches before this number are skipped.
        read_frames: returns the frames of a batch by its first and last number.
    """
    segments = [segment for segment in segments if segment.seq_range[1] >= min_seq]
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
    records = records[records["seq_first"] + records["count"] > min_seq]
    is_later_known = any(segment.t_ns_first > t_ns for segment in segments)
    if not is_later_known and not (records["t_ns_last"] > t_ns).any():
        return None
    early = records[records["t_ns_first"] <= t_ns]
    if not len(early):
        return min_seq - 1
    newest = seq_range_of(early[early["seq_first"].argmax()])
    rows = sum(
        int(np.searchsorted(batch.t_ns, t_ns, side="right")) for batch in read_frames(*newest)
    )
    return max(min_seq - 1, newest[0] + rows - 1)
