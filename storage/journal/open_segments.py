"""Segments of one journal that are being written, or wait to be closed.

Frames may come out of order, newest first and then the backlog: two segments are open, and each
accepts only frames after its last one, so that within a file time never runs back.
"""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path

from devices.errors import StorageError
from storage.durable import check_held, storage_errors, sync_folder
from storage.journal.segment import SUFFIX
from storage.journal.segment_writer import SegmentWriter
from storage.wire import EncodedBatch

SEGMENT_NS = 60_000_000_000
"""Longest segment: a minute of frames, since only complete segments are deleted."""
_OPEN_MAX = 2


class OpenSegments:
    """Open segments of a journal. One thread appends; `sync` may run in another one.

    Args:
        folder: the journal's folder.
        header: schema message with which a segment begins.
        writes_later: `append` does not write; `write` and `sync` do, in any thread.
    """

    def __init__(self, folder: Path, header: bytes, *, writes_later: bool) -> None:
        self._folder = folder
        self._header = header
        self._writes_later = writes_later
        self._open: list[SegmentWriter] = []
        self._closing: list[SegmentWriter] = []
        self._has_new_names = False
        self._lock = threading.Lock()
        """Guards the lists; never locked during disk I/O."""

    @property
    def paths(self) -> set[Path]:
        """Files that are open or not closed yet."""
        with self._lock:
            return {writer.segment.path for writer in (*self._open, *self._closing)}

    @property
    def is_closing(self) -> bool:
        """True if the next sync closes a file."""
        return bool(self._closing)

    def append(self, message: EncodedBatch) -> SegmentWriter:
        """Append a batch to the segment where it fits; all of it, or none.

        Raises:
            StorageError: the disk is full or not writable.
        """
        writer = self._writer_for(message.seq_first, message.t_ns_first)
        try:
            with storage_errors(writer.segment.path):
                writer.append(message)
        except StorageError:
            # The end of the file is unknown now: the next batch begins another file.
            self._retire(writer)
            raise
        return writer

    def write(self) -> None:
        """Return when all earlier batches are in the files.

        Raises:
            StorageError: the disk is full or not writable; the batches go on waiting.
        """
        with self._lock:
            writers = [*self._open, *self._closing]
        with storage_errors(self._folder):
            for writer in writers:
                # A segment that is closed meanwhile is written completely, or its sync has failed:
                # then its waiting batches were not acknowledged, and are requested again.
                with suppress(ValueError):
                    writer.write()

    def sync(self) -> None:
        """Return when all earlier batches are on the disk.

        Raises:
            StorageError: the disk refused.
        """
        with self._lock:
            closing, self._closing = self._closing, []
            writers = [writer for writer in self._open if writer.has_news]
            has_new_names, self._has_new_names = self._has_new_names, False
        failed: OSError | None = None
        for writer in closing:
            try:
                writer.close()
            except OSError as error:
                failed = error
        with storage_errors(self._folder):
            for writer in writers:
                # A segment that is closed meanwhile was synced when it was closed.
                with suppress(ValueError):
                    writer.sync()
            if has_new_names:
                sync_folder(self._folder)
            if failed is not None:
                raise failed

    def retire_all(self) -> None:
        """Stop appending to these segments; the next sync closes them."""
        with self._lock:
            self._closing += self._open
            self._open = []

    def abandon(self) -> None:
        """Close all files as they are: they are about to be deleted."""
        with self._lock:
            writers = [*self._open, *self._closing]
            self._open, self._closing, self._has_new_names = [], [], False
        for writer in writers:
            writer.abandon()

    def _writer_for(self, seq_first: int, t_ns: int) -> SegmentWriter:
        """Return the open segment that ends last before these frames, or a new one."""
        fitting = [w for w in self._open if w.segment.span[1] < seq_first]
        if fitting:
            writer = max(fitting, key=lambda w: w.segment.span[1])
            if t_ns - writer.segment.t_ns_first < SEGMENT_NS:
                return writer
            self._retire(writer)
        if len(self._open) >= _OPEN_MAX:
            self._retire(self._open[0])
        # After a failed write the name may be taken.
        path = self._folder / f"{seq_first:020d}{SUFFIX}"
        suffix_number = 1
        while path.exists():
            path = self._folder / f"{seq_first:020d}-{suffix_number}{SUFFIX}"
            suffix_number += 1
        check_held(path)
        with storage_errors(path):
            writer = SegmentWriter(path, self._header, writes_later=self._writes_later)
        with self._lock:
            self._open.append(writer)
            self._has_new_names = True
        return writer

    def _retire(self, writer: SegmentWriter) -> None:
        """Stop appending to this segment; the next sync closes it."""
        with self._lock:
            self._open.remove(writer)
            if writer.segment.held:
                self._closing.append(writer)
                return
        writer.abandon()
        with suppress(OSError):
            writer.segment.delete()
