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
from service.estimation.compilation import is_compiling
from service.protocol import CloseConnection, LinkCloseCode
from service.server.live_feed.buffer import FeedBuffer, wait_briefly_for_batch
from service.server.live_feed.events import FeedEvent, FrameRows, Position, StreamStart, slice_batch
from service.server.live_feed.lossless_cursor import LosslessCursor, Recompute
from service.server.live_feed.lossy_cursor import QUEUE_NS, LossyCursor
from service.server.live_feed.recomputation import RecomputedFrames
from service.server.live_feed.stream_view import ServerStreamView, StreamView
from service.server.node import ServerNode
from storage.intervals import Intervals

log = logging.getLogger("foottile.live")

Policy = Literal["lossless", "drop_oldest", "latest"]
POLICIES: tuple[Policy, ...] = get_args(Policy)


def start_position(
    node: ServerNode, stream_id: str | None, from_seq: int | None
) -> Position | None:
    """Return the first frame for a reader; None: the next one that comes.

    Raises:
        CloseConnection: no stream has this id.
    """
    if stream_id is None and from_seq is None:
        return None
    stream_id = node.stream_id if stream_id is None else stream_id
    if stream_id in node.unreadable_streams:
        node.retry_unreadable_journals()
    if stream_id not in node.streams and stream_id not in (
        *node.stream_order,
        *node.unreadable_streams,
    ):
        raise CloseConnection(
            LinkCloseCode.NO_STREAM, f"no stream {stream_id[:32]!r} here; leave out stream_id"
        )
    if from_seq is None:
        stream = node.streams.get(stream_id)
        from_seq = (stream.stored.first if stream is not None else None) or 0
    return Position(stream_id, from_seq)


class FeedReader:
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
        buffer: FeedBuffer,
        policy: Policy,
        position: Position | None,
        *,
        needed_frames: Callable[[], Mapping[str, Intervals]],
        invalidate_damaged: Callable[[DamagedFramesError], None],
    ) -> None:
        self._node = node
        self._buffer = buffer
        self._needed_frames = needed_frames
        self._invalidate_damaged = invalidate_damaged
        self._cursor: LosslessCursor | LossyCursor
        if policy == "lossless":
            self._cursor = LosslessCursor(buffer, self._find_stream, position)
        else:
            queue_ns = None if policy == "latest" else QUEUE_NS
            self._cursor = LossyCursor(buffer, self._find_stream, position, queue_ns)
        self._recomputed: RecomputedFrames | None = None
        self._request: Recompute | None = None
        """Request for which `_recomputed` was created."""
        self._request_without_rows: Recompute | None = None
        """Last request for which no frame was due."""

    async def events(self) -> AsyncGenerator[FeedEvent, None]:
        """Yield events without end.

        Raises:
            CloseConnection: the reader cannot go on.
        """
        announced_id: str | None = None
        async with self._buffer.subscribe() as news:
            while True:
                news.clear()
                item = await self.next_event()
                if item is None:
                    await wait_briefly_for_batch(news)
                    continue
                if not isinstance(item, StreamStart) and item.stream_id != announced_id:
                    yield StreamStart(item.stream_id, item.first_seq)
                announced_id = item.stream_id
                yield item

    async def next_event(self) -> FeedEvent | None:
        """Return the next event; None: nothing yet.

        Raises:
            CloseConnection: the reader cannot go on.
        """
        while True:
            step = self._cursor.next_event()
            if not isinstance(step, Recompute):
                return step
            # During warm-up this would compile here. Frames not due wait for their look-ahead.
            if is_compiling() or step == self._request_without_rows:
                return None
            async with self._buffer.recompute_turn:
                step = self._cursor.next_event()  # frames may have come or gone meanwhile
                if not isinstance(step, Recompute):
                    return step
                rows = await self._recompute(step)
            if rows is not None:
                return rows

    def _find_stream(self, stream_id: str) -> StreamView | None:
        if stream_id in self._node.unreadable_streams:
            raise CloseConnection(
                LinkCloseCode.TRY_LATER, f"its journal cannot be read; {self._cursor.position}"
            )
        return ServerStreamView.find_known(self._node, stream_id, self._needed_frames)

    async def _recompute(self, step: Recompute) -> FrameRows | None:
        """Return the next recomputed rows; None: the state has changed, or no frame is due."""
        position, stream = step.position, self._node.streams[step.position.stream_id]
        begins = self._recomputed is None or self._recomputed.position != position
        try:
            if self._recomputed is None or begins:
                self._recomputed = RecomputedFrames(
                    self._node, stream, position, is_final=step.is_final
                )
                self._request = step
            found = await asyncio.to_thread(self._recomputed.next_rows)
        except DamagedFramesError as error:
            self._recomputed = None
            self._invalidate_damaged(error)
            if stream.stored & Intervals([(error.seq_first, error.seq_last)]):
                raise self._unreadable_error(position, error) from error
            return None
        except StorageError as error:
            log.warning("node %s, for a live client: %s", self._node.name, error)
            raise CloseConnection(
                LinkCloseCode.TRY_LATER, f"frames cannot be read now; {position}"
            ) from error
        except FootTileError as error:
            raise self._unreadable_error(position, error) from error
        if found is None:  # the journal's end at creation is reached
            self._recomputed, self._request_without_rows = None, self._request
            return None
        first, last = int(found[0].seq[0]), int(found[0].seq[-1])
        if first > position.seq:
            self._recomputed = None
            if begins and stream.stored.restricted_to(position.seq, position.seq):
                raise self._unreadable_error(position, "a stored frame is not in its journal")
            return None
        if step.until_seq is not None and last >= step.until_seq:  # the buffer has the rest
            found = slice_batch(found, 0, step.until_seq - first)
        rows = FrameRows(position.stream_id, found, is_recomputed=True)
        self._cursor.position = Position(rows.stream_id, rows.last_seq + 1)
        return rows

    def _unreadable_error(self, at: Position, why: object) -> CloseConnection:
        log.warning("node %s, for a live client: %s", self._node.name, why)
        reason = f"frame {at.seq} cannot be read, see the server's log; {at}"
        return CloseConnection(LinkCloseCode.UNREADABLE, reason)
