"""The one stream that tests of journals take frames from; counts depend on the number only."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from devices.acquisition import AcquiredFrame
from devices.frames import ArrayInfo, FrameBatch
from storage.journal.node.in_flight import InFlightWriter
from storage.schema import wire_schema
from storage.wire import EncodedBatch, encode_frames
from tests.builders.arrays import PERIOD_NS, make_array
from tests.builders.frames import make_frames


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
