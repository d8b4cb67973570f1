"""Messages of a node as none may be: right to the checksum, and wrong inside; or damaged."""

from __future__ import annotations

import json
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pyarrow as pa

from devices.frames import ArrayInfo, FrameBatch
from service.protocol.codec import append_crc, append_text_crc
from storage.schema import frames_to_record_batch, wire_schema
from tests.builders.frames import make_frames, with_columns
from tests.builders.odd_values import ODD_VALUES, places, with_value

DEEP = "[" * 2000 + "]" * 2000


def checked_text(content: Any) -> str:
    """A message with the checksum that fits it; NaN and halves of pairs as Python writes them."""
    body = json.dumps(content)
    return append_text_crc(body if body.endswith("}") else f'{{"type":{body}}}')


def wrong_text(random: Random, content: dict[str, Any]) -> str:
    """A message in which one field, or two, hold something else."""
    for _ in range(random.choice((1, 1, 1, 2))):
        place = random.choice(list(places(content)))
        content = with_value(content, place, random.choice(ODD_VALUES))
        if not isinstance(content, dict):
            break
    return checked_text(content)


def damaged(random: Random, message: str | bytes) -> str | bytes:
    """The message with flipped, removed, repeated or strange bytes."""
    content = bytearray(message.encode() if isinstance(message, str) else message)
    for _ in range(random.randrange(1, 4)):
        at = random.randrange(len(content) or 1)
        kind = random.randrange(4)
        if kind == 0 and content:
            content[at] ^= 1 << random.randrange(7)
        elif kind == 1:
            del content[at : at + random.randrange(1, 40)]
        elif kind == 2:
            content[at:at] = content[at : at + random.randrange(1, 40)]
        else:
            content[at:at] = random.randbytes(random.randrange(1, 9))
    if isinstance(message, str):
        return content.decode(errors="replace")
    return bytes(content)


def wrong_batch(random: Random, info: ArrayInfo, seq: int, t_mono_ns: int) -> bytes:
    """A binary message that breaks something, with the checksum that fits it."""
    frames = make_frames(
        np.arange(seq, seq + 10), len(info.tiles), utc_offset_ns=info.utc_offset_ns
    )
    frames = with_columns(frames, t_mono_ns=frames.t_mono_ns - frames.t_mono_ns[0] + t_mono_ns)
    return append_crc(random.choice(_BATCHES)(random, info, frames))


def _encoded(info: ArrayInfo, frames: FrameBatch) -> bytes:
    return frames_to_record_batch(frames, wire_schema(info)).serialize().to_pybytes()


def _odd_column(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    name = random.choice([*vars(frames)])
    column = getattr(frames, name).copy()
    ends = (
        [np.inf, -np.inf, 1e38, -1e38]
        if column.dtype.kind == "f"
        else [
            np.iinfo(column.dtype).min,
            np.iinfo(column.dtype).max,
            np.iinfo(column.dtype).max // 2,
        ]
    )
    column.reshape(-1)[random.randrange(column.size) :] = random.choice(ends)
    return _encoded(info, FrameBatch(**{**vars(frames), name: column}))


def _shifted(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    by_ns = random.choice([-1, 1]) * random.choice([10**9, 10**12, 2**60, 2**62, 2**63 - 1])
    t_mono_ns = (frames.t_mono_ns.astype(object) + by_ns) % 2**64
    t_mono = np.array([int(t) - 2**64 if t >= 2**63 else int(t) for t in t_mono_ns], np.int64)
    with np.errstate(over="ignore"):
        t_ns = t_mono + np.int64(info.utc_offset_ns)
    return _encoded(info, FrameBatch(**{**vars(frames), "t_mono_ns": t_mono, "t_ns": t_ns}))


def _shuffled(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    order = random.sample(range(len(frames)), len(frames))
    return _encoded(info, FrameBatch(**{n: c[order] for n, c in vars(frames).items()}))


def _other_rows(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    rows = random.choice([0, 4097, 20_000])
    empty = make_frames(rows, len(info.tiles), utc_offset_ns=info.utc_offset_ns)
    return _encoded(info, empty)


def _other_tiles(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    tiles = random.choice([1, 3, 64])
    columns = {
        name: np.repeat(column[:, :1], tiles, axis=1) if column.ndim == 2 else column
        for name, column in vars(frames).items()
    }
    other = info.model_copy(update={"tiles": info.tiles[:1] * tiles})
    return _encoded(other, FrameBatch(**columns))


def _stream_of(record: pa.RecordBatch, options: pa.ipc.IpcWriteOptions | None = None) -> bytes:
    """All messages behind the schema's: of dictionaries, if there are any, and of the batch."""
    sink = pa.BufferOutputStream()
    with pa.ipc.new_stream(sink, record.schema, options=options) as writer:
        writer.write_batch(record)
    stream, begin = sink.getvalue(), len(record.schema.serialize())
    return bytes(stream.slice(begin, stream.size - begin - 8).to_pybytes())


def _compressed(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    rows = random.choice([10, 4096, 1_000_000])
    zeros = make_frames(np.zeros(rows), len(info.tiles), utc_offset_ns=info.utc_offset_ns)
    codec = random.choice(["zstd", "lz4"])
    options = pa.ipc.IpcWriteOptions(compression=codec)  # type: ignore[arg-type]  # both it knows
    return _stream_of(frames_to_record_batch(zeros, wire_schema(info)), options)


def _other_schema(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    columns: list[pa.Array[Any]] = [
        pa.array(["a", "b"]).dictionary_encode(),
        pa.array(["a", None]),
        pa.array([[1], [2, 3]]),
        pa.array([None, None]),
        pa.array([1.5, np.nan]),
    ]
    record = pa.RecordBatch.from_arrays([random.choice(columns)] * 11, names=[*"abcdefghijk"])
    return _stream_of(record)


def _odd_header(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    payload = bytearray(_encoded(info, frames))
    header_bytes = int.from_bytes(payload[4:8], "little")
    for _ in range(random.randrange(1, 4)):
        width = random.choice([1, 4, 8])
        at = 4 + random.randrange(header_bytes)
        number = random.choice([0, 1, 127, 255, 2**31 - 1, 2**32 - 1, 2**62, 2**63 - 1, 2**64 - 1])
        payload[at : at + width] = (number % 256**width).to_bytes(width, "little")
    return bytes(payload)


def _with_more(random: Random, info: ArrayInfo, frames: FrameBatch) -> bytes:
    return _encoded(info, frames) + random.randbytes(random.choice([1, 8, 4000]))


_BATCHES: list[Callable[[Random, ArrayInfo, FrameBatch], bytes]] = [
    *(_odd_column, _odd_column, _shifted, _shuffled, _other_rows, _other_tiles, _compressed),
    *(_other_schema, _odd_header, _odd_header, _with_more),
]
