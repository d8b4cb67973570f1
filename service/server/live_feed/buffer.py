"""Buffer of a node's newest live estimates for all readers, and the state of its stream.

Batches are stored without copying, and encoded only on request. Memory is bounded, and a node
without readers costs none.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from devices.frames import FrameBatch
from service.estimation.records import ColumnDict
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.live_feed.events import EncodeCache, FrameRows, slice_batch
from service.server.node import ServerNode
from service.server.streams import ServerStream
from storage.intervals import NO_END, Intervals, Losses

_BUFFER_BYTES_MAX = 8 << 20
"""Limit per node: some 20 s of 8 tiles at 544 Hz, more of fewer."""
_BATCH_OVERHEAD_BYTES = 3000
"""Size of a batch beside its numbers: some forty numpy objects."""
_POLL_S = 1.0


@dataclass(frozen=True)
class FeedBatch(FrameRows):
    """Batch of live estimates, numbered since the node's first reader."""

    batch_number: int = field(kw_only=True)

    def rows_from(self, seq: int) -> FrameRows:
        """Return the rows from a frame of this batch on."""
        begin = seq - self.first_seq
        if begin <= 0:
            return self
        return FrameRows(self.stream_id, slice_batch(self.batch, begin, len(self.batch[0])))


class FeedBuffer:
    """Newest batches of one node, and the readers that wait for the next.

    Args:
        recompute_turn: semaphore: one reader recomputes at a time, so that live estimation has a
            core.
    """

    def __init__(self, recompute_turn: asyncio.Semaphore) -> None:
        self.recompute_turn = recompute_turn
        self.encode_cache = EncodeCache()
        """Encoded messages of the batches."""
        self._batches: deque[FeedBatch] = deque()
        self._bytes_max = _BUFFER_BYTES_MAX
        self._bytes = 0
        self.next_batch_number = 0
        self._waiting: set[asyncio.Event] = set()

    @property
    def oldest_batch_number(self) -> int:
        """Number of the oldest batch, or of the next one if the buffer is empty."""
        return self.next_batch_number - len(self._batches)

    def add_batches(self, stream_id: str, batches: list[EstimatedBatch]) -> None:
        """Add due batches, which may be none, and wake all readers."""
        for batch in batches:
            if not len(batch[0]):
                continue
            number = self.next_batch_number
            self._batches.append(FeedBatch(stream_id, batch, batch_number=number))
            self.next_batch_number += 1
            self._bytes += _size_bytes(*batch)
        while self._bytes > self._bytes_max and len(self._batches) > 1:
            self._bytes -= _size_bytes(*self._batches.popleft().batch)
        self.wake_readers()

    def wake_readers(self) -> None:
        """Wake all readers that wait."""
        for each in self._waiting:
            each.set()

    def __getitem__(self, number: int) -> FeedBatch:
        """Return the batch of this number, which is in the buffer."""
        return self._batches[number - self.oldest_batch_number]

    def find_batch(self, stream_id: str, seq: int) -> FeedBatch | None:
        """Return the batch with this frame; None if it is not in the buffer."""
        oldest = self._batches[0] if self._batches else None
        if oldest is not None and oldest.stream_id == stream_id and seq < oldest.first_seq:
            return None
        return next(
            (p for p in self._batches_of(stream_id) if p.first_seq <= seq <= p.last_seq), None
        )

    def find_first_batch_beginning_after(self, stream_id: str, seq: int) -> FeedBatch | None:
        """Return the oldest batch of a stream that begins after this frame; None without one."""
        found = None
        for piece in self._batches_of(stream_id):
            if piece.first_seq <= seq:
                break
            found = piece
        return found

    def last_seq_of(self, stream_id: str) -> int | None:
        """Return the newest number of this stream in the buffer; None if there is none."""
        piece = next(self._batches_of(stream_id), None)
        return None if piece is None else piece.last_seq

    def _batches_of(self, stream_id: str) -> Iterator[FeedBatch]:
        """Yield batches of a stream, the newest first: readers are mostly near the end."""
        return (piece for piece in reversed(self._batches) if piece.stream_id == stream_id)

    @asynccontextmanager
    async def subscribe(self) -> AsyncIterator[asyncio.Event]:
        """Context manager: an event that is set whenever frames have come."""
        news = asyncio.Event()
        self._waiting.add(news)
        try:
            yield news
        finally:
            self._waiting.discard(news)


