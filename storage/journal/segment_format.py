"""Format of a segment: its schema message and batches, and the index beside it.

The index has a record for each batch: its position, its numbers and its CRC-32. A record without
frames ends it: the segment was synced to its end and closed.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.errors import FileFormatError
from devices.types import SEQ_END
from storage.message_batch import MessageBatch
from storage.wire import EncodedBatch, decode_message

INDEX_SUFFIX = ".idx"

RECORD_DTYPE = np.dtype(
    [
        ("seq_first", "<u8"),
        ("t_ns_first", "<i8"),
        ("t_ns_last", "<i8"),
        ("offset", "<u8"),
        ("length", "<u4"),
        ("count", "<u4"),
        ("crc32", "<u4"),
        ("check", "<u4"),
    ]
)
"""Index record of one batch: `crc32` is of the batch's bytes, `check` of the record before it."""

_CHECKED_BYTES = RECORD_DTYPE.itemsize - 4
_PACKED = struct.Struct("<QqqQIII")
_OFFSET_END = 1 << 62

Records = npt.NDArray[np.void]


def encode_index_record(message: EncodedBatch, offset: int) -> bytes:
    """Return the index record of a batch as bytes."""
    return _pack_with_checksum(
        message.seq_first,
        message.t_ns_first,
        message.t_ns_last,
        offset,
        len(message.payload),
        message.seq_last - message.seq_first + 1,
        zlib.crc32(message.payload),
    )


def encode_closing_record() -> bytes:
    """Return the record that ends an index, as bytes."""
    return _pack_with_checksum(0, 0, 0, 0, 0, 0, 0)


def seq_range_of(record: Any) -> tuple[int, int]:
    """Return the first and last frame number of a record."""
    first = int(record["seq_first"])
    return first, first + int(record["count"]) - 1


def is_record_valid(record: Any) -> bool:
    """Return whether the record's checksum is right, and its numbers are possible."""
    is_checked = zlib.crc32(record.tobytes()[:_CHECKED_BYTES]) == int(record["check"])
    return is_checked and int(record["seq_first"]) < SEQ_END and int(record["offset"]) < _OFFSET_END


def mask_valid_records(index: Records) -> npt.NDArray[np.bool_]:
    """Return a mask of the records that `is_record_valid` accepts."""
    content = memoryview(np.ascontiguousarray(index).tobytes())
    begins = range(0, len(content), RECORD_DTYPE.itemsize)
    checks = [zlib.crc32(content[at : at + _CHECKED_BYTES]) for at in begins]
    found: npt.NDArray[np.bool_] = np.array(checks, np.uint32) == index["check"]
    return found & (index["seq_first"] < SEQ_END) & (index["offset"] < _OFFSET_END)


def is_index_closed(index: Records) -> bool:
    """Return whether the index marks its segment as closed in order."""
    return bool(len(index)) and is_record_valid(index[-1]) and not index[-1]["count"]


def select_valid_batch_records(index: Records) -> Records:
    """Return the valid records with frames."""
    return index[(index["count"] > 0) & mask_valid_records(index)]


def find_end_offset(records: Records) -> int:
    """Return the offset behind the last of some batches in the segment; 0 without any."""
    return int((records["offset"] + records["length"]).max(initial=0))


def read_index(segment_path: Path) -> Records:
    """Read all records of a segment's index, valid or not; a cut one at its end is skipped.

    Raises:
        OSError: there is none, or it cannot be read.
    """
    content = segment_path.with_suffix(INDEX_SUFFIX).read_bytes()
    return np.frombuffer(content, RECORD_DTYPE, len(content) // RECORD_DTYPE.itemsize)


def read_schema_and_first_offset(path: Path) -> tuple[pa.Schema | None, int]:
    """Read a segment's schema and the offset of its first batch; None and 0 if it is cut off.

    Raises:
        OSError: there is no such file.
    """
    with pa.OSFile(str(path), "r") as file:
        try:
            return pa.ipc.read_schema(pa.ipc.read_message(file)), file.tell()
        except (pa.ArrowException, EOFError, OSError):
            return None, 0


def read_messages_until_damage(
    path: Path, begin_offset: int, schema: pa.Schema
) -> Iterator[EncodedBatch]:
    """Yield batches from an offset on, up to the first bytes that are not a complete batch.

    Raises:
        OSError: there is no such file.
    """
    with pa.OSFile(str(path), "r") as file:
        while True:
            try:
                file.seek(begin_offset)
                pa.ipc.read_message(file)
                payload = file.read_at(file.tell() - begin_offset, begin_offset)  # type: ignore[call-arg]  # stubs
                message = EncodedBatch.from_frames_and_payload(
                    decode_message(payload, schema), payload
                )
            except (pa.ArrowException, EOFError, OSError, FileFormatError):
                return
            yield message
            begin_offset += len(payload)


def read_verified_payload(descriptor: int, record: Any) -> bytes | None:
    """Read a batch's bytes from an open segment; None if their CRC-32 is wrong.

    Args:
        descriptor: the segment.
        record: index record of the batch.

    Raises:
        OSError: they cannot be read.
    """
    payload = os.pread(descriptor, int(record["length"]), int(record["offset"]))
    whole = len(payload) == record["length"] and zlib.crc32(payload) == record["crc32"]
    return payload if whole else None


def make_message_batch(records: Records, content: bytes) -> MessageBatch:
    """Combine index records and bytes into a batch of messages to decode at once.

    Args:
        records: index records in order of their frames.
        content: bytes of the batches, in the same order.
    """
    columns = (records[name] for name in ("length", "seq_first", "count", "crc32"))
    return MessageBatch(content, *columns)


def _pack_with_checksum(*values: int) -> bytes:
    # `struct` takes a tenth of the time of filling in an array of one record.
    content = _PACKED.pack(*values)
    return content + zlib.crc32(content).to_bytes(4, "little")
