"""Segment: one file of a journal, with a schema message and then batches as they came.

Beside it lies an index: for each batch its position, its numbers and its CRC-32, because Arrow does
not notice a flipped bit, nor a page that a power cut left empty. A batch without an index record
was never promised to a server or a session. A missing index is rebuilt.

The index has a record for each batch: its position, its numbers and its CRC-32. A record without
frames ends it: the segment was synced to its end and closed.
"""

from __future__ import annotations

import os
import stat
import struct
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count, islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.arrays import Bools
from devices.errors import DamagedFileError, FileFormatError, StorageError
from devices.types import SEQ_END
from storage.durable_files import try_set_aside_and_describe, write_atomically
from storage.intervals import Intervals, union
from storage.wire import EncodedBatch, MessageBatch, decode_message

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


def is_record_intact(record: Any) -> bool:
    """Return whether the record's checksum is right, and its numbers are possible."""
    is_checked = zlib.crc32(record.tobytes()[:_CHECKED_BYTES]) == int(record["check"])
    return is_checked and int(record["seq_first"]) < SEQ_END and int(record["offset"]) < _OFFSET_END


def mask_intact_records(index: Records) -> Bools:
    """Return a mask of the records that `is_record_intact` accepts."""
    content = memoryview(np.ascontiguousarray(index).tobytes())
    begins = range(0, len(content), RECORD_DTYPE.itemsize)
    checks = [zlib.crc32(content[at : at + _CHECKED_BYTES]) for at in begins]
    found: Bools = np.array(checks, np.uint32) == index["check"]
    return found & (index["seq_first"] < SEQ_END) & (index["offset"] < _OFFSET_END)


def is_index_closed(index: Records) -> bool:
    """Return whether the index marks its segment as closed in order."""
    return bool(len(index)) and is_record_intact(index[-1]) and not index[-1]["count"]


def select_batch_records_by_checksum(index: Records) -> Records:
    """Return the valid records with frames."""
    return index[(index["count"] > 0) & mask_intact_records(index)]


def find_end_offset(records: Records) -> int:
    """Return the offset behind the last of some batches in the segment; 0 without any."""
    return int((records["offset"] + records["length"]).max(initial=0))


def read_existing_index(segment_path: Path) -> Records:
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


SUFFIX = ".arrows"
UNREAD_SUFFIX = ".unread"


@dataclass
class Segment:
    """File of batches, and which of its frames count.

    Attributes:
        path: the file; its index has the same name with another suffix.
        stored: numbers of its frames, without invalidated ones and those of other segments.
        t_ns_first: instant of its oldest frame, in the node's UTC.
        t_ns_last: instant of its newest frame.
        size_bytes: length of both files.
    """

    path: Path
    stored: Intervals = field(default_factory=Intervals)
    t_ns_first: int = 0
    t_ns_last: int = 0
    size_bytes: int = 0
    has_invalidated_frames: bool = False
    """True: frames were invalidated while it was written, so it is checked when it is opened."""

    @property
    def seq_range(self) -> tuple[int, int]:
        """First and last number."""
        intervals = list(self.stored)
        return intervals[0][0], intervals[-1][1]

    def register_records(self, records: Records) -> None:
        """Add the numbers, times and size of batches in the file."""
        self.stored.add_ranges(records["seq_first"], records["count"])
        if len(records):
            begin, end = int(records["t_ns_first"].min()), int(records["t_ns_last"].max())
            self._extend(begin, end, int(records["length"].sum()) + records.nbytes)

    def register_message(self, message: EncodedBatch) -> None:
        """Add the numbers, times and size of one written batch; faster than `register_records`."""
        self.stored.add(message.seq_first, message.seq_last)
        size_bytes = len(message.payload) + RECORD_DTYPE.itemsize
        self._extend(message.t_ns_first, message.t_ns_last, size_bytes)

    def _extend(self, t_ns_first: int, t_ns_last: int, size_bytes: int) -> None:
        fresh = not self.size_bytes
        self.t_ns_first = t_ns_first if fresh else min(self.t_ns_first, t_ns_first)
        self.t_ns_last = t_ns_last if fresh else max(self.t_ns_last, t_ns_last)
        self.size_bytes += size_bytes

    def read_stored_batch_records(self) -> Records:
        """Read the valid index records of the stored batches, in order of their frames.

        Raises:
            StorageError: the index cannot be read.
        """
        try:
            found = select_batch_records_by_checksum(read_existing_index(self.path))
        except OSError as error:
            raise StorageError(
                f"cannot be read: {error}", where=str(self.path), errno=error.errno
            ) from error
        found = found[self.stored.contains_ranges(found["seq_first"], found["count"])]
        return found[np.argsort(found["seq_first"], kind="stable")]

    def invalidate_batches_wholly_within_in_memory(self, doubtful_numbers: Intervals) -> None:
        """Remove batches within these numbers from `stored`, also ones not in the index.

        The file under its name may be a copy that was made before they were written.
        """
        records: Records | tuple[()] = ()
        with suppress(StorageError):  # gone, or no descriptor is left
            records = self.read_stored_batch_records()
        batches = [Intervals([seq_range_of(record)]) for record in records]
        self.stored = (self.stored - doubtful_numbers) | union(
            b for b in batches if b - doubtful_numbers
        )

    def rewrite_and_close_index(self) -> None:
        """Write an index of only the batches that count, and mark it as closed.

        Raises:
            StorageError: the disk is full or not writable; the old index is still there then.
        """
        _write_index(self.path, self.read_stored_batch_records())

    def delete_files(self) -> None:
        """Delete the segment and its index.

        Raises:
            OSError: they cannot be deleted.
        """
        # The index first: a segment without index is recovered, an index without segment is not.
        self.path.with_suffix(INDEX_SUFFIX).unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)


