"""The ledger: every number of a session counted once, as recorded, lost for a reason, or pending.

Pure: it is made from intervals, wherever they come from: a running server, or files alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from storage.intervals import CORRUPT, GIVEN_UP, NO_END, NODE_RESTARTED, Intervals, Losses
from storage.sessions.folder import Ledger, Part, PartLedger, Session


def ledger_of(
    parts: tuple[Part, ...], streams: Mapping[str, StreamState], *, finished: bool
) -> Ledger:
    """Count every number of these parts once.

    What is neither held, nor lost for a known reason, nor still with the node, is lost because the
    node came back without it: `node_restarted`.

    Args:
        parts: a part without an end reaches to what is held.
        streams: by boot_id; nothing is known of a stream that is not there.
        finished: no more parts will be added.
    """
    counted = []
    for part in parts:
        stream = streams.get(part.boot_id, StreamState())
        last = _last_of(part, stream)
        gaps, lost = _gaps_and_losses(part, stream)
        length = max(0, last - part.seq_first + 1)
        counted.append(
            PartLedger(
                boot_id=part.boot_id,
                seq_first=part.seq_first,
                seq_last=last,
                recorded=length - gaps.count,
                lost={reason: numbers.count for reason, numbers in sorted(lost.by_reason.items())},
                pending=(gaps - lost.all).count,
                unsynced_tail_max=stream.unsynced_tail_max,
            )
        )
    has_end = finished and all(part.seq_last is not None for part in parts)
    lossy = any(part.lost or part.unsynced_tail_max for part in counted)
    return Ledger(
        complete=has_end and not lossy and not any(part.pending for part in counted),
        lossy=lossy,
        parts=tuple(counted),
        missed_slots=sum(stream.missed_slots for stream in streams.values()),
    )


def lost_numbers(
    parts: tuple[Part, ...], streams: Mapping[str, StreamState]
) -> dict[str, dict[str, list[tuple[int, int]]]]:
    """Which numbers the ledger counts as lost, by boot_id and reason; for the sealed file."""
    found: dict[str, Losses] = {}
    for part in parts:
        _, lost = _gaps_and_losses(part, streams.get(part.boot_id, StreamState()))
        losses = found.setdefault(part.boot_id, Losses())
        for reason, numbers in lost.by_reason.items():
            losses.add(numbers, reason)
    return {
        boot_id: {reason: list(pairs) for reason, pairs in losses.as_pairs().items()}
        for boot_id, losses in found.items()
        if losses
    }


def _last_of(part: Part, stream: StreamState) -> int:
    if part.seq_last is not None:
        return part.seq_last
    newest = stream.held.last
    return max(part.seq_first - 1, -1 if newest is None else newest)


def _gaps_and_losses(part: Part, stream: StreamState) -> tuple[Intervals, Losses]:
    """Numbers of a part that are not held, and those of them that never will be, by reason."""
    last = _last_of(part, stream)
    gaps = Intervals()
    if last >= part.seq_first:
        gaps = stream.held.missing(part.seq_first, last)
    lost = Losses(stream.lost.within(gaps))
    lost.add(gaps - stream.may_come - stream.lost.all, NODE_RESTARTED)
    return gaps, lost


@dataclass(frozen=True)
class StreamState:
    """What is known of one stream where its frames are wanted.

    Attributes:
        held: numbers that are here, or in the sealed file.
        lost: numbers that are known not to come, by reason. What is held is not lost.
        damaged: numbers that were here and cannot be read any more.
        may_come: numbers that the node may still have; until it says so nothing is given up.
        next_seq: the number after its last frame; None while it runs, or if that is not known.
        unsynced_tail_max: how many more frames there may have been behind the last one.
        missed_slots: slots without a frame.
    """

    held: Intervals = field(default_factory=Intervals)
    lost: Losses = field(default_factory=Losses)
    damaged: Intervals = field(default_factory=Intervals)
    may_come: Intervals = field(default_factory=Intervals)
    next_seq: int | None = None
    unsynced_tail_max: int = 0
    missed_slots: int = 0


Stream = TypeVar("Stream", bound=StreamState)


def states_of(session: Session, streams: Mapping[str, Stream]) -> dict[str, Stream]:
    """The streams as the session's ledger counts them.

    What is damaged here is lost unless the node may give it once more, and what may come is lost
    once the session was given up. Slots count only from the start to the stop, and a tail counts
    only if a part reaches the end of its stream.

    Args:
        session: whose ledger it is.
        streams: by boot_id, of all of its parts.
    """
    found = {}
    for part in session.parts:
        stream = streams[part.boot_id]
        lost, may_come = Losses(stream.lost.as_pairs()), stream.may_come
        if session.given_up:
            lost.add(stream.damaged, CORRUPT)
            lost.add(may_come, GIVEN_UP)
            may_come = Intervals()
        lost.add(stream.damaged - may_come, CORRUPT)
        reaches_end = (
            part.seq_last is None or stream.next_seq is None or part.seq_last >= stream.next_seq - 1
        )
        tail = stream.unsynced_tail_max if reaches_end else 0
        missed = session.missed_slots_at_stop.get(part.boot_id, stream.missed_slots)
        if part.boot_id == session.parts[0].boot_id:
            missed = max(0, missed - session.missed_slots_at_start)
        found[part.boot_id] = replace(
            stream,
            lost=lost,
            may_come=may_come,
            unsynced_tail_max=session.unsynced_tail_max.get(part.boot_id, tail),
            missed_slots=missed,
        )
    return found


def numbers_of(parts: Iterable[Part]) -> dict[str, Intervals]:
    """Numbers of these parts by boot_id; a part without an end goes on with every frame to come."""
    numbers: dict[str, Intervals] = {}
    for part in parts:
        last = NO_END if part.seq_last is None else part.seq_last
        if last >= part.seq_first:
            numbers.setdefault(part.boot_id, Intervals()).add(part.seq_first, last)
    return numbers
