"""What a node's live estimates gave lately, piece by piece, for all who take every frame.

Pieces are kept as they were made, and nothing is copied or encoded before somebody asks. Memory is
bounded whatever comes, and a node that nobody has asked for costs none.
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
"""Of one node: some 20 s of 8 tiles at 544 Hz, more of fewer."""
_PIECE_BYTES = 3000
"""What a piece takes beside its numbers: objects of numpy, some forty."""
_LOOK_AGAIN_S = 1.0


@dataclass(frozen=True)
class Piece:
    """Consecutive frames of one stream, as the live estimates gave them."""

    number: int
    """Of the piece, counted since the node was first asked for."""
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
    """The newest pieces of one node, and those who wait for the next.

    Args:
        turn: to compute something again: one at a time, so that the live picture has a core.
        bytes_max: of all that is kept.
    """

    def __init__(self, turn: asyncio.Semaphore, bytes_max: int = BYTES_MAX) -> None:
        self.turn = turn
        self.shared = Shared()
        """What was encoded of the pieces, for others who ask for the same."""
        self._pieces: deque[Piece] = deque()
        self._bytes_max = bytes_max
        self._bytes = 0
        self._next_number = 0
        self._waiting: set[asyncio.Event] = set()

    @property
    def oldest(self) -> int:
        """Number of the oldest piece that is kept, or of the next, if there is none."""
        return self._next_number - len(self._pieces)

    @property
    def watchers(self) -> int:
        """How many read it now."""
        return len(self._waiting)

    @property
    def next_number(self) -> int:
        """Number of the piece that comes next."""
        return self._next_number

    def add(self, boot_id: str, due: list[Estimated]) -> None:
        """What the live estimates have given; it may be nothing, and that is told as well."""
        for frames, columns in due:
            if not len(frames):
                continue
            self._pieces.append(Piece(self._next_number, boot_id, frames, columns))
            self._next_number += 1
            self._bytes += _bytes_of(frames, columns)
        while self._bytes > self._bytes_max and len(self._pieces) > 1:
            gone = self._pieces.popleft()
            self._bytes -= _bytes_of(gone.frames, gone.columns)
        self.wake()

    def wake(self) -> None:
        """Have all who wait look again."""
        for each in self._waiting:
            each.set()

    def __getitem__(self, number: int) -> Piece:
        """The piece of this number, which is kept."""
        return self._pieces[number - self.oldest]

    def find(self, boot_id: str, seq: int) -> Piece | None:
        """The piece with this frame; None if it is not kept."""
        return next((p for p in self._of(boot_id) if p.first <= seq <= p.last), None)

    def after(self, boot_id: str, seq: int) -> Piece | None:
        """The oldest kept piece of a stream that begins after this frame; None if none does."""
        found = None
        for piece in self._of(boot_id):
            if piece.first <= seq:
                break
            found = piece
        return found

    def last(self, boot_id: str) -> int | None:
        """Number of the newest frame of this stream that is kept; None if none is."""
        piece = next(self._of(boot_id), None)
        return None if piece is None else piece.last

    def _of(self, boot_id: str) -> Iterator[Piece]:
        """Pieces of a stream, the newest first: who asks is mostly near the end."""
        return (piece for piece in reversed(self._pieces) if piece.boot_id == boot_id)

    @asynccontextmanager
    async def watched(self) -> AsyncIterator[asyncio.Event]:
        """An event that is set whenever something has come."""
        news = asyncio.Event()
        self._waiting.add(news)
        try:
            yield news
        finally:
            self._waiting.discard(news)


async def wait_for(news: asyncio.Event) -> None:
    """Wait until something has come, or for a second: not all that changes is told."""
    try:
        async with asyncio.timeout(_LOOK_AGAIN_S):
            await news.wait()
    except TimeoutError:
        pass


class Memories:
    """Memories of the nodes that were asked for."""

    def __init__(self) -> None:
        self._of: dict[str, NodeMemory] = {}
        self._turn = asyncio.Semaphore(1)

    def of(self, node: str) -> NodeMemory:
        """The memory of a node, which begins now if nobody has asked for it before."""
        return self._of.setdefault(node, NodeMemory(self._turn))

    def publish(self, node: ServerNode, due: list[Estimated]) -> None:
        """Frames of a node's present stream with their estimates; cheap if nobody asked."""
        memory = self._of.get(node.name)
        if memory is not None:
            memory.add(node.boot_id, due)


def _bytes_of(frames: FrameBatch, columns: Columns) -> int:
    of_all = (*vars(frames).values(), *columns.values())
    return _PIECE_BYTES + sum(int(column.nbytes) for column in of_all)
