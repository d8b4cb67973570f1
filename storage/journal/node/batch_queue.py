"""Queue of batches that wait in memory, with its size."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from storage.wire import EncodedBatch


class BatchQueue:
    """Queue of batches, oldest first, with its size in bytes."""

    def __init__(self) -> None:
        self.batches: deque[EncodedBatch] = deque()
        self.size_bytes = 0

    @property
    def frame_count(self) -> int:
        """Number of frames in the queue."""
        return sum(batch.seq_last - batch.seq_first + 1 for batch in self.batches)

    def append(self, batch: EncodedBatch) -> None:
        """Append the newest batch."""
        self.batches.append(batch)
        self.size_bytes += len(batch.payload)

    def popleft(self) -> EncodedBatch:
        """Remove and return the oldest batch."""
        batch = self.batches.popleft()
        self.size_bytes -= len(batch.payload)
        return batch

    def prepend(self, batches: Iterable[EncodedBatch]) -> None:
        """Put removed batches back, before all others."""
        given = list(batches)
        self.batches.extendleft(reversed(given))
        self.size_bytes += sum(len(batch.payload) for batch in given)
