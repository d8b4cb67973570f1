"""Writes one segment of a journal: batches to its file, their records to the index beside it."""

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
"""More than that does not wait in memory: the disk is far behind, and who appends waits for it."""


class SegmentWriter:
    """Appends to a new segment. Nothing is synced here: what is promised needs `sync` first.

    Args:
        path: the file, which must not be there.
        header: its schema message.
        writes_later: what is appended waits in memory for `write` or `sync`, in whatever thread. To
            write to a file, or only to ask where it ends, may wait until the disk has taken what
            another thread is syncing.

    Raises:
        OSError: it cannot be made; nothing is left behind then.
    """

    def __init__(self, path: Path, header: bytes, *, writes_later: bool = False) -> None:
        self.segment = Segment(path)
        self.has_news = True
        """Is anything not synced?"""
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
        """Take a batch and its record; all of it, or none.

        Raises:
            OSError: the disk is full or does not take it.
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
        """Return when all that was appended before is in the files.

        Raises:
            OSError: the disk is full or does not take it; it goes on waiting.
        """
        with self._writing:
            self._write_waiting()

    def sync(self) -> None:
        """Return when all that was appended before is on the disk.

        Raises:
            OSError: the disk refused; what it holds of this segment is not known then.
        """
        self.has_news = False
        try:
            self.write()
            os.fsync(self._data.fileno())
            os.fsync(self._index.fileno())
            # A file that was moved or deleted takes what is written, too, and keeps it for nobody.
            there, ours = os.stat(self.segment.path), os.fstat(self._data.fileno())
            if (there.st_dev, there.st_ino) != (ours.st_dev, ours.st_ino):
                raise FileNotFoundError(errno.ENOENT, "another file is in its place")
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
                write_all(self._index, closing_record())
                os.fsync(self._index.fileno())
        finally:
            self.abandon()

    def _forget_doubtful(self) -> None:
        """Keep only the batches that count: those disowned were written again elsewhere."""
        with suppress(OSError, StorageError):
            records = self.segment.records()
            if not len(records):
                self.segment.delete()
                return
            self._data.truncate(end_of(records))
            os.fsync(self._data.fileno())
            self.segment.rewrite_index()

    def abandon(self) -> None:
        """Close the files as they are."""
        self._data.close()
        self._index.close()

    def _write_waiting(self) -> None:
        waiting = self._waiting[:]  # more may come meanwhile, behind it
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
