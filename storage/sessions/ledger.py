"""Ledger of a session: every number counted once, as recorded, lost for a reason, or pending.

Pure functions of intervals, which a running server or files alone may give.

Frames of a file are in order: `seq` and `t_mono_ns` rise within a part, and `t_ns` is `t_mono_ns`
plus one offset. Every filter over time relies on that; a file of another program, or an edited one,
need not keep to it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.frame_rules import mask_out_of_range_times
from storage.intervals import ABANDONED, CORRUPT, NO_END, NODE_RESTARTED, Intervals, Losses
from storage.schema import Array
from storage.sessions.folder import Ledger, Part, PartLedger, Session


def compute_ledger(
    parts: tuple[Part, ...], state_by_stream: Mapping[str, StreamState], *, has_all_parts: bool
) -> Ledger:
    """Count every number of these parts once.

    A number that is neither stored, nor lost for a known reason, nor obtainable, is lost because
    the node came back without it: `node_restarted`.

    Args:
        parts: a part without an end reaches to the last stored number.
        state_by_stream: states by stream_id; a missing one counts as empty.
        has_all_parts: True: no more parts will be added.
    """
    counted = []
    for part in parts:
        stream = state_by_stream.get(part.stream_id, StreamState())
        last = _last_seq_of(part, stream)
        gaps, lost = _find_gaps_and_losses(part, stream)
        length = max(0, last - part.seq_first + 1)
        counted.append(
            PartLedger(
                stream_id=part.stream_id,
                seq_first=part.seq_first,
                seq_last=last,
                recorded=length - gaps.number_count,
                lost={
                    reason: numbers.number_count
                    for reason, numbers in sorted(lost.by_reason.items())
                },
                pending=(gaps - lost.numbers).number_count,
                max_lost_tail_frames=stream.max_lost_tail_frames,
            )
        )
    has_end = has_all_parts and all(part.seq_last is not None for part in parts)
    lossy = any(part.lost or part.max_lost_tail_frames for part in counted)
    return Ledger(
        complete=has_end and not lossy and not any(part.pending for part in counted),
        lossy=lossy,
        parts=tuple(counted),
        missed_slots=sum(stream.missed_slots for stream in state_by_stream.values()),
    )


def find_lost_numbers(
    parts: tuple[Part, ...], streams: Mapping[str, StreamState]
) -> dict[str, dict[str, list[tuple[int, int]]]]:
    """Return the numbers that the ledger counts as lost, by stream_id and reason."""
    found: dict[str, Losses] = {}
    for part in parts:
        _, lost = _find_gaps_and_losses(part, streams.get(part.stream_id, StreamState()))
        losses = found.setdefault(part.stream_id, Losses())
        for reason, numbers in lost.by_reason.items():
            losses.add_if_new(numbers, reason)
    return {
        stream_id: {reason: list(pairs) for reason, pairs in losses.to_pairs().items()}
        for stream_id, losses in found.items()
        if losses
    }


def _last_seq_of(part: Part, stream: StreamState) -> int:
    if part.seq_last is not None:
        return part.seq_last
    newest = stream.stored.last
    return max(part.seq_first - 1, -1 if newest is None else newest)


def _find_gaps_and_losses(part: Part, stream: StreamState) -> tuple[Intervals, Losses]:
    """Return a part's numbers that are not stored, and the lost ones of these by reason."""
    last = _last_seq_of(part, stream)
    gaps = Intervals()
    if last >= part.seq_first:
        gaps = stream.stored.missing_in(part.seq_first, last)
    lost = Losses(stream.lost.restricted_to(gaps))
    lost.add_if_new(gaps - stream.obtainable - stream.lost.numbers, NODE_RESTARTED)
    return gaps, lost


@dataclass(frozen=True)
class StreamState:
    """State of one stream for a session that needs its frames.

    Attributes:
        stored: numbers that are stored here, or in the sealed file.
        lost: numbers that will not come, by reason; no stored one is among them.
        damaged: numbers that were stored here and cannot be read any more.
        obtainable: numbers that the node may still have; unknown ones count as obtainable.
        next_seq: number after its last frame; None while it runs, or if unknown.
        max_lost_tail_frames: upper limit of further frames behind the last one.
        missed_slots: slots without a frame.
    """

    stored: Intervals = field(default_factory=Intervals)
    lost: Losses = field(default_factory=Losses)
    damaged: Intervals = field(default_factory=Intervals)
    obtainable: Intervals = field(default_factory=Intervals)
    next_seq: int | None = None
    max_lost_tail_frames: int = 0
    missed_slots: int = 0


