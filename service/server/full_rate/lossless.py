"""Position of a reader that receives every frame once, in order; no I/O.

The reader waits for frames that may still come; lost ones are reported. A reader too slow for the
buffer is disconnected with the position to resume from.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from service.link import Close, HangUp
from service.server.full_rate.items import Begins, Item, Missing, Position, Rows, cut
from service.server.full_rate.known import Known
from service.server.full_rate.memory import NodeMemory, Piece
from storage.intervals import NO_END, Intervals

NOT_KEPT = "not_kept"
"""Loss reason of frames that this server did not keep, since no session needs them."""


@dataclass(frozen=True)
class Again:
    """Request to estimate frames again from the journal, which has the next one.

    Attributes:
        at: first frame.
        last: greatest stored number.
        ends: True: no more frames of this stream will come.
        until: first number in the buffer; None: the buffer has none.
    """

    at: Position
    """first frame."""
    last: int
    """greatest stored number."""
    ends: bool
    """True: no more frames of this stream will come."""
    until: int | None
    """first number in the buffer; None: the buffer has none."""


class Lossless:
    """Position of a reader that receives every frame.

    Args:
        memory: buffer of the node.
        look: returns the present state of a stream; None: unknown, or no longer known.
        position: first frame to send; None: the next one.
    """

    def __init__(
        self,
        memory: NodeMemory,
        look: Callable[[str], Known | None],
        position: Position | None,
    ) -> None:
        self.position = position
        self._memory = memory
        self._look = look
        self._number: int | None = memory.next_number if position is None else None
        """Number of the next batch, while the reader is served from the buffer."""

    def next(self) -> Item | Again | None:
        """Return the next event; None: nothing yet.

        Raises:
            HangUp: the reader cannot go on; the reason has the position to resume from.
        """
        memory = self._memory
        if (position := self.position) is None:
            if self._number is None or self._number >= memory.next_number:
                return None
            self._number = max(self._number, memory.oldest)
            piece = memory[self._number]
            position = self.position = Position(piece.boot_id, piece.first)
        if (found := self._piece(position)) is not None:
            self._number = found.number + 1
            self.position = Position(position.boot_id, found.last + 1)
            begin = position.seq - found.first
            rows = cut((found.frames, found.columns), begin, len(found.frames))
            return Rows(position.boot_id, rows, found.number if begin == 0 else None)
        stream = self._look(position.boot_id)
        if stream is None:
            raise HangUp(Close.NO_STREAM, f"no longer stored: stream {position.boot_id}")
        ahead = memory.after(position.boot_id, position.seq)
        stored = stream.held
        if stored.within(position.seq, position.seq):
            # The live estimator still holds these frames for their look-ahead.
            if ahead is None and not stream.is_over and memory.last(position.boot_id) is not None:
                return None
            until = None if ahead is None else ahead.first
            return Again(position, stored.last or position.seq, stream.is_over, until)
        return self._gap(position, stream, ahead)

    def had(self, rows: Rows) -> None:
        """Move the position behind recomputed frames."""
        self.position = Position(rows.boot_id, rows.to_seq + 1)

    def _piece(self, at: Position) -> Piece | None:
        """Return the buffered batch with this frame, if there is one."""
        memory, number = self._memory, self._number
        if number is None:
            return memory.find(at.boot_id, at.seq)
        if number < memory.oldest:
            raise HangUp(Close.TOO_SLOW, f"too slow; {at}")
        if number < memory.next_number:
            piece = memory[number]
            if piece.boot_id == at.boot_id and piece.first <= at.seq:
                return piece
            self._number = None  # frames between are missing
        return None

    def _gap(self, at: Position, stream: Known, ahead: Piece | None) -> Item | None:
        """Return the event for a frame that is not stored: none yet, a gap, or the next stream."""
        comes = stream.to_come().within(at.seq, NO_END).first
        if comes == at.seq:
            return None
        next_stored = stream.held.within(at.seq, NO_END).first
        here = [
            n for n in (None if ahead is None else ahead.first, next_stored, comes) if n is not None
        ]
        if not here and stream.is_over:
            here = [max(at.seq, stream.end)]
        to_seq = min(here, default=at.seq) - 1
        if to_seq >= at.seq:
            reason, last = _reason(stream, at.seq, to_seq)
            self._go_to(Position(at.boot_id, last + 1))
            return Missing(at.boot_id, at.seq, last, reason)
        following = stream.following if stream.is_over else None
        if following is None:
            return None
        self._go_to(Position(following, 0))
        return Begins(following, 0)

    def _go_to(self, position: Position) -> None:
        self.position, self._number = position, None


def _reason(stream: Known, first: int, last: int) -> tuple[str, int]:
    """Return the reason why frames are lost, and the last frame with this reason."""
    by_reason = stream.lost.within(Intervals([(first, last)]))
    for reason, numbers in by_reason.items():
        for begin, end in numbers:
            if begin == first:
                return reason, end
    begins = [begin for numbers in by_reason.values() for begin, _ in numbers]
    return NOT_KEPT, min([last, *(begin - 1 for begin in begins)])
