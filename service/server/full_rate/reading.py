"""What comes next for one who takes every frame: from memory, from the journal, or not at all.

A reader is a position, not a queue: whoever reads slowly, or not at all, is written nothing and
costs nothing. By policy:

- `lossless`: every frame once, in order. What is still to come is waited for; what will not come is
  said. Who has fallen out of memory by his own slowness is told the position to resume from.
- `drop_oldest`: what is older than `QUEUE_NS` when its turn comes is left out, and that is said.
- `latest`: of what has come, the newest piece only; what lies between is said.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable, Mapping
from dataclasses import dataclass
from typing import Literal, get_args

from devices.errors import DamagedFramesError
from service.estimation.warm import is_warming
from service.link import Close, HangUp
from service.server.estimates.of_node import Estimated
from service.server.full_rate.memory import NodeMemory, Piece, wait_for
from service.server.full_rate.recomputed import Position, Recomputed
from service.server.node import ServerNode
from service.server.streams import ServerStream
from storage.intervals import CORRUPT, NO_END, Intervals

log = logging.getLogger("foottile.live")

Policy = Literal["lossless", "drop_oldest", "latest"]
POLICIES: tuple[Policy, ...] = get_args(Policy)
QUEUE_NS = 2_000_000_000
"""Frames that `drop_oldest` lets wait, as time."""
NOT_KEPT = "not_kept"
"""Why a frame is lost that this server has had, or could have had, and nobody has reserved."""


@dataclass(frozen=True)
class Rows:
    """Frames with their estimates, which may be none; consecutive, of one stream."""

    boot_id: str
    estimated: Estimated
    piece: Piece | None
    """In memory, if it is all of it."""
    recomputed: bool = False


@dataclass(frozen=True)
class Missing:
    """Frames that are left out, ends included."""

    boot_id: str
    from_seq: int
    to_seq: int
    reason: str
    """`slow`: this reader was; `late`: they were not here in time. Else why they are lost."""


@dataclass(frozen=True)
class Begins:
    """What follows is of this stream."""

    boot_id: str
    seq: int


Item = Rows | Missing | Begins


def first_position(node: ServerNode, boot_id: str | None, from_seq: int | None) -> Position | None:
    """From which frame on somebody wants to read; None: from the next that comes.

    Raises:
        HangUp: there is no such stream.
    """
    if boot_id is None and from_seq is None:
        return None
    boot_id = node.boot_id if boot_id is None else boot_id
    if boot_id not in node.streams and boot_id not in node.order:
        raise HangUp(Close.NO_STREAM, f"no stream {boot_id[:32]!r} here; leave out boot_id")
    if from_seq is None:
        stream = node.streams.get(boot_id)
        from_seq = (stream.held.first if stream is not None else None) or 0
    return Position(boot_id, from_seq)


class Reader:
    """One who takes frames of one node.

    Args:
        node: the node.
        memory: of the node.
        needed: which numbers sessions need of it, by stream.
        position: the frame that is wanted first; None: the next that comes.
    """

    def __init__(
        self,
        node: ServerNode,
        memory: NodeMemory,
        needed: Callable[[], Mapping[str, Intervals]],
        position: Position | None,
    ) -> None:
        self.position = position
        self._node = node
        self._memory = memory
        self._needed = needed
        self._number: int | None = memory.next_number if position is None else None
        """Of the piece that comes next, for one who reads from memory."""
        self._recomputed: Recomputed | None = None
        self._not_due: object = None
        """What was asked for when nothing was due."""

    async def items(self, policy: Policy) -> AsyncGenerator[Item, None]:
        """What comes next, without end.

        Raises:
            HangUp: it cannot go on.
        """
        said: str | None = None
        step = self._next if policy == "lossless" else self._next_of_newest
        async with self._memory.watched() as news:
            while True:
                news.clear()
                item = await step(policy)
                if item is None:
                    await wait_for(news)
                    continue
                if not isinstance(item, Begins) and item.boot_id != said:
                    first = item.from_seq if isinstance(item, Missing) else _first(item)
                    yield Begins(item.boot_id, first)
                said = item.boot_id
                yield item

    # --- lossless ---------------------------------------------------------------------------------

    async def _next(self, policy: Policy) -> Item | None:
        at = self.position
        if at is None:
            if self._number is None or self._number >= self._memory.next_number:
                return None
            piece = self._memory[max(self._number, self._memory.oldest)]
            at = self.position = Position(piece.boot_id, piece.first)
        if (rows := self._from_memory(at)) is not None:
            return rows
        stream, is_over = self._node.streams.get(at.boot_id), at.boot_id != self._node.boot_id
        ahead = self._memory.after(at.boot_id, at.seq)
        if stream is not None and stream.held.within(at.seq, at.seq):
            # Frames that wait for their look-ahead come from the live estimates, in a moment.
            if ahead is None and not is_over and self._memory.has(at.boot_id):
                return None
            until = None if ahead is None else ahead.first
            return await self._recompute(policy, at, stream, until=until, ends=is_over)
        return self._gap(at, stream, ahead, is_over=is_over)

    def _from_memory(self, at: Position) -> Rows | None:
        memory = self._memory
        if self._number is not None and self._number < memory.oldest:
            raise HangUp(Close.TOO_SLOW, f"too slow; {resume_text(at)}")
        if self._number is not None and self._number < memory.next_number:
            piece: Piece | None = memory[self._number]
            if piece is not None and not (piece.boot_id == at.boot_id and piece.first <= at.seq):
                self._number = piece = None  # frames are missing between
        else:
            piece = None
        if piece is None and self._number is None:
            piece = memory.find(at.boot_id, at.seq)
        if piece is None:
            return None
        self._recomputed = None
        self._number = piece.number + 1
        self.position = Position(at.boot_id, piece.last + 1)
        if at.seq <= piece.first:
            return Rows(at.boot_id, (piece.frames, piece.columns), piece)
        begin = at.seq - piece.first
        columns = {name: values[begin:] for name, values in piece.columns.items()}
        frames = piece.frames.rows(begin, len(piece.frames))
        return Rows(at.boot_id, (frames, columns), None)

    async def _recompute(
        self, policy: Policy, at: Position, stream: ServerStream, *, until: int | None, ends: bool
    ) -> Item | None:
        asked = (at, stream.held.last, ends)
        # Or it would compile here; or what is there waits for its look-ahead, as it did before.
        if is_warming() or asked == self._not_due:
            return None
        found: Estimated | None = None
        begins = self._recomputed is None or self._recomputed.position != at
        async with self._memory.turn:
            try:
                if self._recomputed is None or begins:
                    self._recomputed = Recomputed(self._node, stream, at, ends=ends)
                found = await asyncio.to_thread(self._recomputed.next_rows)
            except DamagedFramesError as error:
                log.warning("node %s, for a live client: %s", self._node.name, error)
                self._recomputed = None
                return self._lost(at, max(at.seq, error.seq_last), CORRUPT)
        if found is None:
            self._recomputed, self._not_due = None, asked
            return None
        first, last = int(found[0].seq[0]), int(found[0].seq[-1])
        if first > at.seq:
            self._recomputed = None
            if begins:  # they were taken away meanwhile
                return self._lost(at, first - 1, NOT_KEPT)
            return await self._next(policy)  # perhaps they have come since it began to read
        if until is not None and last >= until:  # memory has the rest, as it came
            frames, columns = found
            n, last = until - first, until - 1
            found = frames.rows(0, n), {name: values[:n] for name, values in columns.items()}
        self.position = Position(at.boot_id, last + 1)
        return Rows(at.boot_id, found, None, recomputed=True)

    def _lost(self, at: Position, last: int, reason: str) -> Missing:
        self.position, self._number = Position(at.boot_id, last + 1), None
        return Missing(at.boot_id, at.seq, last, reason)

    def _gap(
        self, at: Position, stream: ServerStream | None, ahead: Piece | None, *, is_over: bool
    ) -> Item | None:
        """The frame is not here: is it still to come, lost, or behind the stream's end?"""
        here = [] if ahead is None else [ahead.first]
        if stream is not None and (held := stream.held.within(at.seq, NO_END).first) is not None:
            here.append(held)
        comes = self._to_come(at, stream, is_over=is_over)
        if comes.within(at.seq, at.seq):
            return None
        ends = [*here, *([] if comes.first is None else [comes.first])]
        if not ends and stream is not None and is_over and stream.notes.next_seq is not None:
            ends = [max(at.seq, stream.notes.next_seq)]
        to_seq = min(ends) - 1 if ends else at.seq - 1
        if to_seq >= at.seq:
            reason, last = _reason(stream, at.seq, to_seq)
            return self._lost(at, last, reason)
        following = _following(self._node, at.boot_id) if is_over else None
        if following is None:
            return None
        self.position, self._number = Position(following, 0), None
        return Begins(following, 0)

    def _to_come(self, at: Position, stream: ServerStream | None, *, is_over: bool) -> Intervals:
        """Numbers from the position on that the node may still send."""
        if stream is None:
            return Intervals()
        if stream.node_has is None:  # it has not spoken since the server was started
            return Intervals([(at.seq, NO_END)]) - stream.held
        needed = self._needed().get(at.boot_id, Intervals())
        lacks = stream.lacks(needed, all_of_it=not is_over)
        return lacks.within(at.seq, NO_END)

    # --- drop_oldest, latest ----------------------------------------------------------------------

    async def _next_of_newest(self, policy: Policy) -> Item | None:
        memory, at = self._memory, self.position
        if self._number is None and at is not None:
            found = memory.find(at.boot_id, at.seq) or memory.after(at.boot_id, at.seq)
            self._number = memory.next_number if found is None else found.number
        if self._number is None or self._number >= memory.next_number:
            return None
        newest = memory[memory.next_number - 1]
        number = max(self._number, memory.oldest)
        if policy == "latest":
            number = newest.number
        while newest.frames.t_ns[-1] - memory[number].frames.t_ns[-1] > QUEUE_NS:
            number += 1
        was_slow, piece = number > self._number, memory[number]
        first = piece.first
        if at is not None and at.boot_id == piece.boot_id:
            first = max(at.seq, first)
            if first > at.seq:
                self.position, self._number = Position(at.boot_id, first), number
                return Missing(at.boot_id, at.seq, first - 1, "slow" if was_slow else "late")
        self.position, self._number = Position(piece.boot_id, piece.last + 1), number + 1
        if first == piece.first:
            return Rows(piece.boot_id, (piece.frames, piece.columns), piece)
        begin = first - piece.first
        columns = {name: values[begin:] for name, values in piece.columns.items()}
        return Rows(piece.boot_id, (piece.frames.rows(begin, len(piece.frames)), columns), None)


def resume_text(at: Position) -> str:
    """How to go on from there, as text that programs read."""
    return f"resume with boot_id={at.boot_id}&from_seq={at.seq}"


def _first(rows: Rows) -> int:
    return int(rows.estimated[0].seq[0])


def _following(node: ServerNode, boot_id: str) -> str | None:
    """The stream that the node took after this one; None if it is the present one."""
    order = node.order
    if boot_id in order[:-1]:
        return order[order.index(boot_id) + 1]
    return None if boot_id == node.boot_id else node.boot_id


def _reason(stream: ServerStream | None, first: int, last: int) -> tuple[str, int]:
    """Why frames are lost, and up to which of them that is the reason."""
    asked = Intervals([(first, last)])
    known = stream.lost.within(asked) if stream is not None else {}
    for reason, numbers in known.items():
        for begin, end in numbers:
            if begin == first:
                return reason, end
    begins = [begin for numbers in known.values() for begin, _ in numbers]
    return NOT_KEPT, min([last, *(begin - 1 for begin in begins)])
