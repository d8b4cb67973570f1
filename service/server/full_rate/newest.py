"""What comes next for one who would rather have what is new than everything: without any I/O.

- `drop_oldest`: what is older than `QUEUE_NS` when its turn comes is left out.
- `latest`: of what has come, the newest piece only.

Nothing is waited for, and all that is left out is said: from a reader's first frame on, what he had
and what he was told add up to every frame that is known of.
"""

from __future__ import annotations

from collections.abc import Callable

from service.server.full_rate.items import Item, Missing, Position, Rows, cut
from service.server.full_rate.known import Known
from service.server.full_rate.memory import NodeMemory, Piece

QUEUE_NS = 2_000_000_000
"""Frames that `drop_oldest` lets wait, as time."""
SLOW, LATE = "slow", "late"


class Newest:
    """A reader's position.

    Args:
        memory: of the node.
        look: what is known of a stream; None: nothing, or not any more.
        position: the frame that is wanted first; None: the next that comes.
        queue_ns: frames that may wait, as time; None: none but the newest piece.
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
        """Of the piece that comes next."""
        if position is not None:
            at = position.boot_id, position.seq
            found = memory.find(*at) or memory.after(*at)
            self._number = self._number if found is None else found.number

    def next(self) -> Item | None:
        """What comes next; None: nothing yet."""
        while self._number < self._memory.next_number:
            piece, at = self._wanted(), self.position
            reason = SLOW if piece.number > self._number else LATE
            if at is not None and at.boot_id != piece.boot_id:
                end = self._end(at.boot_id)
                self.position = Position(self._onward(at.boot_id, piece.boot_id), 0)
                if at.seq < end:
                    return Missing(at.boot_id, at.seq, end - 1, reason)
            elif at is not None and at.seq < piece.first:
                self.position = Position(at.boot_id, piece.first)
                return Missing(at.boot_id, at.seq, piece.first - 1, reason)
            else:
                self._number = piece.number + 1
                begin = 0 if at is None else at.seq - piece.first
                if begin < len(piece.frames):  # else it was had before the server was restarted
                    self.position = Position(piece.boot_id, piece.last + 1)
                    rows = cut((piece.frames, piece.columns), begin, len(piece.frames))
                    return Rows(piece.boot_id, rows, piece.number if begin == 0 else None)
        return None

    def had(self, rows: Rows) -> None:
        """Nothing is estimated again for this reader."""

    def _wanted(self) -> Piece:
        """The oldest piece that is not to be left out."""
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
        """Number after the last frame that is known of a stream which is over."""
        stream, last = self._look(boot_id), self._memory.last(boot_id)
        return max(0 if stream is None else stream.end, 0 if last is None else last + 1)

    def _onward(self, boot_id: str, aim: str) -> str:
        """The stream after this one, on the way to that of a piece."""
        first, seen = aim, {boot_id}
        at: str | None = boot_id
        while at is not None and at != aim:
            stream = self._look(at)
            at = None if stream is None else stream.following
            if at in seen:
                return aim
            if at is not None and len(seen) == 1:
                first = at
            seen.add(at or "")
        return first if at == aim else aim