StreamStateT = TypeVar("StreamStateT", bound=StreamState)


def mark_damaged_and_abandoned_lost(
    session: Session, streams: Mapping[str, StreamStateT]
) -> dict[str, StreamStateT]:
    """Return the streams' states with their losses settled, as the ledger counts them.

    A damaged number is lost unless it is obtainable, and an obtainable one is lost once the session
    was abandoned. Slots count only from start to stop, and a tail counts only if a part reaches the
    end of its stream.

    Args:
        session: the session.
        streams: states of all of its streams, by stream_id.
    """
    found = {}
    for part in session.parts:
        stream = streams[part.stream_id]
        lost, may_come = Losses(stream.lost.to_pairs()), stream.obtainable
        if session.is_abandoned:
            lost.add_if_new(stream.damaged, CORRUPT)
            lost.add_if_new(may_come, ABANDONED)
            may_come = Intervals()
        lost.add_if_new(stream.damaged - may_come, CORRUPT)
        reaches_end = (
            part.seq_last is None or stream.next_seq is None or part.seq_last >= stream.next_seq - 1
        )
        tail = stream.max_lost_tail_frames if reaches_end else 0
        missed = session.missed_slots_at_stop.get(part.stream_id, stream.missed_slots)
        if part.stream_id == session.parts[0].stream_id:
            missed = max(0, missed - session.missed_slots_at_start)
        found[part.stream_id] = replace(
            stream,
            lost=lost,
            obtainable=may_come,
            max_lost_tail_frames=session.max_lost_tail_frames.get(part.stream_id, tail),
            missed_slots=missed,
        )
    return found


def group_numbers_by_stream(parts: Iterable[Part]) -> dict[str, Intervals]:
    """Return the numbers of parts by stream_id; a part without an end has no upper limit."""
    numbers: dict[str, Intervals] = {}
    for part in parts:
        last = NO_END if part.seq_last is None else part.seq_last
        if last >= part.seq_first:
            numbers.setdefault(part.stream_id, Intervals()).add(part.seq_first, last)
    return numbers


_MAX_MESSAGES = 3


@dataclass
class PartFrameSummary:
    """Frames of one part: range, count, and disorder.

    Attributes:
        part: its number, from 0.
        seq_first: number of its first frame.
        seq_last: number of its last frame.
        frames: number of frames.
        offset_ns: `t_ns - t_mono_ns` of its first frame.
        t_mono_ns_first: instant of its first frame.
        t_mono_ns_last: instant of its last frame.
        numbers: frame numbers present.
        disorder_messages: messages about their order; the first few.
        disorder_count: how many there would be.
    """

    part: int
    seq_first: int
    seq_last: int
    offset_ns: int
    t_mono_ns_first: int
    t_mono_ns_last: int
    frames: int = 0
    numbers: Intervals = field(default_factory=Intervals)
    disorder_messages: list[str] = field(default_factory=list)
    disorder_count: int = 0

    @property
    def gaps(self) -> Intervals:
        """Numbers between the first and the last without a frame."""
        first, last = sorted((self.seq_first, self.seq_last))
        return self.numbers.missing_in(first, last)


