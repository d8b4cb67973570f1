"""What a node keeps until the server has it: messages in memory, oldest first, bounded.

The node's journal on disk will take this place with the same four calls; until then what does not
fit into the bound is evicted, oldest first, and counted.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

BYTES_MAX = 64 << 20
"""A quarter of an hour of four tiles at full rate."""


@dataclass(frozen=True)
class EncodedBatch:
    """Consecutive frames as one message of the wire."""

    seq_first: int
    seq_last: int
    payload: bytes


class Backlog:
    """Batches that are not yet acknowledged."""

    def __init__(self, bytes_max: int = BYTES_MAX) -> None:
        self.next_seq = 0
        """Number of the next frame to come."""
        self.evicted_frames = 0
        self._bytes_max = bytes_max
        self._bytes = 0
        self._batches: deque[EncodedBatch] = deque()

    @property
    def first_seq(self) -> int:
        """The oldest frame that is kept."""
        return self._batches[0].seq_first if self._batches else self.next_seq

    @property
    def kept_bytes(self) -> int:
        """What is kept, in bytes of payload."""
        return self._bytes

    def append(self, batch: EncodedBatch) -> None:
        """Keep a batch, which comes after all others; make room for it if need be."""
        self._batches.append(batch)
        self._bytes += len(batch.payload)
        self.next_seq = batch.seq_last + 1
        while self._bytes > self._bytes_max and len(self._batches) > 1:
            self.evict_oldest()

    def evict_oldest(self) -> None:
        """Give up the oldest batch that is kept, and count its frames."""
        oldest = self._drop_oldest()
        self.evicted_frames += oldest.seq_last - oldest.seq_first + 1

    def acknowledge(self, seq_first: int, seq_last: int) -> None:
        """Forget batches that lie within `seq_first` to `seq_last`."""
        kept: list[EncodedBatch] = []
        while self._batches and self._batches[0].seq_first <= seq_last:
            oldest = self._drop_oldest()
            if oldest.seq_first < seq_first or oldest.seq_last > seq_last:
                kept.append(oldest)
        self._batches.extendleft(reversed(kept))
        self._bytes += sum(len(batch.payload) for batch in kept)

    def since(self, seq: int) -> Iterator[EncodedBatch]:
        """Batches with frames from `seq` on, oldest first."""
        # What is asked for is nearly always the newest.
        wanted: deque[EncodedBatch] = deque()
        for batch in reversed(self._batches):
            if batch.seq_last < seq:
                break
            wanted.appendleft(batch)
        return iter(wanted)

    def _drop_oldest(self) -> EncodedBatch:
        oldest = self._batches.popleft()
        self._bytes -= len(oldest.payload)
        return oldest


def make_room(backlogs: Sequence[Backlog], batch: EncodedBatch, bytes_max: int = BYTES_MAX) -> None:
    """Have several streams keep no more together than one alone may, with a batch to come.

    Args:
        backlogs: in the order of the streams; the oldest frames of all are evicted.
        batch: will be appended to the last one, which bounds itself.
        bytes_max: what they may keep.
    """
    for backlog in backlogs[:-1]:
        while backlog.kept_bytes and (
            sum(each.kept_bytes for each in backlogs) + len(batch.payload) > bytes_max
        ):
            backlog.evict_oldest()
