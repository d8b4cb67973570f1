"""A stream that an earlier process left: what it had on disk, and what it had in flight."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from devices.acquisition import RangeFlag
from devices.frames import ArrayInfo, FrameBatch
from storage.intervals import Intervals
from storage.journal.in_flight import read_in_flight
from storage.journal.node_stream import NodeStream, opened
from storage.journal.stream_notes import StreamNotes, unsynced_tail_max
from storage.kernel import kernel_boot_id
from storage.losses import DISK_SLOW
from storage.schema import wire_schema
from storage.wire import EncodedBatch, encode

_MESSAGE_FRAMES = 64


def taken_up(folder: Path) -> NodeStream | None:
    """A stream that an earlier process left, with what it had in flight when it was killed.

    If the machine itself went down, what was in flight is lost; how much that can have been is
    noted: what was taken since the last sync, by the disk's slowest one.

    Raises:
        StorageError: it cannot be read.
    """
    left = read_in_flight(folder)
    stream = opened(folder)
    if stream is None:
        if left is None:
            return None
        stream = NodeStream(folder, StreamNotes(array_info=left[0]), None)
        stream.notes = stream.notes.model_copy(update={"kernel_boot_id": kernel_boot_id()})
    if stream.notes.has_ended:
        return stream
    held = stream.held
    end = (held.last + 1) if held.last is not None else 0
    lost_last = stream.lost.all.last
    end = max(end, (lost_last + 1) if lost_last is not None else 0)
    rescued = left[1] if left is not None else None
    tail = 0
    if rescued is not None:
        RangeFlag(stream.info.tiles).flag(rescued)
        first, last = int(rescued.seq[0]), int(rescued.seq[-1])
        if first > end:  # more waited for the disk than was in flight
            stream.lost.add(Intervals([(end, first - 1)]), DISK_SLOW)
        for a, b in held.missing(max(first, _oldest(held)), last):
            for batch in encoded(rescued.rows(a - first, b + 1 - first), stream.info):
                stream.waiting.append(batch)
                stream.waiting_bytes += len(batch.payload)
        end = max(end, last + 1)
    elif left is None:
        tail = unsynced_tail_max(stream.info.nominal_rate_hz, stream.notes.sync_max_s)
    stream.next_seq = end
    stream.has_ended = True
    stream.notes = stream.notes.model_copy(update={"unsynced_tail_max": tail})
    return stream


def encoded(frames: FrameBatch, info: ArrayInfo) -> Iterator[EncodedBatch]:
    """Frames as messages of the size that nodes send."""
    schema = wire_schema(info)
    for begin in range(0, len(frames), _MESSAGE_FRAMES):
        rows = frames.rows(begin, min(begin + _MESSAGE_FRAMES, len(frames)))
        yield EncodedBatch.of(rows, encode(rows, schema))


def _oldest(held: Intervals) -> int:
    """What is older than everything that is held was evicted, not lost in flight."""
    return next(iter(held))[0] if held else 0


def in_flight_since(stream: NodeStream) -> FrameBatch | None:
    """What acquisition had taken and not handed over when it ended; None if that is nothing.

    Raises:
        StorageError: it cannot be read.
    """
    left = read_in_flight(stream.folder)
    if left is None or left[1] is None or int(left[1].seq[-1]) < stream.next_seq:
        return None
    frames = left[1]
    rows = frames.rows(max(0, stream.next_seq - int(frames.seq[0])), len(frames))
    RangeFlag(stream.info.tiles).flag(rows)
    return rows
