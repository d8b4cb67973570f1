"""Journal of one stream on disk: Arrow IPC stream segments, each with an index beside it.

`<folder>/<first_seq>.arrows` begins with the schema message; each batch is appended as the bytes in
which it came. Appending does not wait for the disk; `sync` does, and only synced frames may be
promised. Opening a journal recovers its segments and cuts off incomplete batches. No number is
stored twice: a batch that is stored already is skipped.
"""

from __future__ import annotations

import errno
import shutil
import stat
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from devices.errors import DamagedFileError, FileFormatError, StorageError
from devices.frames import ArrayInfo, FrameBatch
from devices.words import printable
from storage.durable import make_folder, storage_errors
from storage.intervals import CORRUPT, NO_END, Intervals, Losses, union
from storage.journal import instants
from storage.journal.instants import Instants
from storage.journal.open_segments import OpenSegments
from storage.journal.reading import Batches, BatchReader
from storage.journal.segment import (
    SUFFIX,
    Segment,
    had_records,
    recover,
    set_aside_no_files,
    unread_of,
)
from storage.journal.segment_format import INDEX_SUFFIX, read_header
from storage.journal.stream_notes import StreamNotes
from storage.layout import FRAMES_MAX
from storage.run import RunReader
from storage.schema import array_info, wire_schema
from storage.wire import EncodedBatch, decode, encode

RING_NS = 600_000_000_000
"""Retention time of frames that no session needs, for pre-roll and for late starts."""
_WINDOW_FRAMES = 1 << 16
"""Frames whose index is in memory at once during a read."""


