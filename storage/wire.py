"""Frames as bytes on the wire and in journals: one Arrow IPC message per batch.

Both ends have the schema (it follows from the `ArrayInfo` of the stream), so a message is a record
batch and nothing else; the same bytes, appended to the schema's own message, are an Arrow IPC
stream that any tool can read.

A batch of 25 ms costs as much to decode as thousands of frames, and a journal has 140,000 batches
an hour. So the bytes of each message are checked against its CRC-32, which is cheap, and everything
else is checked for all messages together. If any check fails, decoding of many messages gives None:
the caller then decodes batch by batch to find the faulty one.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Ints
from devices.errors import FileFormatError
from devices.frames import ArrayInfo, Edge, FrameBatch, get_frame_columns
from devices.types import SEQ_END
from storage.edges import encode_record_batch
from storage.intervals import Intervals
from storage.message_layout import MessageLayout, MessageLayoutCache
from storage.schema import frames_to_record_batch, numpy_dtype_of, wire_schema

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


def encode_frames(batch: FrameBatch, schema: pa.Schema, edges: Sequence[Edge] = ()) -> bytes:
    """Encode frames as one message of a stream with this schema (`storage.schema.wire_schema`)."""
    return encode_record_batch(frames_to_record_batch(batch, schema), edges)


_EDGES_BEFORE_NS = 1_000_000_000
"""Edges this much older than the first frame were in an earlier message, of 25 ms."""


def encode_as_messages(
    consecutive_frames: FrameBatch, info: ArrayInfo, edges: Sequence[Edge] = ()
) -> Iterator[EncodedBatch]:
    """Encode frames as messages of the size that nodes send, each with the edges up to its end.

    Edges after the last frame are left out. The first message may repeat earlier ones.
    """
    schema = wire_schema(info)
    begin_ns = int(consecutive_frames.t_mono_ns[0]) - _EDGES_BEFORE_NS
    for begin in range(0, len(consecutive_frames), _MAX_BATCH_FRAMES):
        rows = consecutive_frames.slice_rows(
            begin, min(begin + _MAX_BATCH_FRAMES, len(consecutive_frames))
        )
        end_ns = int(rows.t_mono_ns[-1])
        own = [edge for edge in edges if begin_ns < edge.t_mono_ns <= end_ns]
        yield EncodedBatch.from_frames_and_payload(rows, encode_frames(rows, schema, own))
        begin_ns = end_ns


class Decoder:
    """Decoder of messages of one stream. Thread-safe.

    Args:
        schema: schema of the stream (`storage.schema.wire_schema`).
    """

    def __init__(self, schema: pa.Schema) -> None:
        self.schema = schema
        self._layouts = MessageLayoutCache(schema)
        frame_columns = get_frame_columns(_get_raw_type(schema))
        self._columns = [(name, *frame_columns[name]) for name in schema.names]
        self._tiles = schema.field("pressure_raw").type.list_size

    def decode(self, payload: bytes | memoryview) -> FrameBatch:
        """Decode the frames of one message as views of its bytes, and check them completely.

        Raises:
            FileFormatError: it is no message of this stream, is cut off, or its frames are out of
                order.
        """
        layout = self._layouts.validate_and_get_layout(payload)
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
                f"time runs backwards within frames {first} to {last}", expected="t_mono_ns rising"
            )
        return batch


def _get_raw_type(schema: pa.Schema) -> np.dtype[Any]:
    """Return the type of a stream's counts."""
    return numpy_dtype_of(schema.field("pressure_raw").type.value_type)


def decode_message(payload: bytes | memoryview, schema: pa.Schema) -> FrameBatch:
    """Decode a single message; raises as `Decoder.decode`."""
    return Decoder(schema).decode(payload)


Numbers = npt.NDArray[np.integer[Any]]


@dataclass(frozen=True)
class MessageBatch:
    """Messages that lie one behind the other in memory, with their index entries.

    Attributes:
        content: the bytes of all messages.
        length: length of each message in bytes.
        seq_first: number of each message's first frame, rising.
        count: number of frames of each message.
        crc32: CRC-32 of each message's bytes.
    """

    content: bytes
    length: Numbers
    seq_first: Numbers
    count: Numbers
    crc32: Numbers


