"""Frames as the bytes that go over the wire and into journals: one Arrow IPC message a batch.

The schema is known to both ends (it follows from the `ArrayInfo` of the stream), so a message is a
record batch and nothing else; the same bytes, appended to the schema's own message, are an Arrow
IPC stream that any tool can read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from devices.errors import FileFormatError
from devices.facts import SEQ_END
from devices.frames import ArrayInfo, FrameBatch
from storage.arrow_header import HeaderError
from storage.intervals import Intervals
from storage.layout import layout_of
from storage.schema import from_record_batch, to_record_batch, wire_schema

_MARK = b"\xff\xff\xff\xff"
"""With which a message begins. Arrow also reads older ones without it, in which all that is behind
stands four bytes earlier: where columns are said to lie there would be other numbers."""
_MESSAGE_FRAMES = 64
"""As many as acquisition puts into a batch at most."""


@dataclass(frozen=True)
class EncodedBatch:
    """Consecutive frames as one message, and what a journal notes of it without decoding it."""

    seq_first: int
    seq_last: int
    t_ns_first: int
    t_ns_last: int
    payload: bytes

    @classmethod
    def of(cls, frames: FrameBatch, payload: bytes) -> EncodedBatch:
        """The message `payload`, which holds these frames."""
        return cls(
            *(int(frames.seq[0]), int(frames.seq[-1])),
            *(int(frames.t_ns[0]), int(frames.t_ns[-1])),
            payload,
        )

    @property
    def numbers(self) -> Intervals:
        """Of its frames."""
        return Intervals([(self.seq_first, self.seq_last)])


def encode(batch: FrameBatch, schema: pa.Schema) -> bytes:
    """Frames as one message of a stream with this schema (`storage.schema.wire_schema`)."""
    return to_record_batch(batch, schema).serialize().to_pybytes()


def messages_of(frames: FrameBatch, info: ArrayInfo) -> Iterator[EncodedBatch]:
    """Frames as messages of the size that nodes send."""
    schema = wire_schema(info)
    for begin in range(0, len(frames), _MESSAGE_FRAMES):
        rows = frames.rows(begin, min(begin + _MESSAGE_FRAMES, len(frames)))
        yield EncodedBatch.of(rows, encode(rows, schema))


def decode(payload: bytes | memoryview, schema: pa.Schema) -> FrameBatch:
    """Frames of one message, as views of its bytes; everything about it is checked first.

    Raises:
        FileFormatError: it is no such message, is cut off, or its frames are not in order.
    """
    try:
        if bytes(payload[: len(_MARK)]) != _MARK:
            raise HeaderError("it does not begin as messages do since Arrow 0.15")
        message = pa.ipc.read_message(pa.py_buffer(payload))
        if layout_of(message, schema).message_bytes != len(payload):
            raise HeaderError(f"it is {len(payload)} bytes long, and says another length")
        record = pa.ipc.read_record_batch(message, schema)
        record.validate(full=True)  # whatever the header did not say
    except (pa.ArrowException, EOFError, OSError, ValueError, IndexError) as error:
        raise FileFormatError(
            f"no Arrow message of frames: {error}",
            expected="a record batch of the schema announced in hello",
        ) from error
    batch = from_record_batch(record)
    first, last = int(batch.seq[0]), int(batch.seq[-1])
    # A difference of unsigned numbers wraps, so both ends are looked at as well.
    if (np.diff(batch.seq) != 1).any() or last - first != len(batch) - 1:
        raise FileFormatError(
            f"frames {first} to {last} do not follow one another",
            expected="seq rising by one within a message",
        )
    if last >= SEQ_END:
        raise FileFormatError(f"frame number {last}", expected="less than 2^53")
    if (batch.t_mono_ns[1:] < batch.t_mono_ns[:-1]).any():
        raise FileFormatError(
            f"time runs backwards within frames {first} to {last}",
            expected="t_mono_ns rising",
        )
    return batch
