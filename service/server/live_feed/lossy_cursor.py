"""Position of a reader that prefers new frames over all frames; no I/O.

- policy `drop_oldest`: frames older than `QUEUE_NS` at their turn are dropped.
- policy `latest`: of the buffered batches, only the newest is sent.

The reader waits for nothing, and every dropped frame is reported: from a reader's first frame on,
frames sent and frames reported add up to every known frame.
"""

from __future__ import annotations

from collections.abc import Callable

from service.server.live_feed.buffer import FeedBatch, FeedBuffer
from service.server.live_feed.events import FeedEvent, FrameRows, Gap, Position, slice_batch
from service.server.live_feed.stream_view import StreamView

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
            found = buffer.find_batch(*key) or buffer.first_batch_after(*key)
            self._next_number = self._next_number if found is None else found.number

    def next_event(self) -> FeedEvent | None:
        """Return the next event and go on to the one after; None: nothing yet."""
        while self._next_number < self._buffer.next_batch_number:
            piece, position = self._oldest_allowed(), self.position
            reason = SLOW if piece.number > self._next_number else LATE
            if position is not None and position.stream_id != piece.stream_id:
                end = self._end_seq(position.stream_id)
                self.position = Position(self._next_stream(position.stream_id, piece.stream_id), 0)
                if position.seq < end:
                    return Gap(position.stream_id, position.seq, end - 1, reason)
            elif position is not None and position.seq < piece.first_seq:
                self.position = Position(position.stream_id, piece.first_seq)
                return Gap(position.stream_id, position.seq, piece.first_seq - 1, reason)
            else:
                self._next_number = piece.number + 1
                begin = 0 if position is None else position.seq - piece.first_seq
                if begin < len(piece.frames):
                    self.position = Position(piece.stream_id, piece.last_seq + 1)
                    rows = slice_batch((piece.frames, piece.columns), begin, len(piece.frames))
                    return FrameRows(piece.stream_id, rows, piece.number if begin == 0 else None)
        return None

    def _oldest_allowed(self) -> FeedBatch:
        """Return the oldest batch that is not to be dropped."""
        memory = self._buffer
        newest = memory[memory.next_batch_number - 1]
        if self._queue_ns is None:
            return newest
        number = max(self._next_number, memory.oldest_batch_number)
        until_t_ns = int(newest.frames.t_ns[-1]) - self._queue_ns
        while number < newest.number and memory[number].frames.t_ns[-1] < until_t_ns:
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