def set_aside_irregular_or_forbidden_files(folder: Path) -> list[str]:
    """Set aside segments and indexes that are no regular files or not readable.

    Returns:
        Messages with the files found and their new places.
    """
    problems = []
    for path in sorted((*folder.glob("*" + SUFFIX), *folder.glob("*" + INDEX_SUFFIX))):
        is_file = stat.S_ISREG(path.lstat().st_mode)
        if not is_file or not os.access(path, os.R_OK):
            what = "it cannot be read" if is_file else "it is not a file"
            problems.append(
                try_set_aside_and_describe(path, DamagedFileError(what, where=str(path)))
            )
    return problems


def make_free_unread_path(path: Path) -> Path:
    """Return a free path beside a segment for its unreadable bytes."""
    existing = {each.name for each in path.parent.iterdir()}
    names = (f"{path.stem}{f'.{n}' if n > 1 else ''}{UNREAD_SUFFIX}" for n in count(1))
    return path.with_name(next(name for name in names if name not in existing))


class RecoveredSegment(NamedTuple):
    """Segment of a journal after a restart."""

    segment: Segment | None
    """None: no batch in it was complete, and it is deleted."""
    damaged: Intervals
    """Numbers of its damaged frames."""
    had_batches: bool
    """True if batches were written to it; False: its process was killed just after creating it."""


def recover_or_delete_segment(path: Path, schema: pa.Schema) -> RecoveredSegment:
    """Open an existing segment; delete it if no batch in it is complete.

    Bytes without an index record are moved to a file beside it, not discarded: most often they are
    a message that was cut. A segment that was closed in order is not read through: its batches are
    checked when they are read.

    Raises:
        OSError: it cannot be read or truncated.
        StorageError: its index, or the bytes that are moved, cannot be written.
    """
    size = path.stat().st_size
    damaged, doubtful = Intervals(), Intervals()
    _, end = read_schema_and_first_offset(path)
    try:
        index = read_existing_index(path)
    except FileNotFoundError:
        index = _rebuild_index(path, end, schema)
    else:
        batches = select_batch_records_by_checksum(index)
        was_closed = is_index_closed(index) and len(batches) == len(index) - 1
        if was_closed and len(batches) and find_end_offset(batches) == size:
            segment = Segment(path)
            segment.register_records(batches)
            return RecoveredSegment(segment, damaged, had_batches=True)
    good = []
    read: dict[int, EncodedBatch | None] = {}
    with path.open("rb") as file:
        for record in index:
            if not is_record_intact(record) and end not in read:
                read[end] = next(read_messages_until_damage(path, end, schema), None)
            found = _verify_record(file.fileno(), record, end, read.get(end))
            if found is None and is_record_intact(record):
                doubtful.add(*seq_range_of(record))
            elif found is not None:
                # Damage followed by a good batch happened after writing; a damaged end of an
                # unclosed file was never promised.
                damaged, doubtful = damaged | doubtful, Intervals()
                if found["count"]:
                    good.append(found)
                    end = max(end, int(found["offset"]) + int(found["length"]))
        if end < size:
            file.seek(end)
            # All or no file: on a full disk recovery is retried again and again.
            write_atomically(make_free_unread_path(path), file.read())
    segment = Segment(path)
    if not good:
        index_path = path.with_suffix(INDEX_SUFFIX)
        had_batches = index_path.exists() and (
            index_path.stat().st_size > 0
            or len(list(islice(read_messages_until_damage(path, end, schema), 2))) > 1
        )
        segment.delete_files()
        return RecoveredSegment(None, damaged, had_batches)
    records = np.array(good, RECORD_DTYPE)
    segment.register_records(records)
    os.truncate(path, end)
    # A killed process leaves frames that only the kernel has; from now on they are promised.
    with path.open("rb") as file:
        os.fsync(file.fileno())
    _write_index(path, records)
    return RecoveredSegment(segment, damaged, had_batches=True)


def _write_index(path: Path, records: Records) -> None:
    """Replace a segment's index, marked as closed."""
    content = records.tobytes() + encode_closing_record()
    write_atomically(path.with_suffix(INDEX_SUFFIX), content)


def _verify_record(
    descriptor: int, record: Any, end: int, message: EncodedBatch | None
) -> Any | None:
    """Return the record if the batch's bytes match it, repaired if only the record is damaged."""
    if is_record_intact(record):
        is_right = not record["count"] or read_verified_payload(descriptor, record) is not None
        return record if is_right else None
    if message is None or zlib.crc32(message.payload) != record["crc32"]:
        return None
    return np.frombuffer(encode_index_record(message, end), RECORD_DTYPE)[0]


def _rebuild_index(path: Path, begin: int, schema: pa.Schema) -> Records:
    records = bytearray()
    # Without a whole header no bytes after it can be trusted as a batch.
    for message in read_messages_until_damage(path, begin, schema) if begin else ():
        records += encode_index_record(message, begin)
        begin += len(message.payload)
    return np.frombuffer(bytes(records), RECORD_DTYPE)
