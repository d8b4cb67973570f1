"""Batches that wait in memory, and how much of it they take."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

from storage.wire import EncodedBatch


class BatchQueue:
    """Batches, oldest first, and what they take in memory."""

    def __init__(self) -> None:
        self.batches: deque[EncodedBatch] = deque()
        self.size_bytes = 0

    @property
    def frames(self) -> int:
        """How many frames there are in them."""
        return sum(batch.seq_last - batch.seq_first + 1 for batch in self.batches)

    def append(self, batch: EncodedBatch) -> None:
        """Add the newest one."""
        self.batches.append(batch)
        self.size_bytes += len(batch.payload)

    def popleft(self) -> EncodedBatch:
        """Take out the oldest one."""
        batch = self.batches.popleft()
        self.size_bytes -= len(batch.payload)
        return batch

    def give_back(self, batches: Iterable[EncodedBatch]) -> None:
        """Put back what was taken out, before all others."""
        given = list(batches)
        self.batches.extendleft(reversed(given))
        self.size_bytes += sum(len(batch.payload) for batch in given)
