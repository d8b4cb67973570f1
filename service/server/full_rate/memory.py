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
from service.server.estimates.of_node import Estimated
from service.server.full_rate.shared import Shared
from service.server.node import ServerNode
from service.sessions.pipeline import Columns

BYTES_MAX = 8 << 20
"""Limit per node: some 20 s of 8 tiles at 544 Hz, more of fewer."""
_PIECE_BYTES = 3000
"""Size of a batch beside its numbers: some forty numpy objects."""
_LOOK_AGAIN_S = 1.0


@dataclass(frozen=True)
class Piece:
    """Consecutive frames of one stream with their live estimates."""

    number: int
    """Number of the batch, counted since the node's first reader."""
    boot_id: str
    frames: FrameBatch
    columns: Columns

    @property
    def first(self) -> int:
        """Number of its first frame."""
        return int(self.frames.seq[0])

    @property
    def last(self) -> int:
        """Number of its last frame."""
        return int(self.frames.seq[-1])


class NodeMemory:
    """Newest batches of one node, and the readers that wait for the next.

    Args:
        recompute_turn: semaphore: one reader recomputes at a time, so that live estimation has a
            core.
        bytes_max: size limit.
    """

    def __init__(self, turn: asyncio.Semaphore, bytes_max: int = BYTES_MAX) -> None:
        self.turn = turn
        self.shared = Shared()
        """Encoded messages of the batches."""
        self._pieces: deque[Piece] = deque()
        self._bytes_max = bytes_max
        self._bytes = 0
        self._next_number = 0
        self._waiting: set[asyncio.Event] = set()

    @property
    def oldest(self) -> int:
        """Number of the oldest batch, or of the next one if the buffer is empty."""
        return self._next_number - len(self._pieces)

    @property
    def watchers(self) -> int:
        """Number of present readers."""
        return len(self._waiting)

    @property
    def next_number(self) -> int:
        """Number of the next batch."""
        return self._next_number

    def add(self, boot_id: str, due: list[Estimated]) -> None:
        """Add due batches, which may be none, and wake all readers."""
        for frames, columns in due:
            if not len(frames):
                continue
            self._pieces.append(Piece(self._next_number, boot_id, frames, columns))
            self._next_number += 1
            self._bytes += _bytes_of(frames, columns)
        while self._bytes > self._bytes_max and len(self._pieces) > 1:
            oldest = self._pieces.popleft()
            self._bytes -= _bytes_of(oldest.frames, oldest.columns)
        self.wake()

    def wake(self) -> None:
        """Wake all readers that wait."""
        for each in self._waiting:
            each.set()

    def __getitem__(self, number: int) -> Piece:
        """Return the batch of this number, which is in the buffer."""
        return self._pieces[number - self.oldest]

    def find(self, boot_id: str, seq: int) -> Piece | None:
        """Return the batch with this frame; None if it is not in the buffer."""
        return next((p for p in self._of(boot_id) if p.first <= seq <= p.last), None)

    def after(self, boot_id: str, seq: int) -> Piece | None:
        """Return the oldest batch of a stream that begins after this frame; None without one."""
        found = None
        for piece in self._of(boot_id):
            if piece.first <= seq:
                break
            found = piece
        return found

    def last(self, boot_id: str) -> int | None:
        """Return the newest number of this stream in the buffer; None if there is none."""
        piece = next(self._of(boot_id), None)
        return None if piece is None else piece.last

    def _of(self, boot_id: str) -> Iterator[Piece]:
        """Yield batches of a stream, the newest first: readers are mostly near the end."""
        return (piece for piece in reversed(self._pieces) if piece.boot_id == boot_id)

    @asynccontextmanager
    async def watched(self) -> AsyncIterator[asyncio.Event]:
        """Context manager: an event that is set whenever frames have come."""
        news = asyncio.Event()
        self._waiting.add(news)
        try:
            yield news
        finally:
            self._waiting.discard(news)


async def wait_for(news: asyncio.Event) -> None:
    """Wait for new frames, at most a second: not every change sets the event."""
    try:
        async with asyncio.timeout(_LOOK_AGAIN_S):
            await news.wait()
    except TimeoutError:
        pass


class Memories:
    """Buffers of the nodes with readers."""

    def __init__(self) -> None:
        self._of: dict[str, NodeMemory] = {}
        self._turn = asyncio.Semaphore(1)

    def of(self, node: str) -> NodeMemory:
        """Return the buffer of a node, created for its first reader."""
        return self._of.setdefault(node, NodeMemory(self._turn))

    def publish(self, node: ServerNode, due: list[Estimated]) -> None:
        """Add estimated frames of a node's present stream; cheap without readers."""
        memory = self._of.get(node.name)
        if memory is not None:
            memory.add(node.boot_id, due)


def _bytes_of(frames: FrameBatch, columns: Columns) -> int:
    of_all = (*vars(frames).values(), *columns.values())
    return _PIECE_BYTES + sum(int(column.nbytes) for column in of_all)
