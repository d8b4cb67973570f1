"""Ledger of a session: every number counted once, as recorded, lost for a reason, or pending.

Pure functions of intervals, which a running server or files alone may give.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from storage.intervals import CORRUPT, GIVEN_UP, NO_END, NODE_RESTARTED, Intervals, Losses
from storage.sessions.folder import Ledger, Part, PartLedger, Session


def compute_ledger(
    parts: tuple[Part, ...], state_by_stream: Mapping[str, StreamState], *, is_finished: bool
) -> Ledger:
    """Count every number of these parts once.

    A number that is neither stored, nor lost for a known reason, nor obtainable, is lost because
    the node came back without it: `node_restarted`.

    Args:
        parts: a part without an end reaches to the last stored number.
        state_by_stream: states by stream_id; a missing one counts as empty.
        is_finished: True: no more parts will be added.
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
    has_end = is_finished and all(part.seq_last is not None for part in parts)
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
        lost: numbers that will not come, by reason; none of them is stored.
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


def settle_losses(session: Session, streams: Mapping[str, StreamStateT]) -> dict[str, StreamStateT]:
    """Return the streams' states with their losses settled, as the ledger counts them.

    A damaged number is lost unless it is obtainable, and an obtainable one is lost once the session
    was given up. Slots count only from start to stop, and a tail counts only if a part reaches the
    end of its stream.

    Args:
        session: the session.
        streams: states of all of its streams, by stream_id.
    """
    found = {}
    for part in session.parts:
        stream = streams[part.stream_id]
        lost, may_come = Losses(stream.lost.to_pairs()), stream.obtainable
        if session.given_up:
            lost.add_if_new(stream.damaged, CORRUPT)
            lost.add_if_new(may_come, GIVEN_UP)
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
