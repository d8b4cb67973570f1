"""Buffer of a node's newest live estimates, batch by batch, for all readers of every frame.

Batches are stored without copying, and encoded only on request. Memory is bounded, and a node
without readers costs none.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass

from devices.frames import FrameBatch
from service.server.estimates.node_estimator import EstimatedBatch
from service.server.live_feed.encode_cache import EncodeCache
from service.server.node import ServerNode
from service.sessions.pipeline import Columns

BYTES_MAX = 8 << 20
"""Limit per node: some 20 s of 8 tiles at 544 Hz, more of fewer."""
_BATCH_OVERHEAD_BYTES = 3000
"""Size of a batch beside its numbers: some forty numpy objects."""
_POLL_S = 1.0


@dataclass(frozen=True)
class FeedBatch:
    """Consecutive frames of one stream with their live estimates."""

    number: int
    """Number of the batch, counted since the node's first reader."""
    stream_id: str
    frames: FrameBatch
    columns: Columns

    @property
    def first_seq(self) -> int:
        """Number of its first frame."""
        return int(self.frames.seq[0])

    @property
    def last_seq(self) -> int:
        """Number of its last frame."""
        return int(self.frames.seq[-1])


class FeedBuffer:
    """Newest batches of one node, and the readers that wait for the next.

    Args:
        recompute_turn: semaphore: one reader recomputes at a time, so that live estimation has a
            core.
        bytes_max: size limit.
    """

    def __init__(self, recompute_turn: asyncio.Semaphore, bytes_max: int = BYTES_MAX) -> None:
        self.recompute_turn = recompute_turn
        self.encode_cache = EncodeCache()
        """Encoded messages of the batches."""
        self._batches: deque[FeedBatch] = deque()
        self._bytes_max = bytes_max
        self._bytes = 0
        self._next_number = 0
        self._waiting: set[asyncio.Event] = set()

    @property
    def oldest_batch_number(self) -> int:
        """Number of the oldest batch, or of the next one if the buffer is empty."""
        return self._next_number - len(self._batches)

    @property
    def reader_count(self) -> int:
        """Number of present readers."""
        return len(self._waiting)

    @property
    def next_batch_number(self) -> int:
        """Number of the next batch."""
        return self._next_number

    def add_batches(self, stream_id: str, batches: list[EstimatedBatch]) -> None:
        """Add due batches, which may be none, and wake all readers."""
        for frames, columns in batches:
            if not len(frames):
                continue
            self._batches.append(FeedBatch(self._next_number, stream_id, frames, columns))
            self._next_number += 1
            self._bytes += _size_bytes(frames, columns)
        while self._bytes > self._bytes_max and len(self._batches) > 1:
            oldest = self._batches.popleft()
            self._bytes -= _size_bytes(oldest.frames, oldest.columns)
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
        return next(
            (p for p in self._batches_of(stream_id) if p.first_seq <= seq <= p.last_seq), None
        )

    def first_batch_after(self, stream_id: str, seq: int) -> FeedBatch | None:
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


def _size_bytes(frames: FrameBatch, columns: Columns) -> int:
    of_all = (*vars(frames).values(), *columns.values())
    return _BATCH_OVERHEAD_BYTES + sum(int(column.nbytes) for column in of_all)