class MessageBatchDecoder:
    """Decoder of message batches of one stream. Thread-safe.

    Args:
        schema: schema of the stream (`storage.schema.wire_schema`).
    """

    def __init__(self, schema: pa.Schema) -> None:
        self.schema = schema
        self._layouts = MessageLayoutCache(schema)

    def decode_or_none_if_damaged(self, messages: MessageBatch) -> FrameBatch | None:
        """Decode all messages into copied columns; None if any check against the index fails.

        The rules of frames (`storage.frame_rules`) are not checked.
        """
        ends = np.cumsum(messages.length, dtype=np.int64)
        begins = ends - messages.length.astype(np.int64)
        if not len(ends) or ends[-1] != len(messages.content):
            return None
        layouts = self._verify_layouts(messages, begins.tolist(), ends.tolist())
        if layouts is None:
            return None
        frames = _concatenate_frames(messages, begins, layouts, self.schema)
        return frames if _is_in_order(frames, messages) else None

    def _verify_layouts(
        self, run: MessageBatch, begins: Sequence[int], ends: Sequence[int]
    ) -> list[MessageLayout] | None:
        """Return the layout of each message; None if one is damaged or not of this stream."""
        view = memoryview(run.content)
        found = []
        indexed = zip(begins, ends, run.count.tolist(), run.crc32.tolist(), strict=True)
        for begin, end, count, crc32 in indexed:
            message = view[begin:end]
            if zlib.crc32(message) != crc32:
                return None
            try:
                layout = self._layouts.validate_and_get_layout(message)
            except FileFormatError:
                return None
            if layout.rows != count:
                return None
            found.append(layout)
        return found


def _concatenate_frames(
    run: MessageBatch, begins: Ints, layouts: Sequence[MessageLayout], schema: pa.Schema
) -> FrameBatch:
    """Copy the frames of verified messages into contiguous columns."""
    count = run.count.astype(np.int64)
    row = np.cumsum(count) - count
    total = int(count.sum())
    tiles = schema.field("pressure_raw").type.list_size
    columns = {
        name: np.empty((total, tiles) if per_tile else total, dtype)
        for name, (dtype, per_tile) in get_frame_columns(_get_raw_type(schema)).items()
    }
    alike: dict[int, list[int]] = {}
    for number, layout in enumerate(layouts):
        alike.setdefault(id(layout), []).append(number)
    for numbers in alike.values():
        layout = layouts[numbers[0]]
        rows = (row[numbers, None] + np.arange(layout.rows)).reshape(-1)
        for name, (offset, size) in zip(schema.names, layout.columns, strict=True):
            if not size:
                continue
            column = columns[name]
            # A view of every window of `size` bytes, from which the messages' columns are picked.
            shape = len(run.content) - size + 1, size
            windows = np.ndarray(shape, np.uint8, run.content, strides=(1, 1))
            found = windows[begins[numbers] + offset].view(column.dtype)
            column[rows] = found.reshape(len(rows), *column.shape[1:])
    return FrameBatch(**columns)


def _is_in_order(frames: FrameBatch, run: MessageBatch) -> bool:
    """Return whether the frames match the index, with rising numbers, and times in each message."""
    first, count = run.seq_first.astype(np.uint64), run.count.astype(np.uint64)
    row = (np.cumsum(count) - count).astype(np.int64)
    number = np.arange(len(frames), dtype=np.uint64)
    expected = np.repeat(first - row.astype(np.uint64), run.count) + number  # modulo 2^64
    back = frames.t_mono_ns[1:] < frames.t_mono_ns[:-1]
    back[row[1:] - 1] = False
    return bool(
        (frames.seq == expected).all()
        and (first[1:] >= first[:-1] + count[:-1]).all()
        and int(first[-1] + count[-1]) <= SEQ_END
        and not back.any()
    )
