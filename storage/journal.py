"""What a server holds of one stream: Arrow IPC stream segments on disk, and an index in memory.

`<folder>/<first_seq>.arrows` begins with the schema message; each batch is appended as the bytes in
which it came. A file cut off anywhere keeps every whole message before the cut, so what was synced
survives a killed process; opening a journal reads the segments again and cuts such a tail away.
Nothing is held twice: a number that is there already is left as it is.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pyarrow as pa

from devices.errors import FileFormatError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from storage.durable import storage_errors, sync_folder
from storage.intervals import Intervals
from storage.schema import array_info, wire_schema
from storage.segment import SUFFIX, Entry, Segment, recover, write_all
from storage.wire import decode, encode

SEGMENT_NS = 60_000_000_000
"""A segment is closed after a minute of frames: what is not needed is deleted by segments."""


class Journal:
    """The frames of one stream (one `boot_id` of one node). One thread writes; any may read.

    Args:
        folder: the stream's own folder; made if absent.
        info: description of the stream's array.
    """

    def __init__(self, folder: Path, info: ArrayInfo) -> None:
        self.folder = folder
        self.info = info
        self.held = Intervals()
        """Numbers that were appended, synced or not."""
        self._schema = wire_schema(info)
        self._segments: list[Segment] = []
        self._file: BinaryIO | None = None
        self._end = 0
        self._tidy = True
        self._sync_failed: StorageError | None = None
        with storage_errors(folder):
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted(folder.glob("*" + SUFFIX)):
                segment = recover(path, self._schema)
                if segment is not None:
                    self._index(segment)

    @classmethod
    def open(cls, folder: Path) -> Journal:
        """A journal that is there already; its description is in its segments.

        Raises:
            FileFormatError: no readable segment in it.
            StorageError: it cannot be read.
        """
        with storage_errors(folder):
            for path in sorted(folder.glob("*" + SUFFIX)):
                with suppress(pa.ArrowException, EOFError, FileFormatError):
                    with pa.OSFile(str(path), "r") as file:
                        schema = pa.ipc.open_stream(file).schema
                    return cls(folder, array_info(schema, where=str(path)))
        raise FileFormatError("no readable journal segment", where=str(folder))

    def append(self, batch: FrameBatch, payload: bytes | None = None) -> Intervals:
        """Hold the frames of `batch` that are not held yet; give back which ones these are.

        Args:
            batch: frames, `seq` rising by one.
            payload: the batch as it came over the wire; else it is encoded here.

        Raises:
            StorageError: the disk is full or not writable. What of the batch could not be written
                is not held then.
        """
        first, last = int(batch.seq[0]), int(batch.seq[-1])
        new = self.held.missing(first, last)
        for a, b in new:
            rows = batch.rows(a - first, b - first + 1)
            whole = (a, b) == (first, last)
            self._write(rows, payload if whole and payload is not None else None)
        return new

    def sync(self) -> None:
        """Return when everything appended before is on the disk; may run in another thread.

        Raises:
            StorageError: the disk refused, now or when a segment was closed since the last sync.
        """
        failed, self._sync_failed = self._sync_failed, None
        if failed is not None:
            raise failed
        file = self._file
        if file is None:
            return
        with storage_errors(self.folder):
            try:
                descriptor = os.dup(file.fileno())
            except ValueError:  # closed meanwhile, and synced before that
                return
            try:
                os.fsync(descriptor)
            finally:
                os.close(descriptor)

    def disown(self, numbers: Intervals) -> None:
        """Hold batches within `numbers` no longer: they could not be synced, and may be lost."""
        for segment in self._segments:
            segment.entries = [
                entry
                for entry in segment.entries
                if numbers.missing(entry.seq_first, entry.seq_last)
            ]
        left = (entry for segment in self._segments for entry in segment.entries)
        self.held = Intervals((entry.seq_first, entry.seq_last) for entry in left)
        self._tidy = False  # go on in a new segment

    def read(self, seq_first: int, seq_last: int) -> Iterator[FrameBatch]:
        """Frames from `seq_first` to `seq_last` that are held, in order, a batch at a time.

        Raises:
            FileFormatError: a batch on disk is damaged.
            StorageError: a segment cannot be read.
        """
        index = sorted(
            (entry.seq_first, segment.path, entry)
            for segment in list(self._segments)
            for entry in list(segment.entries)
            if entry.seq_first <= seq_last and entry.seq_last >= seq_first
        )
        for path, found in groupby(index, key=lambda item: item[1]):
            with storage_errors(path), path.open("rb") as file:
                for _, _, entry in found:
                    payload = os.pread(file.fileno(), entry.length, entry.offset)
                    try:
                        batch = decode(payload, self._schema)
                    except FileFormatError as error:
                        raise FileFormatError(
                            f"the batch at byte {entry.offset} is damaged: {error.what}",
                            where=str(path),
                        ) from error
                    if int(batch.seq[0]) != entry.seq_first or len(batch) != entry.frames:
                        raise FileFormatError(
                            f"the batch at byte {entry.offset} is not the one that was written",
                            where=str(path),
                        )
                    yield batch.rows(
                        max(0, seq_first - entry.seq_first),
                        min(len(batch), seq_last - entry.seq_first + 1),
                    )

    def first_seq_since(self, t_ns: int) -> int | None:
        """The first number held that was taken at `t_ns` (node's UTC) or later, roughly.

        By whole batches, so up to one batch earlier; None if nothing so young is held.
        """
        young = [
            entry.seq_first
            for segment in self._segments
            if segment.t_ns_last >= t_ns
            for entry in segment.entries
            if entry.t_ns_last >= t_ns
        ]
        return min(young, default=None)

    def t_ns_near(self, seq: int, *, newest: bool) -> int | None:
        """Node's UTC of the newest frame held up to `seq`, or of the oldest from `seq` on.

        By whole batches; None if there is no such frame.
        """
        entries = [entry for segment in self._segments for entry in segment.entries]
        if newest:
            found = [entry for entry in entries if entry.seq_first <= seq]
            return max(found, key=lambda e: e.seq_last).t_ns_last if found else None
        found = [entry for entry in entries if entry.seq_last >= seq]
        return min(found, key=lambda e: e.seq_first).t_ns_first if found else None

    def last_seq_until(self, t_ns: int, *, at_least: int) -> int | None:
        """The last number taken at `t_ns` or before, if frames after `t_ns` are held too.

        None while the stream has not passed `t_ns`. Batches before `at_least` are not looked at;
        `at_least` - 1 if all of them were taken later.
        """
        entries = [e for s in self._segments for e in s.entries if e.seq_last >= at_least]
        if all(entry.t_ns_last <= t_ns for entry in entries):
            return None
        before = [entry for entry in entries if entry.t_ns_first <= t_ns]
        if not before:
            return at_least - 1
        newest = max(before, key=lambda entry: entry.seq_last)
        rows = sum(
            int(np.searchsorted(batch.t_ns, t_ns, side="right"))
            for batch in self.read(newest.seq_first, newest.seq_last)
        )
        return max(at_least - 1, newest.seq_first + rows - 1)

    def prune(self, before_t_ns: int, keep: Intervals) -> int:
        """Delete segments that end before `before_t_ns` and hold nothing of `keep`; how many.

        Raises:
            StorageError: a file cannot be deleted.
        """
        gone = 0
        for segment in self._segments[:-1]:  # never the one that is written
            if segment.t_ns_last < before_t_ns and not segment.holds_any(keep):
                with storage_errors(segment.path):
                    segment.path.unlink(missing_ok=True)
                self._segments.remove(segment)
                gone += 1
        if gone:
            self.held = Intervals(
                (e.seq_first, e.seq_last) for s in self._segments for e in s.entries
            )
        return gone

    def delete(self) -> None:
        """Close the journal and delete all of it."""
        self.close()
        self._segments = []
        self.held = Intervals()
        shutil.rmtree(self.folder, ignore_errors=True)

    def close(self) -> None:
        """Sync what is open and close it; a later append opens a new segment."""
        if self._file is not None:
            with storage_errors(self.folder):
                try:
                    os.fsync(self._file.fileno())
                finally:
                    self._file.close()
                    self._file = None

    def _index(self, segment: Segment) -> None:
        """Take in a segment that was there; what was disowned once may be in two of them."""
        new = []
        for entry in segment.entries:
            if self.held.missing(entry.seq_first, entry.seq_last).count == entry.frames:
                self.held.add(entry.seq_first, entry.seq_last)
                new.append(entry)
        segment.entries = new
        self._segments.append(segment)

    def _write(self, rows: FrameBatch, payload: bytes | None) -> None:
        payload = encode(rows, self._schema) if payload is None else payload
        first, t_ns = int(rows.seq[0]), int(rows.t_ns[0])
        if self._file is not None and (
            not self._tidy or t_ns - self._segments[-1].entries[0].t_ns_first >= SEGMENT_NS
        ):
            try:
                self.close()
            except StorageError as error:
                self._sync_failed = error  # whoever waits for these frames to be safe is told
        file = self._file if self._file is not None else self._begin(first)
        segment = self._segments[-1]
        self._tidy = False
        with storage_errors(segment.path):
            write_all(file, payload)
        self._tidy = True
        segment.entries.append(
            Entry(first, int(rows.seq[-1]), t_ns, int(rows.t_ns[-1]), self._end, len(payload))
        )
        self._end += len(payload)
        self.held.add(first, int(rows.seq[-1]))

    def _begin(self, seq_first: int) -> BinaryIO:
        header = self._schema.serialize().to_pybytes()
        # After a failed write the name may be taken by a file without a whole batch.
        path = self.folder / f"{seq_first:020d}{SUFFIX}"
        taken = 1
        while path.exists():
            path = self.folder / f"{seq_first:020d}-{taken}{SUFFIX}"
            taken += 1
        with storage_errors(path):
            file = path.open("xb", buffering=0)
            try:
                write_all(file, header)
                sync_folder(self.folder)
            except OSError:
                file.close()
                path.unlink(missing_ok=True)
                raise
        self._file, self._end = file, len(header)
        self._segments.append(Segment(path))
        return file
