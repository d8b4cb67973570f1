"""Writer of one segment of a journal: batches to its file, their records to the index beside it.

Frames may come out of order, newest first and then the backlog: two segments are open, and each
accepts only frames after its last one, so that within a file time never runs back.
"""

from __future__ import annotations

import errno
import os
import threading
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from devices.errors import StorageError
from storage.durable_files import raise_if_locked_folder_gone, sync_folder, translate_storage_errors
from storage.journal.segment import (
    INDEX_SUFFIX,
    SUFFIX,
    Segment,
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
        """Append a batch and its record, completely or not at all.

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


SEGMENT_DURATION_NS = 60_000_000_000
"""Longest segment: a minute of frames, since only complete segments are deleted."""
_MAX_OPEN_SEGMENTS = 2


class OpenSegments:
    """Open segments of a journal. One thread appends; `sync` may run in another one.

    Args:
        folder: the journal's folder.
        header: schema message with which a segment begins.
        is_write_deferred: `append` does not write; `write_waiting` and `sync` do, in any thread.
    """

    def __init__(self, folder: Path, header: bytes, *, is_write_deferred: bool) -> None:
        self._folder = folder
        self._header = header
        self._writes_later = is_write_deferred
        self._open: list[SegmentWriter] = []
        self._closing: list[SegmentWriter] = []
        self._has_new_names = False
        self._lock = threading.Lock()
        """Guards the lists; never locked during disk I/O."""

    @property
    def unclosed_paths(self) -> set[Path]:
        """Files that are open or not closed yet."""
        with self._lock:
            return {writer.segment.path for writer in (*self._open, *self._closing)}

    @property
    def has_segment_to_close(self) -> bool:
        """True if the next sync closes a file."""
        return bool(self._closing)

    def append(self, message: EncodedBatch) -> SegmentWriter:
        """Append a batch to the segment where it fits, completely or not at all.

        Raises:
            StorageError: the disk is full or not writable.
        """
        writer = self._get_writer(message.seq_first, message.t_ns_first)
        try:
            with translate_storage_errors(writer.segment.path):
                writer.append(message)
        except StorageError:
            # The end of the file is unknown now: the next batch begins another file.
            self._retire(writer)
            raise
        return writer

    def write_waiting(self) -> None:
        """Return when all earlier batches are in the files.

        Raises:
            StorageError: the disk is full or not writable; the batches go on waiting.
        """
        with self._lock:
            writers = [*self._open, *self._closing]
        with translate_storage_errors(self._folder):
            for writer in writers:
                # A segment that is closed meanwhile is written completely, or its sync has failed:
                # then its waiting batches were not acknowledged, and are requested again.
                with suppress(ValueError):
                    writer.write_waiting()

    def sync(self) -> None:
        """Return when all earlier batches are on the disk.

        Raises:
            StorageError: the disk refused.
        """
        with self._lock:
            closing, self._closing = self._closing, []
            writers = [writer for writer in self._open if writer.has_unsynced]
            has_new_names, self._has_new_names = self._has_new_names, False
        failed: OSError | None = None
        for writer in closing:
            try:
                writer.close()
            except OSError as error:
                failed = error
        with translate_storage_errors(self._folder):
            for writer in writers:
                # A segment that is closed meanwhile was synced when it was closed.
                with suppress(ValueError):
                    writer.sync()
            if has_new_names:
                sync_folder(self._folder)
            if failed is not None:
                raise failed

    def close_segments_at_next_sync(self) -> None:
        """Stop appending to these segments; the next sync closes them."""
        with self._lock:
            self._closing += self._open
            self._open = []

    def close_without_sync(self) -> None:
        """Close all files as they are: they are about to be deleted."""
        with self._lock:
            writers = [*self._open, *self._closing]
            self._open, self._closing, self._has_new_names = [], [], False
        for writer in writers:
            writer.close_without_sync()

    def _get_writer(self, seq_first: int, t_ns: int) -> SegmentWriter:
        """Return the open segment that ends last before these frames, or a new one."""
        fitting = [w for w in self._open if w.segment.seq_range[1] < seq_first]
        if fitting:
            writer = max(fitting, key=lambda w: w.segment.seq_range[1])
            if t_ns - writer.segment.t_ns_first < SEGMENT_DURATION_NS:
                return writer
            self._retire(writer)
        if len(self._open) >= _MAX_OPEN_SEGMENTS:
            self._retire(self._open[0])
        # After a failed write the name may be taken.
        path = self._folder / f"{seq_first:020d}{SUFFIX}"
        suffix_number = 1
        while path.exists():
            path = self._folder / f"{seq_first:020d}-{suffix_number}{SUFFIX}"
            suffix_number += 1
        raise_if_locked_folder_gone(path)
        with translate_storage_errors(path):
            writer = SegmentWriter(path, self._header, is_write_deferred=self._writes_later)
        with self._lock:
            self._open.append(writer)
            self._has_new_names = True
        return writer

    def _retire(self, writer: SegmentWriter) -> None:
        """Stop appending to this segment; the next sync closes it."""
        with self._lock:
            self._open.remove(writer)
            if writer.segment.stored:
                self._closing.append(writer)
                return
        writer.close_without_sync()
        with suppress(OSError):
            writer.segment.delete_files()
