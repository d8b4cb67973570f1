"""Frames as the bytes that go over the wire and into journals: one Arrow IPC message a batch.

The schema is known to both ends (it follows from the `ArrayInfo` of the stream), so a message is a
record batch and nothing else; the same bytes, appended to the schema's own message, are an Arrow
IPC stream that any tool can read.
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from devices.errors import FileFormatError
from devices.frames import FrameBatch
from storage.schema import from_record_batch, to_record_batch

FRAMES_MAX = 4096
"""Frames in one message; a node sends some ten. More is not what a node sends."""


def encode(batch: FrameBatch, schema: pa.Schema) -> bytes:
    """Frames as one message of a stream with this schema (`storage.schema.wire_schema`)."""
    return to_record_batch(batch, schema).serialize().to_pybytes()


def decode(payload: bytes | memoryview, schema: pa.Schema) -> FrameBatch:
    """Frames of one message, as views of its bytes; everything about it is checked first.

    Raises:
        FileFormatError: it is no such message, is cut off, or its frames are not in order.
    """
    try:
        record = pa.ipc.read_record_batch(pa.py_buffer(payload), schema)
        record.validate(full=True)  # offsets and lengths of foreign bytes are not to be trusted
    except (pa.ArrowException, EOFError, OSError, ValueError, IndexError) as error:
        raise FileFormatError(
            f"no Arrow message of frames: {error}",
            expected="a record batch of the schema announced in hello",
        ) from error
    batch = from_record_batch(record)
    if not 0 < len(batch) <= FRAMES_MAX:
        raise FileFormatError(
            f"a message of {len(batch)} frames", expected=f"1 to {FRAMES_MAX} frames"
        )
    # Unsigned: a step back wraps to a huge one.
    if (np.diff(batch.seq) != 1).any():
        raise FileFormatError(
            f"frames {batch.seq[0]} to {batch.seq[-1]} do not follow one another",
            expected="seq rising by one within a message",
        )
    if int(batch.seq[-1]) >= 2**62:
        raise FileFormatError(f"frame number {batch.seq[-1]}", expected="less than 2^62")
    if (np.diff(batch.t_mono_ns) < 0).any():
        raise FileFormatError(
            f"time runs backwards within frames {batch.seq[0]} to {batch.seq[-1]}",
            expected="t_mono_ns rising",
        )
    return batch
