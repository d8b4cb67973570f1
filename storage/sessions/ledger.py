"""The ledger: every number of a session counted once, as recorded, lost for a reason, or pending.

Pure: it is made from intervals, wherever they come from: a running server, or files alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from storage.intervals import Intervals
from storage.losses import NODE_RESTARTED, Losses
from storage.sessions.folder import Ledger, Part, PartLedger


@dataclass(frozen=True)
class StreamState:
    """What is known of one stream where its frames are wanted.

    Attributes:
        held: numbers that are here, or in the sealed file.
        lost: numbers that are known not to come, by reason. What is held is not lost.
        may_come: numbers that the node may still have; until it says so nothing is given up.
        unsynced_tail_max: how many more frames there may have been behind the last one.
        missed_slots: slots without a frame, over the session.
    """

    held: Intervals = field(default_factory=Intervals)
    lost: Losses = field(default_factory=Losses)
    may_come: Intervals = field(default_factory=Intervals)
    unsynced_tail_max: int = 0
    missed_slots: int = 0


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
        last = part.seq_last
        if last is None:
            newest = stream.held.last
            last = max(part.seq_first - 1, -1 if newest is None else newest)
        gaps = Intervals()
        if last >= part.seq_first:
            gaps = stream.held.missing(part.seq_first, last)
        lost = {reason: lost.count for reason, lost in stream.lost.within(gaps).items()}
        unknown = gaps - stream.lost.all
        never = unknown - stream.may_come
        if never:
            lost[NODE_RESTARTED] = lost.get(NODE_RESTARTED, 0) + never.count
        length = max(0, last - part.seq_first + 1)
        counted.append(
            PartLedger(
                boot_id=part.boot_id,
                seq_first=part.seq_first,
                seq_last=last,
                recorded=length - gaps.count,
                lost=dict(sorted(lost.items())),
                pending=gaps.count - sum(lost.values()),
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
        stream = streams.get(part.boot_id, StreamState())
        if part.seq_last is None or part.seq_last < part.seq_first:
            continue
        gaps = stream.held.missing(part.seq_first, part.seq_last)
        losses = found.setdefault(part.boot_id, Losses())
        for reason, numbers in stream.lost.within(gaps).items():
            losses.add(numbers, reason)
        losses.add(gaps - stream.lost.all - stream.may_come, NODE_RESTARTED)
    return {
        boot_id: {reason: list(pairs) for reason, pairs in losses.as_pairs().items()}
        for boot_id, losses in found.items()
        if losses
    }
