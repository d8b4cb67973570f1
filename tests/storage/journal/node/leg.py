"""The stream that tests of a node's journal take frames from; what a node takes, has, gives."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np

from devices.acquisition import AcquiredFrame
from devices.frames import ArrayInfo, FrameBatch
from storage.journal.node.in_flight import InFlightWriter
from storage.journal.node.journal import NodeJournal
from storage.journal.node.stream import NodeStream
from storage.schema import wire_schema
from storage.wire import EncodedBatch, encode_frames
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames
from tests.waiting import until


def frames(first: int, last: int) -> FrameBatch:
    """Frames `first` to `last`; the first of all is taken a period after the clock began."""
    seq = np.arange(first, last + 1)
    counts = 500 + (seq[:, None] * 7 + np.arange(2)) % 97
    return make_frames(seq, t_mono_ns=PERIOD_NS * (seq + 1), pressure_raw=counts)


def message(first: int, last: int) -> EncodedBatch:
    """The same frames as a node's message."""
    batch = frames(first, last)
    return EncodedBatch.from_frames_and_payload(
        batch, encode_frames(batch, wire_schema(make_array()))
    )


def take_in_flight(folder: Path, batch: FrameBatch, info: ArrayInfo | None = None) -> None:
    """Take these frames as acquisition does, whose process then ends."""
    keeper = InFlightWriter(folder, info or make_array())
    for row in range(len(batch)):
        keeper.write_frame(
            AcquiredFrame(*(getattr(batch, name)[row].tolist() for name in AcquiredFrame._fields))
        )
    keeper.close()


Start = Callable[..., NodeJournal]


def fill(journal: NodeJournal, stream: NodeStream, first: int, last: int) -> None:
    """Take frames `first` to `last`, ten in a batch."""
    for begin in range(first, last + 1, 10):
        journal.queue_batch_and_limit_memory(stream, message(begin, min(begin + 9, last)))


def store(journal: NodeJournal, stream: NodeStream, first: int, last: int) -> None:
    """Take frames, and wait until they are on the disk."""
    fill(journal, stream, first, last)
    until(lambda: stream.stored.last == last)


def given(stream: NodeStream, first: int, last: int) -> list[int]:
    """First numbers of the batches that it gives for these frames."""
    return [batch.seq_first for batch in stream.read_overlapping_batches(first, last)]


def killed(journal: NodeJournal, folder: Path) -> Path:
    """The node's folder as SIGKILL leaves it: what the kernel has."""
    copy = folder.with_name(folder.name + "-killed")
    shutil.copytree(folder, copy)
    journal.end_streams_and_close()
    return copy
