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
from storage.journal.segment_format import INDEX_SUFFIX, closing_record, end_of, record_of
from storage.wire import EncodedBatch

_WAITING_MAX_BYTES = 4 << 20
"""Upper limit of bytes that wait in memory: beyond it the appending thread waits for the disk."""


class SegmentWriter:
    """Writer that appends to a new segment. Batches may be promised only after `sync`.

    Args:
        path: the file, which must not exist.
        header: its schema message.
        writes_later: appended batches wait in memory for `write` or `sync`, in any thread. Even to
            query a file's end may wait until the disk has taken what another thread is syncing.

    Raises:
        OSError: it cannot be created; no file is left behind.
    """

    def __init__(self, path: Path, header: bytes, *, writes_later: bool = False) -> None:
        self.segment = Segment(path)
        self.has_news = True
        """True if any appended batch is not synced."""
        self._writes_later = writes_later
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
            write_all(self._data, header)
        except OSError:
            self.abandon()
            self.segment.delete()
            raise

    def append(self, message: EncodedBatch) -> None:
        """Append a batch and its record; all of it, or none.

        Raises:
            OSError: the disk is full or refuses it.
        """
        record = record_of(message, self._end)
        if self._writes_later and self._end - self._written < _WAITING_MAX_BYTES:
            self._waiting.append((message.payload, record))
        else:
            with self._writing:
                self._write_waiting()
                self._put(message.payload, record)
        self._end += len(message.payload)
        self.has_news = True
        self.segment.note(message)

    def write(self) -> None:
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
        self.has_news = False
        try:
            self.write()
            os.fsync(self._data.fileno())
            os.fsync(self._index.fileno())
            # A file that was moved or deleted accepts writes, too, but under another name or none.
            there, ours = os.stat(self.segment.path), os.fstat(self._data.fileno())
            if (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino):
                raise FileNotFoundError(errno.ENOENT, "another file is in its place")
        except OSError:
            self.has_news = True
            raise

    def close(self) -> None:
        """Sync, and mark the index as closed, so that the segment need not be checked again.

        Raises:
            OSError: the disk failed.
        """
        try:
            self.sync()
            if self.segment.is_doubtful:
                self._forget_doubtful()
                return
            with suppress(OSError):  # without it the batches are checked at the next open
                write_all(self._index, closing_record())
                os.fsync(self._index.fileno())
        finally:
            self.abandon()

    def _forget_doubtful(self) -> None:
        """Remove invalidated batches: they were written again elsewhere."""
        with suppress(OSError, StorageError):
            records = self.segment.records()
            if not len(records):
                self.segment.delete()
                return
            self._data.truncate(end_of(records))
            os.fsync(self._data.fileno())
            self.segment.rewrite_index()

    def abandon(self) -> None:
        """Close the files without a sync."""
        self._data.close()
        self._index.close()

    def _write_waiting(self) -> None:
        waiting = self._waiting[:]  # more may be appended meanwhile
        if waiting:
            self._put(
                b"".join(data for data, _ in waiting), b"".join(index for _, index in waiting)
            )
            del self._waiting[: len(waiting)]

    def _put(self, data: bytes, records: bytes) -> None:
        self._data.seek(self._written)
        write_all(self._data, data)
        try:
            write_all(self._index, records)
        except OSError:
            with suppress(OSError):
                self._data.truncate(self._written)
            raise
        self._written += len(data)


def write_all(file: BinaryIO, data: bytes) -> None:
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