class Journal:
    """Frames of one stream (one `stream_id` of one node). One thread writes; any may read.

    Args:
        folder: the stream's own folder; created if absent.
        info: description of the stream's array.
        writes_later: `append` never waits for the disk. Appended batches wait in memory until they
            are synced or read; batches that the disk then refuses count as stored until `disown`.
    """

    def __init__(self, folder: Path, info: ArrayInfo, *, writes_later: bool = False) -> None:
        self.folder = folder
        self.info = info
        self.held = Intervals()
        """Numbers that were appended, synced or not."""
        self.lost = Losses()
        """Numbers that were or should have been stored, by the reason why they are not."""
        self.problems: list[str] = []
        """Damage found when the journal was opened, and how it was handled, as messages."""
        self._schema = wire_schema(info)
        self._segments: list[Segment] = []
        header = self._schema.serialize().to_pybytes()
        self._open = OpenSegments(folder, header, writes_later=writes_later)
        self._runs = RunReader(self._schema)
        self._instants = Instants(lambda seq, is_upper: self.t_ns_near(seq, newest=is_upper))
        with storage_errors(folder):
            make_folder(folder)
            self.problems += set_aside_no_files(folder)
            for path in sorted(folder.glob("*" + SUFFIX)):
                index = path.with_suffix(INDEX_SUFFIX)
                is_indexed = index.exists() and had_records(path, self._schema)
                segment, damaged = recover(path, self._schema)
                self.lost.add(damaged, CORRUPT)
                if segment is not None:
                    self._take_in(segment)
                elif is_indexed:  # else its process was killed just after creating it
                    self.problems.append(
                        printable(f"{path}: no frame in it is proven by its index")
                    )
            for path in folder.glob("*" + INDEX_SUFFIX):
                # A power cut may lose the name of a segment and keep that of its index. None of its
                # frames was promised then; but a person may have deleted it: set the index aside.
                if not path.with_suffix(SUFFIX).exists():
                    with suppress(OSError):
                        path.rename(unread_of(path))
        self.lost.found(self.held)

    @classmethod
    def open(cls, folder: Path, *, writes_later: bool = False) -> Journal:
        """Open an existing journal; its array's description is in its notes or segments.

        Raises:
            DamagedFileError: it has no readable segment.
            FileFormatError: another version wrote its notes.
            StorageError: it cannot be read.
        """
        problems: list[str] = []
        with storage_errors(folder):
            notes = StreamNotes.load_whole(folder, problems)
            info = notes.array_info if notes is not None else _described(folder)
        if info is None:
            what = "; ".join(("no readable journal segment", *problems))
            raise DamagedFileError(what, where=str(folder))
        journal = cls(folder, info, writes_later=writes_later)
        journal.problems[:0] = problems
        if notes is not None:
            journal.lost.add(Intervals(notes.damaged) - journal.held, CORRUPT)
        return journal

    @property
    def size_bytes(self) -> int:
        """Approximate size on disk."""
        return sum(segment.size_bytes for segment in self._segments)

    @property
    def is_open(self) -> bool:
        """True if a segment is open, or not closed yet."""
        return bool(self._open.paths)

    @property
    def is_closing(self) -> bool:
        """True if the next sync closes a segment."""
        return self._open.is_closing

    def misplaced(self, frames: FrameBatch) -> str:
        """Return a message if time would run back between `frames` and stored ones; else empty.

        Raises:
            StorageError: an index cannot be read.
        """
        with storage_errors(self.folder):
            return self._instants.misplaced(frames, self.held)

    def append(self, batch: FrameBatch, payload: bytes | None = None) -> Intervals:
        """Append the frames of `batch` that are not stored yet; return their numbers.

        Args:
            batch: frames, `seq` rising by one.
            payload: the batch as it came over the wire; None: it is encoded here.

        Raises:
            StorageError: the disk is full or not writable. The frames that could not be written do
                not count as stored.
        """
        first, last = int(batch.seq[0]), int(batch.seq[-1])
        new = self.held.missing(first, last)
        for a, b in new:
            if (a, b) == (first, last):  # the usual case, without the cost of views
                payload = encode(batch, self._schema) if payload is None else payload
                self._write(EncodedBatch.of(batch, payload))
            else:
                rows = batch.rows(a - first, b - first + 1)
                self._write(EncodedBatch.of(rows, encode(rows, self._schema)))
        return new

    def append_message(self, message: EncodedBatch) -> None:
        """Append a message that this machine has encoded, without decoding it.

        Raises:
            StorageError: as for `append`.
        """
        if self.held.missing(message.seq_first, message.seq_last) == message.numbers:
            self._write(message)
        else:
            self.append(decode(message.payload, self._schema), message.payload)

    def sync(self) -> None:
        """Return when all earlier batches are on the disk; may run in another thread.

        Raises:
            StorageError: the disk refused.
        """
        self._open.sync()

    def disown(self, doubtful: Intervals) -> None:
        """Remove batches within `doubtful`, unsynced or damaged, from the stored ones.

        In a closed segment they are removed from the index on disk, so that a later copy is the
        valid one after a restart.
        """
        written = self._open.paths
        for segment in self._segments:
            if not segment.held & doubtful:
                continue
            segment.disown(doubtful)
            if segment.path in written:
                segment.is_doubtful = True
            else:
                with suppress(StorageError, OSError):
                    segment.rewrite_index()
        self._segments = [segment for segment in self._segments if segment.held]
        self._recount()
        self._open.retire_all()

    def read(self, seq_first: int, seq_last: int) -> Iterator[FrameBatch]:
        """Yield the stored frames from `seq_first` to `seq_last`, in order, in pieces.

        Raises:
            DamagedFramesError: a batch on disk is damaged; the error has its numbers.
            StorageError: a segment cannot be read.
        """
        with BatchReader(self._runs) as reader:
            for batches in self._found(seq_first, seq_last):
                for frames in reader.frames(batches):
                    begin, end = np.searchsorted(frames.seq, (seq_first, seq_last + 1)).tolist()
                    yield frames.rows(begin, end)

    def messages(self, seq_first: int, seq_last: int) -> Iterator[EncodedBatch]:
        """Yield the complete batches with any of these frames, in order, as they came.

        Raises:
            DamagedFramesError: a batch on disk is damaged; the error has its numbers.
            StorageError: a segment cannot be read.
        """
        with BatchReader(self._runs) as reader:
            for batches in self._found(seq_first, seq_last):
                yield from reader.messages(batches)

    def first_seq_since(self, t_ns: int) -> int | None:
        """Return the first stored number at `t_ns` (node's UTC) or later, to a batch.

        It is up to one batch earlier; None if no stored frame is that young.
        """
        self._open.write()
        return instants.first_seq_since(self._segments, t_ns)

    def t_ns_near(self, seq: int, *, newest: bool) -> int | None:
        """Return the node's UTC of the newest frame up to `seq`, or of the oldest from `seq` on.

        To a batch; None if there is no such frame.
        """
        near = self.held.within(0, seq).last if newest else self.held.within(seq, NO_END).first
        if near is None:
            return None
        self._open.write()
        return instants.t_ns_near(self._segments, near, newest=newest)

    def last_seq_until(self, t_ns: int, *, at_least: int) -> int | None:
        """Return the last number at `t_ns` or before, if later frames are stored too.

        None while the stream has not passed `t_ns`. Batches before `at_least` are skipped;
        `at_least` - 1 if all others are later.
        """
        self._open.write()
        return instants.last_seq_until(self._segments, t_ns, at_least=at_least, read=self.read)

    def prune(self, before_t_ns: int, keep: Intervals) -> Intervals:
        """Delete segments that end before `before_t_ns` and have no number of `keep`.

        Returns:
            The deleted numbers.

        Raises:
            StorageError: a file cannot be deleted.
        """
        written = self._open.paths
        gone = Intervals()
        for segment in list(self._segments):
            if segment.path in written or segment.t_ns_last >= before_t_ns:
                continue
            if segment.held & keep:
                continue
            with storage_errors(segment.path):
                segment.delete()
            self._segments.remove(segment)
            gone = gone | segment.held
        if gone:
            self._recount()
        return gone

    def evict(self, keep: Intervals) -> Intervals:
        """Delete the oldest segment without a number of `keep`; return its numbers, if any.

        Raises:
            StorageError: it cannot be deleted.
        """
        for t_ns in sorted(segment.t_ns_last for segment in self._segments):
            if gone := self.prune(t_ns + 1, keep):
                return gone
        return Intervals()

    def delete(self) -> None:
        """Close the journal and delete its folder."""
        self._open.abandon()
        self._segments = []
        self.held = Intervals()
        shutil.rmtree(self.folder, ignore_errors=True)

    def retire(self) -> None:
        """Stop appending to the open segments: the next sync closes them."""
        self._open.retire_all()

    def close(self) -> None:
        """Sync and close the open segments; a later append opens a new one.

        Raises:
            StorageError: the disk refused.
        """
        self.retire()
        self.sync()

    def _take_in(self, segment: Segment) -> None:
        """Add a recovered segment; after an invalidation two segments may have equal numbers."""
        if segment.held & self.held:
            segment.disown(self.held)
        if segment.held:
            self._segments.append(segment)
            self.held = self.held | segment.held

    def _recount(self) -> None:
        self._instants.forget()
        self.held = union(segment.held for segment in self._segments)

    def _write(self, message: EncodedBatch) -> None:
        segment, numbers_ = self._open.append(message).segment, message.numbers
        if segment.held == numbers_:  # its first batch
            self._segments.append(segment)
        self.held.add(message.seq_first, message.seq_last)
        self._instants.note(message, self.held)
        self.lost.found(numbers_)

    def _found(self, seq_first: int, seq_last: int) -> Iterator[Batches]:
        """Yield batches with any of these frames, some ten thousand frames at a time."""
        at = max(0, seq_first - FRAMES_MAX)
        while (held := list(self.held.within(at, seq_last))) and held[0][0] <= seq_last:
            at = held[0][0]
            end = min(at + _WINDOW_FRAMES, seq_last + 1)
            self._open.write()
            found = []
            for segment in list(self._segments):
                if segment.held and segment.span[0] < end and segment.span[1] >= at:
                    try:
                        records = segment.records()
                    except StorageError as error:
                        if error.errno == errno.ENOENT and segment not in self._segments:
                            continue  # pruned meanwhile
                        raise
                    inside = (records["seq_first"] >= at) & (records["seq_first"] < end)
                    found.append((segment.path, records[inside]))
            yield Batches.of(found).since(seq_first)
            at = end


def _described(folder: Path) -> ArrayInfo | None:
    """Return the array description of the oldest readable segment; None if there is none."""
    for path in sorted(folder.glob("*" + SUFFIX)):
        with suppress(FileFormatError):
            schema = read_header(path)[0] if stat.S_ISREG(path.lstat().st_mode) else None
            if schema is not None:
                return array_info(schema, where=str(path))
    return None
