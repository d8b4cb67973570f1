"""One file of a journal: a schema message, then batches, each as the bytes in which it came.

Beside it lies an index: for each batch where it is, which frames it holds and its CRC-32, because
Arrow does not notice a flipped bit, nor a page that a power cut left empty. A batch that is not in
the index was never promised to anybody. An index that is missing altogether is made anew.
"""

from __future__ import annotations

import os
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from devices.errors import FileFormatError, StorageError
from storage.durable import write_whole
from storage.intervals import Intervals
from storage.wire import EncodedBatch, decode

SUFFIX = ".arrows"
INDEX_SUFFIX = ".idx"
UNREAD_SUFFIX = ".unread"

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

Records = npt.NDArray[np.void]


@dataclass
class Segment:
    """A file, and which of the frames in it count.

    Attributes:
        path: the file; its index has the same name with another suffix.
        held: numbers of frames. What was disowned, or is in another segment as well, is not there.
        t_ns_first: instant of its oldest frame, in the node's UTC.
        t_ns_last: instant of its newest frame.
        size_bytes: length of both files.
    """

    path: Path
    held: Intervals = field(default_factory=Intervals)
    t_ns_first: int = 0
    t_ns_last: int = 0
    size_bytes: int = 0
    is_doubtful: bool = False
    """Has something in it been disowned while it was written? Then it is checked when opened."""

    @property
    def span(self) -> tuple[int, int]:
        """First and last number."""
        intervals = list(self.held)
        return intervals[0][0], intervals[-1][1]

    def take_in(self, records: Records) -> None:
        """Note batches that are in the file."""
        for record in records:
            first = int(record["seq_first"])
            self.held.add(first, first + int(record["count"]) - 1)
        if len(records):
            begin, end = int(records["t_ns_first"].min()), int(records["t_ns_last"].max())
            fresh = not self.size_bytes
            self.t_ns_first = begin if fresh else min(self.t_ns_first, begin)
            self.t_ns_last = end if fresh else max(self.t_ns_last, end)
            self.size_bytes += int(records["length"].sum()) + records.nbytes

    def records(self) -> Records:
        """Index of the batches that count, in order of their frames.

        Raises:
            OSError: the index cannot be read.
        """
        found = read_index(self.path)
        found = found[[is_whole(record) for record in found]]
        held = [
            bool(record["count"]) and not self.held.missing(*numbers(record)) for record in found
        ]
        found = found[np.array(held, dtype=np.bool_)]
        return found[np.argsort(found["seq_first"], kind="stable")]

    def rewrite_index(self) -> None:
        """Have only what counts in the index, which says that it was closed.

        Raises:
            StorageError: the disk is full or not writable; the old index is still there then.
        """
        closing = _sealed(np.zeros(1, RECORD))
        content = self.records().tobytes() + closing.tobytes()
        write_whole(self.path.with_suffix(INDEX_SUFFIX), content)

    def delete(self) -> None:
        """Delete both files.

        Raises:
            OSError: they cannot be deleted.
        """
        # Who is killed in between leaves a segment, whose index is made anew, and no orphan.
        self.path.with_suffix(INDEX_SUFFIX).unlink(missing_ok=True)
        self.path.unlink(missing_ok=True)


class SegmentWriter:
    """Appends to a new segment. Nothing is synced here: whoever promises anything calls `sync`.

    Args:
        path: the file, which must not be there.
        header: its schema message.

    Raises:
        OSError: it cannot be made; nothing is left behind then.
    """

    def __init__(self, path: Path, header: bytes) -> None:
        self.segment = Segment(path)
        self.has_news = True
        """Is anything not synced?"""
        self._data: BinaryIO = path.open("xb", buffering=0)
        try:
            self._index: BinaryIO = path.with_suffix(INDEX_SUFFIX).open("wb", buffering=0)
        except OSError:
            self._data.close()
            path.unlink(missing_ok=True)
            raise
        try:
            write_all(self._data, header)
        except OSError:
            self.abandon()
            self.segment.delete()
            raise

    def append(self, message: EncodedBatch) -> None:
        """Write a batch and its record; all of it, or none.

        Raises:
            OSError: the disk is full or does not take it.
        """
        offset = self._data.tell()
        record = record_of(message, offset)
        write_all(self._data, message.payload)
        try:
            write_all(self._index, record.tobytes())
        except OSError:
            with suppress(OSError):
                self._data.truncate(offset)
                self._data.seek(offset)
            raise
        self.has_news = True
        self.segment.take_in(record)

    def sync(self) -> None:
        """Return when all that was appended before is on the disk.

        Raises:
            OSError: the disk refused; what it holds of this segment is not known then.
        """
        self.has_news = False
        try:
            os.fsync(self._data.fileno())
            os.fsync(self._index.fileno())
        except OSError:
            self.has_news = True
            raise

    def close(self) -> None:
        """Sync, and note in the index that this segment is whole, so that it need not be checked.

        Raises:
            OSError: the disk refused.
        """
        try:
            self.sync()
            if self.segment.is_doubtful:
                self._forget_doubtful()
                return
            with suppress(OSError):  # without it the batches are checked when it is opened again
                write_all(self._index, _sealed(np.zeros(1, RECORD)).tobytes())
                os.fsync(self._index.fileno())
        finally:
            self.abandon()

    def _forget_doubtful(self) -> None:
        """Have only what counts in the files: what was disowned was written again elsewhere."""
        with suppress(OSError, StorageError):
            records = self.segment.records()
            if not len(records):
                self.segment.delete()
                return
            self._data.truncate(int((records["offset"] + records["length"]).max()))
            os.fsync(self._data.fileno())
            self.segment.rewrite_index()

    def abandon(self) -> None:
        """Close the files as they are."""
        self._data.close()
        self._index.close()


