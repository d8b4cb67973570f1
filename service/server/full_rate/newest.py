"""Position of a reader that prefers new frames over all frames; no I/O.

- `drop_oldest`: frames older than `QUEUE_NS` at their turn are dropped.
- `latest`: of the buffered batches, only the newest is sent.

The reader waits for nothing, and every dropped frame is reported: from a reader's first frame on,
frames sent and frames reported add up to every known frame.
"""

from __future__ import annotations

from collections.abc import Callable

from service.server.full_rate.items import Item, Missing, Position, Rows, cut
from service.server.full_rate.known import Known
from service.server.full_rate.memory import NodeMemory, Piece

QUEUE_NS = 2_000_000_000
"""Age limit of waiting frames for `drop_oldest`."""
SLOW, LATE = "slow", "late"


class Newest:
    """Position of a reader that drops old frames.

    Args:
        buffer: buffer of the node.
        find_stream: returns the present state of a stream; None: unknown, or no longer known.
        position: first frame to send; None: the next one.
        queue_ns: age limit of waiting frames; None: only the newest batch is sent.
    """

    def __init__(
        self,
        memory: NodeMemory,
        look: Callable[[str], Known | None],
        position: Position | None,
        queue_ns: int | None,
    ) -> None:
        self.position = position
        self._memory = memory
        self._look = look
        self._queue_ns = queue_ns
        self._number = memory.next_number
        """Number of the next batch to send."""
        if position is not None:
            key = position.boot_id, position.seq
            found = memory.find(*key) or memory.after(*key)
            self._number = self._number if found is None else found.number

    def next(self) -> Item | None:
        """Return the next event; None: nothing yet."""
        while self._number < self._memory.next_number:
            piece, position = self._wanted(), self.position
            reason = SLOW if piece.number > self._number else LATE
            if position is not None and position.boot_id != piece.boot_id:
                end = self._end(position.boot_id)
                self.position = Position(self._onward(position.boot_id, piece.boot_id), 0)
                if position.seq < end:
                    return Missing(position.boot_id, position.seq, end - 1, reason)
            elif position is not None and position.seq < piece.first:
                self.position = Position(position.boot_id, piece.first)
                return Missing(position.boot_id, position.seq, piece.first - 1, reason)
            else:
                self._number = piece.number + 1
                begin = 0 if position is None else position.seq - piece.first
                if begin < len(piece.frames):
                    self.position = Position(piece.boot_id, piece.last + 1)
                    rows = cut((piece.frames, piece.columns), begin, len(piece.frames))
                    return Rows(piece.boot_id, rows, piece.number if begin == 0 else None)
        return None

    def had(self, rows: Rows) -> None:
        """Ignore recomputed frames: this reader never gets any."""

    def _wanted(self) -> Piece:
        """Return the oldest batch that is not to be dropped."""
        memory = self._memory
        newest = memory[memory.next_number - 1]
        if self._queue_ns is None:
            return newest
        number = max(self._number, memory.oldest)
        until_t_ns = int(newest.frames.t_ns[-1]) - self._queue_ns
        while number < newest.number and memory[number].frames.t_ns[-1] < until_t_ns:
            number += 1
        return memory[number]

    def _end(self, boot_id: str) -> int:
        """Return the number after the last known frame of an ended stream."""
        stream, last = self._look(boot_id), self._memory.last(boot_id)
        return max(0 if stream is None else stream.end, 0 if last is None else last + 1)

    def _onward(self, boot_id: str, aim: str) -> str:
        """Return the stream after this one, on the way to the stream of a batch."""
        first, seen = aim, {boot_id}
        current: str | None = boot_id
        while current is not None and current != aim:
            stream = self._look(current)
            current = None if stream is None else stream.following
            if current in seen:
                return aim
            if current is not None and len(seen) == 1:
                first = current
            seen.add(current or "")
        return first if current == aim else aim
