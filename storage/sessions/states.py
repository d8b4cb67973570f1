"""What is known of the streams that a session is made of, and what its ledger makes of that.

A running server, recovery after a crash, a node that records alone and `verify` each say what they
know of a stream. What follows from it for a session is decided here, for all of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TypeVar

from storage.intervals import NO_END, Intervals
from storage.losses import CORRUPT, GIVEN_UP, Losses
from storage.sessions.folder import Part, Session


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
    once the session was given up. Of slots only those since the start and until the stop count, and
    a tail only where a part reaches to the end of its stream.

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
