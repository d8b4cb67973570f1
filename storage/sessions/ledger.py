"""The ledger: every number of a session counted once, as recorded, lost for a reason, or pending.

Pure: it is made from intervals, wherever they come from: a running server, or files alone.
"""

from __future__ import annotations

from collections.abc import Mapping

from storage.intervals import Intervals
from storage.losses import NODE_RESTARTED, Losses
from storage.sessions.folder import Ledger, Part, PartLedger
from storage.sessions.states import StreamState


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