class FrameOrderChecker:
    """Check of frame order, piece by piece; results are in `parts` and `disorder_messages`."""

    def __init__(self) -> None:
        self.parts: list[PartFrameSummary] = []
        self.disorder_messages: list[str] = []
        """Messages about the order of the parts."""

    @property
    def problems(self) -> list[str]:
        """Messages about all disorder."""
        found = list(self.disorder_messages)
        for part in self.parts:
            found += [f"part {part.part}: {message}" for message in part.disorder_messages]
            if part.disorder_count > len(part.disorder_messages):
                more = part.disorder_count - len(part.disorder_messages)
                found.append(f"part {part.part}: and {more} more of the kind")
        return found

    def add_and_check_frames(self, columns: Mapping[str, Array]) -> None:
        """Add the next frames, and collect messages about their order; nothing is raised.

        Args:
            columns: `seq`, `t_mono_ns`, `t_ns` and, if the file has it, `part`; n rows each.
        """
        rows = len(columns["seq"])
        numbers = columns.get("part", np.zeros(rows, dtype=np.uint16))
        if not rows:
            return
        cuts = [0, *(np.flatnonzero(numbers[1:] != numbers[:-1]) + 1).tolist(), rows]
        for begin, end in pairwise(cuts):
            cut = {name: columns[name][begin:end] for name in ("seq", "t_mono_ns", "t_ns")}
            self._check_part_frames(int(numbers[begin]), cut["seq"], cut["t_mono_ns"], cut["t_ns"])

    def _check_part_frames(self, number: int, seq: Array, t_mono_ns: Array, t_ns: Array) -> None:
        if not self.parts or self.parts[-1].part != number:
            if self.parts and number < self.parts[-1].part:
                self.disorder_messages.append(f"part {number} follows part {self.parts[-1].part}")
            self.parts.append(
                PartFrameSummary(
                    part=number,
                    seq_first=int(seq[0]),
                    seq_last=int(seq[0]),
                    offset_ns=int(t_ns[0]) - int(t_mono_ns[0]),
                    t_mono_ns_first=int(t_mono_ns[0]),
                    t_mono_ns_last=int(t_mono_ns[0]),
                )
            )
        part = self.parts[-1]
        if part.frames:
            seq = np.concatenate([np.array([part.seq_last], seq.dtype), seq])
            before = np.array([part.t_mono_ns_last], t_mono_ns.dtype)
            with_before = np.concatenate([before, t_mono_ns])
        else:
            with_before = t_mono_ns
        falls = seq[1:] <= seq[:-1]
        back = with_before[1:] < with_before[:-1]
        for at in np.flatnonzero(falls).tolist():
            _add_message(part, f"frame {seq[at + 1]} follows frame {seq[at]}")
        for at in np.flatnonzero(back & ~falls).tolist():
            late_ns = int(with_before[at]) - int(with_before[at + 1])
            _add_message(part, f"time runs back by {late_ns} ns before frame {seq[at + 1]}")
        beyond = mask_out_of_range_times(t_mono_ns, t_ns)
        shifted = (t_ns - t_mono_ns != part.offset_ns) & ~beyond  # beyond, a difference may wrap
        for wrong, problem in (
            (beyond, "is in no possible year"),
            (shifted, "is not t_mono_ns plus the part's offset"),
        ):
            if wrong.any():
                first = int(seq[len(seq) - len(t_ns) + int(np.argmax(wrong))])
                _add_message(part, f"t_ns of frame {first} {problem}")
        breaks = np.flatnonzero((seq[1:] - seq[:-1] != 1) | falls) + 1
        cuts = [0, *breaks.tolist(), len(seq)]
        for begin, end in pairwise(cuts):
            part.numbers.add(int(seq[begin]), int(seq[end - 1]))
        part.frames += len(t_ns)
        part.seq_last, part.t_mono_ns_last = int(seq[-1]), int(t_mono_ns[-1])


def iterate_checking_order(
    pieces: Iterable[tuple[FrameBatch, Mapping[str, Array]]], *, where: str
) -> Iterator[tuple[FrameBatch, Mapping[str, Array]]]:
    """Yield the same frames, for readers that rely on their order.

    Raises:
        FileFormatError: the first frame out of order is reached.
    """
    order = FrameOrderChecker()
    for frames, extra in pieces:
        columns = {"seq": frames.seq, "t_mono_ns": frames.t_mono_ns, "t_ns": frames.t_ns}
        order.add_and_check_frames(
            columns | {name: extra[name] for name in ("part",) if name in extra}
        )
        if problems := order.problems:
            raise FileFormatError(
                f"its frames are out of order: {problems[0]}",
                where=where,
                expected="seq and t_mono_ns rising within a part, t_ns at one offset from it",
                remedy="`foottile verify` lists what else is wrong",
            )
        yield frames, extra


def _add_message(part: PartFrameSummary, text: str) -> None:
    part.disorder_count += 1
    if len(part.disorder_messages) < _MAX_MESSAGES:
        part.disorder_messages.append(text)
