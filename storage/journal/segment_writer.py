"""Writer of one segment of a journal: batches to its file, their records to the index beside it."""

from __future__ import annotations

import errno
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from devices.errors import StorageError
from storage.journal.segment import Segment
from storage.journal.segment_format import (
    INDEX_SUFFIX,
    encode_closing_record,
    encode_index_record,
    find_end_offset,
)
from storage.wire import EncodedBatch

_MAX_WAITING_BYTES = 4 << 20
"""Upper limit of bytes that wait in memory: beyond it the appending thread waits for the disk."""


class SegmentWriter:
    """Writer that appends to a new segment. Batches may be promised only after `sync`.

    Args:
        path: the file, which must not exist.
        header: its schema message.
        is_write_deferred: appended batches wait in memory for `write_waiting` or `sync`, in any
            thread. Even to query a file's end may wait until the disk has taken what another
            thread is syncing.

    Raises:
        OSError: it cannot be created; no file is left behind.
    """

    def __init__(self, path: Path, header: bytes, *, is_write_deferred: bool = False) -> None:
        self.segment = Segment(path)
        self.has_unsynced = True
        """True if any appended batch is not synced."""
        self._writes_later = is_write_deferred
        self._waiting: list[tuple[bytes, bytes]] = []
        self._writing = threading.Lock()
        self._end = self._written = len(header)
        self._data: BinaryIO = path.open("xb", buffering=0)
        try:
            self._index: BinaryIO = path.with_suffix(INDEX_SUFFIX).open("wb", buffering=0)
        except OSError:
            self._data.close()
            path.unlink(missing_ok=True)
            raise
        try:
            write_all_or_none(self._data, header)
        except OSError:
            self.close_without_sync()
            self.segment.delete_files()
            raise

    def append(self, message: EncodedBatch) -> None:
        """Append a batch and its record; all of it, or none.

        Raises:
            OSError: the disk is full or refuses it.
        """
        record = encode_index_record(message, self._end)
        if self._writes_later and self._end - self._written < _MAX_WAITING_BYTES:
            self._waiting.append((message.payload, record))
        else:
            with self._writing:
                self._write_waiting()
                self._write_bytes(message.payload, record)
        self._end += len(message.payload)
        self.has_unsynced = True
        self.segment.register_message(message)

    def write_waiting(self) -> None:
        """Return when all earlier batches are in the files.

        Raises:
            OSError: the disk is full or refuses them; they go on waiting.
        """
        with self._writing:
            self._write_waiting()

    def sync(self) -> None:
        """Return when all earlier batches are on the disk.

        Raises:
            OSError: the disk failed; the segment's content on disk is unknown then.
        """
        self.has_unsynced = False
        try:
            self.write_waiting()
            os.fsync(self._data.fileno())
            os.fsync(self._index.fileno())
            # A file that was moved or deleted accepts writes, too, but under another name or none.
            there, ours = os.stat(self.segment.path), os.fstat(self._data.fileno())
            if (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino):
                raise FileNotFoundError(errno.ENOENT, "another file is in its place")
        except OSError:
            self.has_unsynced = True
            raise

    def close(self) -> None:
        """Sync, and mark the index as closed, so that the segment need not be checked again.

        Raises:
            OSError: the disk failed.
        """
        try:
            self.sync()
            if self.segment.has_invalidated_frames:
                self._drop_invalidated()
                return
            with suppress(OSError):  # without it the batches are checked at the next open
                write_all_or_none(self._index, encode_closing_record())
                os.fsync(self._index.fileno())
        finally:
            self.close_without_sync()

    def _drop_invalidated(self) -> None:
        """Remove invalidated batches: they were written again elsewhere."""
        with suppress(OSError, StorageError):
            records = self.segment.read_stored_batch_records()
            if not len(records):
                self.segment.delete_files()
                return
            self._data.truncate(find_end_offset(records))
            os.fsync(self._data.fileno())
            self.segment.rewrite_and_close_index()

    def close_without_sync(self) -> None:
        """Close the files without a sync."""
        self._data.close()
        self._index.close()

    def _write_waiting(self) -> None:
        waiting = self._waiting[:]  # more may be appended meanwhile
        if waiting:
            self._write_bytes(
                b"".join(data for data, _ in waiting), b"".join(index for _, index in waiting)
            )
            del self._waiting[: len(waiting)]

    def _write_bytes(self, data: bytes, records: bytes) -> None:
        self._data.seek(self._written)
        write_all_or_none(self._data, data)
        try:
            write_all_or_none(self._index, records)
        except OSError:
            with suppress(OSError):
                self._data.truncate(self._written)
            raise
        self._written += len(data)


def write_all_or_none(file: BinaryIO, data: bytes) -> None:
    """Write all of `data`, or leave the file at its old length."""
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
