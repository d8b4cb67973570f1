"""Events of the live feed: frames, gaps, stream starts."""

from __future__ import annotations

from dataclasses import dataclass

from service.server.estimates.node_estimator import EstimatedBatch


@dataclass(frozen=True)
class Position:
    """Next frame of a reader."""

    stream_id: str
    seq: int

    def __str__(self) -> str:
        """Return the query to resume from here, as text that programs parse."""
        return f"resume with stream_id={self.stream_id}&from_seq={self.seq}"


@dataclass(frozen=True)
class FrameRows:
    """Consecutive frames of one stream with their estimates, if any."""

    stream_id: str
    batch: EstimatedBatch
    batch_number: int | None = None
    """Number of the buffered batch, if these are all of its rows."""
    is_recomputed: bool = False

    @property
    def first_seq(self) -> int:
        """Number of the first frame."""
        return int(self.batch[0].seq[0])

    @property
    def last_seq(self) -> int:
        """Number of the last frame."""
        return int(self.batch[0].seq[-1])


@dataclass(frozen=True)
class Gap:
    """Frames that are left out, both ends included."""

    stream_id: str
    first_seq: int
    last_seq: int
    reason: str
    """`slow`: the reader was too slow; `late`: the frames did not come in time. Else the loss
    reason."""


@dataclass(frozen=True)
class StreamStart:
    """Start of a stream: the next events are of this stream."""

    stream_id: str
    first_seq: int


FeedEvent = FrameRows | Gap | StreamStart


def slice_batch(batch: EstimatedBatch, begin: int, end: int) -> EstimatedBatch:
    """Return rows `begin` to `end` - 1 of frames and their estimates; unchanged if that is all."""
    frames, columns = batch
    if begin <= 0 and end >= len(frames):
        return batch
    return frames.slice_rows(begin, end), {name: v[begin:end] for name, v in columns.items()}
