"""Frames as bytes on the wire and in journals: one Arrow IPC message per batch.

Both ends have the schema (it follows from the `ArrayInfo` of the stream), so a message is a record
batch and nothing else; the same bytes, appended to the schema's own message, are an Arrow IPC
stream that any tool can read.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from devices.errors import FileFormatError
from devices.frames import FRAME_COLUMNS, ArrayInfo, FrameBatch
from devices.types import SEQ_END
from storage.intervals import Intervals
from storage.message_layout import MessageLayoutCache
from storage.schema import frames_to_record_batch, wire_schema

_MAX_BATCH_FRAMES = 64
"""Largest batch of the acquisition."""


@dataclass(frozen=True)
class EncodedBatch:
    """Consecutive frames as one message, with the numbers and times of its first and last frame."""

    seq_first: int
    seq_last: int
    t_ns_first: int
    t_ns_last: int
    payload: bytes

    @classmethod
    def from_frames_and_payload(cls, frames: FrameBatch, payload: bytes) -> EncodedBatch:
        """Wrap the message `payload`, which holds these frames."""
        return cls(
            *(int(frames.seq[0]), int(frames.seq[-1])),
            *(int(frames.t_ns[0]), int(frames.t_ns[-1])),
            payload,
        )

    @property
    def numbers(self) -> Intervals:
        """Numbers of its frames."""
        return Intervals([(self.seq_first, self.seq_last)])


def encode_frames(batch: FrameBatch, schema: pa.Schema) -> bytes:
    """Encode frames as one message of a stream with this schema (`storage.schema.wire_schema`)."""
    return frames_to_record_batch(batch, schema).serialize().to_pybytes()


def encode_as_messages(frames: FrameBatch, info: ArrayInfo) -> Iterator[EncodedBatch]:
    """Encode frames as messages of the size that nodes send."""
    schema = wire_schema(info)
    for begin in range(0, len(frames), _MAX_BATCH_FRAMES):
        rows = frames.slice_rows(begin, min(begin + _MAX_BATCH_FRAMES, len(frames)))
        yield EncodedBatch.from_frames_and_payload(rows, encode_frames(rows, schema))


class Decoder:
    """Decoder of messages of one stream. Thread-safe.

    Args:
        schema: schema of the stream (`storage.schema.wire_schema`).
    """

    def __init__(self, schema: pa.Schema) -> None:
        self._layouts = MessageLayoutCache(schema)
        self._columns = [(name, *FRAME_COLUMNS[name]) for name in schema.names]
        self._tiles = schema.field("pressure_raw").type.list_size

    def decode(self, payload: bytes | memoryview) -> FrameBatch:
        """Decode the frames of one message as views of its bytes, and check them completely.

        Raises:
            FileFormatError: it is no message of this stream, is cut off, or its frames are out of
                order.
        """
        layout = self._layouts.get_layout(payload)
        by_frame, by_tile = (layout.rows,), (layout.rows, self._tiles)
        batch = FrameBatch(
            **{
                name: np.ndarray(by_tile if per_tile else by_frame, dtype, payload, offset)
                for (name, dtype, per_tile), (offset, _) in zip(
                    self._columns, layout.columns, strict=True
                )
            }
        )
        seq, t_mono_ns = batch.seq, batch.t_mono_ns
        first, last = int(seq[0]), int(seq[-1])
        # A difference of unsigned numbers wraps, so both ends are checked as well.
        if last - first != len(batch) - 1 or np.count_nonzero(seq[1:] - seq[:-1] != 1):
            raise FileFormatError(
                f"frames {first} to {last} do not follow one another",
                expected="seq rising by one within a message",
            )
        if last >= SEQ_END:
            raise FileFormatError(f"frame number {last}", expected="less than 2^53")
        if np.count_nonzero(t_mono_ns[1:] < t_mono_ns[:-1]):
            raise FileFormatError(
                f"time runs backwards within frames {first} to {last}",
                expected="t_mono_ns rising",
            )
        return batch


def decode_message(payload: bytes | memoryview, schema: pa.Schema) -> FrameBatch:
    """Decode a single message; raises as `Decoder.decode`."""
    return Decoder(schema).decode(payload)