async def wait_briefly_for_batch(event: asyncio.Event) -> None:
    """Wait for new frames, at most a second: not every change sets the event."""
    try:
        async with asyncio.timeout(_POLL_S):
            await event.wait()
    except TimeoutError:
        pass


class FeedBuffers:
    """Buffers of the nodes with readers."""

    def __init__(self) -> None:
        self._buffers: dict[str, FeedBuffer] = {}
        self._turn = asyncio.Semaphore(1)

    def get_or_create(self, node: str) -> FeedBuffer:
        """Return the buffer of a node, created for its first reader."""
        return self._buffers.setdefault(node, FeedBuffer(self._turn))

    def add_to_existing_buffer(self, node: ServerNode, batches: list[EstimatedBatch]) -> None:
        """Add estimated frames of a node's present stream to its buffer, if it has one."""
        memory = self._buffers.get(node.name)
        if memory is not None:
            memory.add_batches(node.stream_id, batches)


def _size_bytes(frames: FrameBatch, columns: ColumnDict) -> int:
    of_all = (*vars(frames).values(), *columns.values())
    return _BATCH_OVERHEAD_BYTES + sum(int(column.nbytes) for column in of_all)


class StreamView:
    """Present state of a stream of this server.

    Args:
        node: the node.
        stream_id: id of the stream.
        stream: stored stream; None: nothing yet.
        needed_frames: returns the frames that sessions need of the node, by stream id.
    """

    def __init__(
        self,
        node: ServerNode,
        stream_id: str,
        stream: ServerStream | None,
        needed_frames: Callable[[], Mapping[str, Intervals]],
    ) -> None:
        self._node, self._stream_id = node, stream_id
        self._stream = stream
        self._needed_frames = needed_frames

    @classmethod
    def find_known(
        cls, node: ServerNode, stream_id: str, needed_frames: Callable[[], Mapping[str, Intervals]]
    ) -> StreamView | None:
        """Return the view of a stream, empty without stored frames; None: not known, or not now."""
        stream = node.streams.get(stream_id)
        # After a restart of the server a stream without stored frames has no folder.
        if stream is None and (node.has_connected or stream_id not in node.announced_stream_order):
            return None
        return cls(node, stream_id, stream, needed_frames)

    @property
    def stored(self) -> Intervals:
        """Frames in its journal."""
        return Intervals() if self._stream is None else self._stream.stored

    @property
    def lost(self) -> Losses:
        """Frames that will not come, by reason."""
        return Losses() if self._stream is None else self._stream.lost

    @property
    def has_ended(self) -> bool:
        """True if the node has another present stream."""
        return self._stream_id != self._node.stream_id

    @property
    def end_seq(self) -> int:
        """Number after the last known frame."""
        announced = None if self._stream is None else self._stream.notes.next_seq
        ends = [last + 1 for last in (self.stored.last, self.lost.numbers.last) if last is not None]
        return max([announced or 0, *ends])

    @property
    def next_stream_id(self) -> str | None:
        """Next stream of the node; None: this is the present one."""
        node, order = self._node, self._node.announced_stream_order
        if self._stream_id in order:
            return (*order, None)[order.index(self._stream_id) + 1]
        # Hello no longer lists it: the next one is the first that began later, by the node's clock.
        journal = None if self._stream is None else self._stream.journal
        last_t_ns = (
            None if journal is None else journal.find_batch_t_ns_near(NO_END, at_or_before=True)
        )
        if last_t_ns is not None:
            for each in node.hello.earlier:
                if each.t_ns_first > last_t_ns:
                    return each.array_info.stream_id
        return node.stream_id

    def compute_unstored_obtainable(self) -> Intervals:
        """Return the frames that are not stored and that the node can still send."""
        stream = self._stream
        if stream is None:
            return Intervals([(0, NO_END)])
        if stream.node_ranges is None:  # no hello since the server was started
            return stream.obtainable - stream.stored
        needed = self._needed_frames().get(self._stream_id, Intervals())
        return stream.frames_to_request(needed, include_unneeded=not self.has_ended)