def record_of(message: EncodedBatch, offset: int) -> Records:
    """The index record of a batch: an array of one."""
    record = np.zeros(1, RECORD)
    record["seq_first"] = message.seq_first
    record["t_ns_first"], record["t_ns_last"] = message.t_ns_first, message.t_ns_last
    record["offset"], record["length"] = offset, len(message.payload)
    record["count"] = message.seq_last - message.seq_first + 1
    record["crc32"] = zlib.crc32(message.payload)
    return _sealed(record)


def numbers(record: Any) -> tuple[int, int]:
    """First and last frame of a record with frames."""
    first = int(record["seq_first"])
    return first, first + int(record["count"]) - 1


def is_whole(record: Any) -> bool:
    """Is the record what was written?"""
    return zlib.crc32(record.tobytes()[:_CHECKED]) == int(record["check"])


def read_index(path: Path) -> Records:
    """All whole records of a segment's index, right or not; a cut one at its end is left out.

    Raises:
        OSError: there is none, or it cannot be read.
    """
    content = path.with_suffix(INDEX_SUFFIX).read_bytes()
    return np.frombuffer(content, RECORD, len(content) // RECORD.itemsize)


def payload_of(descriptor: int, record: Any) -> bytes | None:
    """A batch's bytes from an open segment; None if they are not the ones that were written.

    Raises:
        OSError: they cannot be read.
    """
    payload = os.pread(descriptor, int(record["length"]), int(record["offset"]))
    whole = len(payload) == record["length"] and zlib.crc32(payload) == record["crc32"]
    return payload if whole else None


def recover(path: Path, schema: pa.Schema) -> tuple[Segment | None, Intervals]:
    """Take in a segment that is there: what counts in it, and which frames in it are damaged.

    The segment is None, and gone, if there is no whole batch in it. What is not in the index is set
    aside in a file beside it, not thrown away: most often it is a message that was cut. A segment
    that was closed in order is not read through: its batches are checked when they are read.

    Raises:
        OSError: it cannot be read, or not cut.
    """
    size = path.stat().st_size
    damaged, doubtful = Intervals(), Intervals()
    try:
        index = read_index(path)
    except FileNotFoundError:
        index, was_closed = _index_anew(path, schema), False
    else:
        was_closed = _was_closed(index, size)
    good = []
    with path.open("rb") as file:
        end = _header_length(path)
        for record in index:
            found = record if was_closed else _checked(file.fileno(), path, record, end, schema)
            if found is None and is_whole(record):
                doubtful.add(*numbers(record))
            elif found is not None:
                # What is damaged before something whole was damaged later; at the end of a file
                # that was not closed it never was on the disk, and nobody was promised it.
                damaged = damaged | doubtful
                doubtful = Intervals()
                if found["count"]:
                    good.append(found)
                    end = max(end, int(found["offset"]) + int(found["length"]))
        if end < size:
            file.seek(end)
            path.with_suffix(UNREAD_SUFFIX).write_bytes(file.read())
    segment = Segment(path)
    if not good:
        segment.delete()
        return None, damaged
    records = np.array(good, RECORD)
    segment.take_in(records)
    if not was_closed:
        os.truncate(path, end)
        # A killed process leaves frames that only the kernel holds; from now on they are promised.
        with path.open("rb") as file:
            os.fsync(file.fileno())
        closing = _sealed(np.zeros(1, RECORD))
        write_whole(path.with_suffix(INDEX_SUFFIX), records.tobytes() + closing.tobytes())
    return segment, damaged


def write_all(file: BinaryIO, data: bytes) -> None:
    """Write all of `data`, or leave the file as long as it was."""
    begin = file.tell()
    view = memoryview(data)
    try:
        while view:
            view = view[file.write(view) :]
    except OSError:
        with suppress(OSError):
            file.truncate(begin)
            file.seek(begin)
        raise


def _sealed(record: Records) -> Records:
    record["check"] = zlib.crc32(record.tobytes()[:_CHECKED])
    return record


def _was_closed(index: Records, size: int) -> bool:
    """Was it synced to its end, and is it as long as it was then?"""
    if len(index) < 2 or not all(is_whole(record) for record in index) or index[-1]["count"]:
        return False
    return bool((index["offset"] + index["length"]).max() == size)


def _checked(descriptor: int, path: Path, record: Any, end: int, schema: pa.Schema) -> Any | None:
    """The record if the batch's bytes agree with it; mended if only the record was damaged."""
    if is_whole(record):
        if not record["count"]:
            return record
        return record if payload_of(descriptor, record) is not None else None
    found = _message_at(path, end, schema)
    if found is None or zlib.crc32(found.payload) != record["crc32"]:
        return None
    return record_of(found, end)[0]


def _index_anew(path: Path, schema: pa.Schema) -> Records:
    records = []
    end = _header_length(path)
    while end and (found := _message_at(path, end, schema)) is not None:
        records.append(record_of(found, end))
        end += len(found.payload)
    return np.concatenate(records) if records else np.zeros(0, RECORD)


def _header_length(path: Path) -> int:
    """Where the first batch begins; 0 if not even the schema was written."""
    with pa.OSFile(str(path), "r") as file:
        try:
            pa.ipc.read_schema(pa.ipc.read_message(file))
        except (pa.ArrowException, EOFError, OSError):
            return 0
        return file.tell()


def _message_at(path: Path, offset: int, schema: pa.Schema) -> EncodedBatch | None:
    with pa.OSFile(str(path), "r") as file:
        try:
            file.seek(offset)
            pa.ipc.read_message(file)
            payload = os.pread(file.fileno(), file.tell() - offset, offset)
            return EncodedBatch.of(decode(payload, schema), payload)
        except (pa.ArrowException, EOFError, OSError, FileFormatError):
            return None
