"""How a segment is read: its schema message and batches, and the index beside it.

The index has a record for each batch: where it is, which frames it holds, and its CRC-32. A record
without frames ends it: the segment was synced to its end and closed.
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
from devices.facts import SEQ_END
from storage.run import Run
from storage.wire import EncodedBatch, decode

INDEX_SUFFIX = ".idx"

RECORD = np.dtype(
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
"""One batch in the index: `crc32` is of its bytes, `check` of this record before it."""

_CHECKED = RECORD.itemsize - 4
_PACKED = struct.Struct("<QqqQIII")
_OFFSET_END = 1 << 62

Records = npt.NDArray[np.void]


def record_of(message: EncodedBatch, offset: int) -> bytes:
    """The index record of a batch."""
    return _sealed(
        message.seq_first,
        message.t_ns_first,
        message.t_ns_last,
        offset,
        len(message.payload),
        message.seq_last - message.seq_first + 1,
        zlib.crc32(message.payload),
    )


def closing_record() -> bytes:
    """The record that ends an index."""
    return _sealed(0, 0, 0, 0, 0, 0, 0)


def numbers(record: Any) -> tuple[int, int]:
    """First and last frame of a record with frames."""
    first = int(record["seq_first"])
    return first, first + int(record["count"]) - 1


def is_whole(record: Any) -> bool:
    """Is the record what was written? No writer of ours gives numbers that no stream reaches."""
    is_checked = zlib.crc32(record.tobytes()[:_CHECKED]) == int(record["check"])
    return is_checked and int(record["seq_first"]) < SEQ_END and int(record["offset"]) < _OFFSET_END


def are_whole(index: Records) -> npt.NDArray[np.bool_]:
    """Which records are what was written?"""
    content = memoryview(np.ascontiguousarray(index).tobytes())
    begins = range(0, len(content), RECORD.itemsize)
    checks = [zlib.crc32(content[at : at + _CHECKED]) for at in begins]
    found: npt.NDArray[np.bool_] = np.array(checks, np.uint32) == index["check"]
    return found & (index["seq_first"] < SEQ_END) & (index["offset"] < _OFFSET_END)


def is_closed(index: Records) -> bool:
    """Does it say that its segment was closed in order?"""
    return bool(len(index)) and is_whole(index[-1]) and not index[-1]["count"]


def batches_in(index: Records) -> Records:
    """Its whole records with frames."""
    return index[(index["count"] > 0) & are_whole(index)]


def end_of(index: Records) -> int:
    """Where the last of some batches ends in the segment; 0 without any."""
    return int((index["offset"] + index["length"]).max(initial=0))


def read_index(path: Path) -> Records:
    """All records of a segment's index, right or not; a cut one at its end is left out.

    Raises:
        OSError: there is none, or it cannot be read.
    """
    content = path.with_suffix(INDEX_SUFFIX).read_bytes()
    return np.frombuffer(content, RECORD, len(content) // RECORD.itemsize)


def read_header(path: Path) -> tuple[pa.Schema | None, int]:
    """Schema of a segment, and where its first batch begins; None and 0 if the schema is cut off.

    Raises:
        OSError: there is no such file.
    """
    with pa.OSFile(str(path), "r") as file:
        try:
            return pa.ipc.read_schema(pa.ipc.read_message(file)), file.tell()
        except (pa.ArrowException, EOFError, OSError):
            return None, 0


def messages_from(path: Path, begin: int, schema: pa.Schema) -> Iterator[EncodedBatch]:
    """Batches from a position on, up to the first bytes that are not a whole batch.

    Raises:
        OSError: there is no such file.
    """
    with pa.OSFile(str(path), "r") as file:
        while True:
            try:
                file.seek(begin)
                pa.ipc.read_message(file)
                payload = file.read_at(file.tell() - begin, begin)  # type: ignore[call-arg]  # stubs
                message = EncodedBatch.of(decode(payload, schema), payload)
            except (pa.ArrowException, EOFError, OSError, FileFormatError):
                return
            yield message
            begin += len(payload)


def payload_of(descriptor: int, record: Any) -> bytes | None:
    """A batch's bytes from an open segment; None if they are not the ones that were written.

    Args:
        descriptor: the segment.
        record: of the batch, in the index.

    Raises:
        OSError: they cannot be read.
    """
    payload = os.pread(descriptor, int(record["length"]), int(record["offset"]))
    whole = len(payload) == record["length"] and zlib.crc32(payload) == record["crc32"]
    return payload if whole else None


def run_of(records: Records, content: bytes) -> Run:
    """Batches that are to be read at once.

    Args:
        records: in order of their frames.
        content: their bytes, in the same order.
    """
    columns = (records[name] for name in ("length", "seq_first", "count", "crc32"))
    return Run(content, *columns)


def _sealed(*values: int) -> bytes:
    # Packed, which takes a tenth of the time of filling in an array of one.
    content = _PACKED.pack(*values)
    return content + zlib.crc32(content).to_bytes(4, "little")
