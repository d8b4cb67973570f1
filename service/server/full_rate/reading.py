"""Reader of the live feed: next events by its policy, from the buffer or the journal.

A reader is a position, not a queue: a slow reader costs no memory. The next event is decided in
`lossless_cursor` and `lossy_cursor`; this module waits for it, and recomputes frames in a thread,
one reader after the other.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import AsyncGenerator, Callable, Mapping
from typing import Literal, get_args

from devices.errors import DamagedFramesError, FootTileError, StorageError
from service.estimation.warm import is_warming
from service.link import Close, HangUp
from service.server.full_rate.items import Begins, Item, Position, Rows, cut
from service.server.full_rate.known import Known, KnownStream
from service.server.full_rate.lossless import Again, Lossless
from service.server.full_rate.memory import NodeMemory, wait_for
from service.server.full_rate.newest import QUEUE_NS, Newest
from service.server.full_rate.recomputed import Recomputed
from service.server.node import ServerNode
from storage.intervals import Intervals

log = logging.getLogger("foottile.live")

Policy = Literal["lossless", "drop_oldest", "latest"]
POLICIES: tuple[Policy, ...] = get_args(Policy)


def first_position(node: ServerNode, boot_id: str | None, from_seq: int | None) -> Position | None:
    """Return the first frame for a reader; None: the next one that comes.

    Raises:
        HangUp: no stream has this id.
    """
    if boot_id is None and from_seq is None:
        return None
    boot_id = node.boot_id if boot_id is None else boot_id
    if boot_id in node.unread:
        node.read_again()
    if boot_id not in node.streams and boot_id not in (*node.order, *node.unread):
        raise HangUp(Close.NO_STREAM, f"no stream {boot_id[:32]!r} here; leave out boot_id")
    if from_seq is None:
        stream = node.streams.get(boot_id)
        from_seq = (stream.held.first if stream is not None else None) or 0
    return Position(boot_id, from_seq)


class Reader:
    """Reader of one node's frames.

    Args:
        node: the node.
        buffer: buffer of the node.
        policy: rule for dropping frames.
        position: first frame to send; None: the next one.
        needed_frames: returns the frames that sessions need of the node, by stream id.
        invalidate_damaged: called with frames that are damaged on disk.
    """

    def __init__(
        self,
        node: ServerNode,
        memory: NodeMemory,
        policy: Policy,
        position: Position | None,
        *,
        needed: Callable[[], Mapping[str, Intervals]],
        drop_damaged: Callable[[DamagedFramesError], None],
    ) -> None:
        self._node = node
        self._memory = memory
        self._needed = needed
        self._drop_damaged = drop_damaged
        self._course: Lossless | Newest
        if policy == "lossless":
            self._course = Lossless(memory, self._look, position)
        else:
            queue_ns = None if policy == "latest" else QUEUE_NS
            self._course = Newest(memory, self._look, position, queue_ns)
        self._recomputed: Recomputed | None = None
        self._asked: Again | None = None
        """Request for which `_recomputed` was created."""
        self._not_due: Again | None = None
        """Last request for which no frame was due."""

    async def items(self) -> AsyncGenerator[Item, None]:
        """Yield events without end.

        Raises:
            HangUp: the reader cannot go on.
        """
        announced_id: str | None = None
        async with self._memory.watched() as news:
            while True:
                news.clear()
                item = await self.next()
                if item is None:
                    await wait_for(news)
                    continue
                if not isinstance(item, Begins) and item.boot_id != announced_id:
                    yield Begins(item.boot_id, item.from_seq)
                announced_id = item.boot_id
                yield item

    async def next(self) -> Item | None:
        """Return the next event; None: nothing yet.

        Raises:
            HangUp: the reader cannot go on.
        """
        while True:
            step = self._course.next()
            if not isinstance(step, Again):
                return step
            # During warm-up this would compile here. Frames not due wait for their look-ahead.
            if is_warming() or step == self._not_due:
                return None
            async with self._memory.turn:
                step = self._course.next()  # frames may have come or gone meanwhile
                if not isinstance(step, Again):
                    return step
                rows = await self._estimated_again(step)
            if rows is not None:
                return rows

    def _look(self, boot_id: str) -> Known | None:
        if boot_id in self._node.unread:
            raise HangUp(Close.TRY_LATER, f"its journal cannot be read; {self._course.position}")
        return KnownStream.of(self._node, boot_id, self._needed)

    async def _estimated_again(self, step: Again) -> Rows | None:
        """Return the next recomputed rows; None: the state has changed, or no frame is due."""
        position, stream = step.at, self._node.streams[step.at.boot_id]
        begins = self._recomputed is None or self._recomputed.position != position
        try:
            if self._recomputed is None or begins:
                self._recomputed = Recomputed(self._node, stream, position, ends=step.ends)
                self._asked = step
            found = await asyncio.to_thread(self._recomputed.next_rows)
        except DamagedFramesError as error:
            self._recomputed = None
            self._drop_damaged(error)
            if stream.held & Intervals([(error.seq_first, error.seq_last)]):
                raise self._unreadable(position, error) from error
            return None
        except StorageError as error:
            log.warning("node %s, for a live client: %s", self._node.name, error)
            raise HangUp(Close.TRY_LATER, f"frames cannot be read now; {position}") from error
        except FootTileError as error:
            raise self._unreadable(position, error) from error
        if found is None:  # the journal's end at creation is reached
            self._recomputed, self._not_due = None, self._asked
            return None
        first, last = int(found[0].seq[0]), int(found[0].seq[-1])
        if first > position.seq:
            self._recomputed = None
            if begins and stream.held.within(position.seq, position.seq):
                raise self._unreadable(position, "a stored frame is not in its journal")
            return None
        if step.until is not None and last >= step.until:  # the buffer has the rest
            found = cut(found, 0, step.until - first)
        rows = Rows(position.boot_id, found, recomputed=True)
        self._course.had(rows)
        return rows

    def _unreadable(self, at: Position, why: object) -> HangUp:
        log.warning("node %s, for a live client: %s", self._node.name, why)
        reason = f"frame {at.seq} cannot be read, see the server's log; {at}"
        return HangUp(Close.UNREADABLE, reason)
