"""Positions of readers of the live feed: every frame once, or new frames first; no I/O.

A lossless reader waits for frames that may still come; lost ones are reported. If it is too slow
for the buffer, it is disconnected with the position to resume from. A lossy reader has a policy:

- `drop_oldest`: frames older than `QUEUE_NS` at their turn are dropped.
- `latest`: of the buffered batches, only the newest is sent.

It waits for nothing, and every dropped frame is reported: from a reader's first frame on,
frames sent and frames reported add up to every known frame.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from service.protocol.codec import CloseConnection, LinkCloseCode
from service.server.live_feed.buffer import FeedBatch, FeedBuffer, StreamView
from service.server.live_feed.events import FeedEvent, Gap, Position, StreamStart
from storage.intervals import NO_END, Intervals

NOT_KEPT = "not_kept"
"""Loss reason of frames that this server did not keep, since no session needs them."""


@dataclass(frozen=True)
class Recompute:
    """Request to estimate frames again from the journal, which has the next one.

    Attributes:
        position: first frame.
        last_seq: greatest stored number before any frame that may still come.
        is_final: True: no more frames of this stream will come.
        until_seq: first number in the buffer; None: the buffer has none.
    """

    position: Position
    last_seq: int
    is_final: bool
    until_seq: int | None


class LosslessCursor:
    """Position of a reader that receives every frame.

    Args:
        buffer: buffer of the node.
        find_stream: returns the present state of a stream; None: unknown, or no longer known.
        position: first frame to send; None: the next one.
    """

    def __init__(
        self,
        buffer: FeedBuffer,
        find_stream: Callable[[str], StreamView | None],
        position: Position | None,
    ) -> None:
        self.position = position
        self._buffer = buffer
        self._find_stream = find_stream
        self._next_number: int | None = buffer.next_batch_number if position is None else None
        """Number of the next batch, while the reader is served from the buffer."""

    def next_event(self) -> FeedEvent | Recompute | None:
        """Return the next event and go on to the one after; None: nothing yet.

        Raises:
            CloseConnection: the reader cannot go on; the reason has the position to resume from.
        """
        memory = self._buffer
        if (position := self.position) is None:
            if self._next_number is None or self._next_number >= memory.next_batch_number:
                return None
            self._next_number = max(self._next_number, memory.oldest_batch_number)
            piece = memory[self._next_number]
            position = self.position = Position(piece.stream_id, piece.first_seq)
        if (found := self._buffered_batch(position)) is not None:
            self._next_number = found.batch_number + 1
            self.position = Position(position.stream_id, found.last_seq + 1)
            return found.rows_from(position.seq)
        stream = self._find_stream(position.stream_id)
        if stream is None:
            raise CloseConnection(
                LinkCloseCode.NO_STREAM, f"no longer stored: stream {position.stream_id}"
            )
        ahead = memory.find_first_batch_beginning_after(position.stream_id, position.seq)
        stored = stream.stored
        if stored.restricted_to(position.seq, position.seq):
            # The live estimator still holds these frames for their look-ahead.
            if (
                ahead is None
                and not stream.has_ended
                and memory.last_seq_of(position.stream_id) is not None
            ):
                return None
            until = None if ahead is None else ahead.first_seq
            comes = _first_to_come(stream, position)
            last = stored.restricted_to(position.seq, NO_END if comes is None else comes - 1).last
            is_final = stream.has_ended and comes is None
            return Recompute(position, last or position.seq, is_final, until)
        return self._gap_event(position, stream, ahead)

    def _buffered_batch(self, position: Position) -> FeedBatch | None:
        """Return the buffered batch with this frame, if there is one."""
        memory, number = self._buffer, self._next_number
        if number is None:
            return memory.find_batch(position.stream_id, position.seq)
        if number < memory.oldest_batch_number:
            raise CloseConnection(LinkCloseCode.TOO_SLOW, f"too slow; {position}")
        if number < memory.next_batch_number:
            piece = memory[number]
            if piece.stream_id == position.stream_id and piece.first_seq <= position.seq:
                return piece
            self._next_number = None  # frames between are missing
        return None

    def _gap_event(
        self, position: Position, stream: StreamView, ahead: FeedBatch | None
    ) -> FeedEvent | None:
        """Return the event for a frame that is not stored: none yet, a gap, or the next stream."""
        comes = _first_to_come(stream, position)
        if comes == position.seq:
            return None
        next_stored = stream.stored.restricted_to(position.seq, NO_END).first
        here = [
            n
            for n in (None if ahead is None else ahead.first_seq, next_stored, comes)
            if n is not None
        ]
        if not here and stream.has_ended:
            here = [max(position.seq, stream.end_seq)]
        to_seq = min(here, default=position.seq) - 1
        if to_seq >= position.seq:
            reason, last = _loss_reason(stream, position.seq, to_seq)
            self._move_to(Position(position.stream_id, last + 1))
            return Gap(position.stream_id, position.seq, last, reason)
        following = stream.next_stream_id if stream.has_ended else None
        if following is None:
            return None
        self._move_to(Position(following, 0))
        return StreamStart(following, 0)

    def _move_to(self, position: Position) -> None:
        self.position, self._next_number = position, None


def _first_to_come(stream: StreamView, position: Position) -> int | None:
    """Return the first frame from a position on that is not stored and may still come."""
    return stream.compute_unstored_obtainable().restricted_to(position.seq, NO_END).first


def _loss_reason(stream: StreamView, first: int, last: int) -> tuple[str, int]:
    """Return the reason why frames are lost, and the last frame with this reason."""
    by_reason = stream.lost.restricted_to(Intervals([(first, last)]))
    for reason, numbers in by_reason.items():
        for begin, end in numbers:
            if begin == first:
                return reason, end
    begins = [begin for numbers in by_reason.values() for begin, _ in numbers]
    return NOT_KEPT, min([last, *(begin - 1 for begin in begins)])


QUEUE_NS = 2_000_000_000
"""Age limit of waiting frames for the policy `drop_oldest`."""
SLOW, LATE = "slow", "late"


class LossyCursor:
    """Position of a reader that drops old frames.

    Args:
        buffer: buffer of the node.
        find_stream: returns the present state of a stream; None: unknown, or no longer known.
        position: first frame to send; None: the next one.
        queue_ns: age limit of waiting frames; None: only the newest batch is sent.
    """

    def __init__(
        self,
        buffer: FeedBuffer,
        find_stream: Callable[[str], StreamView | None],
        position: Position | None,
        queue_ns: int | None,
    ) -> None:
        self.position = position
        self._buffer = buffer
        self._find_stream = find_stream
        self._queue_ns = queue_ns
        self._next_number = buffer.next_batch_number
        """Number of the next batch to send."""
        if position is not None:
            key = position.stream_id, position.seq
            found = buffer.find_batch(*key) or buffer.find_first_batch_beginning_after(*key)
            self._next_number = self._next_number if found is None else found.batch_number

    def next_event(self) -> FeedEvent | None:
        """Return the next event and go on to the one after; None: nothing yet."""
        while self._next_number < self._buffer.next_batch_number:
            piece, position = self._oldest_allowed(), self.position
            reason = SLOW if piece.batch_number > self._next_number else LATE
            if position is not None and position.stream_id != piece.stream_id:
                end = self._end_seq(position.stream_id)
                self.position = Position(self._next_stream(position.stream_id, piece.stream_id), 0)
                if position.seq < end:
                    return Gap(position.stream_id, position.seq, end - 1, reason)
            elif position is not None and position.seq < piece.first_seq:
                self.position = Position(position.stream_id, piece.first_seq)
                return Gap(position.stream_id, position.seq, piece.first_seq - 1, reason)
            else:
                self._next_number = piece.batch_number + 1
                seq = piece.first_seq if position is None else position.seq
                if seq <= piece.last_seq:
                    self.position = Position(piece.stream_id, piece.last_seq + 1)
                    return piece.rows_from(seq)
        return None

    def _oldest_allowed(self) -> FeedBatch:
        """Return the oldest batch that is not to be dropped."""
        memory = self._buffer
        newest = memory[memory.next_batch_number - 1]
        if self._queue_ns is None:
            return newest
        number = max(self._next_number, memory.oldest_batch_number)
        until_t_ns = int(newest.batch[0].t_ns[-1]) - self._queue_ns
        while number < newest.batch_number and memory[number].batch[0].t_ns[-1] < until_t_ns:
            number += 1
        return memory[number]

    def _end_seq(self, stream_id: str) -> int:
        """Return the number after the last known frame of an ended stream."""
        stream, last = self._find_stream(stream_id), self._buffer.last_seq_of(stream_id)
        return max(0 if stream is None else stream.end_seq, 0 if last is None else last + 1)

    def _next_stream(self, stream_id: str, target: str) -> str:
        """Return the stream after this one, on the way to the stream of a batch."""
        first, seen = target, {stream_id}
        current: str | None = stream_id
        while current is not None and current != target:
            stream = self._find_stream(current)
            current = None if stream is None else stream.next_stream_id
            if current in seen:
                return target
            if current is not None and len(seen) == 1:
                first = current
            seen.add(current or "")
        return first if current == target else target
